"""Random streams are NumPy's own, and draws of an episode have the distributions that their scenario says."""

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from cz_gym import SCENARIOS, Parameters, Scenario, make_puller
from cz_gym.episodes import draw as draws
from cz_gym.episodes.draw import AVERAGING_ERROR, FREEZES, Episode, Factors, Stream, factors_from_key, new_series
from cz_gym.episodes.rng import WORDS, next_word, normal, seed_stream, two_normals, uniform
from cz_gym.episodes.scenario import Actuators, Faults, Interface, Reference, Sensor, TemperatureRamp, Told, Variation
from cz_gym.jit import kernel
from cz_gym.physics.plant import ripple

MM, MINUTE, SPAN = 1e-3, 60.0, 10800.0
WORD = st.integers(0, 2**64 - 1)
KEY = st.tuples(WORD, WORD)


def draw(scenario, key, grid=50, samples=50):
    found = SCENARIOS[scenario] if isinstance(scenario, str) else scenario
    series = new_series(grid, samples)
    for array in series:
        array[:] = 7.0
    return draws.episode_from_key(found, key, series), series


def keys(n):
    return [(i, 3 * i + 1) for i in range(n)]


WHOLE = dataclasses.replace(
    SCENARIOS["puller-frames"],
    name="whole",
    faults=SCENARIOS["sensor-fault"].faults,
    actuators=Actuators(heater_lag=(0.0, 10.0), heater_dead_time=(2.0, 5.0)),
    sensor=dataclasses.replace(SCENARIOS["puller-frames"].sensor, pyrometer_filter=(0.0, 20.0)),
)
"""All of puller-frames and sensor-fault at once, and a slow heater and pyrometer."""
DRAWN = {
    "recipe": {"recipe_duration": "duration", "recipe_start": "start"},
    "drift": {"drift_amount": "amount", "drift_duration": "duration", "drift_start": "start"},
    "reference": {"reference_duration": "duration", "reference_start": "start"},
    "sensor": {"ripple_amplitude": "ripple", "pyrometer_drift": "pyrometer_drift", "camera_sd": "camera_noise",
               "pyrometer_sd": "pyrometer_noise", "pyrometer_filter": "pyrometer_filter"},
    "faults": {"bias_drift_amount": "bias_drift", "bias_drift_duration": "bias_drift_duration", "dropout": "dropout"},
    "actuators": {"heater_lag": "heater_lag", "heater_dead_time": "heater_dead_time"},
}  # fmt: skip
"""Constants of an episode that are drawn between the ends of a member, by family."""


def test_constants_are_uniform_in_their_members_ranges_and_independent():
    episodes, columns = [draw(WHOLE, key)[0] for key in keys(2000)], []
    for family, members in DRAWN.items():
        for name, member in members.items():
            low, high = getattr(getattr(WHOLE, family), member)
            columns.append([(getattr(e, name) - low) / (high - low) for e in episodes])
    rates = np.array([e.recipe_amount / e.recipe_duration for e in episodes]) * MINUTE
    turns = np.array([(e.ripple_omega, e.ripple_phase) for e in episodes]) / (2 * math.pi)
    check_uniform(np.array([*columns, rates + 0.5, (turns[:, 0] * MINUTE - 8) / 7, turns[:, 1]]).T)
    moved = np.array([e.reference_amount for e in episodes if e.reference_amount != 0.0])
    check_uniform(0.5 + 0.5 * moved[:, None] / (2.5 * MM))
    assert len(moved) / 2000 == pytest.approx(0.5, abs=0.045)
    offsets = np.abs([e.ring_offset for e in episodes])
    assert 0.35 * MM < offsets.max() <= 0.4 * MM
    assert stats.kstest([e.r_c_start / (0.2 * MM) for e in episodes], "norm").pvalue > 1e-3


def test_a_slow_heater_and_pyrometer_change_no_other_draw():
    quick = dataclasses.replace(WHOLE, actuators=Actuators(), sensor=SCENARIOS["puller-frames"].sensor)
    assert not dataclasses.replace(Scenario("slow"), actuators=WHOLE.actuators).deterministic
    for key in keys(5):
        one, other = draw(WHOLE, key), draw(quick, key)
        assert one[0].heater_dead_time > 2.0
        assert same((one[0]._replace(heater_lag=0.0, heater_dead_time=0.0, pyrometer_filter=0.0), one[1]), other)


