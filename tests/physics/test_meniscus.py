import numpy as np
import pytest

from cz_gym import make_puller
from cz_gym.physics.meniscus import hurle_height, hurle_ring_offset, hurle_slope, profile, profile_scale, ring_point
from cz_gym.physics.plant import HEIGHT_MAX_IN_A, HEIGHT_MIN

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
    M = profile_scale(r_c, h_c, cosine, PULLER.a)
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
