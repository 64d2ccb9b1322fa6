"""A process of two states runs through everything that ``Cz-v0`` does: a heated tank, its level seen by the camera.

h' = v_p - v_0 sqrt(h/h_0) and T' = (Q_H - G (T - T_a) - Q_d) / C: the first drive fills it, the second heats it.
"""

import pickle
import warnings
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from gymnasium.vector import AutoresetMode
from scipy.integrate import solve_ivp
from stable_baselines3.common.env_checker import check_env as check_with_sb3

from cz_gym import CzEnv, CzVectorEnv, check_vector_env
from cz_gym.body.signals import WEIGHTS, Cost, cost_slopes, cost_terms, reward
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.engine.tangents import DifferentiableBatch
from cz_gym.evaluation.protocol import Case, Contender
from cz_gym.evaluation.rollout import rollout
from cz_gym.jit import force_inlined, jittable
from cz_gym.physics.plant import bias_offset, recipe, reference
from cz_gym.process import DONE, GROWS, LOST, PULL_SCALE, Channel, Inputs, Past, PerfectReadings, Process, Relative
from cz_gym.tools.report.tables import rows
from cz_gym.tools.report.task_records import BODY_DRIVES, BODY_ERROR
from cz_gym.tools.run import run as benchmark

# The process: at most 80 lines to the mark below.
LEVEL, FALL, MM = Channel("m", 1e-3, "level above reference"), Channel("m/s", PULL_SCALE, "inflow above nominal"), 1e-3
HEAT, WARM, ONE = Channel("W", 1e4, "power above nominal"), Channel("K", 5.0, "temperature"), Channel("1", 1.0, "-")


class Tank(NamedTuple):
    h_0: float
    v_0: float
    G: float
    T_a: float
    T_0: float
    C: float


class Level(NamedTuple):
    h: Any
    T: Any


class Load(NamedTuple):
    Q_d: Any


class Read(NamedTuple):
    level: Annotated[Any, LEVEL]
    valid: Annotated[Any, ONE]
    h_ref: Annotated[Any, LEVEL]
    T_ref: Annotated[Any, WARM]
    T: Annotated[Any, WARM]
    v_p: Annotated[Any, FALL]
    Q_H: Annotated[Any, HEAT]


class Truth(NamedTuple):
    error: Annotated[Any, LEVEL]
    T: Annotated[Any, WARM]


class BriefInfo(NamedTuple):
    h: Any
    h_ref: Any


LOG = {"h": LEVEL, "succeeded": ONE, "h_ref": LEVEL, "T": WARM, "v_p": FALL, "Q_H": HEAT, "ring_offset": LEVEL}
LOG |= {f"term_{name}": ONE for name in Cost._fields} | {"action_clipped": ONE}
Log: Any = NamedTuple("Log", [(name, Annotated[Any, channel]) for name, channel in LOG.items()])


class StepMemory(NamedTuple):
    fed: Any


@jittable
def derive(q, f, m):
    return Tank(q.r_0, q.v_0, 30.0 * f.G_1a, q.T_a, q.T_a + 300.0, q.C_2 * f.C_2)


@jittable
def begin(slot, m):
    slot.fed = 0.0
    for row in range(3):
        slot.table[row, 0], slot.table[row, 1] = 1e4 * row, 0.1 * row
    return Level(slot.puller.h_0 + slot.episode.r_c_start, slot.puller.T_0)


@force_inlined
def rates(x, u, d, p, m):
    return Level(u.v_p - p.v_0 * np.sqrt(x.h / p.h_0), (u.Q_H - p.G * (x.T - p.T_a) + d.Q_d) / p.C)


@jittable
def accept(slot, x, new, u, d, t, dt, limit, m):
    error = new.h - slot.puller.h_0 - reference(t, slot.episode)
    full = slot.fed >= slot.table[2, 1]
    return new, (DONE if full else GROWS) if np.abs(error) <= limit else LOST


@jittable
def measure(x, u, about, memory, readings, slot, t):
    p, e, h_ref = slot.puller, slot.episode, reference(t, slot.episode)
    drives = u.v_p - about.v_p, u.Q_H - about.Q_H
    return Read(readings.ring - p.h_0 - h_ref, slot.valid, h_ref, recipe(t, e), readings.T_1 - p.T_0, *drives)


@jittable
def nominal(x, slot, interval):
    return Inputs(slot.puller.v_0, slot.puller.G * (slot.puller.T_0 - slot.puller.T_a))