@pytest.mark.parametrize("revolutions", [0.3, 1.0, 1.5, 4.2])
def test_an_averaged_ring_has_the_mean_of_its_frames(revolutions):
    """Against sums over 20,000 frames; the window is that of the episode's own stream, and no other draw changes."""
    sensor = dataclasses.replace(SCENARIOS["puller"].sensor, averaging=revolutions)
    averaged = dataclasses.replace(SCENARIOS["puller"], sensor=sensor)
    for key in keys(5):
        frame, mean = draw("puller-frames", key)[0], draw(averaged, key)[0]
        stream = np.random.PCG64(np.random.SeedSequence(key, spawn_key=(draws.stream_number(Stream.TOLD),)))
        error = np.random.Generator(stream).standard_normal(3)[2]
        window = revolutions * (1.0 + AVERAGING_ERROR * error) * 2.0 * math.pi / frame.ripple_omega
        taken = np.array([0.0, 5.0, 1234.0])
        before = taken[:, None] - window * (np.arange(20_000) + 0.5) / 20_000
        np.testing.assert_allclose(ripple(taken, mean), ripple(before, frame).mean(axis=1), atol=1e-12)
        kept = {"ripple_amplitude": 0.0, "ripple_phase": 0.0}
        assert mean._replace(**kept) == frame._replace(**kept)
    if revolutions == 1.0:
        assert max(draw(averaged, key)[0].ripple_amplitude for key in keys(200)) < 0.02 * MM


def test_told_values_err_as_said_and_change_no_other_draw():
    exact = dataclasses.replace(SCENARIOS["hot-zone"], told=Told())
    drawn = [draw("hot-zone", key)[0] for key in keys(1000)]
    errors = np.array([(each.told_power, each.told_temperature) for each in drawn]) / (1000.0, 2.0)
    for error in errors.T:
        assert stats.kstest(error, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(errors.T)[0, 1]) < 0.1
    for key, one in zip(keys(20), drawn, strict=False):
        assert one._replace(told_power=0.0, told_temperature=0.0) == draw(exact, key)[0]


@given(KEY)
def test_freezes_last_as_designed_and_are_disjoint(key):
    _, series = draw("sensor-fault", key)
    lengths = series.freezes[:, 1] - series.freezes[:, 0]
    flagged = lengths[: FREEZES - 1]
    assert 1 <= np.count_nonzero(flagged) <= 3
    assert np.all((flagged[flagged > 0] >= 30) & (flagged[flagged > 0] <= 180 + 1e-9))
    assert 30 <= lengths[-1] <= 60 + 1e-9
    windows = sorted(window.tolist() for window in series.freezes if window[1] > 0)
    assert windows[0][0] >= 0
    assert windows[-1][1] <= SPAN
    assert all(before[1] <= after[0] for before, after in pairwise(windows))


def felt(scenario, key):
    """A draw without the numbers that act on nothing."""
    e, series = draw(scenario, key)
    if not e.ripple_amplitude:
        e = e._replace(ripple_phase=0.0)
    if not e.bias_drift_amount:
        e = e._replace(bias_drift_start=0.0)
    return e, series


def same(one, other):
    equal = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one[1], other[1], strict=True))
    return one[0] == other[0] and equal


BESIDE = dataclasses.replace(
    Scenario("deterministic"),
    recipe=TemperatureRamp(duration=(50.0, 50.0)),
    reference=Reference(1.0, (1e-3, 1e-3), (50.0, 50.0)),
    sensor=Sensor(outlier_sd=1e-4, rotation=(0.1, 0.1)),
    faults=Faults(flagged_duration=(50.0, 50.0), unflagged_duration=(50.0, 50.0)),
)
"""Every episode is the same, but a member that is random takes effect."""


