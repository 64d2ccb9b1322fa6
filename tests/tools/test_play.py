"""Pulling by hand: keys posted to a window nobody sees, the score, and refusals in one line."""

import itertools
import sys

import numpy as np
import pytest

from cz_gym import CzEnv, make_puller
from cz_gym.config import make_config
from cz_gym.rendering import canvas
from cz_gym.tools import play
from cz_gym.tools.registry import find_controller

pygame = pytest.importorskip("pygame")
gymnasium_play = pytest.importorskip("gymnasium.utils.play")


@pytest.fixture
def quick(monkeypatch):
    """A clock that does not wait, and matplotlib's backend as it was."""
    backend = pytest.importorskip("matplotlib").rcParams["backend"]
    monkeypatch.setattr(pygame.time, "Clock", lambda: type("Clock", (), {"tick": lambda *_: None}))
    yield
    sys.modules["matplotlib"].rcParams["backend"] = backend


def test_keys_move_the_drives_while_they_are_held():
    keys, p = play.keys_to_actions(), make_puller()
    assert len(keys) == 17  # of three by three by two, all but none; shift alone does nothing
    env = CzEnv("nominal", action="rate", info="all")
    for pressed, pull, heat in (
        ((pygame.K_UP,), 0.01, 0.0),
        ((pygame.K_DOWN, pygame.K_LSHIFT), -0.1, 0.0),
        ((pygame.K_LEFT, pygame.K_UP), 0.01, -0.005),
        ((pygame.K_RIGHT, pygame.K_LSHIFT), 0.0, 0.05),
    ):
        env.reset(seed=1)
        info = env.step(keys[tuple(sorted(pressed))])[-1]
        assert info["v_p"] / p.v_0 - 1.0 == pytest.approx(pull, rel=1e-5, abs=1e-9)
        assert (info["Q_H"] - p.Q_H_0) / 10e3 == pytest.approx(heat, rel=1e-5, abs=1e-9)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("leaves", [True, False])
def test_a_run_ends_with_the_score(leaves, monkeypatch, capsys):
    """Up to the horizon of 5 min, or 21 steps: 20 without a key and one more that ends the game."""
    shown, counter = [], itertools.count()
    display = gymnasium_play.display_arr

    def watch(screen, picture, **options):
        shown.append(int(picture.max()))
        display(screen, picture, **options)
        if leaves and next(counter) == 20:
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE))

    monkeypatch.setattr(gymnasium_play, "display_arr", watch)
    assert play.main(["--minutes", "5", "--seed", "3"]) == 0
    steps = 20 if leaves else 60
    assert len(shown) == steps + 1
    assert min(shown) > 200
    config = make_config("randomized", None, "measured", horizon=300.0, action="rate")
    told = capsys.readouterr().out
    assert told.replace("\n", " ") == play.score(config, 3, [np.zeros(2, np.float32)] * steps, False) + " "
    assert max(map(len, told.splitlines())) <= 80


def test_the_score_of_the_same_controller_is_a_draw():
    config = make_config("randomized", None, "measured", horizon=600.0, action="direct")
    paper = find_controller("paper").make(config)
    env, state, actions, over = CzEnv.from_config(config), None, [], False
    observation, _ = env.reset(seed=12)
    while not over:
        action, state = paper.predict(observation, state)
        actions.append(action)
        observation, _, _, over, _ = env.step(action)
    by_hand, by_paper = play.score(config, 12, actions, False).split("; ")
    assert by_hand.partition("by hand ")[2] == by_paper.partition("controller ")[2]


def test_playing_without_pygame_says_what_to_install(monkeypatch, refused):
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert refused(play.main, []) == f"cz-gym play: {canvas.MISSING}\n"


def test_playing_without_a_display_is_refused_in_one_line(monkeypatch, refused):
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    assert refused(play.main, []) == f"cz-gym play: {play.NO_DISPLAY}\n"
    pygame.display.quit()
    if sys.platform.startswith("linux"):  # where displays have names
        for name in play.DISPLAYS:
            monkeypatch.delenv(name, raising=False)
        assert refused(play.main, []) == f"cz-gym play: {play.NO_DISPLAY}\n"
