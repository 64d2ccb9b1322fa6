"""Named scenarios, refused numbers, hashes; series of disturbances from logs, one an episode."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cz_gym import SCENARIOS, CzEnv, Scenario
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Drift, Faults, Interface, Pullers, TemperatureRamp, to_csv
from cz_gym.episodes.scenarios import find_scenario, mix_of
from cz_gym.evaluation.protocol import find_case, user_case
from cz_gym.puller.file import find_puller
from cz_gym.support.errors import CzError

FROZEN = {
    "nominal": "470ebb0cf8fc46d8", "paper-ramp": "00726411751b722d", "reference-a": "c61db8d3195dde7b",
    "reference-b": "fafc6c06ed88de8b", "randomized": "28ec8d2bf14b3b7b", "hard": "f3b0f280a51eb76d",
    "sensor-fault": "a2ba81372aa15e66", "puller": "c0609b6094256346", "hot-zone": "ea4fb6000736f296",
    "only-recipe": "986d178b78f3b36e", "only-drift": "35df8d2d49bfbfbe", "only-interface": "8b4a530df4f47e75",
    "only-sensor": "bb58fef8179b8f19", "only-reference": "7e3a5668784daa66", "only-parameters": "6702460317bfa4ff",
    "puller-frames": "c2238e9f40904c19", "melt-layer": "d2a0b9ede38c1c76", "randomized-traced": "8a2bdc0f93627159",
}  # fmt: skip
MEMBERS = Scenario("plain").members


def changed(scenario, family, member, value):
    """The scenario with one number replaced, which may raise."""
    part = dataclasses.replace(getattr(scenario, family), **{member: value})
    return dataclasses.replace(scenario, **{family: part})


def test_contents_of_the_scenarios_are_frozen():
    """A changed scenario is another benchmark: change a hash here only together with the committed results."""
    assert {scenario.name: scenario.hash for scenario in SCENARIOS.values()} == FROZEN
    assert list(SCENARIOS) == list(FROZEN)
    with pytest.raises(dataclasses.FrozenInstanceError):
        SCENARIOS["nominal"].recipe = TemperatureRamp()


@pytest.mark.parametrize(("family", "member", "default"), MEMBERS)
def test_every_number_counts_in_the_hash(family, member, default):
    quantity = member.metadata["member"].quantity
    kind = type(default[0] if isinstance(default, tuple) else default)
    low, high = (kind(end * quantity.size) for end in (quantity.low, quantity.high))
    other = (low, high) if isinstance(default, tuple) else high
    base = SCENARIOS["nominal"]
    assert changed(base, family, member.name, other).hash != base.hash


@given(
    st.sampled_from(MEMBERS),
    st.sampled_from([math.nan, -math.inf, "much", None, (0.0,), (1.0, 0.0), (0.0, math.nan), (-2.0, -1.0), [0.0, 1.0]]),
)
def test_nonsense_is_refused_in_one_line(where, value):
    family, member, default = where
    if value == (-2.0, -1.0) and isinstance(default, tuple) and member.metadata["member"].quantity.holds(-1.0):
        return
    with pytest.raises(ValueError, match=member.name) as refusal:
        changed(SCENARIOS["nominal"], family, member.name, value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("family", "member", "value", "meant"),
    [
        ("faults", "flagged", (0.5, 1.0), ""), ("faults", "flagged", (2, 9), ""), ("faults", "unflagged", 0.5, ""),
        ("faults", "dropout", (0.0, 1.5), ""), ("pullers", "mix", (0.0, 1.5), ""), ("pullers", "melt_loss", 1.0, ""),
        ("sensor", "latency", 1e4, ""), ("sensor", "latency", -5.0, ""), ("sensor", "camera_noise", (0.0, 0.0021), ""),
        ("interface", "tau_fast", 0.0, ""), ("actuators", "pull_slew", -1.0, ""),
        ("actuators", "heater_dead_time", (0.0, 61.0), "within 0 to 60"),
        ("actuators", "heater_lag", (0.0, 2000.0), r"2 \(2000 ms\)"),
        ("actuators", "pull_window", 0.3, r"5e-06 \(0.3 mm/min\)"),
        ("actuators", "pull_slew", 0.3, r"8.33333e-08 \(0.3 mm/min2\)"),
        ("recipe", "rate", (-0.5, 0.5), r"-0.00833333 \(-0.5 K/min\)"),
        ("sensor", "rotation", (8.0, 15.0), r"0.133333 \(8 rpm\)"),
        ("sensor", "ripple", (0.0, 0.2), r"0.0002 \(0.2 mm\)"),
        ("pullers", "capillary", 3.0, r"0.03 \(3 %\)"),
    ],
)  # fmt: skip
def test_a_number_outside_its_range_is_refused_with_a_guess_at_the_unit_that_was_meant(family, member, value, meant):
    with pytest.raises(ValueError, match=rf"scenario 'nominal': {family}.{member}.*{meant}"):
        changed(SCENARIOS["nominal"], family, member, value)


def test_families_of_another_kind_no_name_and_freezes_that_do_not_fit_are_refused():
    long = Faults(flagged=(3, 3), flagged_duration=(3601.0, 3601.0))
    for arguments, said in (
        ({"drift": TemperatureRamp()}, "a Drift"),
        ({"name": ""}, "name"),
        ({"faults": long}, "do not fit"),
    ):
        with pytest.raises(ValueError, match=said):
            Scenario(**{"name": "mine", **arguments})


def test_equal_contents_have_equal_hashes():
    whole = Scenario("mine", Pullers(mix=(0, 1)), drift=Drift((-0.0, 2)), interface=Interface((1, 1)))
    same = Scenario("mine", Pullers(mix=(0.0, 1.0)), drift=Drift((0.0, 2.0)), interface=Interface((1.0, 1.0)))
    assert (whole == same, whole.hash) == (True, same.hash)


def test_models_set_the_share_of_conduction_and_a_scenario_has_two_names():
    given = {None: (0.0, 1.0), "I": (1.0, 1.0), "II": (0.0, 0.0), 0.25: (0.25, 0.25)}
    assert {model: mix_of(model, SCENARIOS["randomized"]) for model in given} == given
    assert find_scenario("unknown-puller") == find_scenario("puller") == SCENARIOS["puller"]
    assert find_case("unknown-puller") == find_case("puller")


TIME = np.array([0.0, 10.0, 30.0])
FIRST = TIME, np.array([0.0, 100.0, 300.0]), np.array([0.5, -0.5, 0.0])
SECOND = TIME, np.array([-50.0, -50.0, -50.0]), np.array([0.1, 0.1, 0.1])


@pytest.fixture
def place(tmp_path):
    path = tmp_path / "day.csv"
    path.write_text(to_csv([FIRST, SECOND]))
    return path


def met(env, seed, steps=9):
    """Load and fluctuation of each step, which it begins with."""
    env.reset(seed=seed)
    disturbances = []
    for _ in range(steps):
        env.step(np.zeros(2))
        slot = env.get_state().slot.slot
        disturbances.append((slot["Q_d"].item(), slot["dT_i"].item()))
    return np.array(disturbances).T


def test_each_episode_meets_one_series_drawn_by_its_seed(place):
    at = np.minimum(5.0 * np.arange(9), 30.0)
    expected = [[np.interp(at, TIME, column) for column in each[1:]] for each in (FIRST, SECOND)]
    for scenario in (place, str(place)):
        env = CzEnv(scenario, action="direct", observation="measured")
        found = [met(env, seed) for seed in range(8)]
        which = [next(k for k in (0, 1) if np.allclose(each, expected[k], atol=1e-12)) for each in found]
        assert set(which) == {0, 1}
        env.reset(seed=0)
        with pytest.raises(CzError, match="series of a log come with the environment"):
            env.reset(options={"scenario": "hard"})


def test_a_puller_of_one_s_own_keeps_them_and_other_contents_are_another_scenario(place):
    one, other = (path.with_name(f"{k}.csv") for k, path in enumerate((place, place)))
    one.write_text(to_csv([FIRST]))
    other.write_text(to_csv([SECOND]))
    scenario = user_case(str(one)).scenario
    config = make_config(one, puller=find_puller("germanium"))
    assert config.sole_scenario.series == scenario.series == find_scenario(one).series
    assert len(scenario.series) == 7
    assert len({find_scenario(path).hash for path in (one, other)} | {config.scenario.hash}) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b\n1,2\n", "must be a CSV file with columns series, time_s, load_W, fluctuation_K"),
        ("series,time_s,load_W,fluctuation_K\n", "there must be one"),
        ("series,time_s,load_W,fluctuation_K\n0,0,nan,1\n", "four finite numbers"),
        ("series,time_s,load_W,fluctuation_K\n0,5,1,1\n0,5,1,1\n", "the times of a series must begin"),
    ],
)
def test_a_file_that_holds_no_series_is_refused_in_one_line(text, said, tmp_path):
    (tmp_path / "day.csv").write_text(text)
    with pytest.raises(CzError, match=said) as refusal:
        make_config(tmp_path / "day.csv")
    assert "\n" not in str(refusal.value)
    with pytest.raises(CzError, match="must be a CSV file"):
        make_config(tmp_path / "absent.csv")
