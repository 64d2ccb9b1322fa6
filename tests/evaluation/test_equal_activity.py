"""Radius error at equal pull activity: interpolation along a family's frontier, and its bootstrap intervals."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from cz_gym.evaluation.statistics import Resamples, frontier, intervals, ratios

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
    assert ratios(points, FAMILY) == pytest.approx({FAMILY[0]: 1.0, FAMILY[1]: 1.0, "agent": 2.0, "busier": 0.5})


def drawn(activity, rmse, seeds=1, spread=0.1):
    random = np.random.default_rng(int(1e6 * activity))
    return np.array([activity, rmse]) * np.exp(spread * random.normal(size=(seeds, 60, 2)))


MEMBERS = {name: drawn(a, power_law(a)) for name, a in zip(FAMILY, np.geomspace(0.003, 0.03, 8), strict=True)}


def test_a_ratios_interval_holds_it_and_shrinks_with_the_spread():
    widths = []
    for spread in (0.2, 0.02):
        episodes = {**MEMBERS, "agent": drawn(0.01, 0.12, seeds=3, spread=spread)}
        found = intervals(episodes, FAMILY, Resamples.draw(60, 200))
        means = {name: tuple(values.mean(axis=(0, 1))) for name, values in episodes.items()}
        low, high = found["agent"]
        assert low < ratios(means, FAMILY)["agent"] < high
        assert found[FAMILY[2]] == pytest.approx((1.0, 1.0))
        widths.append(high - low)
    assert widths[1] < widths[0]


def test_an_agent_quieter_than_the_family_has_no_interval():
    assert "agent" not in intervals({**MEMBERS, "agent": drawn(0.001, 0.5)}, FAMILY, Resamples.draw(60, 50))
