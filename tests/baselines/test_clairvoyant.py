"""The clairvoyant bound: its optimum against a general optimiser, its plan against the environment itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize

from cz_gym import CzVectorEnv, State
from cz_gym.baselines import clairvoyant
from cz_gym.baselines.clairvoyant import Clairvoyant, Limits, future_of, limits_of, mean_pull, optimise
from cz_gym.body.signals import Cost, cost_terms
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Actuators
from cz_gym.episodes.scenarios import HARD, RANDOMIZED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import Playback, rollout
from cz_gym.process import Inputs
from cz_gym.support.errors import CzError
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

SEEDS = (1_000_000, 1_000_001, 1_000_002)


def planned(scenario=RANDOMIZED, horizon=0.5 * HOUR):
    config = make_config(scenario, observation="state", horizon=horizon, action="direct")
    return config, Clairvoyant().for_episodes(config, np.array(SEEDS))


@pytest.fixture(scope="module")
def optimum():
    return planned(horizon=1.0 * HOUR)


def replay(config, policy):
    """A rollout of a policy as it is, with or without a plan."""
    return rollout(SimpleNamespace(predict=policy.predict), config, SEEDS)


def planned_cost(future, x, u):
    """The objective of states and inputs, summed over the steps."""
    v_0, Q_H_0 = future.puller.inputs_0
    v_p, Q_H = u[..., 0], u[..., 1]
    moves = (np.diff(v, axis=0, prepend=np.broadcast_to(rest, v[:1].shape)) for v, rest in ((v_p, v_0), (Q_H, Q_H_0)))
    mean = mean_pull(v_p, v_0, float(future.lengths[:, 0].sum()))
    return sum(cost_terms(Cost(x[1:, :, 0] - future.target, mean, *moves))).sum(axis=0)


def played(u, inputs_0):
    """A policy that plays inputs v_p [m/s] and Q_H [W], shape (steps, n, 2)."""
    full = np.stack([inputs_0[:, 0], np.full(len(inputs_0), 10 * KILO)], axis=-1)
    return Playback(((u - inputs_0) / full).clip(-1, 1))


@pytest.mark.parametrize("interval", [2.0, 5.0, 7.5, 10.0])
def test_the_known_future_is_the_one_the_environment_brings(interval):
    config = make_config(HARD, observation="state", control_interval=interval, horizon=0.5 * HOUR, action="direct")
    future = future_of(config, SEEDS)
    env = CzVectorEnv.from_config(config, 3, info="all")
    env.reset(seed=list(SEEDS))
    actions = np.random.default_rng(0).uniform(-0.05, 0.05, (200, 3, 2)).astype(np.float32).astype(np.float64)
    x = future.start
    for k, action in enumerate(actions[: round(900.0 / interval)]):
        info = env.step(action)[-1]
        v_p, Q_H = future.puller.v_0 * (1.0 + action[:, 0]), future.puller.Q_H_0 + 10.0 * KILO * action[:, 1]
        x = future.advance(State(*x), Inputs(v_p, Q_H), slice(k, k + 1))
        x = State(*(value[0] for value in x))
        assert future.target[k] == pytest.approx(info["r_ref"] - info["ring_offset"], rel=1e-14)
    for name in ("r_c", "h_c", "T_1", "T_b"):
        assert getattr(x, name) == pytest.approx(info[name], rel=1e-12), name


def test_the_environment_replays_what_was_planned(optimum):
    config, policy = optimum
    run = replay(config, policy)
    power = run.signals.Q_H
    assert not run.failed.any()
    assert run.signals.r_c == pytest.approx(policy.best.x[1:, :, 0], abs=1e-6 * MM)
    assert power == pytest.approx(policy.best.u[:, :, 1], abs=0.01)
    assert policy.best.converged.all()


def test_no_nearby_inputs_are_cheaper_and_the_slope_is_zero(optimum):
    config, policy = optimum
    best = policy.best
    random = np.random.default_rng(5)
    smooth = np.cumsum(random.normal(size=best.u.shape), axis=0) / np.sqrt(len(best.u))
    rough = random.normal(size=best.u.shape)
    for shape in (smooth, rough):
        change = shape * np.array([0.002 * MM_PER_MIN, 0.002 * KILO])
        moved = (played(best.u + sign * change, policy.inputs_0) for sign in (-1.0, 0.0, 1.0))
        costs = [metrics(replay(config, each)).cost * config.steps for each in moved]
        rise = costs[0] + costs[2] - 2.0 * costs[1]
        assert (rise > 0.0).all()
        assert (np.abs(costs[2] - costs[0]) < 0.02 * rise).all()


def test_the_clairvoyant_optimum_within_tight_limits_is_a_general_optimisers():
    config = make_config("hard", observation="state", horizon=60.0, action="direct")
    future = future_of(config, SEEDS[:1])
    limits = Limits(np.array([0.003, 0.1]), np.array([0.001, 0.03]))
    found = optimise(future, limits)
    nominal = np.array([future.puller.v_0[0], future.puller.Q_H_0[0]])
    scale, N = np.array([MM_PER_MIN, KILO]), len(future.target)

    def costs(W):
        """Cost of candidates of shape (m, 2 N), which may be complex."""
        u = nominal + W.reshape(-1, N, 2).swapaxes(0, 1) * scale
        x = [np.broadcast_to(np.stack(future.start, axis=-1), (len(W), 5))]
        for k in range(N):
            after = future.advance(State(*x[-1].T), Inputs(*u[k].T), slice(k, k + 1))
            x.append(np.stack([value[0] for value in after], axis=-1))
        return planned_cost(future, np.array(x), u)

    def slope(w):
        return costs(w + 1e-30j * np.eye(2 * N)).imag / 1e-30

    def moves(w):
        change = np.diff(w.reshape(N, 2), axis=0, prepend=0.0)
        return np.concatenate([(limits.move - change).ravel(), (limits.move + change).ravel()])

    bounds = [(-span, span) for span in limits.span] * N
    peer = minimize(
        lambda w: costs(w[None])[0], np.zeros(2 * N), jac=slope, method="SLSQP", bounds=bounds,
        constraints={"type": "ineq", "fun": moves}, options={"ftol": 1e-13, "maxiter": 500},
    )  # fmt: skip
    assert np.abs(np.diff(peer.x[::2], prepend=0.0)).max() == pytest.approx(limits.move[0], rel=1e-6)
    assert np.abs(peer.x[::2]).max() == pytest.approx(limits.span[0], rel=1e-6)
    assert planned_cost(future, found.x, found.u)[0] == pytest.approx(peer.fun, rel=1e-6)
    assert (found.u[:, 0, 0] - nominal[0]) / MM_PER_MIN == pytest.approx(peer.x[::2], abs=1e-5)


@pytest.mark.slow
def test_slow_narrow_and_stepping_drives_are_respected_and_followed():
    pull = {"pull_window": 0.05 * MM_PER_MIN, "pull_slew": 0.06 * MM_PER_MIN / MINUTE}
    actuators = Actuators(**pull, heater_slew=0.2 * KILO / MINUTE, heater_step=0.1 * KILO)
    config, policy = planned(replace(HARD, name="narrow", actuators=actuators))
    u, u_0 = policy.best.u, policy.inputs_0
    pull, power = u[:, :, 0] - u_0[:, 0], u[:, :, 1] - u_0[:, 1]
    limits = limits_of(actuators, (u_0[0, 0], config.heater_range), config.control_interval)
    assert np.abs(pull).max() < limits.span[0] * MM_PER_MIN
    assert np.abs(np.diff(pull, axis=0)).max() < limits.move[0] * MM_PER_MIN
    assert np.abs(np.diff(power, axis=0)).max() < limits.move[1] * KILO
    run = replay(config, policy)
    assert not run.failed.any()
    assert run.signals.r_c == pytest.approx(policy.best.x[1:, :, 0], abs=0.05 * MM)


def test_the_clairvoyant_refuses_to_act_on_other_slots():
    _, policy = planned(horizon=60.0)
    with pytest.raises(ValueError, match="a plan for 3 episodes, not 2"):
        policy.predict(np.zeros((2, 17)))


def test_an_optimum_that_was_not_reached_is_no_bound(monkeypatch):
    config = make_config("randomized", observation="state", horizon=300.0, action="direct")
    monkeypatch.setattr(clairvoyant, "MOST_STEPS", 3)
    future = future_of(config, SEEDS)
    limits = limits_of(config.scenario.actuators, config.ranges, config.control_interval)
    assert not optimise(future, limits).converged.all()
    with pytest.raises(CzError, match=r"clairvoyant is no bound on 'randomized': .* 1000000, .* was not reached"):
        rollout(Clairvoyant(), config, SEEDS)
