"""Common behaviour of the controllers on "measured" observations: batches, memories, shapes, control intervals."""

import math
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.error import InvalidAction
from hypothesis import given, settings
from hypothesis import strategies as st

from cz_gym import CzVectorEnv, Parameters
from cz_gym.baselines import CompensatedPID, Compensator, SeriesPID
from cz_gym.baselines.lqg_filter import NoiseModel, RingModel
from cz_gym.baselines.pid import FilteredPID, TemperatureLoop
from cz_gym.baselines.policy import Policy
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.spaces import MEASURED
from cz_gym.support.errors import CzError
from cz_gym.support.names import map_arrays
from cz_gym.tools.registry import CONTROLLERS, find_controller, make_controller
from tests.observed import PLAIN, actions_of, measured, observations

CASES = [(entry.name, "randomized") for entry in CONTROLLERS if entry.observation == "measured" and not entry.slow]
TUNED = ("pid-conventional", "paper-filtered", "paper-tuned", "lqg")
CASES += [("paper-tuned", "puller"), ("lqg", "puller")]


@pytest.fixture(scope="module")
def seen():
    return list(observations(steps=8))


@pytest.mark.parametrize(("name", "scenario"), CASES)
def test_slots_do_not_disturb_each_other_and_begin_anew(name, scenario, seen):
    policy, together, alone = make_controller(name, make_config(scenario, **PLAIN)), None, None
    assert isinstance(policy, Policy)
    for rows in seen:
        before = together
        copies = None if before is None else map_arrays(np.copy, before)
        actions, together = policy.predict(rows, together)
        action, alone = policy.predict(rows[1], alone)
        assert (actions.shape, actions.dtype, action.shape) == ((3, 2), np.float32, (2,))
        np.testing.assert_allclose(action, actions[1], rtol=1e-5, atol=1e-6)
        if before is not None:
            map_arrays(np.testing.assert_array_equal, before, copies)
    mixed, _ = policy.predict(seen[-1], together, np.array([True, False, True]))
    new, _ = policy.predict(seen[-1])
    going_on, _ = policy.predict(seen[-1], together)
    np.testing.assert_allclose(mixed[[0, 2]], new[[0, 2]], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(mixed[1], going_on[1], rtol=1e-5, atol=1e-6)
    assert name == "open-loop" or np.abs(new - going_on).max() > 1e-6


@pytest.mark.parametrize("name", TUNED)
def test_every_control_interval_holds_the_radius_alike(name):
    configs = [make_config("randomized", control_interval=dt, horizon=5400.0, **PLAIN) for dt in (5.0, 2.0, 10.0)]
    found = [metrics(rollout(make_controller(name, config), config, range(8))) for config in configs]
    assert not np.any([m.failure_rate for m in found])
    usual, *others = (m.rmse_mm.mean() for m in found)
    assert others == pytest.approx([usual, usual], rel=0.25)


@pytest.mark.parametrize("name", TUNED)
def test_a_controller_without_disturbances_stays_where_it_is(name):
    config = make_config("nominal", control_interval=2.0, horizon=3600.0, **PLAIN)
    assert metrics(rollout(make_controller(name, config), config, [0])).max_error_mm[0] < 1e-3


# What a controller was made for

OTHER = {"parameters": Parameters(r_0=0.1), "control_interval": 2.0}


@pytest.mark.parametrize("name", [entry.name for entry in CONTROLLERS if entry.name != "open-loop"])
def test_actions_are_for_the_environment_of_the_controller_alone(name):
    entry = find_controller(name)
    config = make_config("nominal", observation=entry.observation, action="direct", horizon=60.0, **OTHER)
    policy = entry.make(config)
    if hasattr(policy, "for_episodes"):
        policy = policy.for_episodes(config, np.arange(1))
    env = CzVectorEnv.from_config(config, 1)
    action, _ = policy.predict(env.reset(seed=0)[0])
    assert policy.made_for == config.made_for
    env.step(action)
    for option in OTHER:
        other = CzVectorEnv.from_config(replace(config, **{option: getattr(make_config(**PLAIN), option)}), 1)
        other.reset(seed=0)
        with pytest.raises(InvalidAction, match="was made for"):
            other.step(action)


@pytest.mark.parametrize("option", OTHER)
def test_a_controller_can_be_made_for_another_environment_or_for_any(option):
    env = CzVectorEnv(1, scenario="nominal", **{**PLAIN, option: OTHER[option]})
    observation, _ = env.reset(seed=0)
    own = CompensatedPID().for_config(env.config)
    assert own.settings[option] == OTHER[option]
    anywhere = CompensatedPID(any_environment=True)
    assert anywhere.made_for is None
    for accepted in (own, anywhere):
        env.step(accepted.predict(observation)[0])


# Readings that are no numbers, and settings that are none

READERS = [entry.name for entry in CONTROLLERS if entry.observation != "state"]
BAD = st.lists(st.sets(st.integers(0, len(MEASURED) - 1), min_size=1), min_size=1, max_size=4)
ROW = measured(ring_error=1e-5, r_ref=2e-4, r_ref_1min=2e-4, r_ref_5min=2e-4, T_1=0.1, v_p=1e-7, Q_H=50.0)


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=6, deadline=None)
@given(bad=BAD, value=st.sampled_from([math.nan, math.inf, -math.inf]), start=st.integers(0, 2))
def test_readings_that_are_not_finite_are_not_read(name, bad, value, start):
    """A PID goes on as if the last readings had been repeated; an LQG forgets that it read less."""
    policy = make_controller(name, make_config(**PLAIN))
    rows = np.repeat(ROW[None], 3 + len(bad) + 60 * name.startswith("lqg"), axis=0)
    usual = actions_of(policy, rows)
    for k, channels in enumerate(bad, start):
        rows[k, :, list(channels)] = value
    found = actions_of(policy, rows)
    assert np.isfinite(found).all()
    if start > 0:
        np.testing.assert_allclose(found[-1], usual[-1], atol=5e-3 if name.startswith("lqg") else 1e-7)


@pytest.mark.parametrize("name", ["paper", "paper-tuned", "lqg"])
@pytest.mark.parametrize("garbage", [math.nan, 0.0, 9.0])
def test_a_ring_that_is_not_valid_is_not_read(name, garbage):
    """It counts as the last valid ring, also while the reference moves."""
    rows = np.stack([measured(ring_error=3e-5 - r_ref, r_ref=r_ref) for r_ref in np.linspace(0.0, 1e-4, 6)])
    held = rows.copy()
    held[2:4, :, 1] = rows[2:4, :, 1] = 0.0
    rows[2:4, :, 0] = garbage
    policy = make_controller(name, make_config(**PLAIN))
    np.testing.assert_allclose(actions_of(policy, rows), actions_of(policy, held), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        (SeriesPID, {"K_p": -0.01}),
        (SeriesPID, {"T_i": 0.0}),
        (SeriesPID, {"N": math.nan}),
        (Compensator, {"fast": -1e-3}),
        (CompensatedPID, {"control_interval": 0.0}),
        (FilteredPID, {"T_f": -1.0}),
        (TemperatureLoop, {"T_i": 0.0}),
        (NoiseModel, {"slow_tau": 0.0}),
        (RingModel, {"latency": -5.0}),
    ],
)
def test_impossible_settings_are_refused_at_once(kind, wrong):
    (name,) = wrong
    with pytest.raises(CzError, match=f"{name} must be"):
        kind(**wrong)
