"""Pictures show the logged signals, in every render mode, and change nothing."""

import os
import pickle
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from scipy.integrate import trapezoid

from cz_gym import HURLE, CzEnv, Parameters, make_puller
from cz_gym.env import CzCrystalEnv
from cz_gym.physics.meniscus import hurle_slope
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.rendering import canvas
from cz_gym.rendering import picture as triple_point
from cz_gym.rendering.picture import MODES, Ending, Picture, check_size
from cz_gym.support.units import MM
from tests.conftest import ROOT, python
from tests.observed import PLAIN

pygame = pytest.importorskip("pygame")
BOX = Picture(640, 480).box


def grown(steps=240, pull=0.0, kind=CzEnv, **arguments):
    """A crystal pulled with a slow swing of the pull speed, so that its surface is not straight."""
    env = kind(render_mode="rgb_array", observation="measured", **arguments)
    env.reset(seed=4)
    for k in range(steps):
        if env.step(np.array([pull + 0.25 * np.sin(0.06 * k), 0.0], np.float32))[2]:
            break
    frame = env.render()
    assert frame is not None
    return frame, env._view.record


def near(frame, colour, within=70.0):
    """Pixels close to a colour, shape (height, width)."""
    return np.linalg.norm(frame.astype(float) - colour, axis=-1) < within


def check_near(pixels, expected, reach):
    """The pixels of a line that are set within ``reach`` of the expected coordinate are centred on it, to one pixel."""
    first = round(expected) - reach
    assert np.flatnonzero(pixels[first : first + 2 * reach]).mean() + first + 0.5 == pytest.approx(expected, abs=1.0)


@pytest.fixture(scope="module")
def picture():
    return grown()


def test_a_whole_crystals_scale_follows_its_crown():
    """From the axis on; the camera's radius is that of the recipe's ring; the header and the end say what it is."""
    widths = []
    for steps in (100, 900):
        frame, record = grown(steps, kind=CzCrystalEnv, action="direct", scenario="nominal")
        scale = triple_point.scale_of(BOX, record)
        assert scale.x(0.0) == BOX.x
        assert near(frame[round(scale.y_0) - 1], canvas.MELT).any()
        row, (r_c, _, z) = round(scale.y(record.last("h_c") + 5 * MM)), record.surface()
        edge = np.interp((scale.y_0 - (row + 0.5)) / scale.per_metre, z, r_c)
        check_near(near(frame[row], canvas.TRUE), scale.x(edge), 8)
        widths.append(scale.per_metre)
        assert abs(record.camera_error[-1] - record.error[-1]) < 2 * MM
    assert widths[0] > 2.0 * widths[1]
    assert record.length[-1] == record.last("L")


@pytest.mark.parametrize(
    ("moved", "by", "ending"),
    [("r_c", 13 * MM, "LOST"), ("h_c", 9 * MM, "DETACHED"), ("T_b", -30.0, "COLD"), ("L", 0.03, "DONE")],
)
def test_how_a_whole_crystal_ends(moved, by, ending):
    env = CzCrystalEnv(render_mode="rgb_array", observation="measured", scenario="nominal", stage=1.24)
    env.reset(seed=0)
    env._slots["x"][moved] += by
    assert env.step(np.zeros(2, np.float32))[2]
    assert env._view.record.ending is Ending[ending]
    assert env.render().shape == (480, 640, 3)


def test_the_drawn_surface_is_the_logged_radius(picture):
    frame, record = picture
    scale = triple_point.scale_of(BOX, record)
    r_c, _, z = record.surface()
    blue = near(frame, canvas.TRUE)
    rows = range(round(BOX.y) + 8, round(scale.y(z[0])) - 8)
    for row in rows:
        check_near(blue[row], scale.x(np.interp((scale.y_0 - (row + 0.5)) / scale.per_metre, z, r_c)), 12)
    assert len(rows) > 50
    assert np.ptp(r_c) > 0.05 * MM


@pytest.mark.parametrize(("pull", "r_0"), [(-0.3, 87.5e-3), (0.3, 87.5e-3), (0.0, 20e-3), (0.0, 150e-3)])
def test_the_rings_mark_is_at_the_rings_radius(pull, r_0):
    frame, record = grown(60, pull=pull, parameters=Parameters(r_0=r_0))
    scale = triple_point.scale_of(BOX, record)
    # In the melt, where the mark's line goes down from the ring.
    check_near(near(frame, canvas.CAMERA)[round(scale.y_0 + 34)], scale.x(record.last("r_br")), 8)


@pytest.mark.parametrize(("model", "tolerance"), [(HURLE, 1e-6), (YOUNG_LAPLACE, 0.3 * MM)], ids=["hurle", "exact"])
def test_the_drawn_meniscus_leaves_the_triple_point_and_meets_the_ring(model, tolerance, monkeypatch):
    """Hurle's curve leaves at Hurle's slope; through the exact model's slope it passes near the exact ring."""
    monkeypatch.setattr(triple_point, "POINTS", 20_001)
    p = make_puller(meniscus=model)
    for h_c in (0.004, p.h_0, 0.0085) if model is HURLE else (p.h_0,):
        r, z, z_b = triple_point.meniscus_curve(p.r_0, h_c, p, model, Parameters().phi_b)
        assert (r[0], z[0]) == (p.r_0, h_c)
        ring = p.r_0 + model.ring_offset(p.r_0, h_c, p)
        assert np.interp(-z_b, -z, r) == pytest.approx(ring, abs=tolerance)
        if model is HURLE:
            sine, cosine = hurle_slope(p.r_0, h_c, p)
            assert (r[1] - r[0]) / (z[0] - z[1]) == pytest.approx(sine / cosine, rel=2e-3)


