import math

import numba
import numpy as np
import pytest
from scipy.optimize import bisect

from cz_gym import make_puller
from cz_gym.camera import view as rays
from cz_gym.camera.image import radiance, sight, wall_edge
from cz_gym.camera.view import (
    FLAT,
    MELT,
    Camera,
    Hit,
    Ray,
    Scene,
    first_hit,
    make_scene,
    make_view,
    mirror,
    profile_at,
    project,
    slope_at,
)
from cz_gym.physics.meniscus import hurle_slope, profile

PULLER = make_puller()
VIEW = make_view(Camera())


def scene_at(r_c=PULLER.r_0, h_c=PULLER.h_0):
    return Scene(*map(float, make_scene(r_c, h_c, PULLER)))


def height_of_melt(r, scene):
    """Height of the surface at a distance from the axis, by bisection on the plant's own profile."""
    if r <= scene.r_c:
        return math.inf

    def beyond(z):
        return scene.r_c + float(profile(z, scene.M) - profile(scene.h_c, scene.M)) - r

    return bisect(beyond, 1e-9, scene.h_c, xtol=1e-18) if beyond(1e-9) > 0.0 else 1e-9


@pytest.mark.parametrize("h_c", [1.2e-3, 4e-3, 6.64e-3, 9e-3])
def test_the_profile_is_the_plants(h_c):
    scene = scene_at(h_c=h_c)
    for q in np.linspace(scene.q_c, 8.0, 30):
        r, z, dr, dz = profile_at(q, scene)
        assert r - scene.r_c == pytest.approx(float(profile(z, scene.M) - profile(h_c, scene.M)), abs=1e-13)
        sine, cosine = slope_at(q)
        assert math.hypot(sine, cosine) == pytest.approx(1.0, abs=1e-14)
        assert dz * cosine == pytest.approx(-dr * sine, abs=1e-15)
    sin_theta, _ = hurle_slope(scene.r_c, h_c, PULLER)
    assert slope_at(scene.q_c)[1] == pytest.approx(float(sin_theta), abs=1e-12)


def test_rays_meet_the_melt_where_marching_says():
    """Oracle: bisection between the last point above the surface and the first below, marched in steps of 0.1 mm."""
    rng = np.random.default_rng(1)
    scene = scene_at()
    met = 0
    for _ in range(25):
        ray = sight(rng.uniform(40, 120), rng.uniform(0, 160), VIEW)
        hit = first_hit(ray, scene.q_c, scene, VIEW)
        if hit.what != MELT:
            continue
        met += 1

        def above(t, ray=ray):
            r = math.hypot(ray.x + t * ray.dx, ray.y + t * ray.dy)
            return ray.z + t * ray.dz - height_of_melt(r, scene)

        t = (0.02 - ray.z) / ray.dz
        while above(t) > 0.0:
            t += 1e-4
        at = np.array([ray.x, ray.y, ray.z]) + bisect(above, t - 1e-4, t) * np.array([ray.dx, ray.dy, ray.dz])
        np.testing.assert_allclose([hit.x, hit.y, hit.z], at, atol=2e-9)
    assert met > 12


def test_rays_are_mirrored_by_the_law_of_reflection():
    rng = np.random.default_rng(2)
    scene = scene_at()
    for _ in range(50):
        q, angle = rng.uniform(scene.q_c, FLAT), rng.uniform(-0.6, 0.6)
        r, z, _, _ = profile_at(q, scene)
        hit = Hit(MELT, r * math.cos(angle), r * math.sin(angle), z, q)
        ray = Ray(0.4, 0.0, 0.9, hit.x - 0.4, hit.y, hit.z - 0.9)
        out = mirror(ray, hit)
        sine, cosine = slope_at(q)
        n = np.array([sine * math.cos(angle), sine * math.sin(angle), cosine])
        before, after = np.array(ray[3:]), np.array(out[3:])
        assert before @ n == pytest.approx(-after @ n, abs=1e-14)
        np.testing.assert_allclose(before - (before @ n) * n, after - (after @ n) * n, atol=1e-14)
        assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before), rel=1e-14)


