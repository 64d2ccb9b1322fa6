"""Derivatives of a step: against differences of the environment's own steps, through failures, on the plant alone."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded

from cz_gym import CzVectorEnv
from cz_gym.body.process import BODY
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.engine.kernels import model_of
from cz_gym.engine.tangents import STATES, DifferentiableBatch, rk4_by, rows, smooth, work_shape
from cz_gym.episodes.scenario import Actuators, DriveReadings
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.physics.meniscus import HURLE, hurle_slope
from cz_gym.physics.plant import Disturbance, State, make_puller, rk4
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.process import Inputs, jacobian
from cz_gym.spaces import ACTIONS, MEASURED
from tests.observed import PLAIN

STEPS = {
    "r_c": 1e-7, "h_c": 1e-7, "T_1": 1.0, "T_2": 1.0, "T_b": 1e-2, "v_p": 1e-9, "v_p_mean": 1e-7, "Q_H": 100.0,
    "a": 1e-3, "L": 1e-6, "A_s": 1e-5, "M_s": 1e-2, "N": 1e-4, "v_p_nominal": 1e-9, "Q_H_nominal": 100.0,
}  # fmt: skip
"""Step of the finite differences, for each number."""


def moved(batch, slots, frames, actions, column, by):
    """State and cost after a step from a state, or action, of which one number was moved."""
    memory, actions, states = batch._batch.memory, actions.copy(), smooth(batch.config.process)
    memory.slots[:], memory.frames[:] = slots, frames
    name = states[column] if column < len(states) else ""
    if column >= len(states):
        actions[:, column - len(states)] += by
    elif name in batch.config.process.State._fields:
        memory.slots["x"][name] += by
    elif name.startswith("v_p") or name.endswith("nominal"):
        memory.slots[name] += by
    else:
        memory.slots["Q_H"] += by
        memory.slots["Q_H_slewed"] += by
    batch._state, batch.grows = batch._now(), np.ones(batch.num_envs, np.bool_)
    step = batch.step(actions)
    return np.concatenate([step.state, step.cost], axis=1), step


LATE = replace(RANDOMIZED, sensor=replace(RANDOMIZED.sensor, latency=1.0))
"""A camera whose frame, at an interval of 2 s, is now and then of the grid point inside the step."""


WHOLE = {"process": CRYSTAL, "stage": {"crown": 2, "body": 1, "tail": 1}}
ALONG = (("randomized", "rate", 5.0, 40), ("sensor-fault", "rate", 5.0, 40), ("randomized", "smooth", 3.0, 42))
"""Whole crystals, whose derivatives take two minutes to compile."""


@pytest.mark.parametrize(
    ("scenario", "action", "interval", "steps", "what"),
    [
        *((scenario, action, 5.0, 40, {}) for scenario in ("randomized", "sensor-fault") for action in ACTIONS),
        *(("randomized", "smooth", interval, 42, {}) for interval in (2.0, 3.0)),
        *((LATE, "smooth", 2.0, steps, {}) for steps in (42, 43)),
        *(pytest.param(*along, WHOLE, marks=pytest.mark.slow) for along in ALONG),
    ],
)
def test_derivatives_are_those_of_the_steps(scenario, action, interval, steps, what):
    """Of state, cost, and the observation after the step, which is rounded to float32 and, the weight, to 0.01 kg."""
    n, random = 24, np.random.default_rng(0)
    config = make_config(scenario, action=action, observation="measured", control_interval=interval, **what)
    batch, states = DifferentiableBatch(config, n), smooth(config.process)
    weighs = [channel.name == "weight" for channel in config.process.measured]
    batch.reset(range(n))
    gain = 0.02 if action == "rate" else 0.1
    for _ in range(steps):
        batch.step(gain * random.normal(size=(n, 2)))
    memory, actions = batch._batch.memory, gain * random.normal(size=(n, 2))
    slots, frames = memory.slots.copy(), memory.frames.copy()
    _, step = moved(batch, slots, frames, actions, 0, 0.0)
    assert step.grows.all()
    shown = batch.measured_by_state @ step.jacobian[:, : len(states)]
    for column in range(len(states) + 2):
        name = states[column] if column < len(states) else "a"
        if name in ("ring", "reading", "stop"):
            continue
        by = STEPS[name] * ((5.0 / interval) ** 3 if name == "Q_H" else 1.0)  # power moves the radius by dt^3
        (ahead, more), (behind, less) = (moved(batch, slots, frames, actions, column, sign * by) for sign in (1, -1))
        found, expected = step.jacobian[:, :, column], (ahead - behind) / (2.0 * by)
        rounding = 2e-15 * np.abs(ahead) / by
        rounding[:, states.index("v_p_mean")] = rounding[:, states.index("v_p")]
        rounding[:, len(states) :] = 3e-14 / by  # costs are of small errors, differences of radii
        off = np.abs(found - expected) > 2e-5 * np.abs(expected).max(axis=0) + rounding
        assert not off.any(), (name, np.array(rows(config.process))[off.any(axis=0)])
        expected = (more.measured.astype(float) - less.measured) / (2.0 * by)
        rounding = (2e-7 * np.maximum(np.abs(more.measured), 1e-2) + np.where(weighs, 0.02, 0.0)) / by
        off = np.abs(shown[:, :, column] - expected) > 1e-4 * np.abs(expected).max(axis=0) + rounding
        assert not off.any(), (name, np.array(config.process.Measured._fields)[off.any(axis=0)])


def test_a_reading_that_is_held_or_late_depends_on_the_one_before():
    ring, reading = STATES.index("ring"), STATES.index("reading")
    late = DifferentiableBatch(make_config("puller", **PLAIN), 8)
    late.reset(range(8))
    step = late.step(np.zeros((8, 2)))
    np.testing.assert_array_equal(step.jacobian[:, reading, ring], 1.0)
    fault = DifferentiableBatch(make_config("sensor-fault", **PLAIN), 64)
    fault.reset(range(64))
    held = np.zeros(64, bool)
    for _ in range(100):
        before = fault._batch.memory.slots["ring"].copy()
        step = fault.step(np.zeros((64, 2)))
        same = fault._batch.memory.slots["ring"] == before
        np.testing.assert_array_equal(step.jacobian[:, reading, reading], same)
        np.testing.assert_array_equal(step.jacobian[~same, reading], step.jacobian[~same, ring])
        held |= same
    assert held.any()


def test_a_slow_heater_and_pyrometer_have_the_derivatives_of_quick_ones():
    slow, quick = (DifferentiableBatch(make_config("hot-zone", **PLAIN), 8) for _ in range(2))
    for batch in (slow, quick):
        batch.reset(range(8))
    actions = np.full((8, 2), 0.01)
    for _ in range(20):
        slow.step(actions)
    memory = quick._batch.memory
    memory.slots[:], memory.frames[:] = slow._batch.memory.slots, slow._batch.memory.frames
    assert memory.slots["episode"]["heater_lag"].min() > 0.0
    memory.slots["episode"]["heater_lag"] = memory.slots["episode"]["pyrometer_filter"] = 0.0
    quick._state = quick._now()
    one, other = slow.step(actions), quick.step(actions)
    assert (one.state != other.state)[:, STATES.index("T_1")].any()
    np.testing.assert_allclose(one.jacobian[:, : len(STATES)], other.jacobian[:, : len(STATES)], rtol=1e-3)


def test_window_and_slew_stop_derivatives():
    batch = DifferentiableBatch(make_config("puller", **PLAIN), 4)
    batch.reset(range(4))
    step = batch.step(np.full((4, 2), 0.9))
    v, Q, n = STATES.index("v_p"), STATES.index("Q_H"), len(STATES)
    assert not step.jacobian[:, [v, Q], :][:, :, [n, n + 1]].any(), "the slew decides, not the action"
    np.testing.assert_array_equal(step.jacobian[:, v, v], 1.0)


def test_a_lost_crystal_stops_counting():
    batch = DifferentiableBatch(make_config("randomized", **PLAIN), 8)
    batch.reset(range(8))
    actions = np.zeros((8, 2))
    actions[:4] = 1.0
    for _ in range(1500):
        step = batch.step(actions)
        assert np.isfinite(step.jacobian).all()
        assert np.isfinite(step.cost).all()
        assert np.isfinite(step.state).all()
        assert not step.jacobian[~step.grows].any()
        assert not step.cost[~step.grows].any()
        if not step.grows[:4].any():
            break
    assert not step.grows[:4].any()
    last = step.state[:4]
    np.testing.assert_array_equal(batch.step(actions).state[:4], last)


@pytest.mark.parametrize("scenario", ["hard", "all"])
def test_the_environment_s_own_crystals_and_observations(scenario):
    """Also where the config observes something else."""
    batch, env = DifferentiableBatch(make_config(scenario), 4), CzVectorEnv(4, scenario, observation="measured")
    _, measured = batch.reset([5, 6, 7, 8])
    first, infos = env.reset(seed=[5, 6, 7, 8])
    np.testing.assert_array_equal(measured, first)
    np.testing.assert_array_equal(batch.scenarios, infos.get("scenario", scenario))
    for action in np.random.default_rng(0).uniform(-0.2, 0.2, (50, 4, 2)):
        step = batch.step(action)
        np.testing.assert_array_equal(step.measured, env.step(action)[0])
    assert batch.measured_by_state.shape == (len(MEASURED), len(STATES))


def test_the_chain_rule_over_rk4_is_exact():
    """Against the complex step through the whole of it, ten times in a row."""
    puller, d = make_puller(lam=0.5), Disturbance(50.0, 0.3, 0.95)
    x, u, work = State(*puller.state_0)._replace(r_c=0.051, h_c=0.0062), puller.inputs_0, np.zeros(work_shape(BODY))
    for _ in range(10):
        rk4_by(work, x, u, d, puller, 5.0, model_of(BODY, HURLE))
        whole = jacobian(lambda *at: rk4(State(*at[:5]), Inputs(*at[5:]), d, puller, 5.0, hurle_slope), (*x, *u))
        np.testing.assert_allclose(work[3], whole, rtol=1e-10, atol=1e-16)
        x = rk4(x, u, d, puller, 5.0, hurle_slope)


@pytest.mark.slow
def test_the_end_of_the_tail_has_derivatives():
    """Where the crystal is hundreds of its fin's lengths long; and a length that is reached is no loss."""
    batch = DifferentiableBatch(make_config("nominal", process=CRYSTAL, stage=1.24, **PLAIN), 2)
    batch.reset(range(2))
    for _ in range(600):
        step = batch.step(np.zeros((2, 2)))
        assert np.isfinite(step.jacobian).all()
        assert np.isfinite(batch.measured_by_state).all()
    assert not step.grows.any()
    assert not batch.lost.any()
    assert not batch.measured_by_state.any()


