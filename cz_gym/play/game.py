"""Pulling a crystal by hand: keys, time, the picture with its help, and the score beside another controller's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.env import CzEnv
from cz_gym.rendering import palette
from cz_gym.rendering.backend import load
from cz_gym.rendering.canvas import TIMES, Box, Canvas, Frame
from cz_gym.rendering.numbers_panel import SetPoints
from cz_gym.rendering.record import Record
from cz_gym.rendering.scene import Scene
from cz_gym.rendering.view import FPS, Window, record_of
from cz_gym.task import HEATER_RANGE
from cz_gym.units import KILO, MM_PER_MIN

from .score import Result, Score, score

SLOWEST, FASTEST = 1.0, 3600.0
"""Limits of the speed of time: seconds of growth a second of watching."""
PULL_STEP, HEATER_STEP = 0.01 * MM_PER_MIN, 0.1 * KILO
"""Changes of the pull speed [m/s] and of the heater [W] by a key; with shift ten times as large."""
HELP = (
    ("\N{UPWARDS ARROW} \N{DOWNWARDS ARROW}", "pull speed: more makes the crystal thinner"),
    ("\N{RIGHTWARDS ARROW} \N{LEFTWARDS ARROW}", "heater: more makes it thinner, minutes later"),
    ("shift", "ten times as much"),
    ("space", "start, pause"),
    ("+  -", "time runs faster, slower"),
    ("R  N", "this crystal again, the next crystal"),
    ("H  Q", "help, end"),
)


class Game:
    """One player at one window, compared with the controller ``rival`` on the same crystal.

    Time stands still until the player starts it.
    """

    def __init__(
        self, window: Window, size: tuple[int, int], config: Config, seed: int, speed: float, rival: Any
    ) -> None:
        self.window, self.config, self.speed, self.rival = window, config, speed, rival
        self.env = CzEnv.from_config(config, "rgb_array", size, info="all")
        self.scene = Scene(*size)
        self.scores: list[Score] = []
        self.helping, self.running = True, True
        self._keys = _keys()
        self.begin(seed)

    def begin(self, seed: int) -> None:
        """Begin a crystal, with time standing still."""
        self.seed = seed
        self.env.reset(seed=seed)
        self.actions: list[npt.NDArray[np.float32]] = []
        self.paused, self.due = True, 0.0
        self.score: Score | None = None
        p = self.record.puller
        self.set_points = SetPoints(p.v_0, p.Q_H_0)

    @property
    def record(self) -> Record:
        """The episode so far, from which the picture is drawn."""
        return record_of(self.env)

    def play(self) -> list[Score]:
        """Run until the player ends it; every score, that of a run ended early among them."""
        pygame = load()
        pygame.key.set_repeat(250, 40)
        while self.running:
            for event in pygame.event.get():
                self.handle(event)
            self.advance(1.0 / FPS)
            self.window.show(self.draw())
        if self.score is None:
            self.finish(failed=False)
        self.env.close()
        return self.scores

    def handle(self, event: Any) -> None:
        """Do what a key asks for, or end when the window is closed."""
        pygame = load()
        if event.type == pygame.QUIT:
            self.running = False
        elif event.type == pygame.KEYDOWN and event.key in self._keys:
            self._keys[event.key](self, 10.0 if event.mod & pygame.KMOD_SHIFT else 1.0)

    def change(self, pull: float, heat: float) -> None:
        """Add to the set-points [m/s, W], within the range of the drives."""
        p = self.record.puller
        v_p = min(max(self.set_points.v_p + pull, 0.0), 2.0 * p.v_0)
        Q_H = min(max(self.set_points.Q_H + heat, p.Q_H_0 - HEATER_RANGE), p.Q_H_0 + HEATER_RANGE)
        self.set_points = SetPoints(v_p, Q_H)

    def change_speed(self, factor: float) -> None:
        """Let time run faster or slower."""
        self.speed = min(max(self.speed * factor, SLOWEST), FASTEST)

    def start_or_pause(self) -> None:
        """Start or pause time; starting closes the help."""
        self.paused = not self.paused
        self.helping = self.helping and self.paused

    def advance(self, seconds: float) -> None:
        """Let a time pass for the player [s], and the control intervals that fall into it for the crystal."""
        if self.paused or self.score is not None:
            return
        self.due += seconds * self.speed
        while self.due >= self.config.control_interval and self.score is None:
            self.due -= self.config.control_interval
            self.step()

    def step(self) -> None:
        """Hold the set-points for one control interval."""
        p = self.record.puller
        action = np.array(
            [self.set_points.v_p / p.v_0 - 1.0, (self.set_points.Q_H - p.Q_H_0) / HEATER_RANGE], np.float32
        )
        self.actions.append(action.clip(-1.0, 1.0))
        _, _, terminated, truncated, _ = self.env.step(self.actions[-1])
        if terminated or truncated:
            self.finish(failed=terminated)

    def finish(self, failed: bool) -> None:
        """Score the actions so far, if there are any."""
        if self.actions:
            self.score = score(self.config, self.seed, self.actions, failed, self.rival)
            self.scores.append(self.score)

    def draw(self) -> Frame:
        """The picture that the player sees."""
        return self.scene.draw(self.record, self.set_points, self._overlay)

    def _overlay(self, canvas: Canvas) -> None:
        """Help, pause and score on top of the picture."""
        unit, box = canvas.unit, self.scene.layout.numbers
        y = box.bottom - 18 * unit
        canvas.text(box.x + 8 * unit, y, f"time {TIMES}{self.speed:.0f}", colour=palette.FAINT)
        canvas.text(box.right - 8 * unit, y, "H: help", colour=palette.FAINT, anchor="right")
        if self.score is not None:
            both = (("you", self.score.player), ("paper", self.score.controller))
            rows = tuple((name, _in_words(result)) for name, result in sorted(both, key=lambda one: one[1].rmse_mm))
            _draw_card(canvas, "The run is over: least error first", rows, "R: again   N: next crystal   Q: end")
        elif self.helping:
            _draw_card(canvas, "Pull a crystal by hand", HELP, "hold the radius on its reference; space starts")
        elif self.paused:
            _draw_card(canvas, "Paused", (), "space continues")


def _draw_card(canvas: Canvas, title: str, rows: tuple[tuple[str, str], ...], foot: str) -> None:
    """A card of a title, rows and a last line in the picture's middle."""
    unit = canvas.unit
    width, height = 330.0 * unit, (62.0 + 18.0 * len(rows)) * unit
    box = Box((canvas.width - width) / 2.0, (0.66 * canvas.height - height) / 2.0, width, height)
    canvas.rectangle(palette.RIM, box.inner(-2 * unit, -2 * unit, -2 * unit, -2 * unit))
    canvas.rectangle(palette.BACK, box)
    canvas.text(box.x + 16 * unit, box.y + 11 * unit, title, 14, bold=True)
    for i, (left, right) in enumerate(rows):
        y = box.y + (36.0 + 18.0 * i) * unit
        canvas.text(box.x + 16 * unit, y, left, 11, palette.CAMERA, bold=True)
        canvas.text(box.x + 76 * unit, y, right, 11)
    canvas.text(box.x + 16 * unit, box.bottom - 22 * unit, foot, 10, palette.FAINT)