@pytest.mark.parametrize(
    ("ray", "what", "at"),
    [
        (Ray(0.2, 0.0, 0.5, -1.0, 0.0, -1.0), rays.CRYSTAL, (PULLER.r_0, 0.0, 0.5 - (0.2 - PULLER.r_0))),
        (Ray(0.2, 0.0, 0.05, 1.0, 0.0, -0.1), rays.WALL, (0.28, 0.0, 0.042)),
        (Ray(0.2, 0.0, 0.05, 1.0, 0.0, 0.1), rays.WALL, (0.28, 0.0, 0.058)),
        (Ray(0.2, 0.0, 0.10, 1.0, 0.0, 1.0), rays.SHIELD, (0.22, 0.0, 0.12)),
        (Ray(0.2, 0.0, 0.20, 0.0, 0.0, -1.0), rays.SHIELD, (0.2, 0.0, 0.12)),
        (Ray(0.17, 0.0, 0.10, 0.0, 0.0, -1.0), MELT, (0.17, 0.0, 0.0)),
        (Ray(0.12, 0.0, 0.10, 0.0, 0.0, 1.0), rays.OPENING, None),
        (Ray(0.12, 0.0, 0.01, -1.0, 0.0, 0.5), rays.CRYSTAL, (PULLER.r_0, 0.0, 0.01 + 0.5 * (0.12 - PULLER.r_0))),
    ],
)
def test_rays_hit_the_first_surface_in_their_way(ray, what, at):
    scene = scene_at()
    hit = first_hit(ray, FLAT if ray.dz > 0 else scene.q_c, scene, VIEW)
    assert hit.what == what
    if at is not None:
        np.testing.assert_allclose([hit.x, hit.y, hit.z], at, atol=1e-4 if what == MELT else 1e-12)


@pytest.mark.parametrize(("tilt", "wall_height"), [(0.2, 0.12), (0.349, 0.12), (0.45, 0.08), (0.349, 0.2)])
def test_the_rings_edge_halves_the_angle_between_camera_and_walls_end(tilt, wall_height):
    """The jump of brightness down the middle, by bisection on traced rays, against the half-angle's closed form."""
    view = make_view(Camera(tilt=tilt, wall_height=wall_height))
    scene = scene_at()
    edge = wall_edge(scene, view)
    row = float(project(edge.r, 0.0, edge.z, view).row)

    def excess(row):
        return radiance(sight(row, 80.0, view), scene, view) - 0.5

    assert excess(row - 0.5) > 0.0 > excess(row + 0.5)
    jump = bisect(excess, row - 0.5, row + 0.5)
    assert jump == pytest.approx(row, abs=1e-6)
    hit = first_hit(sight(jump, 80.0, view), scene.q_c, scene, view)
    assert math.acos(slope_at(hit.q)[1]) == pytest.approx(edge.slope, abs=1e-7)


@numba.njit(error_model="numpy")
def _compiled(row, column, scene, view):
    return radiance(sight(row, column, view), scene, view)


def test_compiled_equals_uncompiled():
    rng = np.random.default_rng(3)
    for h_c in (1.2e-3, 4e-3, 6.64e-3, 9.3e-3):
        scene = scene_at(PULLER.r_0 + rng.uniform(-8e-3, 8e-3), h_c)
        for _ in range(40):
            row, column = rng.uniform(0, 120), rng.uniform(0, 160)
            plain = radiance(sight(row, column, VIEW), scene, VIEW)
            assert _compiled(row, column, scene, VIEW) == pytest.approx(plain, rel=1e-9)
            mirrored = radiance(sight(row, 160.0 - column, VIEW), scene, VIEW)
            assert mirrored == pytest.approx(plain, rel=1e-9)
