"""The whole picture of one episode, in any size: the crystal's edge, numbers and the chart of the radius error."""

from typing import NamedTuple

import numpy as np

from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from . import palette, triple_point
from .canvas import Box, Canvas, Frame, first_at_least
from .palette import Colour
from .record import Ending, Floats, Record

RANGES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Half widths of an axis of radius errors [mm]."""
TOLERANCE = 0.5 * MM
"""Half width of the shaded band around no error [m]: the benchmark's tolerance."""
TICKS = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0)
"""Steps of the time axis [min]."""
MARGINS = (38.0, 18.0, 10.0, 14.0)
"""Room for the axes' numbers and the legend: left, top, right, bottom [nominal px]."""


class Layout(NamedTuple):
    """The boxes of the panels."""

    triple_point: Box
    numbers: Box
    chart: Box


def layout(box: Box) -> Layout:
    """The panels of a picture; the triple point gets the remaining space."""
    top, below = 34.0, 0.24 * box.h
    main = box.h - top - below - 12.0
    return Layout(
        triple_point=Box(6.0, top, box.w - 168.0, main),
        numbers=Box(box.w - 156.0, top, 150.0, main),
        chart=Box(6.0, top + main + 6.0, box.w - 12.0, below),
    )


class Picture:
    """Draws records as pictures of one size."""

    def __init__(self, width: int, height: int) -> None:
        self.canvas = Canvas(width, height)
        self.layout = layout(self.canvas.box)

    def draw(self, record: Record) -> Frame:
        """The picture of a record's newest sample, shape (height, width, 3)."""
        canvas, boxes = self.canvas, self.layout
        canvas.begin(boxes.numbers, boxes.chart)
        _draw_header(canvas, record)
        triple_point.draw(canvas, boxes.triple_point, record)
        _draw_numbers(canvas, boxes.numbers, record)
        _draw_chart(canvas, boxes.chart, record)
        if record.ending is not None:
            _draw_ending(canvas, boxes.triple_point, record.ending)
        return canvas.finish()


def _draw_header(canvas: Canvas, record: Record) -> None:
    """Scenario, time, length grown, and whether the crystal grows."""
    hours, rest = divmod(round(float(record.t[-1])), round(HOUR))
    minutes, seconds = divmod(rest, round(MINUTE))
    canvas.text(10, 7, record.config.process.name, size=14, bold=True)
    canvas.text(14 + 9 * len(record.config.process.name), 10, record.scenario, palette.FAINT, 11)
    time, grown = f"{hours}:{minutes:02d}:{seconds:02d}", f"{record.length[-1] / MM:.1f} mm"
    for x, name, value in ((204, "time", time), (312, "grown", grown)):
        canvas.text(x, 10, name, palette.FAINT, 11)
        canvas.text(x + 42, 7.5, value, size=13, bold=True)
    status, colour = ("growing", palette.WELL) if record.ending is None else ("ended", palette.ALARM)
    if record.ending is None and record.last("valid") <= 0.0:
        status, colour = "camera: no reading", palette.CAMERA
    canvas.text(canvas.box.right - 10, 10, status, colour, 11, 1.0, True)


Row = tuple[str, str, Colour]
"""Name, value and its colour."""


def numbers(record: Record) -> list[list[Row]]:
    """The rows of a record's newest sample; the first of each group is a signal, those below it its references."""
    last, (v_p, Q_H, T_b) = record.last, record.nominal
    return [
        [_row("by the camera", record.camera_error[-1] + last("r_ref"), MM, "mm", palette.CAMERA),
         _row("reference", last("r_ref"), MM, "mm", palette.REFERENCE)],
        [_row("pull speed", last("v_p"), MM_PER_MIN, "mm/min", palette.DRIVE), _row("nominal", v_p, MM_PER_MIN)],
        [_row("heater", last("Q_H"), KILO, "kW", palette.DRIVE), _row("nominal", Q_H, KILO)],
        [_row("heater T_1", last("T_1"), 1.0, "K", palette.TEMPERATURE), _row("recipe", last("T_1_ref"))],
        [_row("melt T_b", last("T_b"), 1.0, "K", palette.TEMPERATURE), _row("nominal", T_b)],
    ]  # fmt: skip


