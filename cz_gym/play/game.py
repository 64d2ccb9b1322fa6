"""Pulling a crystal by hand: keys, time, the picture with its help, and the score beside another controller's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cz_gym.config import Config
from cz_gym.env import CzEnv
from cz_gym.rendering import palette
from cz_gym.rendering.backend import load
from cz_gym.rendering.canvas import TIMES, Box, Canvas
from cz_gym.rendering.gauges import Asked
from cz_gym.rendering.scene import Scene
from cz_gym.rendering.view import FPS, Window, record_of
from cz_gym.task import HEATER_RANGE
from cz_gym.units import KILO, MM_PER_MIN

from .score import Hand, Outcome, Played

if TYPE_CHECKING:
    from cz_gym.rendering.record import Record

SLOWEST, FASTEST = 1.0, 3600.0
"""Factors on real time."""
PULL_STEP, PULL_LEAP = 0.01 * MM_PER_MIN, 0.1 * MM_PER_MIN
"""What a key, and a key with shift, changes the pull speed by [m/s]."""
HEATER_STEP, HEATER_LEAP = 0.1 * KILO, 1.0 * KILO
"""The same for the heater [W]."""
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
    """One player at one window.

    ``rival`` is the controller to be compared with. Time stands still until the player starts it.
    """

    def __init__(
        self, window: Window, size: tuple[int, int], config: Config, seed: int, speed: float, rival: Any
    ) -> None:
        self.window, self.config, self.seed, self.speed, self.rival = window, config, seed, speed, rival
        self.env = CzEnv(
            config.scenario, config.model, horizon=config.horizon, parameters=config.parameters,
            meniscus=config.meniscus, render_mode="rgb_array", render_size=size, info="all")  # fmt: skip
        self.scene = Scene(*size)
        self.outcomes: list[Outcome] = []
        self.helping, self.running = True, True
        self._keys = _keys()
        self.begin(seed)

    def begin(self, seed: int) -> None:
        """A crystal from its beginning, time standing still."""
        self.seed = seed
        _, info = self.env.reset(seed=seed)
        self.played = Played(self.config, seed, info)
        self.paused, self.due, self.outcome = True, 0.0, None
        p = self.record.puller
        self.asked = Asked(p.v_0, p.Q_H_0)

    outcome: Outcome | None
    """The score once the run is over."""

    @property
    def record(self) -> Record:
        """What the picture is drawn from."""
        return record_of(self.env)

    def play(self) -> list[Outcome]:
        """Run until the player ends it; every score, that of a run ended early among them."""
        pygame = load()
        pygame.key.set_repeat(250, 40)
        while self.running:
            for event in pygame.event.get():
                self.handle(event)
            self.advance(1.0 / FPS)
            self.window.show(self.scene.draw(self.record, self.asked, self.overlay))
        if self.outcome is None:
            self.finish()
        self.env.close()
        return self.outcomes

    def handle(self, event: Any) -> None:
        """Do what a key asks for, or end when the window is closed."""
        pygame = load()
        if event.type == pygame.QUIT:
            self.running = False
        elif event.type == pygame.KEYDOWN:
            action = self._keys.get(event.key)
            if action is not None:
                action(self, bool(event.mod & pygame.KMOD_SHIFT))

    def ask(self, pull: float, heat: float) -> None:
        """Change the set-points by so much [m/s, W], inside the range of the drives."""
        p = self.record.puller
        v_p = min(max(self.asked.v_p + pull, 0.0), 2.0 * p.v_0)
        Q_H = min(max(self.asked.Q_H + heat, p.Q_H_0 - HEATER_RANGE), p.Q_H_0 + HEATER_RANGE)
        self.asked = Asked(v_p, Q_H)

    def hasten(self, factor: float) -> None:
        """Let time run faster or slower."""
        self.speed = min(max(self.speed * factor, SLOWEST), FASTEST)

    def toggle(self) -> None:
        """Start or pause."""
        self.paused = not self.paused
        self.helping = self.helping and self.paused

    def advance(self, seconds: float) -> None:
        """Let so much of the player's time pass [s]."""
        if self.paused or self.outcome is not None:
            return
        self.due += seconds * self.speed
        while self.due >= self.config.control_interval and self.outcome is None:
            self.due -= self.config.control_interval
            self.step()

    def step(self) -> None:
        """One control interval with the set-points as they stand."""
        p = self.record.puller
        action = np.array([self.asked.v_p / p.v_0 - 1.0, (self.asked.Q_H - p.Q_H_0) / HEATER_RANGE], np.float32)
        _, reward, terminated, truncated, info = self.env.step(action.clip(-1.0, 1.0))
        self.played.add(info, reward, terminated)
        if terminated or truncated:
            self.finish()

    def finish(self) -> None:
        """Score what was played, if anything was."""
        if self.played.steps:
            self.outcome = self.played.against(self.rival)
            self.outcomes.append(self.outcome)

    def overlay(self, canvas: Canvas) -> None:
        """Help, pause and score on top of the picture."""
        unit, strips = canvas.unit, self.scene.layout.strips
        canvas.text(
            strips.right - 10 * unit, strips.y + 4 * unit, f"time {TIMES}{self.speed:.0f}   H: help", 9.5,
            palette.FAINT, "right",
        )  # fmt: skip
        if self.outcome is not None:
            self._card(canvas, "The run is over", _score(self.outcome), "R: again   N: next crystal   Q: end")
        elif self.helping:
            self._card(canvas, "Pull a crystal by hand", HELP, "hold the radius on its reference; space starts")
        elif self.paused:
            self._card(canvas, "Paused", (), "space goes on")

    def _card(self, canvas: Canvas, title: str, rows: tuple[tuple[str, str], ...], foot: str) -> None:
        unit = canvas.unit
        width, height = 330.0 * unit, (62.0 + 18.0 * len(rows)) * unit
        box = Box((canvas.width - width) / 2.0, (0.66 * canvas.height - height) / 2.0, width, height)
        rim = Box(box.x - 2 * unit, box.y - 2 * unit, box.w + 4 * unit, box.h + 4 * unit)
        canvas.cover(rim)
        canvas.rectangle(palette.RIM, rim, 8.0)
        canvas.rectangle(palette.BACK, box, 7.0)
        canvas.text(box.x + 16 * unit, box.y + 11 * unit, title, 14, palette.INK, bold=True)
        for i, (left, right) in enumerate(rows):
            y = box.y + (36.0 + 18.0 * i) * unit
            canvas.text(box.x + 16 * unit, y, left, 11, palette.CAMERA, bold=True)
            canvas.text(box.x + 76 * unit, y, right, 11, palette.INK)
        canvas.text(box.x + 16 * unit, box.bottom - 22 * unit, foot, 10, palette.FAINT)