@jittable
def logged(slot, measured, cost, t, ring, m):
    x, h_ref = slot.x, slot.puller.h_0 + measured.h_ref
    terms = cost.radius, cost.pull, cost.pull_step, cost.heater_step
    done = 1.0 if slot.over == DONE else 0.0
    return Log(x.h, done, h_ref, x.T, slot.v_p, slot.Q_H, bias_offset(t, slot.episode), *terms, slot.clipped)


@jittable
def cost_inputs(x, u, before, memory, slot, t):
    error = x.h - slot.puller.h_0 - reference(t, slot.episode) + bias_offset(t, slot.episode)
    return Cost(error, u.v_p / slot.puller.v_0 - 1.0 + 0.0 * memory.fed, u.v_p - before.v_p, u.Q_H - before.Q_H)


TANK = Process(
    Tank, Level, Load, Read, Truth, Log, BriefInfo, Cost, (Past("level", MM),), (Relative("T", "T_ref", 2.0, "-"),),
    check=lambda parameters, meniscus: parameters, derive=derive, begin=begin, nominal=nominal,
    hidden_load=jittable(lambda p_drift, p: -p.G * p_drift), disturb=jittable(lambda Q_d, dT_i, t, e: Load(Q_d)),
    perfect_readings=jittable(lambda x, p, m: PerfectReadings(x.h, x.h, 0.0 * x.h, x.T)),
    rates=rates, accept=accept, measure=measure, cost_inputs=cost_inputs,
    true_state=jittable(lambda slot, seen, t: Truth(slot.x.h - slot.puller.h_0, slot.x.T - slot.puller.T_0)),
    logged=logged, brief_info=jittable(lambda slot, seen: BriefInfo(slot.x.h, slot.puller.h_0 + seen.h_ref)),
    cost_terms=cost_terms, cost_slopes=cost_slopes, reward=reward, StepMemory=StepMemory,
    check_points=lambda p: [(Level(0.9 * p.h_0, p.T_0 + 5.0), Inputs(p.v_0, 100.0), Load(3.0))],
    update_memory=jittable(lambda memory, u, about, dt: StepMemory(memory.fed + u.v_p * dt)),
    weights=WEIGHTS, table=(3, 2),
)  # fmt: skip
# The end of the process.

gym.register("Tank-v0", "cz_gym.env:CzEnv", vector_entry_point="cz_gym.env:CzVectorEnv", kwargs={"process": TANK})
SETTINGS = {"scenario": "randomized", "control_interval": 20.0, "horizon": 1200.0, "info": "all"}


class Integrating:
    """A PID on level and temperature, with the memory (integral of the level's error, last error)."""

    made_for = None

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        level, warm = observation[:, 0].astype(float), observation[:, 4].astype(float)
        total, last = (np.zeros_like(level), level) if state is None else state
        if state is not None and episode_start is not None:
            total, last = np.where(episode_start, 0.0, total), np.where(episode_start, level, last)
        pull = -0.6 * level - 0.02 * total - 0.3 * (level - last)
        action = np.stack([pull, -0.8 * warm], axis=1)
        return np.clip(action, -1.0, 1.0).astype(np.float32), (total + level, level)


MIX = {"crown": 0.4, "body": 0.3, "tail": 0.3}
BOTH = {"tank": {"process": TANK}, "crystal": {"process": CRYSTAL, "stage": MIX}}
processes = pytest.mark.parametrize(
    "given", [pytest.param(BOTH["tank"], marks=pytest.mark.slow), BOTH["crystal"]], ids=[*BOTH]
)
"""No cache keeps the code of a test's own process: every run compiles the tank for a minute."""


@processes
@pytest.mark.parametrize("observation", ["measured", "history", "state"])
def test_the_checkers_of_gymnasium_and_stable_baselines3(observation, given):
    kind, settings = ("Tank-v0", SETTINGS) if given["process"] is TANK else ("CzCrystal-v0", {"stage": MIX})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make(kind, observation=observation, **settings).unwrapped
        check_with_gymnasium(env)
        check_with_sb3(env)


@processes
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_the_batch_is_a_vector_of_scalars(mode, given):
    settings = {**given, "scenario": "all", "info": "all", "control_interval": 120.0, "horizon": 3600.0}
    make = lambda n, mode: CzVectorEnv(n, autoreset_mode=mode, **settings)  # noqa: E731
    checked = check_vector_env(make, lambda: CzEnv(**settings), mode=mode)
    assert checked.by_slot
    assert checked.episodes > checked.failures > 4


