import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from stable_baselines3.common.env_checker import check_env as check_with_sb3

from cz_gym import CzEnv, Parameters, make_puller
from cz_gym.camera.image import RingDetector, picture, wall_edge
from cz_gym.camera.view import COLUMNS, IMAGE, ROWS, Camera, camera_for, check_camera, make_scene, make_view
from cz_gym.config import make_config
from cz_gym.episodes.draw import stream_number
from cz_gym.episodes.scenario import Scenario, Sensor
from cz_gym.physics.meniscus import hurle_ring_offset
from cz_gym.physics.young_laplace import YOUNG_LAPLACE

PULLER = make_puller()
VIEW = make_view(Camera())
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
        left, right = np.moveaxis(numbers.standard_normal((ROWS, COLUMNS // 2, 2)), 2, 0)
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
            (lambda change=change: check_camera(Camera()._replace(**change), Parameters()), says)
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
    puller, view = make_puller(parameters), make_view(camera_for(parameters))
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