def _in_words(result: Result) -> str:
    failed = "    failed" if result.failed else ""
    return f"RMSE {result.rmse_mm:.3f} mm    return {result.reward:,.0f}{failed}"


def _keys() -> dict[int, Callable[[Game, float], None]]:
    """The effect of each key, given the game and a number of steps."""
    k = load()
    keys: dict[int, Callable[[Game, float], None]] = {
        k.K_UP: lambda game, steps: game.change(steps * PULL_STEP, 0.0),
        k.K_DOWN: lambda game, steps: game.change(-steps * PULL_STEP, 0.0),
        k.K_RIGHT: lambda game, steps: game.change(0.0, steps * HEATER_STEP),
        k.K_LEFT: lambda game, steps: game.change(0.0, -steps * HEATER_STEP),
        k.K_SPACE: lambda game, _: game.start_or_pause(),
        k.K_r: lambda game, _: game.begin(game.seed),
        k.K_n: lambda game, _: game.begin(game.seed + 1),
        k.K_h: lambda game, _: setattr(game, "helping", not game.helping),
    }
    keys |= dict.fromkeys((k.K_q, k.K_ESCAPE), lambda game, _: setattr(game, "running", False))
    keys |= dict.fromkeys((k.K_PLUS, k.K_KP_PLUS, k.K_EQUALS), lambda game, _: game.change_speed(1.5))
    keys |= dict.fromkeys((k.K_MINUS, k.K_KP_MINUS), lambda game, _: game.change_speed(1.0 / 1.5))
    return keys
