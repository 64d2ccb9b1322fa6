"""The camera: rays against bisection and geometry, images against the readings they show."""

import math

import gymnasium as gym
import numba
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from scipy.optimize import bisect
from stable_baselines3.common.env_checker import check_env as check_with_sb3

from cz_gym import CzEnv, Parameters, make_puller
from cz_gym.camera import view as rays
from cz_gym.camera.image import RingDetector, picture, radiance, sight, wall_edge
from cz_gym.camera.view import FLAT, IMAGE, MELT, Camera, Ray, first_hit, make_scene, make_view, profile_at, slope_at
from cz_gym.config import make_config
from cz_gym.episodes.draw import stream_number
from cz_gym.episodes.scenario import Scenario, Sensor
from cz_gym.physics.meniscus import hurle_ring_offset, hurle_slope, profile
from cz_gym.physics.young_laplace import YOUNG_LAPLACE

PULLER = make_puller()
VIEW = make_view(Camera())


def scene_at(r_c=PULLER.r_0, h_c=PULLER.h_0):
    return rays.Scene(*map(float, make_scene(r_c, h_c, PULLER)))


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
        hit = rays.Hit(MELT, r * math.cos(angle), r * math.sin(angle), z, q)
        ray = Ray(0.4, 0.0, 0.9, hit.x - 0.4, hit.y, hit.z - 0.9)
        out = rays.mirror(ray, hit)
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
    row = float(rays.project(edge.r, 0.0, edge.z, view).row)

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


ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 3, 2)).astype(np.float32)


@pytest.fixture(scope="module")
def detector():
    return RingDetector(VIEW, PULLER)


@pytest.mark.filterwarnings("error")
def test_gymnasiums_and_sb3s_checkers_pass():
    env = gym.make("Cz-v0", observation="camera", horizon=600.0)
    check_with_gymnasium(env.unwrapped, skip_render_check=True)
    check_with_sb3(env, warn=True)
    assert env.observation_space == gym.spaces.Box(0, 255, (120, 160, 1), np.uint8)


def test_steps_and_info_equal_those_of_measured():
    camera, measured = CzEnv("puller", observation="camera"), CzEnv("puller")
    assert repr(camera.reset(seed=3)[1]) == repr(measured.reset(seed=3)[1])
    for action in ACTIONS[:10, 0]:
        assert repr(camera.step(action)[1:]) == repr(measured.step(action)[1:])


def test_the_image_shows_the_reading_not_the_truth(detector):
    """The ring in the image is the reading, noise included: what "measured" says, and nothing better."""
    env, measured = (
        CzEnv("only-sensor", observation=name, horizon=200.0, info="all") for name in ("camera", "measured")
    )
    image, info = env.reset(seed=4)
    shown, _ = measured.reset(seed=4)
    bias = detector.read(picture(PULLER.r_0, PULLER.h_0, PULLER, VIEW)).radius - PULLER.r_0
    errors, truths = [], []
    for _ in range(15):
        reading = info["r_ref"] + 1e-3 * float(shown[0])
        radius = detector.read(image).radius - bias
        errors.append(radius - reading)
        truths.append(reading - (info["r_br"] - PULLER.ring_bias))
        image, _, _, _, info = env.step(np.zeros(2, np.float32))
        shown, *_ = measured.step(np.zeros(2, np.float32))
    assert np.std(truths) > 1e-5
    assert np.std(errors) < 0.5 * np.std(truths)


def test_flagged_readings_are_black_and_unflagged_freezes_repeat_the_image():
    env, measured = (CzEnv("sensor-fault", observation=name, horizon=600.0) for name in ("camera", "measured"))
    black = frozen = 0
    over, rest = True, np.zeros(2, np.float32)
    for seed in (0, 4):
        image, _ = env.reset(seed=seed)
        shown, _ = measured.reset(seed=seed)
        over = False
        while not over:
            before, was = image, shown
            image, _, terminated, truncated, _ = env.step(rest)
            shown, *_ = measured.step(rest)
            over = terminated or truncated
            assert (image.max() == 0) == (shown[1] == 0.0)
            black += int(image.max() == 0)
            if shown[1] and was[1] and shown[0] == was[0] and shown[2] == was[2]:
                np.testing.assert_array_equal(image, before)
                frozen += 1
    assert black > 0
    assert frozen > 0


