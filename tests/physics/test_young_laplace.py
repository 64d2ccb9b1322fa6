"""The exact meniscus against an independent solver, its limits and its table."""

import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_bvp

from cz_gym import Parameters, make_puller
from cz_gym.physics import young_laplace as exact
from cz_gym.physics.linearisation import radius_model
from cz_gym.physics.meniscus import HURLE, profile, ring_point
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.task import HEIGHT_MAX_IN_A, HEIGHT_MIN

PULLER = make_puller()
A, R_0, ALPHA_0, PHI_B = PULLER.a, PULLER.r_0, math.radians(11.0), math.radians(3.5)


@pytest.mark.parametrize("r_c", [0.05, 0.0875, 0.15])
@pytest.mark.parametrize("h_c", [1.2e-3, 4e-3, 6.6e-3])
def test_shooting_against_collocation(r_c, h_c):
    """z(r) as a boundary-value problem, in capillary constants, solved by another method."""

    def bend(r, y):
        z, slope = y
        steep = 1.0 + slope * slope
        return np.vstack([slope, 2.0 * z * steep**1.5 - slope * steep / r])

    first, h = r_c / A, h_c / A
    r = first + np.linspace(0.0, 1.0, 400) ** 2 * 12.0
    guess = h * np.exp(-math.sqrt(2.0) * (r - first))
    found = solve_bvp(
        bend, lambda at, far: np.array([at[0] - h, far[0]]), r, [guess, -guess], tol=1e-9, max_nodes=200_000
    )
    assert found.success
    solution = exact.solve(r_c, h_c, A, PHI_B)
    assert float(solution.theta) == pytest.approx(0.5 * math.pi - math.atan(-found.sol(first)[1]), abs=1e-7)
    ring = first + float(solution.ring_offset) / A
    if ring > first:
        assert math.atan(-found.sol(ring)[1]) == pytest.approx(PHI_B, rel=1e-6)


def test_wide_crystal_is_planar():
    h = np.linspace(0.2, 1.2, 6) * A
    solution = exact.solve(1e4, h, A, PHI_B)
    np.testing.assert_allclose(np.sin(solution.theta), 1.0 - (h / A) ** 2, atol=1e-6)
    np.testing.assert_allclose(solution.ring_offset, A * (ring_point(PHI_B) - profile(h / A, 1.0)), rtol=1e-6)


@pytest.mark.parametrize(
    ("narrowest", "slopes", "ring", "height"), [(0.05, (1.0, 12.0), 1e-7, 1e-9), (A / 0.3, (0.5, 15.0), 2e-6, 3e-9)]
)
def test_table_against_the_exact_solution(narrowest, slopes, ring, height):
    random = np.random.default_rng(0)
    r, phi_b = random.uniform(narrowest, 0.15, 200), np.radians(random.uniform(*slopes, 200))
    h = random.uniform(HEIGHT_MIN, HEIGHT_MAX_IN_A * A, 200)
    solution = exact.solve(r, h, A, phi_b)
    p = SimpleNamespace(a=A, X_b=ring_point(phi_b))
    sine, cosine = YOUNG_LAPLACE.slope(r, h, p)
    np.testing.assert_allclose(np.arctan2(sine, cosine), solution.theta, atol=1e-8)
    np.testing.assert_allclose(YOUNG_LAPLACE.ring_offset(r, h, p), solution.ring_offset, atol=ring * A)
    np.testing.assert_allclose(YOUNG_LAPLACE.height(r, solution.theta, A), h, rtol=height)


@pytest.mark.parametrize("degrees", [1.0, 3.5, 10.0])
def test_ring_sensitivity_against_the_exact_solution(degrees):
    """How fast the ring moves with the height, at the operating point: what G_m hangs on."""
    step, phi_b = 1e-4 * A, math.radians(degrees)
    h = float(exact.solve_height(R_0, ALPHA_0, A))
    low, high = exact.solve(R_0, h + np.array([-step, step]), A, phi_b).ring_offset
    p = make_puller(Parameters(phi_b=phi_b), meniscus=YOUNG_LAPLACE)
    model = radius_model(p, YOUNG_LAPLACE)
    assert model.lead * model.numerator == pytest.approx((high - low) / (2.0 * step), rel=1e-5)


def test_hurle_is_within_its_known_error():
    for r_c in (0.05, 0.0875, 0.15):
        hurle = float(HURLE.height(r_c, ALPHA_0, A))
        assert float(exact.solve_height(r_c, ALPHA_0, A)) == pytest.approx(hurle, rel=6e-3)


def test_environment_runs_on_the_exact_meniscus():
    """Compiled and plain agree, and the operating point is a steady state."""
    env = gym.make("Cz-v0", scenario="nominal", model="I", meniscus=YOUNG_LAPLACE, info="all")
    p = make_puller(meniscus=YOUNG_LAPLACE)
    env.reset(seed=0)
    for _ in range(20):
        info = env.step(np.zeros(2, np.float32))[4]
    assert info["h_c"] == pytest.approx(p.h_0, rel=1e-12)
    assert info["r_c"] == pytest.approx(p.r_0, rel=1e-12)
    for _ in range(60):
        info = env.step(np.array([-0.2, 0.0], np.float32))[4]
    offset = YOUNG_LAPLACE.ring_offset(info["r_c"], info["h_c"], p)
    assert info["r_br"] == pytest.approx(info["r_c"] + offset, rel=1e-12)
    theta = float(exact.solve(info["r_c"], info["h_c"], p.a, PHI_B).theta)
    assert info["alpha_c"] == pytest.approx(theta - ALPHA_0, abs=1e-8)
    env.close()


def test_outside_the_table_is_nan():
    p = SimpleNamespace(a=A, X_b=float(ring_point(PHI_B)))
    assert all(np.isnan(YOUNG_LAPLACE.slope(0.02, 5e-3, p)))
    assert np.isnan(YOUNG_LAPLACE.ring_offset(R_0, 5e-3, SimpleNamespace(a=A, X_b=float(ring_point(0.5)))))


def test_no_meniscus_rises_that_high():
    with pytest.raises(ArithmeticError, match="Young-Laplace"):
        exact.solve(0.01, 1.4 * A, A, PHI_B)