@pytest.mark.parametrize("spread", [0.0, 0.5])
@pytest.mark.parametrize(("family", "member"), [each[:2] for each in BESIDE.members])
def test_every_member_says_whether_it_is_random(family, member, spread):
    """A scenario called deterministic draws the same episode for every key; a member without that information fails."""
    says, whole = member.metadata["member"], isinstance(np.ravel(member.default)[0].item(), int)
    high = says.quantity.high if whole else min(0.5 * says.quantity.high * says.quantity.size, 100.0)
    low = high if not spread else 0 if whole else spread * high
    value = (low, high) if isinstance(member.default, tuple) else low if says.draw is Variation.CHANCE else high
    part = dataclasses.replace(getattr(BESIDE, family), **{member.name: value})
    scenario = dataclasses.replace(BESIDE, **{family: part})
    random = says.draw in (Variation.NONZERO, Variation.CHANCE) or (says.draw is Variation.RANGE and low != high)
    assert scenario.deterministic is not random
    drawn = [
        (factors_from_key(scenario, part.mix, key) if family == "pullers" else (), felt(scenario, key))
        for key in keys(12)
    ]
    equal = all(one[0] == drawn[0][0] and same(one[1], drawn[0][1]) for one in drawn)
    assert equal is scenario.deterministic or (equal and "flagged_duration" in member.name)


@pytest.mark.parametrize("name", list(SCENARIOS))
def test_a_longer_horizon_extends_a_draw_and_never_changes_it(name):
    short, long = draw(name, (8, 9), 100, 90), draw(name, (8, 9), 400, 2000)
    assert short[0] == long[0]
    np.testing.assert_array_equal(short[1].interface, long[1].interface[:100])
    np.testing.assert_array_equal(short[1].noise, long[1].noise[:90])
    np.testing.assert_array_equal(short[1].freezes, long[1].freezes)


def test_families_share_no_random_number():
    key = (11, 12)
    whole, series = draw("randomized", key)
    shared = {"recipe": "recipe_", "drift": "drift_", "reference": "reference_"}
    for family, prefix in shared.items():
        alone, _ = draw(f"only-{family}", key)
        fields = [name for name in Episode._fields if name.startswith(prefix)]
        assert fields
        assert [getattr(alone, name) for name in fields] == [getattr(whole, name) for name in fields]
    np.testing.assert_array_equal(draw("only-interface", key)[1].interface, series.interface)
    np.testing.assert_array_equal(draw("only-sensor", key)[1].noise, series.noise)
    alone, _ = draw("only-parameters", key)
    assert alone.r_c_start == whole.r_c_start
    assert alone.drift_amount == 0.0
    factors = [factors_from_key(SCENARIOS[name], (0.0, 1.0), key) for name in ("only-parameters", "randomized")]
    assert factors[0] == factors[1]


def test_interface_fluctuation_is_two_stationary_processes():
    scenario = Scenario("mine", interface=Interface(sd=(1.0, 1.0)))
    runs = np.array([draw(scenario, key, grid=320)[1].interface for key in keys(3000)])
    for start in (0, 150):
        for lag in (0, 1, 6, 40, 156):
            product = runs[:, start] * runs[:, start + lag]
            expected = math.exp(-5 * lag / 30) + math.exp(-5 * lag / 780)
            error = product.std() / math.sqrt(len(runs))
            assert product.mean() == pytest.approx(expected, abs=4 * error)
    assert stats.kstest(runs[:, 100] / math.sqrt(2), "norm").pvalue > 1e-3


def test_factors_are_uniform_and_those_of_hot_zones_log_uniform_on_the_same_crystals():
    hot_zone, randomized = (
        np.array([factors_from_key(SCENARIOS[name], (0.0, 1.0), key) for key in keys(2000)])
        for name in ("hot-zone", "randomized")
    )
    assert (randomized[:, 7:10] == 1.0).all()
    assert (randomized[:, 10:] == 0.0).all()
    widths, middle = np.array([0.5, 0.03, *[0.1] * 5]), np.array([0.5, *[1.0] * 6])
    check_uniform(0.5 + 0.5 * (randomized[:, :7] - middle) / widths)
    np.testing.assert_array_equal(hot_zone[:, :3], randomized[:, :3])
    slow, quick = draw("hot-zone", (5, 6))[0], draw("randomized", (5, 6))[0]
    own = {name: getattr(slow, name) for name in ("heater_lag", "pyrometer_filter", "told_power", "told_temperature")}
    assert slow == quick._replace(**own)
    assert 0.0 < slow.heater_lag < 10.0
    assert 0.0 < slow.pyrometer_filter < 20.0
    low = np.log([0.75] * 4 + [0.5, 0.5, 0.7])
    high = np.log([1.33] * 4 + [2.0, 2.0, 1.4])
    check_uniform(np.c_[(np.log(hot_zone[:, 3:10]) - low) / (high - low), hot_zone[:, 10] / 8e-4])


