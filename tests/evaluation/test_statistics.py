"""Statistics against closed forms, and radius error at equal pull activity."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from cz_gym.evaluation import statistics
from cz_gym.evaluation.statistics import Resamples, cvar, differences, frontier, means, probability_of_improvement


def single(values):
    """Episodes of a controller without training seeds, one metric."""
    return np.asarray(values, float)[None, :, None]


def test_interval_of_a_mean_is_the_normal_one(rng):
    values = rng.normal(2.0, 0.5, 500)
    (estimate,) = means(single(values), Resamples.draw(500))
    half = 1.96 * values.std() / np.sqrt(500)
    assert estimate.mean == pytest.approx(values.mean())
    assert estimate.n == 500
    assert estimate.ci95 == pytest.approx((values.mean() - half, values.mean() + half), abs=0.06 * half)


def test_intervals_cover_the_truth_as_often_as_they_say(rng):
    resamples = Resamples.draw(100, count=1000)
    draws = rng.exponential(1.0, (1, 100, 400))
    covered = [estimate.ci95[0] <= 1.0 <= estimate.ci95[1] for estimate in means(draws, resamples) if estimate.ci95]
    assert len(covered) == 400
    assert np.mean(covered) == pytest.approx(0.94, abs=0.035)


def test_every_metric_and_controller_shares_its_resamples(rng):
    values = rng.normal(0.0, 1.0, 60)
    resamples = Resamples.draw(60)
    both = np.stack([values, 3.0 - 2.0 * values], axis=-1)[None]
    first, second = means(both, resamples)
    assert first.ci95 is not None
    assert second.ci95 == pytest.approx((3.0 - 2.0 * first.ci95[1], 3.0 - 2.0 * first.ci95[0]))
    (shift,) = differences(single(values - 0.1), single(values), resamples)
    assert shift.mean == pytest.approx(-0.1)
    assert shift.ci95 == pytest.approx((-0.1, -0.1))


def test_paired_difference_is_as_sharp_as_the_differences(rng):
    crystal, own = rng.normal(0.0, 5.0, 400), rng.normal(-0.2, 0.3, 400)
    (estimate,) = differences(single(crystal + own), single(crystal), Resamples.draw(400))
    half = 1.96 * own.std() / np.sqrt(400)
    assert estimate.ci95 == pytest.approx((own.mean() - half, own.mean() + half), abs=0.08 * half)


def test_one_deterministic_episode_has_no_interval():
    resamples = Resamples.draw(1)
    assert means(single([0.7]), resamples)[0] == (0.7, None, 1)
    assert differences(single([0.7]), single([0.9]), resamples)[0] == (pytest.approx(-0.2), None, 1)
    assert probability_of_improvement(np.array([[0.7]]), np.array([[0.9]]), resamples) == (1.0, None, 1)
    assert cvar(np.array([[0.7]]), resamples) == (pytest.approx(0.7), None, 1)


def test_training_seeds_carry_their_own_uncertainty(rng):
    """Two seeds at 0 and 1 on identical episodes: a resample's mean is 0, 1/2 or 1 with chances 1/4, 1/2, 1/4.

    Both sides of a difference are resampled on their own. Seeds that agree add nothing.
    """
    apart, resamples = np.stack([np.zeros((30, 1)), np.ones((30, 1))]), Resamples.draw(30)
    assert means(apart, resamples) == ((0.5, (0.0, 1.0), 30),)
    assert differences(apart, apart, resamples) == ((0.0, (-1.0, 1.0), 30),)
    values = rng.normal(size=(1, 30, 3))
    for one, five in zip(means(values, resamples), means(np.repeat(values, 5, axis=0), resamples), strict=True):
        assert five.mean == pytest.approx(one.mean)
        assert five.ci95 == pytest.approx(one.ci95)


def test_spread_over_seeds_and_episodes_adds_up(rng):
    """Seed effect plus episode effect: variances of the two resamplings add."""
    seeds, episodes = rng.normal(0.0, 1.0, 40), rng.normal(0.0, 3.0, 300)
    values = (seeds[:, None] + episodes[None])[:, :, None]
    (estimate,) = means(values, Resamples.draw(300))
    half = 1.96 * np.sqrt(seeds.var() / 40 + episodes.var() / 300)
    assert estimate.ci95 is not None
    assert np.diff(estimate.ci95)[0] == pytest.approx(2 * half, rel=0.06)


def test_probability_of_improvement_counts_wins_and_half_the_ties():
    ours, theirs = np.array([[0.1, 0.2, 0.3, 0.4]]), np.array([[0.2, 0.2, 0.2, 0.5]])
    estimate = probability_of_improvement(ours, theirs, Resamples.draw(4))
    assert estimate.mean == (1 + 0.5 + 0 + 1) / 4
    assert probability_of_improvement(theirs, ours, Resamples.draw(4)).mean == 1 - estimate.mean
    two_seeds = np.vstack([ours, theirs])
    assert probability_of_improvement(two_seeds, theirs, Resamples.draw(4)).mean == (estimate.mean + 0.5) / 2


def test_cvar_is_the_mean_of_the_worst_twentieth(rng):
    """If the share is no whole number of episodes, the last one counts in part; training seeds are pooled."""
    values = rng.permutation(np.arange(1.0, 101.0))[None]
    assert cvar(values, Resamples.draw(100)).mean == pytest.approx((96 + 97 + 98 + 99 + 100) / 5)
    few = np.arange(1.0, 31.0)[None]
    assert cvar(few, Resamples.draw(30)).mean == pytest.approx((30 + 0.5 * 29) / 1.5)
    assert cvar(few[:, :10], Resamples.draw(10)).mean == pytest.approx(10)
    seeds = np.stack([np.zeros(20), np.arange(20.0)])
    assert cvar(seeds, Resamples.draw(20)).mean == pytest.approx((19 + 18) / 2)


PAIRS = st.lists(st.tuples(st.floats(1e-4, 1.0), st.floats(1e-3, 10.0)), min_size=2, max_size=12)
FAMILY = tuple(f"member-{i}" for i in range(8))


def power_law(activity):
    return 0.01 * activity**-0.5


@given(PAIRS)
@example([(1e-4, 1.0), (0.00010000000000000002, 0.5), (1.0, 0.1)])
def test_a_frontier_goes_through_its_points_and_never_rises(pairs):
    try:
        curve = frontier(pairs)
    except ValueError:
        return
    for activity, rmse in zip(*curve, strict=True):
        assert curve.at(activity) == pytest.approx(rmse, rel=1e-9)
    between = np.geomspace(curve.activity[0], curve.activity[-1], 50)[1:-1]
    values = [curve.at(activity) for activity in between]
    assert np.all(np.diff(values) <= 1e-12)
    assert all(rmse >= curve.at(activity) * (1.0 - 1e-9) for activity, rmse in pairs if activity >= curve.activity[0])


def test_a_setting_beaten_in_both_is_left_out_and_more_activity_than_the_familys_need_not_be_used():
    curve = frontier([(0.01, 0.07), (0.02, 0.05), (0.03, 0.06)])
    np.testing.assert_array_equal(curve.activity, [0.01, 0.02])
    assert curve.at(5.0) == 0.05


@pytest.mark.parametrize("pairs", [[(0.01, 0.07)], [(0.01, 0.05), (0.02, 0.06)], [(0.0, 0.1), (0.1, 0.1)]])
def test_a_frontier_needs_two_settings_and_positive_numbers_and_ends_at_the_quietest(pairs):
    with pytest.raises(ValueError, match=r"frontier needs two|must be positive"):
        frontier(pairs)
    for activity in (0.009, 0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match=r"below the frontier's 0\.01"):
            frontier([(0.01, 0.07), (0.02, 0.05)]).at(activity)


def test_ratios_are_taken_at_each_controllers_own_activity():
    """Between the members of a family that is a power law, the curve is that law."""
    points = {name: (a, power_law(a)) for name, a in zip(FAMILY[:2], (0.005, 0.02), strict=True)}
    points |= {"agent": (0.01, 0.2), "quieter": (0.001, 0.4), "busier": (0.1, power_law(0.02) / 2.0)}
    assert statistics.ratios(points, FAMILY) == pytest.approx(
        {FAMILY[0]: 1.0, FAMILY[1]: 1.0, "agent": 2.0, "busier": 0.5}
    )


def drawn(activity, rmse, seeds=1, spread=0.1):
    random = np.random.default_rng(int(1e6 * activity))
    return np.array([activity, rmse]) * np.exp(spread * random.normal(size=(seeds, 60, 2)))


MEMBERS = {name: drawn(a, power_law(a)) for name, a in zip(FAMILY, np.geomspace(0.003, 0.03, 8), strict=True)}


def test_a_ratios_interval_holds_it_and_shrinks_with_the_spread():
    widths = []
    for spread in (0.2, 0.02):
        episodes = {**MEMBERS, "agent": drawn(0.01, 0.12, seeds=3, spread=spread)}
        found = statistics.intervals(episodes, FAMILY, Resamples.draw(60, 200))
        means = {name: tuple(values.mean(axis=(0, 1))) for name, values in episodes.items()}
        low, high = found["agent"]
        assert low < statistics.ratios(means, FAMILY)["agent"] < high
        assert found[FAMILY[2]] == pytest.approx((1.0, 1.0))
        widths.append(high - low)
    assert widths[1] < widths[0]


def test_an_agent_quieter_than_the_family_has_no_interval():
    assert "agent" not in statistics.intervals({**MEMBERS, "agent": drawn(0.001, 0.5)}, FAMILY, Resamples.draw(60, 50))
