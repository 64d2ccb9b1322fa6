"""Properties of every named controller of both environments, and common behaviour of those on "measured"."""

import math
import pickle
from dataclasses import replace
from functools import cache, reduce
from operator import or_

import numpy as np
import pytest
from gymnasium.error import InvalidAction
from hypothesis import given, settings
from hypothesis import strategies as st

from cz_gym import SCENARIOS, CzVectorEnv, Parameters
from cz_gym.baselines import CompensatedPID, Compensator, SeriesPID
from cz_gym.baselines.analysis import design_compensator
from cz_gym.baselines.lqg import PrivilegedLQG
from cz_gym.baselines.lqg_filter import NoiseModel, RingModel
from cz_gym.baselines.margins import margin_limits
from cz_gym.baselines.pid import FilteredPID, StandardPID, TemperatureLoop
from cz_gym.baselines.policy import Policy
from cz_gym.body.process import BODY
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.episodes.scenario import DriveReadings
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.spaces import MEASURED
from cz_gym.support.errors import CzError, map_arrays
from cz_gym.support.units import KILO, MM_PER_MIN
from cz_gym.tools.export.controllers import make_block
from cz_gym.tools.registry import CONTROLLERS, CRYSTAL_CONTROLLERS, KNOWN, find_controller, make_controller
from studies.paper.experiments import MODEL_I, MODEL_II
from tests.observed import PLAIN, actions_of, measured, observations

ALL = [(each, task) for task in (BODY, CRYSTAL) for each in KNOWN[task.name] if not each.slow]
SEEING = [(each, task) for each, task in ALL if not each.bound or each.observation == "measured"]
OTHER = {"parameters": Parameters(r_0=0.1), "control_interval": 2.0}


def by_name(cases):
    return pytest.mark.parametrize(("entry", "task"), cases, ids=[each.name for each, _ in cases])


def config_of(entry, task, scenario="randomized"):
    stage = {"stage": "crown"} if task == CRYSTAL else {}
    return make_config(scenario, None, entry.observation, action="direct", process=task, **stage)


def rows_of(config, steps=8):
    """Observations of three crystals whose drives move at random, sample by sample."""
    env, rng = CzVectorEnv.from_config(config, 3), np.random.default_rng(0)
    rows = [env.reset(seed=0)[0].copy()]
    rows += [env.step(rng.uniform(-0.1, 0.1, (3, 2)))[0].copy() for _ in range(steps - 1)]
    return rows


@by_name(ALL)
def test_a_batch_acts_as_single_crystals_do_and_no_memory_changes_in_place(entry, task):
    config = config_of(entry, task)
    policy, seen, together, alone, again = entry.make(config), rows_of(config), None, None, None
    copy = pickle.loads(pickle.dumps(policy))
    assert isinstance(policy, Policy)
    for rows in seen:
        before = together
        copies = None if before is None else map_arrays(np.copy, before)
        actions, together = policy.predict(rows, together)
        action, alone = policy.predict(rows[1], alone)
        repeated, again = copy.predict(rows, again)
        assert (actions.shape, actions.dtype, action.shape) == ((3, 2), np.float32, (2,))
        assert (np.abs(actions) <= 1.0).all()
        np.testing.assert_array_equal(repeated, actions)
        np.testing.assert_allclose(action, actions[1], rtol=1e-5, atol=1e-6)
        if before is not None:
            map_arrays(np.testing.assert_array_equal, before, copies)
    mixed, _ = policy.predict(seen[-1], together, np.array([True, False, True]))
    new, _ = policy.predict(seen[-1])
    going_on, _ = policy.predict(seen[-1], together)
    np.testing.assert_allclose(mixed[[0, 2]], new[[0, 2]], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(mixed[1], going_on[1], rtol=1e-5, atol=1e-6)
    assert entry.name in ("open-loop", "recipe") or np.abs(new - going_on).max() > 1e-6


@by_name([(each, BODY) for each in CONTROLLERS if each.name != "open-loop"])
def test_actions_are_for_the_environment_of_the_controller_alone(entry, task):
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
    anywhere = CompensatedPID(any_environment=True)
    assert anywhere.made_for is None
    env.step(anywhere.predict(measured())[0])


BAD = st.lists(st.sets(st.integers(0, len(MEASURED) - 1), min_size=1), min_size=1, max_size=4)
ROW = measured(ring_error=1e-5, r_ref=2e-4, r_ref_1min=2e-4, r_ref_5min=2e-4, T_1=0.1, v_p=1e-7, Q_H=50.0)


@by_name([(each, task) for each, task in SEEING if task == BODY])
@settings(max_examples=6, deadline=None)
@given(bad=BAD, value=st.sampled_from([math.nan, math.inf, -math.inf]), start=st.integers(0, 2))
def test_readings_that_are_not_finite_are_not_read(entry, task, bad, value, start):
    """A PID goes on as if the last readings had been repeated; an LQG forgets that it read less."""
    policy, lqg = entry.make(make_config(**PLAIN)), entry.name.startswith("lqg")
    rows = np.repeat(ROW[None], 3 + len(bad) + 60 * lqg, axis=0)
    usual = actions_of(policy, rows)
    for k, channels in enumerate(bad, start):
        rows[k, :, list(channels)] = value
    found = actions_of(policy, rows)
    assert np.isfinite(found).all()
    if start > 0:
        np.testing.assert_allclose(found[-1], usual[-1], atol=5e-3 if lqg else 1e-7)


@by_name([(each, task) for each, task in ALL if task == BODY and not each.bound])
def test_what_can_be_exported_says_so(entry, task):
    config = config_of(entry, task)
    if getattr(entry.make(config), "exportable", False):
        assert make_block(entry.name, config).controller == entry.make(config)
    else:
        with pytest.raises(CzError, match="cannot be exported"):
            make_block(entry.name, config)


def test_controllers_are_made_for_one_process():
    crystal, body = make_config(process=CRYSTAL, **PLAIN), make_config("randomized")
    assert make_controller("compensated", crystal).made_for == crystal.made_for
    for name, config, said in (
        ("compensated", body, "unknown controller 'compensated'"),
        ("paper", crystal, "unknown controller 'paper'; choose from recipe, ring-pid"),
    ):
        with pytest.raises(CzError, match=said):
            make_controller(name, config)
    with pytest.raises(CzError, match="was made for"):
        rollout(make_controller("compensated", crystal), body, [0])


def test_who_runs_on_a_puller_unless_controllers_are_named():
    runs = [each.name for each in CRYSTAL_CONTROLLERS if each.on_puller]
    assert runs == ["ring-pid-reduced", "compensated", "lqg-along", "true-radius"]
    assert find_controller("paper").on_puller


# Common behaviour on "measured" observations

TUNED = ("pid-conventional", "paper-filtered", "paper-tuned", "lqg")


@pytest.mark.parametrize("name", [*TUNED[:3], pytest.param(TUNED[3], marks=pytest.mark.slow)])
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


# Readings that are no numbers, and settings that are none


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


LIMITS = ("", "2", "2,30,2,1", "a,b,c", "0.5,30,2", "2,30,1", "nan,30,2")


def other_slots():
    PrivilegedLQG().for_episodes(make_config("randomized", **PLAIN), [1, 2]).predict(next(observations()))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: SeriesPID(K_p=-0.01), "K_p must be"),
        (lambda: SeriesPID(T_i=0.0), "T_i must be"),
        (lambda: SeriesPID(N=math.nan), "N must be"),
        (lambda: Compensator(fast=-1e-3), "fast must be"),
        (lambda: CompensatedPID(control_interval=0.0), "control_interval must be"),
        (lambda: FilteredPID(T_f=-1.0), "T_f must be"),
        (lambda: TemperatureLoop(T_i=0.0), "T_i must be"),
        (lambda: NoiseModel(slow_tau=0.0), "slow_tau must be"),
        (lambda: RingModel(latency=-5.0), "latency must be"),
        (lambda: StandardPID(1.0, 100.0, 100.0, 0.1).series(), "complex zeros"),
        (lambda: design_compensator(MODEL_II), "two stable"),
        (lambda: design_compensator(MODEL_I, -MODEL_I.poles[1]), "two stable"),
        (lambda: design_compensator(MODEL_I, 0.0), "cut"),
        (other_slots, "2 pullers are known, got 3 slots"),
        *((lambda text=text: margin_limits(text), "--margins") for text in LIMITS),
    ],
)
def test_what_no_controller_can_be_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# Readings of the drives that err

