"""The LQG on the linear plant, its filter in steady state, against theory: its cost by the covariance equation."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from cz_gym import make_puller
from cz_gym.baselines.lqg import LQG, PULL_SCALE, LQGDesign, solve
from cz_gym.baselines.lqg_filter import PLANT, STATES, NoiseModel, RingModel
from cz_gym.body.signals import coefficients
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN
from tests.observed import measured

PULLER = make_puller(lam=0.5)
LINEAR = LQGDesign(nonlinear=False, gate=np.inf, noise=NoiseModel(camera_memory=np.inf, recipe_share=0.0))
PER_SQUARE = np.array(coefficients(LINEAR.weights)._replace(pull=LINEAR.weights.pull / PULL_SCALE**2))
"""Its cost of a unit square of radius error, pull speed and both steps; without bands."""
KNOWN = RingModel(5.0, 0.1 * MM, 10.0 * MINUTE, rotation=(10.0 / MINUTE, 10.0 / MINUTE))
SCALES = np.array([MM, MM, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0 / HOUR, KILO])
"""Units in which the plant's states are of one order: in SI the covariance equation is ill-conditioned."""


def gains_of(ring=None, dt=5.0):
    return solve(replace(LINEAR, ring=ring), dt, PULLER)


def stationary(plant):
    """The states that are stationary in a loop: plant, interface fluctuations, ripple and past rings."""
    return [*range(PLANT + 2), *range(len(STATES), len(plant.A))]


def noise_sds(gains):
    return np.array([gains.filter.noise.camera_sd, gains.filter.noise.pyrometer_sd])


def root(Q):
    """A matrix whose product with its transpose is the covariance Q."""
    values, vectors = np.linalg.eigh(Q)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def steady_gain(gains):
    """Kalman gain of (r_br, T_1) at which the filter settles, shape (states, 2)."""
    A, _, H, Q, _ = gains.filter.plant
    R = np.diag(noise_sds(gains) ** 2)
    P = solve_discrete_are(A.T, H.T, Q, R)
    return P @ H.T @ np.linalg.inv(H @ P @ H.T + R)


def closed_loop(gains):
    """A and B of s = (plant, x_hat before the reading, previous inputs), and rows giving r_c, v_p and input steps."""
    plant, K = gains.filter.plant, steady_gain(gains)
    moving, states = stationary(plant), len(plant.A)
    n, m = len(moving), states + 2
    A, B, H = plant.A[np.ix_(moving, moving)], plant.B[moving], plant.H[:, moving]
    F, K_u = np.split(gains.regulator.feedback, [len(STATES)], axis=1)
    F = np.pad(F, ((0, 0), (0, states - len(STATES))))
    corrected = np.eye(states) - K @ plant.H
    C, D = np.hstack([-F @ corrected, np.eye(2) - K_u]), -F @ K
    v, w = np.diag(noise_sds(gains)), root(plant.Q[np.ix_(moving, moving)])
    inputs = np.hstack([D @ H, C, np.zeros((2, n)), D @ v])
    state = np.hstack([A, np.zeros((n, m)), w, np.zeros((n, 2))]) + B @ inputs
    reading = np.hstack([H, np.zeros((2, m + n)), v])
    kept = np.hstack([np.zeros((states, n)), plant.A @ corrected, np.zeros((states, 2 + n + 2))])
    estimate = kept + plant.A @ K @ reading + plant.B @ inputs
    previous = np.pad(np.eye(2), ((0, 0), (n + m - 2, n + 2)))
    radius = np.eye(1, n + m + n + 2)
    both = np.vstack([state, estimate, inputs])
    return both[:, : n + m], both[:, n + m :], np.vstack([radius, inputs[:1], inputs - previous])


def stationary_cost(gains):
    """Mean of the cost's terms by the covariance equation P = A P A' + B B'."""
    A, B, signals = closed_loop(gains)
    plant = gains.filter.plant
    own = np.concatenate([SCALES, np.full(len(plant.A) - len(STATES), MM)])
    scales = np.concatenate([own[stationary(plant)], own, [MM_PER_MIN, KILO]])
    A, B = A / scales[:, None] * scales, B / scales[:, None]
    P = solve_discrete_lyapunov(A, B @ B.T, method="direct") * np.outer(scales, scales)
    by_state, by_noise = np.split(signals, [len(A)], axis=1)
    return PER_SQUARE * np.diag(by_state @ P @ by_state.T + by_noise @ by_noise.T)


@pytest.mark.parametrize(("ring", "dt"), [(None, 5.0), (KNOWN, 5.0), (RingModel(5.0), 10.0)])
def test_cost_through_predict_matches_the_covariance_equation(ring, dt):
    """Mean cost under white noise is the sum of what one kick of each noise costs: one slot a kick."""
    gains = gains_of(ring, dt)
    plant = gains.filter.plant
    moving = stationary(plant)
    both, m = np.ix_(moving, moving), len(moving)
    A, B, H = plant.A[both], plant.B[moving], plant.H[:, moving]
    kicks = np.vstack([root(plant.Q[both]).T, np.zeros((2, m))])
    glitches = np.vstack([np.zeros((m, 2)), np.diag(noise_sds(gains))])
    x, u, state, cost, settle = np.zeros((m + 2, m)), np.zeros((m + 2, 2)), None, [], 700
    controller = LQG(dt, replace(LINEAR, ring=ring))
    for k in range(settle + 1200):
        y = x @ H.T + glitches * (k == settle)
        action, state = controller.predict(measured(ring_error=y[:, 0], T_1=y[:, 1], v_p=u[:, 0], Q_H=u[:, 1]), state)
        moved = action.astype(float) * [PULLER.v_0, 1e4]
        cost.append(PER_SQUARE * np.sum(np.square([x[:, 0], moved[:, 0], *(moved - u).T]), axis=1))
        x, u = x @ A.T + moved @ B.T + kicks * (k == settle), moved
    terms = np.sum(cost, axis=0)
    np.testing.assert_allclose(terms, stationary_cost(gains), rtol=1e-2)
    assert np.sum(cost[-100:]) < 1e-3 * np.sum(terms)


def test_to_know_of_the_latency_costs_less_than_to_ignore_it():
    costs = [sum(stationary_cost(gains_of(RingModel(latency)))) for latency in (0.0, 5.0, 10.0)]
    assert costs[0] == pytest.approx(sum(stationary_cost(gains_of())), rel=1e-9)
    assert costs[0] < costs[1] < costs[2]
