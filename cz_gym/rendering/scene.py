"""The whole picture of one episode, in any size: crystal, triple point, numbers and the chart of the radius error."""

from __future__ import annotations

from collections.abc import Callable
from numbers import Integral
from typing import Any, NamedTuple

from cz_gym.errors import CzError
from cz_gym.units import HOUR, MINUTE, MM

from . import chart, numbers_panel, palette, puller_panel, triple_point
from .canvas import BASE, Box, Canvas, Frame
from .numbers_panel import SetPoints
from .record import Ending, Record

SMALLEST, LARGEST = 360, 3840
"""Fewest and most pixels along a side."""


class Layout(NamedTuple):
    """The boxes of the panels."""

    header: Box
    puller: Box
    triple_point: Box
    numbers: Box
    chart: Box


def check_size(size: Any) -> tuple[int, int]:
    """Width and height of a picture [px]; CzError names what was given and what is allowed."""
    try:
        width, height = size
        numbers = all(isinstance(side, Integral) and not isinstance(side, bool) for side in (width, height))
        fits = numbers and min(width, height) >= SMALLEST and max(width, height) <= LARGEST
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise CzError(
            f"render_size must be (width, height), whole numbers of {SMALLEST} to {LARGEST} pixels, not {size!r}"
        )
    return int(width), int(height)


def layout(width: int, height: int) -> Layout:
    """The panels of a picture of that size; the triple point gets what the others leave."""
    unit = min(width / BASE[0], height / BASE[1])
    gap, side, head, column, below = 6.0 * unit, 188.0 * unit, 28.0 * unit, 150.0 * unit, 0.24 * height
    top = head + gap
    main = height - top - below - 2.0 * gap
    return Layout(
        header=Box(gap, 0.0, width - 2.0 * gap, head),
        puller=Box(gap, top, side, main),
        triple_point=Box(side + 2.0 * gap, top, width - side - column - 4.0 * gap, main),
        numbers=Box(width - column - gap, top, column, main),
        chart=Box(gap, top + main + gap, width - 2.0 * gap, below),
    )


class Scene:
    """Draws records as pictures of one size."""

    def __init__(self, width: int, height: int) -> None:
        self.canvas = Canvas(width, height)
        self.layout = layout(width, height)

    def draw(
        self,
        record: Record,
        set_points: SetPoints | None = None,
        overlay: Callable[[Canvas], None] | None = None,
    ) -> Frame:
        """The picture of a record's newest sample, shape (height, width, 3).

        ``set_points`` are a player's, ``overlay`` draws on top.
        """
        canvas, boxes = self.canvas, self.layout
        canvas.begin((boxes.puller, boxes.numbers, boxes.chart))
        self._draw_header(record)
        puller_panel.draw(canvas, boxes.puller, record)
        canvas.text(boxes.puller.x + 8 * canvas.unit, boxes.puller.y + 5 * canvas.unit, "crystal", 9.5, palette.FAINT)
        triple_point.draw(canvas, boxes.triple_point, record)
        numbers_panel.draw(canvas, boxes.numbers, record, set_points)
        chart.draw(canvas, boxes.chart, record)
        if record.ending is not None:
            draw_ending(canvas, boxes.triple_point, record.ending)
        if overlay is not None:
            overlay(canvas)
        return canvas.finish()

    def _draw_header(self, record: Record) -> None:
        """Scenario, time, length grown, and whether the crystal grows."""
        canvas, unit = self.canvas, self.canvas.unit
        left, middle, right = self.layout.header.x, self.layout.triple_point.x, self.layout.header.right
        hours, rest = divmod(round(float(record.t[-1])), round(HOUR))
        minutes, seconds = divmod(rest, round(MINUTE))
        canvas.text(left + 4 * unit, 7 * unit, "Cz-v0", 14, bold=True)
        canvas.text(left + 58 * unit, 10 * unit, record.scenario, 11, palette.FAINT)
        time, grown = f"{hours}:{minutes:02d}:{seconds:02d}", f"{record.length[-1] / MM:.1f} mm"
        for x, after, name, value in ((0, 30, "time", time), (112, 152, "grown", grown)):
            canvas.text(middle + x * unit, 10 * unit, name, 11, palette.FAINT)
            canvas.text(middle + after * unit, 7.5 * unit, value, 13, bold=True)
        status, colour = ("growing", palette.WELL) if record.ending is None else ("ended", palette.ALARM)
        if record.ending is None and record.last("valid") <= 0.0:
            status, colour = "camera: no reading", palette.CAMERA
        canvas.text(right - 4 * unit, 10 * unit, status, 11, colour, "right", True)


def draw_ending(canvas: Canvas, box: Box, ending: Ending) -> None:
    """A band across a panel that says how the episode ended."""
    unit = canvas.unit
    band = Box(box.x, box.y + 6 * unit, box.w, 20 * unit)
    canvas.rectangle(palette.RIM if ending is Ending.HORIZON else palette.ALARM, band)
    canvas.text(box.x + box.w / 2.0, band.y + 3.5 * unit, ending.value, 11, palette.INK, "centre", True)
