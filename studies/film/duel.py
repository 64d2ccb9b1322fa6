"""Two controllers on the same crystal, side by side: the picture of :mod:`studies.film`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cz_gym.env import CzEnv
from cz_gym.rendering import chart, palette, puller_panel, triple_point
from cz_gym.rendering.canvas import TIMES, Box, Canvas, Frame
from cz_gym.rendering.geometry import TOLERANCE, error_range
from cz_gym.rendering.palette import Colour
from cz_gym.rendering.record import Ending, Record
from cz_gym.rendering.scene import draw_ending
from cz_gym.rendering.view import record_of
from cz_gym.task import RADIUS_LIMIT
from cz_gym.units import MM


class Side:
    """A policy in its environment on the crystal of a seed, and how it is shown."""

    def __init__(self, name: str, policy: Any, env: CzEnv, colour: Colour, seed: int) -> None:
        self.name, self.policy, self.env, self.colour = name, policy, env, colour
        self._observation, _ = env.reset(seed=seed)
        self._state: Any = None

    @property
    def record(self) -> Record:
        """Its episode so far."""
        return record_of(self.env)

    def step_to(self, sample: int) -> None:
        """Go on to that sample, or to the end."""
        while len(self.record) <= sample and self.record.ending is None:
            action, self._state = self.policy.predict(self._observation, self._state)
            self._observation, *_ = self.env.step(action)

    def rmse(self) -> float:
        """RMSE of the true radius so far [m], at most the limit of the radius."""
        error = self.record.error[1:]
        return min(float(np.sqrt(np.mean(np.square(error)))), RADIUS_LIMIT) if len(error) else 0.0


def draw(canvas: Canvas, sides: Sequence[Side]) -> Frame:
    """Each side's crystal and triple point, and below them both errors on one chart."""
    unit = canvas.unit
    gap, below = 6.0 * unit, 0.27 * canvas.height
    width = (canvas.width - (len(sides) + 1) * gap) / len(sides)
    magnified = min(puller_panel.magnification(side.record) for side in sides)
    limit = error_range(*(side.record.error for side in sides))
    bottom = Box(gap, canvas.height - below - gap, canvas.width - 2.0 * gap, below)
    boxes = [Box(gap + i * (width + gap), gap, width, canvas.height - below - 3.0 * gap) for i in range(len(sides))]
    canvas.begin((bottom, *boxes))
    traces = [chart.Trace(side.record.t, side.record.error, side.colour) for side in sides]
    chart.draw_traces(canvas, bottom, sides[0].record.config.horizon, limit, traces)
    x, y = bottom.x + 38.0 * unit, bottom.y + 4 * unit
    canvas.text(x, y, "true radius error [mm]", 9.5, palette.FAINT)
    told = f"{TIMES}{magnified:g}: drawn {magnified:g} times as large; shaded: within {TOLERANCE / MM:g} mm"
    canvas.text(bottom.right - 10.0 * unit, y, told, 9.5, palette.FAINT, "right")
    for i, (side, box) in enumerate(zip(sides, boxes, strict=True)):
        canvas.text(x + (125 + 140 * i) * unit, y, side.name, 9.5, side.colour, bold=True)
        _draw_side(canvas, box, side, magnified)
    return canvas.finish()


def _draw_side(canvas: Canvas, box: Box, side: Side, magnified: float) -> None:
    unit, record = canvas.unit, side.record
    canvas.text(box.x + 10 * unit, box.y + 7 * unit, side.name, 13, side.colour, bold=True)
    rmse = f"RMSE {side.rmse() / MM:.2f} mm"
    canvas.text(box.right - 10 * unit, box.y + 7 * unit, rmse, 13, palette.INK, "right", True)
    below = box.inner(0.0, 26.0 * unit, 0.0, 0.0)
    crystal = Box(below.x, below.y, 0.44 * below.w, below.h)
    edge = Box(crystal.right, below.y, below.right - crystal.right, below.h)
    puller_panel.draw(canvas, crystal, record, magnified, side.colour)
    triple_point.draw(canvas, edge, record, side.colour)
    if record.ending not in (None, Ending.HORIZON):
        draw_ending(canvas, edge, record.ending)