DEAD = replace(RANDOMIZED, actuators=Actuators(heater_dead_time=(0.0, 5.0)))
LATE = replace(RANDOMIZED, readings=DriveReadings(delay=5.0))


@pytest.mark.parametrize(
    ("config", "slots", "message"),
    [
        (make_config(control_interval=10.0, **PLAIN), 2, "must be at most 5 s"),
        (make_config("all", control_interval=2.5, **PLAIN), 2, "latency of 5 s is longer"),
        (make_config(DEAD), 2, "a heater with a dead time has no derivatives"),
        (make_config(LATE), 2, "readings of drives with a delay have no derivatives"),
        ("randomized", 2, "this needs a Config, not .randomized."),
        (make_config(**PLAIN), 0, "num_envs must be"),
        (make_config(**PLAIN), 2.0, "num_envs must be"),
    ],
)
def test_a_config_without_derivatives_is_refused(config, slots, message):
    with pytest.raises(ValueError, match=message):
        DifferentiableBatch(config, slots)


def test_resets_and_actions_that_are_none_are_refused():
    batch = DifferentiableBatch(make_config(**PLAIN), np.int64(2))
    with pytest.raises(ResetNeeded, match="every slot needs a crystal"):
        batch.step(np.zeros((2, 2)))
    batch.reset([1], [0])
    with pytest.raises(ResetNeeded, match="every slot needs a crystal"):
        batch.step(np.zeros((2, 2)))
    for seeds, which in (([1.7], [0]), ([1, 2], [0, 0]), ([1], [-1]), ([1], [2])):
        with pytest.raises(ValueError, match=r"seeds must be whole|slots must be different"):
            batch.reset(seeds, which)
    batch.reset([np.int64(1), 2])
    for actions in (np.full((2, 2), np.nan), np.zeros(2), np.zeros((3, 2))):
        with pytest.raises(InvalidAction, match=r"shape \(2, 2\)"):
            batch.step(actions)
    assert batch.step(np.zeros((2, 2))).grows.all()


