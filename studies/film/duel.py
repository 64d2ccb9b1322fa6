"""Two controllers on the same crystal, side by side: the picture of :mod:`studies.film`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cz_gym.env import CzEnv
from cz_gym.rendering import chart, palette, puller_panel, triple_point
from cz_gym.rendering.canvas import TIMES, Box, Canvas, Frame
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
    whole, gap = canvas.box, 6.0
    below, width = 0.27 * whole.h, (whole.w - (len(sides) + 1) * gap) / len(sides)
    magnified = min(puller_panel.magnification(side.record) for side in sides)
    bottom = Box(gap, whole.h - below - gap, whole.w - 2.0 * gap, below)
    boxes = [Box(gap + i * (width + gap), gap, width, whole.h - below - 3.0 * gap) for i in range(len(sides))]
    canvas.begin(bottom, *boxes)
    traces = [chart.Trace(side.record.t, side.record.error, side.colour) for side in sides]
    limit = chart.error_range(*(trace.error for trace in traces))
    chart.draw_traces(canvas, bottom, sides[0].record.config.horizon, limit, traces)
    x, y = bottom.x + 38, bottom.y + 4
    canvas.text(x, y, "true radius error [mm]", palette.FAINT)
    scale = f"{TIMES}{magnified:g}: drawn {magnified:g} times as large; shaded: within {chart.TOLERANCE / MM:g} mm"
    canvas.text(bottom.right - 10, y, scale, palette.FAINT, anchor=1.0)
    for i, (side, box) in enumerate(zip(sides, boxes, strict=True)):
        canvas.text(x + 125 + 140 * i, y, side.name, side.colour, bold=True)
        canvas.text(box.x + 10, box.y + 7, side.name, side.colour, 13, bold=True)
        canvas.text(box.right - 10, box.y + 7, f"RMSE {side.rmse() / MM:.2f} mm", size=13, anchor=1.0, bold=True)
        crystal = Box(box.x, box.y + 26, 0.44 * box.w, box.h - 26)
        edge = Box(crystal.right, crystal.y, 0.56 * box.w, crystal.h)
        puller_panel.draw(canvas, crystal, side.record, magnified, side.colour)
        triple_point.draw(canvas, edge, side.record, side.colour)
        if side.record.ending not in (None, Ending.HORIZON):
            draw_ending(canvas, edge, side.record.ending)
    return canvas.finish()
