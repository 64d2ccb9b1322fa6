"""The LQG against the exact optimum and the nonlinear plant."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cz_gym import make_puller
from cz_gym.baselines.lqg import LQGDesign, look_ahead, quadratic_cost, regulator, samples_ahead, solve
from cz_gym.baselines.lqg_filter import DRIFT, FAST, HEATER, PLANT, SLOW, STATES, NoiseModel, plant_model
from cz_gym.body.signals import Measured, Weights
from cz_gym.physics.meniscus import HURLE
from cz_gym.physics.plant import Disturbance, State, hidden_load, rates
from cz_gym.physics.schedule import quintic
from cz_gym.process import Inputs
from cz_gym.puller.file import find_puller

PULLER = make_puller(lam=0.5)
NOISE = NoiseModel()


# The augmented plant


def test_the_sampled_plant_moves_as_the_equations_do():
    rng = np.random.default_rng(0)
    small = np.array([1e-6, 1e-6, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-6, 0.1])
    z, u, dt = rng.normal(size=len(STATES)) * small, np.array([1e-8, 1.0]), 20.0

    def motion(t, y):
        x = State(*(y[:PLANT] + np.array(PULLER.state_0)))
        drives = Inputs(PULLER.v_0 + u[0], PULLER.Q_H_0 + u[1] + y[HEATER])
        d = Disturbance(float(hidden_load(y[DRIFT], PULLER)), y[FAST] + y[SLOW], 1.0)
        rate = -y[DRIFT + 1] / NOISE.drift_rate_tau
        own = [-y[FAST] / NOISE.fast_tau, -y[SLOW] / NOISE.slow_tau, y[DRIFT + 1], rate, 0.0]
        return np.array([*rates(x, drives, d, PULLER, HURLE.slope), *own])

    exact = solve_ivp(motion, (0.0, dt), z, rtol=1e-10, atol=1e-14).y[:, -1]
    model = plant_model(PULLER, NOISE, dt)
    np.testing.assert_allclose(model.A @ z + model.B @ u, exact, rtol=2e-3, atol=1e-3 * small.min())


def test_the_fluctuations_keep_their_variance():
    model = plant_model(PULLER, NOISE, 5.0)
    for state, sd in ((FAST, NOISE.fast_sd), (SLOW, NOISE.slow_sd), (DRIFT + 1, NOISE.drift_rate_sd)):
        assert model.A[state, state] ** 2 * sd**2 + model.Q[state, state] == pytest.approx(sd**2, rel=1e-9)
    two = plant_model(PULLER, NOISE, 10.0)
    np.testing.assert_allclose(model.A @ model.Q @ model.A.T + model.Q, two.Q, rtol=1e-6, atol=1e-25)


# The regulator


def brute_force_first_move(model, weights, dt, z, steps, reference_steps, drift_steps):
    """The first optimal move by least squares over all moves of a long horizon."""
    n = len(model.A)
    A = np.block([[model.A, model.B], [np.zeros((2, n)), np.eye(2)]])
    B = np.vstack([model.B, np.eye(2)])
    free, forced, radius = z.copy(), np.zeros((n + 2, 2 * steps)), 0.0
    Q, _, R = quadratic_cost(weights, dt)
    pull, moves = Q[PLANT, PLANT], np.diag(R) - np.array([Q[PLANT, PLANT], 0.0])
    rows, targets = [], []
    for k in range(steps):
        move = np.zeros((2, 2 * steps))
        move[:, 2 * k : 2 * k + 2] = np.eye(2)
        forced, free = A @ forced + B @ move, A @ free
        if k < len(drift_steps):
            free[DRIFT] += drift_steps[k]
            radius += reference_steps[k]
        costs = (Q[0, 0], forced[0], free[0] - radius), (pull, forced[n], free[n])
        for weight, row, offset in (*costs, (moves[0], move[0], 0.0), (moves[1], move[1], 0.0)):
            rows.append(np.sqrt(weight) * row)
            targets.append(-np.sqrt(weight) * offset)
    unknown_scale = np.tile([1e-6, 1e3], steps)
    solution = np.linalg.lstsq(np.array(rows) * unknown_scale, np.array(targets), rcond=None)[0]
    return (solution * unknown_scale)[:2]


@pytest.mark.parametrize("what", ["state", "reference", "drift", "drift-rate"])
def test_the_first_move_is_that_of_the_whole_horizon(what):
    dt, ahead = 30.0, 10
    noise = replace(NOISE, drift_rate_tau=600.0)
    model, weights = plant_model(PULLER, noise, dt), Weights(heater_step=0.5)
    law = regulator(model, weights, dt)
    z, reference, drift = np.zeros(len(STATES) + 2), np.zeros(ahead), np.zeros(ahead)
    if what == "state":
        z[:] = [1e-4, 1e-4, 1.0, 0.5, 0.2, 0.1, 0.2, 0.0, 0.0, 10.0, 1e-6, 100.0]
    elif what == "reference":
        reference[:] = np.linspace(0.0, 1e-4, ahead)
    elif what == "drift":
        drift[:] = np.linspace(0.1, 0.0, ahead)
    else:
        z[[DRIFT, DRIFT + 1]] = 1.0, 1e-3
    expected = brute_force_first_move(model, weights, dt, z, 140, reference, drift)
    found = -law.feedback @ z + reference @ law.reference + drift @ law.drift
    # A shifted reference counts as an equilibrium of its own, though the free radius drifts off it by 9e-6 a second.
    rtol = 0.02 if what == "reference" else 2e-3
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=0.0)


# The preview


@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
def test_the_plan_is_the_recipe_five_minutes_ahead(dt):
    def recipe(t):
        return 1e-3 * quintic(np.clip((t - 400.0) / 1200.0, 0.0, 1.0))

    zeros = np.zeros(1)
    samples = samples_ahead(dt)
    plan = np.zeros((1, 2, samples + 1))
    for k in range(round(900.0 / dt)):
        shown = [np.array([recipe(k * dt + ahead)]) for ahead in (0.0, 60.0, 300.0)]
        seen = Measured(zeros, zeros, *shown, *(2.0 * value for value in shown), *[zeros] * 4)
        plan = look_ahead(plan, seen, np.array([k == 0]), dt)
        if k * dt >= 300.0:
            future = recipe((k + np.arange(samples + 1)) * dt)
            np.testing.assert_allclose(plan[0, 0], future, atol=1e-15)
            np.testing.assert_allclose(plan[0, 1], 2.0 * future, atol=1e-15)


def test_the_radius_estimate_is_limited_as_the_puller_s_radius_is():
    file = find_puller("silicon-300mm")
    plant_filter = solve(LQGDesign(), 5.0, make_puller(file.parameters))[0]
    mean = np.zeros((2, len(STATES)))
    mean[:, 0] = 1.0, -0.012
    assert plant_filter._clipped(mean)[:, 0] == pytest.approx([file.radius_limit, -0.012], rel=1e-12)