def test_crystals_at_their_end_stay():
    batch = DifferentiableBatch(make_config(horizon=50.0, **PLAIN), 2)
    batch.reset([1, 2])
    ends = [batch.step(np.zeros((2, 2))) for _ in range(12)]
    assert [step.grows.all() for step in ends] == [True] * 10 + [False] * 2
    np.testing.assert_array_equal(ends[-1].state, ends[9].state)
    assert not ends[-1].cost.any()


@pytest.mark.slow  # compiles for another meniscus
def test_the_exact_meniscus_has_derivatives_too():
    batch = DifferentiableBatch(make_config(meniscus=YOUNG_LAPLACE, **PLAIN), 4)
    batch.reset(range(4))
    slots, frames = batch._batch.memory.slots.copy(), batch._batch.memory.frames.copy()
    column, by = STATES.index("h_c"), 1e-7
    _, step = moved(batch, slots, frames, np.zeros((4, 2)), column, 0.0)
    ahead, behind = (moved(batch, slots, frames, np.zeros((4, 2)), column, sign * by)[0] for sign in (1.0, -1.0))
    rows = [STATES.index(name) for name in ("r_c", "h_c", "ring")]
    np.testing.assert_allclose(step.jacobian[:, rows, column], ((ahead - behind) / (2.0 * by))[:, rows], rtol=1e-4)