def _row(name: str, value: float, scale: float = 1.0, unit: str = "", colour: Colour = palette.FAINT) -> Row:
    """A row for a value in SI units; NaN is a failed reading."""
    return name, f"{value / scale:.2f} {unit}".rstrip() if np.isfinite(value) else "no reading", colour


def _draw_numbers(canvas: Canvas, box: Box, record: Record) -> None:
    """The true radius error in large figures, then the groups of rows."""
    left, right, y = box.x + 8, box.right - 8, box.y + 45
    canvas.text(left, box.y + 5, "true radius error", palette.FAINT)
    canvas.text(box.x + box.w / 2.0, box.y + 18, f"{record.error[-1] / MM:+.2f} mm", palette.TRUE, 19, 0.5, True)
    for group in numbers(record):
        for name, value, colour in group:
            canvas.text(left, y, name, palette.FAINT)
            canvas.text(right, y, value, colour, 9.5, 1.0, name == group[0][0])
            y += 13
        y += 9


def error_range(error: Floats) -> float:
    """Half width of an axis on which these radius errors fit [m]; NaN does not count."""
    largest = float(np.nanmax(np.abs(error), initial=0.0))
    return first_at_least(1.1 * largest / MM, RANGES) * MM


def _draw_chart(canvas: Canvas, box: Box, record: Record) -> None:
    """The radius errors by the camera and the true ones, against time; a dot marks the newest true one."""
    for left, text, colour in (
        (38, "radius error [mm]", palette.FAINT), (136, "by the camera", palette.CAMERA), (220, "true", palette.TRUE),
    ):  # fmt: skip
        canvas.text(box.x + left, box.y + 4, text, colour)
    # The camera's outliers must not set the scale.
    plot, horizon, limit = box.inner(*MARGINS), record.config.horizon, error_range(record.error)
    middle, per_metre = plot.y + 0.5 * plot.h, 0.5 * plot.h / limit
    band = min(TOLERANCE, limit) * per_metre
    canvas.rectangle(palette.BAND, Box(plot.x, middle - band, plot.w, 2.0 * band))
    _draw_time_axis(canvas, plot, horizon)
    for y, text in ((plot.y, f"{limit / MM:+g}"), (middle, "0"), (plot.bottom, f"{-limit / MM:+g}")):
        canvas.lines(palette.RIM, [plot.x, plot.right], y, 0.6)
        canvas.text(plot.x - 4, y - 6, text, palette.FAINT, 9.0, 1.0)
    with canvas.clip(plot):
        x, camera = plot.x + record.t / horizon * plot.w, middle - record.camera_error * per_metre
        for piece in np.split(np.arange(len(x)), np.flatnonzero(np.isnan(camera))):
            piece = piece[np.isfinite(camera[piece])]
            canvas.lines(palette.NOISE, x[piece], camera[piece], 0.8)
        true = middle - record.error * per_metre
        canvas.lines(palette.TRUE, x, true, 1.7)
    if np.isfinite(true[-1]):
        canvas.dot(palette.TRUE, x[-1], min(max(true[-1], plot.y), plot.bottom), 2.6)


def _draw_time_axis(canvas: Canvas, plot: Box, horizon: float) -> None:
    y, step = plot.bottom + 2, first_at_least(horizon / MINUTE / 9.0, TICKS) * MINUTE
    for number in range(int(horizon / step + 1e-9) + 1):
        x = plot.x + number * step / horizon * plot.w
        canvas.lines(palette.RIM, x, [plot.y, plot.bottom], 0.6)
        if x < plot.right - 46:
            hours, minutes = divmod(round(number * step / MINUTE), 60)
            # The first one, centred, would touch the lowest number of the other axis.
            canvas.text(x, y, f"{hours}:{minutes:02d}", palette.FAINT, 9.0, 0.5 if number else 0.0)
    canvas.text(plot.right, y, f"{horizon / HOUR:.3g} h", palette.FAINT, 9.0, 1.0)


def _draw_ending(canvas: Canvas, box: Box, ending: Ending) -> None:
    """A band across a panel that says how the episode ended."""
    band = Box(box.x, box.y + 6, box.w, 20)
    fine = ending in (Ending.HORIZON, Ending.DONE)
    canvas.rectangle(palette.RIM if fine else palette.ALARM, band)
    canvas.text(box.x + box.w / 2.0, band.y + 3.5, ending.value, size=11, anchor=0.5, bold=True)