def check_uniform(columns):
    """Each column is uniform in [0, 1], and independent of the others."""
    for column in columns.T:
        assert stats.kstest(column, stats.uniform().cdf).pvalue > 1e-3
    assert np.abs(np.corrcoef(columns.T) - np.eye(columns.shape[1])).max() < 0.1


def test_what_happens_by_chance_has_its_probability_and_its_distribution():
    sensor, faults = Sensor(outlier_probability=0.02, outlier_sd=1e-3), Faults(dropout=(0.03, 0.03))
    camera = draw(Scenario("mine", sensor=sensor), (3, 4), samples=100_000)[1].noise[:, 0]
    hit = camera[camera != 0]
    assert len(hit) == pytest.approx(2000, abs=4 * math.sqrt(2000))
    assert stats.kstest(hit / 1e-3, "norm").pvalue > 1e-3
    camera = draw(Scenario("mine", faults=faults), (3, 4), samples=50_000)[1].noise[:, 0]
    assert np.isnan(camera).mean() == pytest.approx(0.03, abs=4 * math.sqrt(0.03 / 50_000))
    scenario = Scenario("mine", faults=Faults(flagged=(1, 1), flagged_duration=(100.0, 100.0)))
    starts = [draw(scenario, key)[1].freezes[0, 0] for key in keys(1000)]
    assert stats.kstest(starts, stats.uniform(0, SPAN - 100).cdf).pvalue > 1e-3


def test_drawn_factors_scale_the_parameters_of_the_puller():
    q, factors = Parameters(), Factors(0.3, 1.02, 1.1, 0.9, 1.05, 0.95, 1.08)
    p, nominal = make_puller(draws.randomised(q, factors), factors.lam), make_puller(q)
    assert p.a / nominal.a == pytest.approx(1.02)
    assert (p.k_l, p.kappa_12, p.G_1a, p.G_2b) == pytest.approx((62 * 1.1, 2.8e-8 * 0.9, 30 * 1.05, 200 * 0.95))
    assert p.emission / nominal.emission == pytest.approx(1.08)
    assert (p.lam, p.r_0, p.v_0, p.C_1, p.T_b_0) == (0.3, nominal.r_0, nominal.v_0, nominal.C_1, nominal.T_b_0)


EDGE_WORD = st.one_of(st.integers(0, 2**64 - 1), st.sampled_from([0, 1, 2**32 - 1, 2**32, 2**64 - 1]))


@kernel
def fill(key, number, words, uniforms, normals):
    s = np.zeros(WORDS, np.uint64)
    seed_stream(s, key, number)
    for i in range(words.size):
        words[i] = next_word(s)
    for i in range(uniforms.size):
        uniforms[i] = uniform(s)
    half = normals.size // 2
    for i in range(half):
        normals[i] = normal(s)
    for i in range(half, normals.size, 2):
        normals[i], normals[i + 1] = two_normals(s)
    return s


def numpys(key, number):
    return np.random.PCG64(np.random.SeedSequence(key, spawn_key=(number,)))


@settings(max_examples=200)
@given(st.tuples(EDGE_WORD, EDGE_WORD), st.sampled_from(list(Stream)))
def test_streams_are_numpys_own_bit_for_bit(key, number):
    words, uniforms, normals = np.zeros(3, np.uint64), np.zeros(5), np.zeros(52)
    end = fill(np.array(key, np.uint64), int(number), words, uniforms, normals)
    random = np.random.Generator(numpys(key, number))
    np.testing.assert_array_equal(words, random.bit_generator.random_raw(3))
    np.testing.assert_array_equal(uniforms, random.random(5))
    np.testing.assert_array_equal(normals, random.standard_normal(52))
    state = random.bit_generator.state["state"]
    assert (int(end[0]) << 64 | int(end[1]), int(end[2]) << 64 | int(end[3])) == (state["state"], state["inc"])


@pytest.mark.parametrize("key", [(1, 2), (2**63, 5)])
def test_normals_agree_through_every_branch_of_the_ziggurat(key):
    """200,000 numbers visit the tail beyond the last layer some fifty times."""
    normals = np.zeros(200_000)
    fill(np.array(key, np.uint64), 4, np.zeros(0, np.uint64), np.zeros(0), normals)
    expected = np.random.Generator(numpys(key, 4)).standard_normal(normals.size)
    assert np.count_nonzero(np.abs(expected) > 3.6541528853610088) > 20
    np.testing.assert_array_equal(normals, expected)