def test_shot_noise_is_that_of_its_frames_stream():
    """Frame k draws from NumPy's stream 8 + k whatever members Stream has; no member shares a frame's numbers."""
    faint = Scenario("faint-noise", sensor=Sensor(camera_noise=(1e-12, 1e-12)))
    env = CzEnv(faint, observation="camera")
    image, _ = env.reset(seed=0)
    key = env._slots["key"][0].tolist()
    still = picture(PULLER.r_0, PULLER.h_0, PULLER, VIEW)[..., 0].astype(float)
    for k in range(2):
        numbers = np.random.Generator(np.random.PCG64(np.random.SeedSequence(key, spawn_key=(8 + k,))))
        # Each pixel of the left half draws, then its mirror image.
        left, right = np.moveaxis(numbers.standard_normal((rays.ROWS, rays.COLUMNS // 2, 2)), 2, 0)
        noise = np.hstack([left, right[:, ::-1]]) * np.sqrt(still / VIEW.electrons)
        assert np.abs(image[..., 0] - np.minimum(still + noise, 255.0)).max() < 1.1
        image, *_ = env.step(np.zeros(2, np.float32))
    assert [stream_number(index) for index in range(8)] == [*range(8)]
    horizon = 10_000_000
    assert not {stream_number(index) for index in range(8, 100)} & set(range(8, 8 + horizon))


def test_the_ring_follows_geometry_and_closed_form_within_a_pixel(detector):
    at_rest = wall_edge(make_scene(PULLER.r_0, PULLER.h_0, PULLER), VIEW).r - PULLER.r_0
    for dr in np.linspace(-8e-3, 8e-3, 5):
        for dh in (-1.5e-3, 0.0, 1e-3, 2e-3):
            r_c, h_c = PULLER.r_0 + dr, PULLER.h_0 + dh
            radius = detector.read(picture(r_c, h_c, PULLER, VIEW)).radius
            closed_form = r_c + hurle_ring_offset(r_c, h_c, PULLER) - PULLER.ring_bias
            assert abs(radius - closed_form) < 0.5 * detector.pixel
            assert abs(radius - (wall_edge(make_scene(r_c, h_c, PULLER), VIEW).r - at_rest)) < 0.15 * detector.pixel


def test_an_image_without_a_ring_reads_as_nan(detector):
    flat = picture(PULLER.r_0, 3e-3, PULLER, VIEW)
    for image in (np.zeros(IMAGE, np.uint8), np.full(IMAGE, 200, np.uint8), flat):
        assert math.isnan(detector.read(image).radius)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        *(
            (lambda change=change: rays.check_camera(Camera()._replace(**change), Parameters()), says)
            for change, says in (
                ({"tilt": 1.6}, "tilt"),
                ({"distance": 0.1}, "above the heat shield"),
                ({"focal_length": 0.0}, "focal_length"),
                ({"pixel_pitch": math.nan}, "pixel_pitch"),
                ({"melt_emissivity": 1.2}, "must not exceed 1"),
                ({"shield_radius": 0.05}, "opening"),
                ({"wall_temperature": "hot"}, "wall_temperature"),
            )
        ),
        (lambda: make_config(camera=Camera()), "observation"),
        (lambda: make_config(observation="camera", camera=3), r"cz_gym\.camera\.Camera"),
        (lambda: RingDetector(make_view(Camera(aim=0.02)), PULLER), "no bright ring"),
    ],
)
def test_impossible_cameras_are_refused_in_one_line(call, says):
    with pytest.raises(ValueError, match=says) as raised:
        call()
    assert "\n" not in str(raised.value)


def test_a_camera_changes_the_hash():
    assert len({make_config(observation="camera", camera=Camera(tilt=tilt)).hash for tilt in (0.3, 0.35)}) == 2


def test_images_and_detector_follow_another_puller():
    parameters = Parameters(r_0=0.06, R_cr=0.2)
    puller, view = make_puller(parameters), make_view(rays.camera_for(parameters))
    assert abs(RingDetector(view, puller).read(picture(0.061, puller.h_0, puller, view)).radius - 0.061) < 1e-4
    image, _ = CzEnv("nominal", observation="camera", parameters=parameters).reset(seed=0)
    np.testing.assert_array_equal(image, picture(puller.r_0, puller.h_0, puller, view))


@pytest.mark.slow  # compiles step and image for another meniscus
def test_images_and_detector_follow_the_exact_meniscus():
    puller = make_puller(meniscus=YOUNG_LAPLACE)
    detector = RingDetector(VIEW, puller)
    env = CzEnv("nominal", observation="camera", action="direct", meniscus=YOUNG_LAPLACE, info="all")
    image, _ = env.reset(seed=0)
    np.testing.assert_array_equal(image, picture(puller.r_0, puller.h_0, puller, VIEW))
    for _ in range(12):
        image, _, _, _, info = env.step(np.array([-0.5, 0.0], np.float32))
        assert abs(detector.read(image).radius - (info["r_br"] - puller.ring_bias)) < 0.2 * detector.pixel
    assert abs(info["h_c"] - puller.h_0) > 3e-4
