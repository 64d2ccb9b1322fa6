"""The whole picture of one episode: puller, triple point, gauges, strip charts, in any size."""

from __future__ import annotations

from collections.abc import Callable
from numbers import Integral
from typing import TYPE_CHECKING, Any, NamedTuple

from cz_gym.errors import CzError
from cz_gym.units import HOUR, MINUTE, MM

from . import gauges, palette, puller_panel, ring_panel, strip_charts, triple_point
from .canvas import BASE, Box, Canvas
from .record import Ending, Record

if TYPE_CHECKING:
    from pygame import Surface

SMALLEST, LARGEST = 360, 3840
"""Fewest and most pixels along a side."""
GAUGES, TALL = 4, 1.45
"""Number of gauges; height of the radius' panel above them, in panels of a gauge [-]."""


class Layout(NamedTuple):
    """Where the panels are."""

    header: Box
    puller: Box
    triple_point: Box
    gauges: tuple[Box, ...]
    """The radius' panel, then one a gauge."""
    charts: tuple[Box, Box]
    """Of the radius error and of the pull speed."""


def check_size(size: Any) -> tuple[int, int]:
    """Width and height of a picture [px]; ValueError names what was given and what is allowed."""
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
    gap, side, head, column = 6.0 * unit, 188.0 * unit, 28.0 * unit, 140.0 * unit
    top, below = head + gap, 0.315 * height
    main = height - top - below - 2.0 * gap
    x, small = width - column - gap, (main - GAUGES * gap) / (GAUGES + TALL)
    radius = Box(x, top, column, TALL * small)
    numbers = [Box(x, radius.bottom + gap + i * (small + gap), column, small) for i in range(GAUGES)]
    upper = Box(gap, top + main + gap, width - 2.0 * gap, 0.64 * below)
    return Layout(
        Box(gap, 0.0, width - 2.0 * gap, head),
        Box(gap, top, side, main),
        Box(side + 2.0 * gap, top, width - side - column - 4.0 * gap, main),
        (radius, *numbers),
        (upper, Box(gap, upper.bottom + gap, upper.w, below - upper.h - gap)),
    )


class Scene:
    """Draws records as pictures of one size."""

    def __init__(self, width: int, height: int) -> None:
        self.canvas = Canvas(width, height)
        self.layout = layout(width, height)

    def draw(
        self,
        record: Record,
        set_points: gauges.SetPoints | None = None,
        overlay: Callable[[Canvas], None] | None = None,
        blind: bool = False,
    ) -> Surface:
        """The picture of a record's newest sample; the next call draws into the same surface.

        ``set_points`` of the drives are marked, ``overlay`` draws on top, ``blind`` shows what the puller's sensors do.
        """
        canvas, boxes = self.canvas, self.layout
        canvas.begin((boxes.puller, *boxes.gauges, *boxes.charts))
        self._header(record, blind)
        if blind:
            ring_panel.draw(
                canvas, Box(*boxes.puller[:2], boxes.triple_point.right - boxes.puller.x, boxes.puller.h), record
            )
        else:
            canvas.title(boxes.puller, "crystal")
            puller_panel.draw(canvas, boxes.puller, record)
            triple_point.draw(canvas, boxes.triple_point, record)
        gauges.draw(canvas, boxes.gauges, record, set_points, blind)
        strip_charts.draw(canvas, *boxes.charts, record, blind)
        if record.ending is not None:
            draw_ending(canvas, boxes.triple_point, record.ending)
        if overlay is not None:
            overlay(canvas)
        return canvas.finish()

    def _header(self, record: Record, blind: bool) -> None:
        """Scenario, time, length grown unless ``blind``, and whether all is well."""
        canvas, unit, now = self.canvas, self.canvas.unit, record.now
        left, middle, right = self.layout.header.x, self.layout.triple_point.x, self.layout.header.right
        hours, rest = divmod(round(now.t), round(HOUR))
        minutes, seconds = divmod(rest, round(MINUTE))
        canvas.text(left + 4 * unit, 7 * unit, "Cz-v0", 14, palette.INK, bold=True)
        canvas.text(left + 58 * unit, 10 * unit, record.scenario, 11, palette.FAINT)
        shown = (
            (0, 30, "time", f"{hours}:{minutes:02d}:{seconds:02d}"),
            (112, 152, "grown", f"{now.length / MM:.1f} mm"),
        )
        for x, after, name, value in shown[: 1 if blind else 2]:
            canvas.text(middle + x * unit, 10 * unit, name, 11, palette.FAINT)
            canvas.text(middle + after * unit, 7.5 * unit, value, 13, palette.INK, bold=True)
        status, colour = ("growing", palette.RECIPE) if record.ending is None else ("ended", palette.ALARM)
        if record.ending is None and now.valid <= 0.0:
            status, colour = "camera: no reading", palette.CAMERA
        canvas.text(right - 4 * unit, 10 * unit, status, 11, colour, "right", True)


def draw_ending(canvas: Canvas, box: Box, ending: Ending) -> None:
    """A band across a panel that says how the episode ended."""
    unit = canvas.unit
    colour = palette.TRACK if ending is Ending.HORIZON else palette.ALARM
    band = Box(box.x, box.y + 6 * unit, box.w, 20 * unit)
    canvas.rectangle(colour, band)
    canvas.text(box.x + box.w / 2.0, band.y + 3.5 * unit, ending.value, 11, palette.INK, "centre", True)