def _score(outcome: Outcome) -> tuple[tuple[str, str], ...]:
    def row(name: str, hand: Hand) -> tuple[str, str]:
        return name, f"RMSE {hand.rmse_mm:.3f} mm    return {hand.reward:,.0f}{'    failed' if hand.failed else ''}"

    return row("you", outcome.mine), row("paper", outcome.rival)


def _keys() -> dict[int, Any]:
    """What each key does, given the game and whether shift is held."""
    k = load()

    def drive(pull: float, heat: float, sign: float) -> Any:
        def turn(game: Game, shift: bool) -> None:
            many = sign * (HEATER_LEAP / HEATER_STEP if shift else 1.0)
            game.ask(many * pull, many * heat)

        return turn

    def end(game: Game, shift: bool) -> None:
        game.running = False

    def help_(game: Game, shift: bool) -> None:
        game.helping = not game.helping

    found = {
        k.K_UP: drive(PULL_STEP, 0.0, 1.0),
        k.K_DOWN: drive(PULL_STEP, 0.0, -1.0),
        k.K_RIGHT: drive(0.0, HEATER_STEP, 1.0),
        k.K_LEFT: drive(0.0, HEATER_STEP, -1.0),
        k.K_SPACE: lambda game, shift: game.toggle(),
        k.K_r: lambda game, shift: game.begin(game.seed),
        k.K_n: lambda game, shift: game.begin(game.seed + 1),
        k.K_h: help_,
        k.K_q: end,
        k.K_ESCAPE: end,
    }
    faster, slower = (k.K_PLUS, k.K_KP_PLUS, k.K_EQUALS), (k.K_MINUS, k.K_KP_MINUS)
    found.update({key: lambda game, shift: game.hasten(1.5) for key in faster})
    found.update({key: lambda game, shift: game.hasten(1.0 / 1.5) for key in slower})
    return found
