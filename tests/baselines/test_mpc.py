"""The predictive controller: against the LQR, the plant itself, finite differences, SciPy, and Bayes' rule."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from cz_gym.baselines.bounds.trajectory import SCALES, Limits
from cz_gym.baselines.lqg.controller import LQG, LQGDesign
from cz_gym.baselines.lqg.model import DRIFT, HEATER, PLANT, STATES
from cz_gym.baselines.mpc import EkfMpc, best_corrections, expected_disturbances, held, newton, predict_under_law
from cz_gym.baselines.registry import find_controller
from cz_gym.body.plant import Disturbance, Inputs, State, hidden_load, rk4
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Actuators
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN
from tests.observed import PLAIN, Watched

LINEAR = LQGDesign(nonlinear=False)
SHARE = LINEAR.noise.recipe_share


def situation(n=4, reference=0.0, size=1.0):
    """Estimates, plans and previous inputs, all of plausible size; the recipe of T_1 moves."""
    random = np.random.default_rng(7)
    estimate = random.normal(size=(n, len(STATES))) * [1e-4, 1e-4, 0.5, 0.5, 0.2, 0.2, 0.2, 0.5, 1e-4, 50.0]
    plan = np.zeros((n, 2, 61))
    plan[:, 0] = reference * np.linspace(0.0, 1.0, 61)
    plan[:, 1] = np.cumsum(random.normal(size=(n, 61)) * 0.05, axis=1)
    previous = random.normal(size=(n, 2)) * [1e-6, 100.0]
    return size * estimate, plan * size, size * previous


def parts(mpc, estimate, plan, previous):
    """Prediction, curvature and slope as the controller makes them."""
    gains, shape = mpc.gains, mpc.shape
    disturbances = expected_disturbances(estimate, plan, gains, SHARE, shape.stages)
    z = np.concatenate([estimate[:, :PLANT], previous], axis=1) / SCALES
    prediction = predict_under_law(z, plan, disturbances, gains, SHARE, shape)
    last = held(plan, shape.stages)[:, -1, 0], disturbances[:, -1]
    H, g = newton(prediction, *last, gains.regulator, mpc.design.weights, shape.dt)
    return prediction, H, g, disturbances


@pytest.mark.parametrize(("dt", "blocks"), [(5.0, (1, 1, 2, 4, 8, 16)), (10.0, (1, 3)), (2.0, (1, 40))])
def test_mpc_on_a_linear_plant_without_limits_is_the_lqr(dt, blocks):
    lqg, mpc = LQG(dt, LINEAR), EkfMpc(dt, LINEAR, blocks=blocks)
    estimate, plan, previous = situation()
    plan = np.pad(plan, ((0, 0), (0, 0), (0, 90)), "edge")[:, :, : round(300.0 / dt) + 1]
    assert mpc.law(estimate, plan, previous) == pytest.approx(lqg.law(estimate, plan, previous), rel=1e-8)


def test_casadi_predicts_what_the_plant_does():
    mpc = EkfMpc()
    estimate, plan, previous = situation(reference=1.0 * MM)
    prediction, _, _, disturbances = parts(mpc, estimate, plan, previous)
    p = mpc.gains.filter.puller
    for i in range(len(estimate)):
        x = State(*(np.array(p.state_0) + estimate[i, :PLANT]))
        for k in range(mpc.shape.stages):
            d = disturbances[i, k]
            pull, power = prediction.outputs[i, k, 1:3] * SCALES[PLANT:]
            load = Disturbance(hidden_load(d[DRIFT - PLANT], p), d[0] + d[1], 1.0)
            x = rk4(x, Inputs(p.v_0 + pull, p.Q_H_0 + power + d[HEATER - PLANT]), load, p, 5.0, mpc.meniscus.slope)
            error = prediction.outputs[i, k, 0] * MM
            assert error == pytest.approx(x.r_c - p.r_0 - held(plan, k + 1)[i, -1, 0], abs=1e-13)
        assert prediction.last[i, :PLANT] * SCALES[:PLANT] == pytest.approx(np.array(x) - p.state_0, abs=1e-9)


def test_the_sensitivities_agree_with_finite_differences():
    """The first block's correction acts on the first move alone, as a change of the previous inputs would but for K."""
    mpc = EkfMpc(blocks=(1, 2, 4))
    estimate, plan, previous = situation(n=2)
    prediction, _, _, _ = parts(mpc, estimate, plan, previous)
    assert prediction.outputs_c.shape == (2, 60, 5, 6)
    size = np.array([1e-3, 1e-3])
    K = mpc.gains.regulator.feedback[:, -2:] * SCALES[PLANT:] / SCALES[PLANT:, None]
    for j in range(2):
        change = np.zeros(2)
        change[j] = size[j]
        found = []
        for sign in (1.0, -1.0):
            shifted, _, _, _ = parts(mpc, estimate, plan, previous + sign * change * SCALES[PLANT:])
            found.append(shifted.outputs)
        slope = (found[0] - found[1]) / (2.0 * size[j])
        # d(first input)/d(previous j) = (I - K)_j: the same as corrections (I - K)_j to the first block.
        same = prediction.outputs_c[:, :, :, :2] @ (np.eye(2) - K)[:, j]
        assert slope[:, 1:] == pytest.approx(same[:, 1:], rel=1e-5, abs=1e-7)


