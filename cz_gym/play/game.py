"""The game of pulling a crystal by hand: keys, time, picture, help, and a score beside a controller's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.env import CzEnv
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.replay import Playback
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.plant import Inputs
from cz_gym.rendering import palette
from cz_gym.rendering.canvas import TIMES, Box, Canvas, Frame, load
from cz_gym.rendering.record import Record
from cz_gym.rendering.scene import Scene
from cz_gym.rendering.view import FPS, Window, record_of
from cz_gym.task import HEATER_RANGE
from cz_gym.units import KILO, MINUTE, MM_PER_MIN

SLOWEST, FASTEST = 1, 3600
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


class Result(NamedTuple):
    """The result of one episode."""

    rmse_mm: float
    """RMSE of the true radius [mm], as the benchmark counts it."""
    reward: float
    """Return: the sum of rewards [-]."""
    failed: bool

    def __str__(self) -> str:
        return f"RMSE {self.rmse_mm:.3f} mm, return {self.reward:,.0f}{', failed' if self.failed else ''}"


class Score(NamedTuple):
    """The results of player and controller on the same crystal over the same time."""

    scenario: str
    seed: int
    minutes: float
    player: Result
    controller: Result

    def line(self) -> str:
        """The score in one line."""
        crystal = f"{self.scenario}, crystal {self.seed}, {self.minutes:.0f} min"
        return f"{crystal}: by hand {self.player}; by the paper's controller {self.controller}"


def score(config: Config, seed: int, actions: Sequence[npt.NDArray[np.float32]], failed: bool, rival: Any) -> Score:
    """The score of a player's actions, each of shape (2,), and of a controller.

    A run that the player left early ends there for both. A failed one counts to the horizon, as in the benchmark.
    """
    if not failed:
        config = replace(config, horizon=len(actions) * config.control_interval)
    found = (metrics(rollout(policy, config, [seed])) for policy in (Playback(actions), rival))
    results = (Result(float(one.rmse_mm[0]), float(one.return_[0]), bool(one.failure_rate[0])) for one in found)
    return Score(config.scenario.name, seed, config.horizon / MINUTE, *results)


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
        self.set_points = self.record.puller.inputs_0

    @property
    def record(self) -> Record:
        """The episode so far, from which the picture is drawn."""
        return record_of(self.env)

    def play(self) -> list[Score]:
        """Run until the player ends the game; returns the scores of all runs, the last one included."""
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
        self.set_points = Inputs(v_p, Q_H)

    def change_speed(self, factor: float) -> None:
        """Let time run faster or slower."""
        self.speed = min(max(self.speed * factor, SLOWEST), FASTEST)

    def start_or_pause(self) -> None:
        """Start or pause time; starting closes the help."""
        self.paused = not self.paused
        self.helping = self.helping and self.paused

    def advance(self, seconds: float) -> None:
        """Advance the player's time by some seconds, and the crystal by the control intervals in them."""
        if self.paused or self.score is not None:
            return
        self.due += seconds * self.speed
        while self.due >= self.config.control_interval and self.score is None:
            self.due -= self.config.control_interval
            self.step()

    def step(self) -> None:
        """Hold the set-points for one control interval."""
        p, (v_p, Q_H) = self.record.puller, self.set_points
        action = np.array([v_p / p.v_0 - 1.0, (Q_H - p.Q_H_0) / HEATER_RANGE], np.float32)
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
        box = self.scene.layout.numbers
        canvas.text(box.x + 8, box.bottom - 18, f"time {TIMES}{self.speed:.0f}", palette.FAINT)
        canvas.text(box.right - 8, box.bottom - 18, "H: help", palette.FAINT, anchor=1.0)
        if self.score is not None:
            both = sorted([(self.score.player, "you"), (self.score.controller, "paper")])  # by the error
            rows = tuple((name, str(result)) for result, name in both)
            _draw_card(canvas, "The run is over: least error first", rows, "R: again   N: next crystal   Q: end")
        elif self.helping:
            _draw_card(canvas, "Pull a crystal by hand", HELP, "hold the radius on its reference; space starts")
        elif self.paused:
            _draw_card(canvas, "Paused", (), "space continues")


def _draw_card(canvas: Canvas, title: str, rows: tuple[tuple[str, str], ...], foot: str) -> None:
    """A card of a title, rows and a last line in the picture's middle."""
    width, height = 330.0, 62.0 + 18.0 * len(rows)
    box = Box((canvas.box.w - width) / 2.0, (0.66 * canvas.box.h - height) / 2.0, width, height)
    canvas.rectangle(palette.RIM, box.inner(-2.0, -2.0, -2.0, -2.0))
    canvas.rectangle(palette.BACK, box)
    canvas.text(box.x + 16, box.y + 11, title, size=14, bold=True)
    for i, (left, right) in enumerate(rows):
        canvas.text(box.x + 16, box.y + 36 + 18 * i, left, palette.CAMERA, 11, bold=True)
        canvas.text(box.x + 76, box.y + 36 + 18 * i, right, size=11)
    canvas.text(box.x + 16, box.bottom - 22, foot, palette.FAINT, 10)


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
