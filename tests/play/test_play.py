"""Pulling by hand: keys posted to a window nobody sees, the score, and what the commands say when they cannot."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cz_gym import CzEnv, agents
from cz_gym.baselines.registry import find_controller
from cz_gym.config import Config, make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.play import __main__ as play
from cz_gym.play import game as hand
from cz_gym.play.score import Played
from cz_gym.rendering import backend, palette
from cz_gym.rendering.view import Window
from cz_gym.units import KILO, MM_PER_MIN
from studies.film import __main__ as film

pygame = pytest.importorskip("pygame")
SIZE = (480, 360)
ROOT = Path(__file__).parents[2]


@pytest.fixture
def config() -> Config:
    return make_config("randomized", horizon=600.0)


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


def test_arrows_move_the_set_points(game: hand.Game) -> None:
    p = game.record.puller
    assert game.asked == (p.v_0, p.Q_H_0)
    handle(game, pygame.K_UP, pygame.K_UP, pygame.K_RIGHT)
    assert game.asked == pytest.approx((p.v_0 + 0.02 * MM_PER_MIN, p.Q_H_0 + 0.1 * KILO))
    handle(game, pygame.K_DOWN, pygame.K_LEFT, mod=pygame.KMOD_LSHIFT)
    assert game.asked == pytest.approx((p.v_0 - 0.08 * MM_PER_MIN, p.Q_H_0 - 0.9 * KILO))
    handle(game, *[pygame.K_DOWN, pygame.K_LEFT] * 40, mod=pygame.KMOD_LSHIFT)
    assert game.asked == (0.0, p.Q_H_0 - 10 * KILO)


def test_the_drives_get_what_was_asked(game: hand.Game) -> None:
    handle(game, pygame.K_UP, pygame.K_RIGHT, pygame.K_SPACE)
    game.advance(1.0)
    now, p = game.record.now, game.record.puller
    assert now.t == 60.0
    assert (now.v_p, now.Q_H) == pytest.approx((p.v_0 + 0.01 * MM_PER_MIN, p.Q_H_0 + 0.1 * KILO), rel=1e-6)


def test_time_stands_still_while_paused_and_runs_as_fast_as_told(game: hand.Game) -> None:
    game.advance(10.0)
    assert game.record.now.t == 0.0
    handle(game, pygame.K_SPACE)
    game.advance(1.0)
    handle(game, pygame.K_SPACE)
    game.advance(10.0)
    assert game.record.now.t == 60.0
    handle(game, pygame.K_PLUS)
    assert game.speed == 90.0
    handle(game, *[pygame.K_PLUS] * 30)
    assert game.speed == hand.FASTEST
    handle(game, *[pygame.K_MINUS] * 60)
    assert game.speed == hand.SLOWEST


def test_a_whole_run_in_the_window_ends_with_the_score(game: hand.Game) -> None:
    game.speed = hand.FASTEST
    press(pygame.K_SPACE)
    for _ in range(3):
        press(pygame.K_UP)
    shown: list[int] = []
    show = game.window.show

    def watch(picture: Any) -> None:
        show(picture)
        shown.append(int(pygame.surfarray.array3d(game.window.screen).max()))
        if game.outcome is not None:
            press(pygame.K_q)

    game.window.show = watch  # type: ignore[method-assign]
    (outcome,) = game.play()
    assert max(shown) > 200
    assert outcome.minutes == 10.0
    paper = metrics(rollout(game.rival, game.config, [1]))
    assert outcome.rival == (paper.rmse_mm[0], paper.return_[0], False)
    assert "by hand" in outcome.line()


def test_again_and_the_next_crystal(game: hand.Game) -> None:
    first = game.record.now
    handle(game, pygame.K_SPACE)
    game.advance(2.0)
    handle(game, pygame.K_r)
    assert (game.record.now, game.paused) == (first, True)
    handle(game, pygame.K_n)
    assert game.seed == 2
    assert game.record.now != first


def test_closing_the_window_ends_and_scores_what_was_played(game: hand.Game) -> None:
    handle(game, pygame.K_SPACE)
    game.advance(2.0)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    (outcome,) = game.play()
    assert outcome.minutes == pytest.approx(2.0, abs=0.2)
    assert not game.running


def test_nothing_played_has_no_score(game: hand.Game) -> None:
    press(pygame.K_ESCAPE)
    assert game.play() == []


@pytest.mark.parametrize("seed", [1, 12])
def test_the_score_of_the_same_controller_is_a_draw(config: Config, seed: int) -> None:
    paper = find_controller("paper").make(config)
    env, state, over = CzEnv(config.scenario, horizon=config.horizon), None, False
    observation, info = env.reset(seed=seed)
    played = Played(config, seed, info)
    while not over:
        action, state = paper.predict(observation, state)
        observation, reward, terminated, over, info = env.step(action)
        played.add(info, reward, terminated)
    outcome = played.against(paper)
    assert outcome.mine == pytest.approx(outcome.rival, rel=1e-12)


def test_a_failed_run_counts_to_the_horizon(config: Config) -> None:
    long = make_config("nominal", horizon=5400.0)
    env, over = CzEnv("nominal", horizon=5400.0), False
    _, info = env.reset(seed=1)
    played = Played(long, 1, info)
    while not over:
        _, reward, over, _, info = env.step(np.array([1.0, 0.0], np.float32))
        played.add(info, reward, over)
    run = played.rollout()
    assert run.failed.all()
    assert run.config.horizon == 5400.0
    assert played.against(find_controller("paper").make(long)).mine.rmse_mm > 4.0


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--scenario", "nonsense"], "unknown scenario 'nonsense'"),
        (["--speed", "0"], "--speed must be 1 to 3600, not 0"),
        (["--speed", "nan"], "--speed must be 1 to 3600, not nan"),
        (["--minutes", "inf"], "--minutes must be 1 to 6000, not inf"),
        (["--seed", "-1"], "--seed must not be negative"),
        (["--size", "large"], "--size must be WxH in pixels"),
        (["--size", "10x10"], "360 to 3840"),
    ],
)
def test_bad_options_are_one_line(options: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert play.main(options) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert says in said.err


def test_without_pygame_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert play.main([]) == 2
    assert capsys.readouterr().err == f"python -m cz_gym.play: {backend.MISSING}\n"


def test_without_a_display_it_says_so(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    assert play.main([]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"python -m cz_gym.play: {play.NO_DISPLAY}\n"
    assert not pygame.display.get_init()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="displays have names on Linux")
def test_where_no_display_is_named_none_is_tried(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in play.DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    assert play.main([]) == 2
    assert capfd.readouterr() == ("", f"python -m cz_gym.play: {play.NO_DISPLAY}\n")


def test_the_command_prints_the_score(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def play_on(self: hand.Game) -> list[Any]:
        handle(self, pygame.K_SPACE)
        self.advance(1e4)
        return self.outcomes

    monkeypatch.setattr(hand.Game, "play", play_on)
    assert play.main(["--minutes", "5", "--size", "480x360"]) == 0
    assert capsys.readouterr().out.startswith("randomized, crystal 1, 5 min: RMSE of the true radius ")


def test_an_interrupt_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def stop(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(hand.Game, "play", stop)
    assert play.main([]) == 130
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("module", [play, film])
def test_help_and_wrong_options(module: Any, capsys: pytest.CaptureFixture[str]) -> None:
    for options, code in ((["--help"], 0), (["--frobnicate"], 2), (["--see", "1"], 2)):
        with pytest.raises(SystemExit) as stop:
            module.main(options)
        assert stop.value.code == code
    assert capsys.readouterr().err.count("\n") == 2


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--frames", "1"], "--frames must be 2 to 1000"),
        (["--seed", "-3"], "--seed must not be negative"),
        (["--out", "film.mp4"], "--out must end in .gif"),
        (["--scenario", "nonsense"], "unknown scenario"),
    ],
)
def test_a_film_of_nothing_is_one_line(
    options: list[str], says: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert film.main(options if "--out" in options else [*options, "--out", "new/film.gif"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert says in said
    assert not list(tmp_path.iterdir())


def test_a_short_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Image = pytest.importorskip("PIL.Image")
    pytest.importorskip("onnxruntime")
    out = tmp_path / "new" / "film.gif"
    agent = min(agents.MODELS.glob("*.onnx"))
    assert film.main(["--frames", "3", "--agent", str(agent), "--out", str(out)]) == 0
    with Image.open(out) as picture:
        assert picture.n_frames == 3
        assert picture.size == film.SIZE
        assert picture.info["loop"] == 0
        picture.seek(2)
        last = np.asarray(picture.convert("RGB"), np.float64)
    # The ring's marker is some fifty pixels in four hundred thousand, and keeps its colour all the same.
    assert (np.linalg.norm(last - palette.CAMERA, axis=-1) < 40.0).sum() > 30
    assert "3 frames" in capsys.readouterr().out


def test_the_film_shows_the_shipped_agent_unless_told(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("onnxruntime")
    agent = min(agents.MODELS.glob("*.onnx"))
    monkeypatch.setattr("cz_gym.agents.shipped", lambda: agent)
    _, learned = film.contestants("randomized")
    assert learned.policy.contract.sha256 == agents.OnnxPolicy.load(agent).contract.sha256
    assert learned.name == f"learned: {learned.policy.contract.algorithm}"


def test_a_film_of_no_agent_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("PIL.Image")
    assert film.main(["--agent", str(tmp_path / "none.onnx"), "--out", str(tmp_path / "film.gif")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "none.onnx" in said
    assert not list(tmp_path.iterdir())


def test_playing_loads_no_learning_package() -> None:
    code = (
        "import sys, cz_gym.play, studies.film; assert not {'torch', 'pygame', 'PIL', 'onnxruntime'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=ROOT, check=True)
