"""Two controllers on the same crystal, side by side: the picture of :mod:`cz_gym.film`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..env import CzEnv
from ..task import RADIUS_LIMIT
from ..units import MM
from . import edge_panel, palette, puller_panel, strips
from .canvas import Box, Canvas
from .palette import Colour
from .record import Floats, Record
from .scene import banner
from .view import record_of

if TYPE_CHECKING:
    from pygame import Surface


class Side:
    """A policy, its environment, and how it is shown."""

    def __init__(self, name: str, policy: Any, env: CzEnv, colour: Colour) -> None:
        self.name, self.policy, self.env, self.colour = name, policy, env, colour
        self._observation: Any = None
        self._state: Any = None

    def begin(self, seed: int) -> None:
        """Take the crystal of a seed."""
        self._observation, _ = self.env.reset(seed=seed)
        self._state = None

    @property
    def record(self) -> Record:
        """Its episode so far."""
        return record_of(self.env)

    def step_to(self, sample: int) -> None:
        """Go on to that sample, or to the end."""
        while len(self.record) <= sample and self.record.ending is None:
            action, self._state = self.policy.predict(self._observation, self._state)
            self._observation, *_ = self.env.step(action)

    def error(self) -> Floats:
        """The true radius error at every sample [m]."""
        return self.record.column("r_c") - self.record.column("r_ref")

    def rmse(self) -> float:
        """RMSE of the true radius so far [m]; from a failure on the error counts 8 mm only in the benchmark."""
        error = self.error()[1:]
        return float(np.sqrt(np.mean(np.square(error)))) if len(error) else 0.0


class Duel:
    """Draws both sides as one picture."""

    def __init__(self, width: int, height: int) -> None:
        self.canvas = Canvas(width, height)

    def draw(self, sides: Sequence[Side]) -> Surface:
        """Each side's crystal and triple point, and below them both errors on one chart."""
        canvas, unit = self.canvas, self.canvas.unit
        canvas.clear()
        gap, chart = 6.0 * unit, 0.27 * canvas.height
        width = (canvas.width - (len(sides) + 1) * gap) / len(sides)
        height = canvas.height - chart - 3.0 * gap
        magnified = min(puller_panel.gain(side.record) for side in sides)
        reach = max(edge_panel.reach_of(side.error()) for side in sides)
        for i, side in enumerate(sides):
            self._side(Box(gap + i * (width + gap), gap, width, height), side, magnified, reach)
        bottom = Box(gap, canvas.height - chart - gap, canvas.width - 2.0 * gap, chart)
        strips.error(canvas, bottom, [(side.record, side.colour) for side in sides])
        x = bottom.x + 34.0 * unit
        canvas.text(x, bottom.y + 4 * unit, "true radius error [mm]", 9.5, palette.FAINT)
        for i, side in enumerate(sides):
            canvas.text(x + (125 + 140 * i) * unit, bottom.y + 4 * unit, side.name, 9.5, side.colour, bold=True)
        return canvas.finish()

    def _side(self, box: Box, side: Side, magnified: float, reach: float) -> None:
        canvas, unit, record = self.canvas, self.canvas.unit, side.record
        canvas.panel(box)
        canvas.text(box.x + 10 * unit, box.y + 7 * unit, side.name, 13, side.colour, bold=True)
        rmse = f"RMSE {min(side.rmse(), RADIUS_LIMIT) / MM:.2f} mm"
        canvas.text(box.right - 10 * unit, box.y + 7 * unit, rmse, 13, palette.INK, "right", True)
        below = box.inner(0.0, 26.0 * unit, 0.0, 0.0)
        crystal = Box(below.x, below.y, 0.44 * below.w, below.h)
        puller_panel.draw(canvas, crystal, record, magnified)
        edge = Box(crystal.right, below.y, below.right - crystal.right, below.h)
        edge_panel.draw(canvas, edge, record, reach)
        if record.ending is not None and record.ending.name != "HORIZON":
            banner(canvas, edge, record.ending)
