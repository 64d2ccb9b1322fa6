"""Two controllers on the same crystal, side by side: the picture of :mod:`studies.film`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cz_gym.env import CzEnv
from cz_gym.rendering import edge_panel, palette, puller_panel, strips
from cz_gym.rendering.canvas import Box, Canvas
from cz_gym.rendering.palette import Colour
from cz_gym.rendering.record import Floats, Record
from cz_gym.rendering.scene import banner
from cz_gym.rendering.view import record_of
from cz_gym.task import RADIUS_LIMIT
from cz_gym.units import MM

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
        gap, chart = 6.0 * unit, 0.27 * canvas.height
        width = (canvas.width - (len(sides) + 1) * gap) / len(sides)
        height = canvas.height - chart - 3.0 * gap
        magnified = min(puller_panel.gain(side.record) for side in sides)
        reach = max(edge_panel.reach_of(side.error()) for side in sides)
        boxes = [Box(gap + i * (width + gap), gap, width, height) for i in range(len(sides))]
        bottom = Box(gap, canvas.height - chart - gap, canvas.width - 2.0 * gap, chart)
        charted = strips.reach_of([side.record for side in sides])
        canvas.begin(
            (charted, *((side.name, side.record.puller, side.record.config.horizon) for side in sides)),
            lambda: self._ground(sides, boxes, bottom, charted),
        )
        for side, box in zip(sides, boxes, strict=True):
            self._side(box, side, magnified, reach)
        strips.error(canvas, bottom, [(side.record, side.colour) for side in sides], charted)
        return canvas.finish()

    def _ground(self, sides: Sequence[Side], boxes: Sequence[Box], bottom: Box, charted: float) -> None:
        """All that is the same in every picture, until the chart needs a longer axis."""
        canvas, unit = self.canvas, self.canvas.unit
        strips.error_ground(canvas, bottom, sides[0].record.config.horizon, charted)
        x = bottom.x + 38.0 * unit
        canvas.text(x, bottom.y + 4 * unit, "true radius error [mm]", 9.5, palette.FAINT)
        for i, side in enumerate(sides):
            canvas.text(x + (125 + 140 * i) * unit, bottom.y + 4 * unit, side.name, 9.5, side.colour, bold=True)
        for side, box in zip(sides, boxes, strict=True):
            canvas.panel(box)
            canvas.text(box.x + 10 * unit, box.y + 7 * unit, side.name, 13, side.colour, bold=True)
            crystal, edge = _split(canvas, box)
            puller_panel.ground(canvas, crystal, side.record.puller.r_0)
            edge_panel.ground(canvas, edge, side.record)

    def _side(self, box: Box, side: Side, magnified: float, reach: float) -> None:
        canvas, unit, record = self.canvas, self.canvas.unit, side.record
        rmse = f"RMSE {min(side.rmse(), RADIUS_LIMIT) / MM:.2f} mm"
        canvas.text(box.right - 10 * unit, box.y + 7 * unit, rmse, 13, palette.INK, "right", True)
        crystal, edge = _split(canvas, box)
        puller_panel.draw(canvas, crystal, record, magnified)
        edge_panel.draw(canvas, edge, record, reach)
        if record.ending is not None and record.ending.name != "HORIZON":
            banner(canvas, edge, record.ending)


def _split(canvas: Canvas, box: Box) -> tuple[Box, Box]:
    """Where a side shows its crystal and its triple point."""
    below = box.inner(0.0, 26.0 * canvas.unit, 0.0, 0.0)
    crystal = Box(below.x, below.y, 0.44 * below.w, below.h)
    return crystal, Box(crystal.right, below.y, below.right - crystal.right, below.h)