ERRING = {
    "scales": {"pull_scale": (1.03, 1.03), "heater_scale": (0.97, 0.97)},
    "offsets": {"pull_offset": (0.048 * MM_PER_MIN,) * 2, "heater_offset": (-0.4 * KILO,) * 2},
    "coarse and late": {"pull_resolution": 0.02 * MM_PER_MIN, "heater_resolution": 0.2 * KILO, "delay": 10.0},
}
ERRING["all"] = reduce(or_, ERRING.values())


@cache
def read_with(name, errors):
    """Metrics of a controller that was made for exact readings."""
    exact, erring = (
        make_config(replace(SCENARIOS["puller"], readings=DriveReadings(**values)), horizon=3600.0, **PLAIN)
        for values in ({}, ERRING.get(errors, {}))
    )
    return metrics(rollout(make_controller(name, exact), erring, range(6)))


@pytest.mark.parametrize("errors", ERRING)
@pytest.mark.parametrize("name", [pytest.param("lqg", marks=pytest.mark.slow), "lqg-at-0.02", "paper-tuned"])
def test_erring_readings_of_the_drives_lose_no_crystal(name, errors):
    """A power that read half a percent wrong lost every crystal of the LQGs when moves began at readings."""
    usual, found = read_with(name, "none"), read_with(name, errors)
    assert not found.failure_rate.any()
    assert found.rmse_observable_mm.mean() <= 1.2 * usual.rmse_observable_mm.mean()


def test_a_lasting_difference_between_setpoint_and_reading_is_shown_and_not_integrated():
    policy, state = make_controller("lqg", make_config("nominal", **PLAIN)), None
    for k in range(60):
        _, state = policy.predict(measured(Q_H=0.0 if k == 0 else state.asked[:, 1] + 1.0 * KILO), state)
    assert state.difference[0] == pytest.approx([0.0, 1.0 * KILO], rel=0.02, abs=1e-9)
    np.testing.assert_allclose(state.asked[0], 0.0, atol=1e-3)


def test_a_drive_that_does_not_follow_is_where_its_reading_says():
    policy, state = make_controller("lqg", make_config("nominal", **PLAIN)), None
    for k in range(120):
        _, state = policy.predict(measured(Q_H=0.0 if k == 0 else -8.0 * KILO), state)
    assert state.readings.Q_H[0] == pytest.approx(-8.0 * KILO)
    applied, _ = policy.applied(state.readings, state.asked, state.difference)
    assert applied[0, 1] < -8.0 * KILO + 1.1 * policy.tolerance[1]
