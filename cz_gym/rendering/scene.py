"""The whole picture of one episode: puller, triple point, gauges, strip charts, in any size."""

from __future__ import annotations

from collections.abc import Callable
from numbers import Integral
from typing import TYPE_CHECKING, Any, NamedTuple

from cz_gym.units import MM

from . import edge_panel, gauges, palette, puller_panel, strips
from .canvas import BASE, Box, Canvas
from .gauges import Asked
from .record import Ending, Record

if TYPE_CHECKING:
    from pygame import Surface

SMALLEST, LARGEST = 360, 3840
"""Fewest and most pixels along a side."""


class Layout(NamedTuple):
    """Where the panels are."""

    header: Box
    puller: Box
    edge: Box
    gauges: Box
    strips: Box


def check_size(size: Any) -> tuple[int, int]:
    """Width and height of a picture [px]; ValueError names what was given and what is allowed."""
    try:
        width, height = size
    except (TypeError, ValueError):
        width = height = None
    if not (_is_side(width) and _is_side(height)):
        raise ValueError(
            f"render_size must be (width, height), whole numbers of {SMALLEST} to {LARGEST} pixels, not {size!r}"
        )
    return int(width), int(height)


def parse_size(text: str) -> tuple[int, int]:
    """The size that a command's ``--size`` names; ValueError names what was given and what is allowed."""
    try:
        width, height = (int(side) for side in text.split("x"))
    except ValueError:
        raise ValueError(f"--size must be WxH in pixels, such as 960x720, not {text!r}") from None
    return check_size((width, height))


def _is_side(side: Any) -> bool:
    return isinstance(side, Integral) and not isinstance(side, bool) and SMALLEST <= int(side) <= LARGEST


def layout(width: int, height: int) -> Layout:
    """The panels of a picture of that size; the triple point gets what the others leave."""
    unit = min(width / BASE[0], height / BASE[1])
    gap, side, head = 6.0 * unit, 188.0 * unit, 28.0 * unit
    column = 140.0 * unit
    top = head + gap
    chart = 0.315 * height
    main = height - top - chart - 2.0 * gap
    return Layout(
        Box(gap, 0.0, width - 2.0 * gap, head),
        Box(gap, top, side, main),
        Box(side + 2.0 * gap, top, width - side - column - 4.0 * gap, main),
        Box(width - column - gap, top, column, main),
        Box(gap, top + main + gap, width - 2.0 * gap, chart),
    )


class Scene:
    """Draws records as pictures of one size."""

    def __init__(self, width: int, height: int) -> None:
        self.canvas = Canvas(width, height)
        self.layout = layout(width, height)

    def draw(
        self, record: Record, asked: Asked | None = None, overlay: Callable[[Canvas], None] | None = None
    ) -> Surface:
        """The picture of a record's newest sample; the next call draws into the same surface.

        ``asked`` shows set-points of the drives, ``overlay`` draws on top.
        """
        canvas, boxes, reach = self.canvas, self.layout, strips.reach_of([record])
        same = (record.scenario, record.puller, record.config.horizon, reach)
        canvas.begin(same, lambda: self._ground(record, reach))
        self._header(record)
        puller_panel.draw(canvas, boxes.puller, record)
        edge_panel.draw(canvas, boxes.edge, record)
        gauges.draw(canvas, boxes.gauges, record, asked)
        strips.draw(canvas, boxes.strips, record, reach)
        if record.ending is not None:
            banner(canvas, boxes.edge, record.ending)
        if overlay is not None:
            overlay(canvas)
        return canvas.finish()

    def _ground(self, record: Record, reach: float) -> None:
        """All that is the same in every picture of a record, until the error chart needs a longer axis."""
        canvas, boxes, unit = self.canvas, self.layout, self.canvas.unit
        canvas.text(boxes.header.x + 4 * unit, 7 * unit, "Cz-v0", 14, palette.INK, bold=True)
        canvas.text(boxes.header.x + 58 * unit, 10 * unit, record.scenario, 11, palette.FAINT)
        canvas.text(boxes.edge.x, 10 * unit, "time", 11, palette.FAINT)
        canvas.text(boxes.edge.x + 112 * unit, 10 * unit, "grown", 11, palette.FAINT)
        canvas.panel(boxes.puller, "crystal")
        puller_panel.ground(canvas, boxes.puller, record.puller.r_0)
        edge_panel.ground(canvas, boxes.edge, record)
        gauges.ground(canvas, boxes.gauges, record)
        strips.ground(canvas, boxes.strips, record, reach)

    def _header(self, record: Record) -> None:
        canvas, box, now = self.canvas, self.layout.header, record.now
        unit = canvas.unit
        minutes, seconds = divmod(round(now.t), 60)
        time = f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"
        canvas.text(self.layout.edge.x + 30 * unit, 7.5 * unit, time, 13, palette.INK, bold=True)
        canvas.text(
            self.layout.edge.x + 152 * unit, 7.5 * unit, f"{now.length / MM:.1f} mm", 13, palette.INK, bold=True
        )
        status, colour = ("growing", palette.RECIPE) if record.ending is None else ("ended", palette.ALARM)
        if record.ending is None and now.valid <= 0.0:
            status, colour = "camera: no reading", palette.CAMERA
        canvas.text(box.right - 4 * unit, 10 * unit, status, 11, colour, "right", True)


def banner(canvas: Canvas, box: Box, ending: Ending) -> None:
    """A band across a panel that says how the episode ended."""
    unit = canvas.unit
    colour = palette.TRACK if ending is Ending.HORIZON else palette.ALARM
    band = Box(box.x, box.y + 6 * unit, box.w, 20 * unit)
    canvas.rectangle(colour, band)
    canvas.text(box.x + box.w / 2.0, band.y + 3.5 * unit, ending.value, 11, palette.INK, "centre", True)