def test_limits_are_kept_at_least_cost():
    random = np.random.default_rng(2)
    mpc = EkfMpc()
    prediction, H, g, _ = parts(mpc, *situation())
    g = g + 0.2 * random.normal(size=g.shape) * np.sqrt(np.diagonal(H, axis1=1, axis2=2))
    limits = Limits(np.array([0.3, 2.0]), np.array([0.03, 0.6]))
    corrections = best_corrections(H, g, prediction, mpc.blocks, limits)
    at = np.cumsum((0, *mpc.blocks[:-1]))
    most = np.tile(np.concatenate([limits.span, limits.move]), len(at))
    for i in range(len(g)):
        rows = prediction.outputs_c[i, at, 1:].reshape(-1, g.shape[1])
        free = prediction.outputs[i, at, 1:].ravel()
        assert (np.abs(free + rows @ corrections[i]) <= most + 1e-7).all()
        peer = minimize(
            lambda c, i=i: 0.5 * c @ H[i] @ c + g[i] @ c, np.zeros(len(g[i])), jac=lambda c, i=i: H[i] @ c + g[i],
            method="SLSQP", options={"ftol": 1e-14, "maxiter": 500},
            constraints={
                "type": "ineq",
                "fun": lambda c, rows=rows, free=free: np.concatenate([most - free - rows @ c, most + free + rows @ c]),
                "jac": lambda c, rows=rows: np.concatenate([-rows, rows]),
            },
        )  # fmt: skip
        ours = 0.5 * corrections[i] @ H[i] @ corrections[i] + g[i] @ corrections[i]
        assert ours <= peer.fun + 1e-6 * abs(peer.fun)
        assert (np.abs(free + rows @ corrections[i]) > most - 1e-6).any(), "no limit was active"


def test_mpc_keeps_the_limits_of_now_where_not_all_can_be_kept():
    mpc = EkfMpc()
    prediction, H, g, _ = parts(mpc, *situation())
    limits = Limits(np.array([0.2, 0.5]), np.array([0.02, 0.1]))
    corrections = best_corrections(H, g, prediction, mpc.blocks, limits)
    now = prediction.outputs[:, 0, 1:] + (prediction.outputs_c[:, 0, 1:] @ corrections[:, :, None])[:, :, 0]
    assert (np.abs(now) <= np.concatenate([limits.span, limits.move]) + 1e-7).all()


def test_mpc_asks_for_nothing_beyond_the_limits_of_the_drives():
    actuators = Actuators(
        pull_window=0.02 * MM_PER_MIN, pull_slew=0.05 * MM_PER_MIN / MINUTE, heater_slew=0.5 * KILO / MINUTE
    )
    config = make_config(replace(RANDOMIZED, name="narrow", actuators=actuators), horizon=0.1 * HOUR, **PLAIN)
    with pytest.warns(UserWarning, match=r"lqg was not tuned for actuators\.pull_window"):
        watched = Watched(find_controller("ekf-mpc").make(config))
    run = rollout(watched, config, range(1_000_000, 1_000_003))
    wanted = np.array([state.memory.command for state in watched.states])
    pull = run.signals.v_p - config.parameters.v_0
    assert not run.failed.any()
    # The drives follow to the last digit: nothing was asked for that they could not do.
    assert pull == pytest.approx(wanted[:, :, 0], abs=1e-6 * actuators.pull_window)
    power = np.diff(run.signals.Q_H, axis=0)
    assert power == pytest.approx(np.diff(wanted[:, :, 1], axis=0), abs=0.01)
    assert np.abs(pull).max() == pytest.approx(actuators.pull_window, rel=1e-3)


def test_estimates_beyond_the_equations_fall_back_on_the_law():
    mpc = EkfMpc()
    estimate, plan, previous = situation()
    estimate[0, 1] = 20.0 * MM
    inputs = mpc.law(estimate, plan, previous)
    law = LQG.law(mpc, estimate, plan, previous)
    assert np.isfinite(inputs).all()
    assert inputs[0] == pytest.approx(law[0])
    alone = mpc.law(estimate[:1], plan[:1], previous[:1])
    assert alone[0] == pytest.approx(law[0])


def test_without_casadi_one_line_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ImportError, match=r"^this needs the package casadi: pip install '\.\[mpc\]'$"):
        find_controller("ekf-mpc").make(make_config(**PLAIN))