def test_length_grown_is_the_integral_of_the_growth_rate(picture):
    record = picture[1]
    assert record.length[-1] == pytest.approx(trapezoid(record.column("v_g"), record.t), rel=2e-3)


@pytest.mark.parametrize(("pull", "ending"), [(1.0, Ending.DETACHED), (-1.0, Ending.FROZEN)])
def test_the_picture_of_a_failed_crystal_has_a_band_that_says_so(pull, ending):
    # Model I finds a balance without any pull; Model II grows on, and freezes.
    frame, record = grown(900, pull=pull, scenario="nominal", model="II")
    assert record.ending is ending
    assert near(frame, canvas.ALARM, 5.0)[round(BOX.y) : round(BOX.y) + 30].sum() > 0.3 * 20 * BOX.w


def trajectory(render_mode, scenario, steps=60):
    env = CzEnv(scenario=scenario, render_mode=render_mode, observation="history", action="direct")
    generator = np.random.default_rng(4)
    found = [env.reset(seed=9)]
    for _ in range(steps):
        found.append(env.step(generator.uniform(-1, 1, 2).astype(np.float32)))
        if render_mode == "rgb_array":
            env.render()
        if found[-1][2]:
            break
    found.append(env.get_state())
    env.close()
    return found


@pytest.mark.parametrize("mode", [None, *MODES])
def test_gymnasiums_checker_renders_every_mode_without_a_warning(mode):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make("Cz-v0", horizon=600.0, render_mode=mode, render_size=(641, 483), **PLAIN)
        check_env(env.unwrapped)
    if mode == "rgb_array":
        assert env.unwrapped.render().shape == (483, 641, 3)


@pytest.mark.parametrize("scenario", ["randomized", "puller"])
@pytest.mark.parametrize("mode", MODES)
def test_rendering_changes_nothing(mode, scenario, monkeypatch):
    monkeypatch.setattr("cz_gym.rendering.picture.FPS", 0)  # as fast as it can
    assert pickle.dumps(trajectory(mode, scenario)) == pickle.dumps(trajectory(None, scenario))


def test_the_users_environment_stays_as_it_was():
    code = (
        "import os, gymnasium as gym; before = dict(os.environ)\n"
        "import cz_gym\n"
        "env = gym.make('Cz-v0', render_mode='rgb_array'); env.reset(seed=1); env.render()\n"
        "import pygame; assert not pygame.display.get_init()\n"
        "assert dict(os.environ) == before"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SDL_")}
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=ROOT, capture_output=True, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


@pytest.mark.parametrize("size", [None, 640, "640x480", (640.0, 480.0), (640,), (359, 480), (640, 3841), (True, 480)])
def test_other_sizes_are_refused_in_one_line(size):
    with pytest.raises(ValueError, match=r"^render_size must be \(width, height\), .*not .*$"):
        check_size(size)


def test_before_the_first_reset_there_is_no_crystal():
    for env in (gym.make("Cz-v0", render_mode="rgb_array", **PLAIN), CzEnv(render_mode="rgb_array", **PLAIN)):
        with pytest.raises(ResetNeeded):
            env.render()


def test_a_frame_is_the_callers_own():
    env = CzEnv(render_mode="rgb_array", **PLAIN)
    env.reset(seed=1)
    first = env.render()
    assert first is not None
    kept = first.copy()
    first[:] = 0
    second = env.render()
    assert np.array_equal(second, kept)
    for _ in range(10):
        env.step(np.ones(2, np.float32))
    assert not np.array_equal(env.render(), kept)
    assert np.array_equal(second, kept)


def test_gymnasiums_wrappers_for_windows_and_lists_of_frames_work():
    env = gym.wrappers.HumanRendering(gym.make("Cz-v0", render_mode="rgb_array", **PLAIN))
    env.reset(seed=1)
    env.step(env.action_space.sample())
    env.close()
    again = CzEnv(render_mode="rgb_array", **PLAIN)  # the wrapper's pygame.quit() took the fonts with it
    again.reset(seed=1)
    assert again.render() is not None
    listed = gym.make("Cz-v0", render_mode="rgb_array_list", **PLAIN)
    listed.reset(seed=1)
    listed.step(listed.action_space.sample())
    assert len(listed.render()) == 2


@pytest.mark.slow
def test_without_pygame_nothing_is_declared_and_asking_says_what_to_install():
    code = (
        "import sys\nsys.modules['pygame'] = None\n"
        "import cz_gym\n"
        "assert cz_gym.CzEnv.metadata['render_modes'] == [], cz_gym.CzEnv.metadata\n"
        "try:\n    cz_gym.CzEnv(render_mode='rgb_array')\n"
        "except Exception as error:\n    print(type(error).__name__, error)\n"
    )
    assert python("-W", "error", "-c", code) == f"DependencyNotInstalled {canvas.MISSING}\n"


def test_a_window_that_cannot_open_is_one_clear_error(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    pygame.display.quit()
    env = CzEnv(render_mode="human", **PLAIN)
    with pytest.raises(gym.error.Error, match=r"cannot open a window: .*rgb_array"):
        env.reset(seed=1)
