"""The chart of radius errors over the whole episode."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cz_gym.units import HOUR, MINUTE, MM

from . import palette
from .canvas import Box, Canvas
from .record import Floats, Record

RANGES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Half widths of an axis of radius errors [mm]."""
TOLERANCE = 0.5 * MM
"""Half width of the shaded band around no error [m]: the benchmark's tolerance."""
TICKS = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0)
"""Steps of the time axis [min]."""
MARGINS = (38.0, 18.0, 10.0, 14.0)
"""Room for the axes' numbers and the legend: left, top, right, bottom [nominal px]."""


def first_at_least(value: float, steps: Sequence[float]) -> float:
    """The first of increasing steps that is at least a value, or the last."""
    return next((step for step in steps if step >= value), steps[-1])


def error_range(error: Floats) -> float:
    """Half width of an axis on which these radius errors fit [m]; NaN does not count."""
    largest = float(np.nanmax(np.abs(error), initial=0.0))
    return first_at_least(1.1 * largest / MM, RANGES) * MM


def draw(canvas: Canvas, box: Box, record: Record) -> None:
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
