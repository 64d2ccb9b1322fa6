"""Hurle's meniscus and the exact one, against independent solvers, and their limits."""

import math
from types import SimpleNamespace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_bvp, solve_ivp
from scipy.optimize import newton
from scipy.special import k0e, k1e

from cz_gym import Parameters, make_puller
from cz_gym.body.process import radius_model
from cz_gym.physics import meniscus
from cz_gym.physics.meniscus import HURLE, hurle_height, hurle_ring_offset, hurle_slope, profile, ring_point
from cz_gym.physics.plant import HEIGHT_MAX_IN_A, HEIGHT_MIN
from cz_gym.physics.young_laplace import YOUNG_LAPLACE

PULLER = make_puller()


@pytest.fixture
def points(rng):
    """Radii and heights over everything the limits allow."""
    return rng.uniform(0.06, 0.12, 2000), rng.uniform(HEIGHT_MIN, HEIGHT_MAX_IN_A * PULLER.a, 2000)


def angles(r_c, h_c):
    """Theta as the design prints it."""
    A, B = h_c / (2 * r_c), 1 - h_c**2 / PULLER.a**2
    return np.arcsin(B / np.sqrt(1 + A**2)) - np.arctan(A)


def test_height_is_the_inverse_of_the_slope(points):
    r_c, h_c = points
    np.testing.assert_allclose(hurle_height(r_c, angles(r_c, h_c), PULLER.a), h_c, rtol=1e-12)


def slope_of_profile(z, M):
    """dX/dz by complex step."""
    return profile(z + 1e-30j, M).imag / 1e-30


def test_profile_leaves_the_crystal_at_theta(points):
    r_c, h_c = points
    sine, cosine = hurle_slope(r_c, h_c, PULLER)
    M = meniscus.profile_scale(r_c, h_c, cosine, PULLER.a)
    np.testing.assert_allclose(slope_of_profile(h_c, M), -sine / cosine, rtol=1e-9, atol=1e-12)


def test_bright_ring_is_where_the_profile_has_its_slope():
    phi_b = np.radians(3.5)
    M = 0.0071
    z_b = M * np.sqrt(1 - np.cos(phi_b))
    assert slope_of_profile(z_b, M) == pytest.approx(-1 / np.tan(phi_b), rel=1e-9)
    assert M * ring_point(phi_b) == pytest.approx(profile(z_b, M), rel=1e-12)


def test_ring_offset_is_the_profile_between_its_two_points(points):
    r_c, h_c = points
    M = 1 / np.sqrt(1 / PULLER.a**2 + np.cos(angles(r_c, h_c)) / (2 * r_c * h_c))
    z_b = M * np.sqrt(1 - np.cos(np.radians(3.5)))
    expected = profile(z_b, M) - profile(h_c, M)
    np.testing.assert_allclose(hurle_ring_offset(r_c, h_c, PULLER), expected, rtol=1e-10)
    assert (expected > 0).all()


def test_nominal_height_and_bias_are_the_published_ones():
    assert PULLER.h_0 == pytest.approx(6.640e-3, rel=1e-3)
    assert PULLER.ring_bias == pytest.approx(14.10e-3, rel=1e-3)
    sine, cosine = hurle_slope(PULLER.r_0, PULLER.h_0, PULLER)
    assert np.degrees(np.arctan2(sine, cosine)) == pytest.approx(11.0, abs=1e-9)


def test_no_ring_beyond_the_profile():
    with np.errstate(invalid="ignore"):
        assert np.isnan(hurle_ring_offset(np.array([0.0875]), np.array([1.45 * PULLER.a]), PULLER)).all()


A, R_0, ALPHA_0, PHI_B = PULLER.a, PULLER.r_0, math.radians(11.0), math.radians(3.5)
TAIL = 1e-6
"""Height at which the linear tail hands over to the shooting [a]."""


class Solution(NamedTuple):
    """Exact menisci: angle [rad] at the triple point, and distance [m] from there out to the bright ring."""

    theta: Any
    ring_offset: Any


