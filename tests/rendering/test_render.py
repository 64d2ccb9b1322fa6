"""Render modes through Gymnasium: checkers, wrappers, sizes, failures; and that rendering changes nothing."""

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

from cz_gym import CzEnv
from cz_gym.rendering import canvas, view
from cz_gym.rendering.view import MODES, check_size
from tests.observed import PLAIN
from tests.processes import ROOT, python

pygame = pytest.importorskip("pygame")


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
    monkeypatch.setattr(view, "FPS", 0)  # as fast as it can
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


def test_without_pygame_nothing_is_declared_and_asking_says_what_to_install():
    code = (
        "import sys\nsys.modules['pygame'] = None\n"
        "import cz_gym\n"
        "assert cz_gym.CzEnv.metadata['render_modes'] == [], cz_gym.CzEnv.metadata\n"
        "cz_gym.CzEnv().reset(seed=1)\n"
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
