"""Pulling by hand: keys posted to a window nobody sees, the score, and what the commands say when they cannot."""

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from cz_gym import CzEnv
from cz_gym.baselines.registry import find_controller
from cz_gym.config import Config, make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.play import __main__ as play
from cz_gym.play import game as hand
from cz_gym.play.game import score
from cz_gym.rendering import canvas
from cz_gym.rendering.view import Window
from cz_gym.units import KILO, MM_PER_MIN
from tests.observed import PLAIN

pygame = pytest.importorskip("pygame")
SIZE = (480, 360)


@pytest.fixture
def config() -> Config:
    return make_config("randomized", horizon=600.0, **PLAIN)


@pytest.fixture
def game(config: Config) -> Iterator[hand.Game]:
    window = Window(SIZE, "test")
    yield hand.Game(window, SIZE, config, 1, 60.0, find_controller("paper").make(config))
    window.close()


def press(key: int, mod: int = 0) -> None:
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key, mod=mod))


def handle(game: hand.Game, *keys: int, mod: int = 0) -> None:
    for key in keys:
        game.handle(pygame.event.Event(pygame.KEYDOWN, key=key, mod=mod))


def test_arrows_move_the_set_points_which_the_drives_follow(game: hand.Game) -> None:
    p = game.record.puller
    assert game.set_points == (p.v_0, p.Q_H_0)
    handle(game, pygame.K_UP, pygame.K_UP, pygame.K_RIGHT, pygame.K_SPACE)
    assert game.set_points == pytest.approx((p.v_0 + 0.02 * MM_PER_MIN, p.Q_H_0 + 0.1 * KILO))
    game.advance(1.0)
    assert game.record.t[-1] == 60.0
    assert [game.record.last("v_p"), game.record.last("Q_H")] == pytest.approx(game.set_points, rel=1e-6)
    handle(game, pygame.K_DOWN, pygame.K_LEFT, mod=pygame.KMOD_LSHIFT)
    assert game.set_points == pytest.approx((p.v_0 - 0.08 * MM_PER_MIN, p.Q_H_0 - 0.9 * KILO))
    handle(game, *[pygame.K_DOWN, pygame.K_LEFT] * 40, mod=pygame.KMOD_LSHIFT)
    assert game.set_points == (0.0, p.Q_H_0 - 10 * KILO)


def test_time_stands_still_while_paused_and_runs_at_the_speed_asked_for(game: hand.Game) -> None:
    game.advance(10.0)
    assert game.record.t[-1] == 0.0
    handle(game, pygame.K_SPACE)
    game.advance(1.0)
    handle(game, pygame.K_SPACE)
    game.advance(10.0)
    assert game.record.t[-1] == 60.0
    handle(game, pygame.K_PLUS)
    assert game.speed == 90.0
    handle(game, *[pygame.K_PLUS] * 30)
    assert game.speed == hand.FASTEST
    handle(game, *[pygame.K_MINUS] * 60)
    assert game.speed == hand.SLOWEST


def test_a_whole_run_in_the_window_ends_with_the_score(game: hand.Game) -> None:
    game.speed = hand.FASTEST
    press(pygame.K_SPACE)
    brightest: list[int] = []
    show = game.window.show

    def watch(picture: Any) -> None:
        show(picture)
        brightest.append(int(pygame.surfarray.array3d(game.window.screen).max()))
        if game.score is not None:
            press(pygame.K_q)

    game.window.show = watch  # type: ignore[method-assign]
    (outcome,) = game.play()
    assert max(brightest) > 200
    assert outcome.minutes == 10.0
    paper = metrics(rollout(game.rival, game.config, [1]))
    assert outcome.controller == (paper.rmse_mm[0], paper.return_[0], False)
    assert "by hand" in outcome.line()


def test_again_and_the_next_crystal(game: hand.Game) -> None:
    first = game.record.last("r_c")
    handle(game, pygame.K_SPACE)
    game.advance(2.0)
    handle(game, pygame.K_r)
    assert (game.record.last("r_c"), len(game.record), game.paused) == (first, 1, True)
    handle(game, pygame.K_n)
    assert game.seed == 2
    assert game.record.last("r_c") != first


@pytest.mark.parametrize("seed", [1, 12])
def test_the_score_of_the_same_controller_is_a_draw(config: Config, seed: int) -> None:
    paper = find_controller("paper").make(config)
    env, state, actions, rewards, over = CzEnv.from_config(config), None, [], [], False
    observation, _ = env.reset(seed=seed)
    while not over:
        action, state = paper.predict(observation, state)
        actions.append(action)
        observation, reward, _, over, _ = env.step(action)
        rewards.append(reward)
    found = score(config, seed, actions, False, paper)
    assert found.player == pytest.approx(found.controller, rel=1e-12)
    assert found.player.reward == pytest.approx(sum(rewards), rel=1e-12)


def test_a_failed_run_counts_to_the_horizon() -> None:
    config = make_config("nominal", horizon=5400.0, **PLAIN)
    env, actions, over = CzEnv.from_config(config), [], False
    env.reset(seed=1)
    while not over:
        actions.append(np.array([1.0, 0.0], np.float32))
        over = env.step(actions[-1])[2]
    found = score(config, 1, actions, True, find_controller("paper").make(config))
    assert found.player.failed
    assert found.minutes == 90.0
    assert found.player.rmse_mm > 4.0
    assert ", failed; by the paper's controller RMSE" in found.line()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--scenario", "nonsense"], "unknown scenario 'nonsense'"),
        (["--speed", "0"], "--speed: must be between 1 and 3600, not 0"),
        (["--minutes", "inf"], "--minutes: must be between 1 and 6000, not inf"),
        (["--seed", "-1"], "--seed: must be between 0 and"),
    ],
)
def test_bad_options_are_one_line(options: list[str], says: str, refused: Any) -> None:
    assert says in refused(play.main, options)


def test_without_pygame_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, refused: Any) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert refused(play.main, []) == f"python -m cz_gym.play: {canvas.MISSING}\n"


def test_without_a_display_it_says_so(monkeypatch: pytest.MonkeyPatch, refused: Any) -> None:
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    assert refused(play.main, []) == f"python -m cz_gym.play: {play.NO_DISPLAY}\n"
    assert not pygame.display.get_init()
    if sys.platform.startswith("linux"):  # where displays have names
        for name in play.DISPLAYS:
            monkeypatch.delenv(name, raising=False)
        assert refused(play.main, []) == f"python -m cz_gym.play: {play.NO_DISPLAY}\n"