def solve(r_c, h_c, phi_b=PHI_B):
    """Menisci of these radii and heights [m], by shooting from the linear tail z = c K_0(sqrt(2) r)."""
    r, h, ring_slope = np.broadcast_arrays(np.atleast_1d(r_c) / A, h_c / A, phi_b)
    k = math.sqrt(2.0)

    def shoot(outer, slopes, *other):
        first = np.concatenate([outer, *other])
        run = solve_ivp(slopes, (0.0, 1.0), first, method="DOP853", rtol=1e-11, atol=1e-13)
        return run.y[:, -1].reshape(2, -1)

    def tail_slope(outer):
        return np.arctan(TAIL * k * k1e(k * outer) / k0e(k * outer))

    def rise(outer):
        """Radius and slope at the height h; log(z) runs."""

        def slopes(tau, y):
            (r, phi), z = y.reshape(2, -1), TAIL * (h / TAIL) ** tau
            ds = z * np.log(h / TAIL) / np.sin(phi)
            return np.concatenate([-np.cos(phi) * ds, (2.0 * z + np.sin(phi) / r) * ds])

        return shoot(outer, slopes, tail_slope(outer))

    outer = newton(lambda outer: rise(outer)[0] - r, r + profile(TAIL, 1.0) - profile(h, 1.0), tol=1e-12)
    first = tail_slope(outer)

    def turn(tau, y):
        (r, z), phi = y.reshape(2, -1), first * (ring_slope / first) ** tau
        ds = phi * np.log(ring_slope / first) / (2.0 * z + np.sin(phi) / r)
        return np.concatenate([-np.cos(phi) * ds, np.sin(phi) * ds])

    ring = shoot(outer, turn, np.full_like(outer, TAIL))[0]
    return Solution(0.5 * math.pi - rise(outer)[1], A * (ring - r))


@pytest.mark.parametrize("r_c", [0.05, 0.0875, 0.15])
@pytest.mark.parametrize("h_c", [1.2e-3, 4e-3, 6.6e-3])
def test_table_against_collocation(r_c, h_c):
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
    p = SimpleNamespace(a=A, X_b=ring_point(PHI_B))
    sine, cosine = YOUNG_LAPLACE.slope(r_c, h_c, p)
    assert math.atan2(sine, cosine) == pytest.approx(0.5 * math.pi - math.atan(-found.sol(first)[1]), abs=1e-7)
    ring = first + float(YOUNG_LAPLACE.ring_offset(r_c, h_c, p)) / A
    if ring > first:
        assert math.atan(-found.sol(ring)[1]) == pytest.approx(PHI_B, rel=1e-6)


@pytest.mark.parametrize(
    ("narrowest", "slopes", "ring", "height"), [(0.05, (1.0, 12.0), 1e-7, 1e-9), (A / 0.3, (0.5, 15.0), 2e-6, 3e-9)]
)
def test_table_against_the_exact_solution(narrowest, slopes, ring, height):
    random = np.random.default_rng(0)
    r, phi_b = random.uniform(narrowest, 0.15, 200), np.radians(random.uniform(*slopes, 200))
    h = random.uniform(HEIGHT_MIN, HEIGHT_MAX_IN_A * A, 200)
    solution = solve(r, h, phi_b)
    p = SimpleNamespace(a=A, X_b=ring_point(phi_b))
    sine, cosine = YOUNG_LAPLACE.slope(r, h, p)
    np.testing.assert_allclose(np.arctan2(sine, cosine), solution.theta, atol=1e-8)
    np.testing.assert_allclose(YOUNG_LAPLACE.ring_offset(r, h, p), solution.ring_offset, atol=ring * A)
    np.testing.assert_allclose(YOUNG_LAPLACE.height(r, solution.theta, A), h, rtol=height)


@pytest.mark.parametrize("degrees", [1.0, 3.5, 10.0])
def test_ring_sensitivity_against_the_exact_solution(degrees):
    """Derivative of the ring by the height at the operating point, on which G_m depends."""
    step, phi_b = 1e-4 * A, math.radians(degrees)
    p = make_puller(Parameters(phi_b=phi_b), meniscus=YOUNG_LAPLACE)
    low, high = solve(R_0, p.h_0 + np.array([-step, step]), phi_b).ring_offset
    model = radius_model(p, YOUNG_LAPLACE)
    assert model.lead * model.numerator == pytest.approx((high - low) / (2.0 * step), rel=1e-5)


def test_hurle_is_within_its_known_error():
    for r_c in (0.05, 0.0875, 0.15):
        hurle = float(HURLE.height(r_c, ALPHA_0, A))
        assert float(YOUNG_LAPLACE.height(r_c, ALPHA_0, A)) == pytest.approx(hurle, rel=6e-3)


@pytest.mark.slow
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
    theta = float(solve(info["r_c"], info["h_c"]).theta[0])
    assert info["alpha_c"] == pytest.approx(theta - ALPHA_0, abs=1e-8)
    env.close()


def test_values_outside_the_table_are_nan():
    p = SimpleNamespace(a=A, X_b=float(ring_point(PHI_B)))
    assert all(np.isnan(YOUNG_LAPLACE.slope(0.02, 5e-3, p)))
    assert np.isnan(YOUNG_LAPLACE.ring_offset(R_0, 5e-3, SimpleNamespace(a=A, X_b=float(ring_point(0.5)))))