@processes
def test_states_continue_bit_for_bit_with_what_the_process_added(given):
    settings = {**SETTINGS, **given} if given["process"] is TANK else {**given, "scenario": "puller"}
    env = CzVectorEnv(4, **settings)
    env.reset(seed=1)
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (40, 4, 2)).astype(np.float32)
    for action in actions[:20]:
        env.step(action)
    saved = pickle.loads(pickle.dumps(env.get_state()))
    slot = saved[0].slot.slot
    assert slot["table"].any()
    if given["process"] is TANK:
        assert slot["fed"] > 0.001
        assert slot["table"].tolist() == [[0.0, 0.0], [1e4, 0.1], [2e4, 0.2]]
    else:
        with pytest.raises(ValueError, match="saved under other settings"):
            CzVectorEnv(4, **{**settings, "stage": "tail"}).set_state(saved)
    first = [env.step(action)[:2] for action in actions[20:]]
    other = CzVectorEnv(4, **settings)
    other.set_state(saved)
    for (seen, gained), action in zip(first, actions[20:], strict=True):
        again = other.step(action)
        np.testing.assert_array_equal(again[0], seen)
        np.testing.assert_array_equal(again[1], gained)


@pytest.mark.slow
def test_the_tank_is_the_equations_solution():
    env = CzEnv(process=TANK, action="direct", **{**SETTINGS, "scenario": "nominal"})
    env.reset(seed=0)
    p = Tank(*env._batch.memory.slots["puller"][0].tolist())
    for _ in range(30):
        *_, info = env.step(np.array([0.3, 0.2], np.float32))
    u = Inputs(p.v_0 * (1.0 + float(np.float32(0.3))), p.G * 300.0 + 1e4 * float(np.float32(0.2)))
    exact = solve_ivp(
        lambda t, x: rates(Level(*x), u, Load(0.0), p, None), (0, 600), [p.h_0, p.T_0], rtol=1e-12, atol=1e-12
    ).y[:, -1]
    assert (info["h"], info["T"]) == pytest.approx(tuple(exact), rel=1e-10)


@pytest.mark.slow
def test_it_ends_with_success_once_enough_was_fed():
    env = CzEnv(process=TANK, **{**SETTINGS, "scenario": "nominal", "horizon": 12000.0}, action="direct")
    env.reset(seed=0)
    terminated = truncated = False
    while not terminated and not truncated:
        _, gained, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert terminated
    assert info["succeeded"] == 1.0
    assert gained > 0.5
    assert env._batch.memory.slots["fed"][0] == pytest.approx(0.2, abs=20 * PULL_SCALE)


@pytest.mark.slow
def test_a_pid_in_rollout_and_table(tmp_path):
    """Against a policy that does nothing; metrics of what a tank has not are left out."""
    row = Case("tank", "randomized", "a tank", process=TANK)
    config = replace(row.config(), horizon=7200.0)
    run = rollout(Integrating(), config, range(8))
    still = rollout(type("Still", (Integrating,), {"predict": _still})(), config, range(8))
    rmse = [np.sqrt(np.mean(np.square(each.signals.h - each.signals.h_ref))) for each in (run, still)]
    assert rmse[0] < 0.5 * rmse[1]
    contender = Contender("pid", lambda config: Integrating(), "measured", "a PID")
    found, columns = benchmark([contender], [row], 4, tmp_path, quiet=True), (*BODY_ERROR, *BODY_DRIVES)
    (line,) = rows(found, row, columns)
    told = dict(zip(("name", *(column.metric for column in columns)), line, strict=True))
    assert told["growth_rate_rms_mm_per_min"] == "-"
    assert float(told["rmse_mm"].split()[0]) < 1.0
    assert float(told["failure_rate"].split()[0]) == 0.0


def _still(self, observation, state=None, episode_start=None, deterministic=True):
    return np.zeros((len(observation), 2), np.float32), None


@pytest.mark.slow
def test_its_step_has_derivatives():
    """Of state, inputs, what is carried on and cost, against differences."""
    config = make_config("nominal", action="direct", process=TANK)
    batch = DifferentiableBatch(config, 1)
    assert (batch._names, batch.measured_by_state.shape) == (("h", "T", "v_p", "Q_H", "fed", "ring", "reading"), (7, 7))
    at = np.array([[0.05, -0.03]])

    def end(action):
        batch.reset([0])
        batch.step(np.array([[0.1, 0.1]]))
        step = batch.step(action)
        return np.concatenate([step.state[0], step.cost[0]]), step.jacobian[0]

    for column in range(2):
        by = np.zeros((1, 2))
        by[0, column] = 1e-4
        found, (ahead, _), (behind, _) = end(at)[1][:, 7 + column], end(at + by), end(at - by)
        np.testing.assert_allclose(found, (ahead - behind) / 2e-4, rtol=1e-5, atol=1e-9)
