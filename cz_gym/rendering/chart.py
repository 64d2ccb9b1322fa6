"""The chart of radius errors over the whole episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cz_gym.units import HOUR, MINUTE, MM

from . import palette
from .canvas import Box, Canvas
from .geometry import TOLERANCE, Floats, error_range, first_at_least, paired
from .palette import Colour
from .record import Record

TICKS = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0)
"""Steps of the time axis [min]."""
MARGINS = (38.0, 18.0, 10.0, 14.0)
"""Room for the axes' numbers and the legend: left, top, right, bottom [nominal px]."""


class Trace(NamedTuple):
    """A line of the chart: times [s] and radius errors [m], NaN where there is none."""

    t: Floats
    error: Floats
    colour: Colour
    width: float = 1.7


def draw(canvas: Canvas, box: Box, record: Record) -> None:
    """The radius error by the camera, and the true one."""
    camera, true = Trace(record.t, record.camera_error, palette.NOISE, 0.8), Trace(record.t, record.error, palette.TRUE)
    # The camera's outliers must not set the scale.
    draw_traces(canvas, box, record.config.horizon, error_range(true.error), [camera, true])
    x, y = box.x + 38 * canvas.unit, box.y + 4 * canvas.unit
    canvas.text(x, y, "radius error [mm]", colour=palette.FAINT)
    canvas.text(x + 98 * canvas.unit, y, "by the camera", colour=palette.CAMERA)
    canvas.text(x + 182 * canvas.unit, y, "true", colour=palette.TRUE)


def draw_traces(canvas: Canvas, box: Box, horizon: float, limit: float, traces: Sequence[Trace]) -> None:
    """Radius errors from -limit to limit [m] against time from 0 to the horizon [s].

    A dot is the newest value of the last trace.
    """
    unit = canvas.unit
    plot = box.inner(*(margin * unit for margin in MARGINS))

    def placed(trace: Trace) -> Floats:
        return paired(plot.x + trace.t / horizon * plot.w, plot.y + (0.5 - 0.5 * trace.error / limit) * plot.h)

    band = min(TOLERANCE / limit, 1.0) * plot.h
    canvas.rectangle(palette.BAND, Box(plot.x, plot.y + 0.5 * (plot.h - band), plot.w, band))
    _draw_time_axis(canvas, plot, horizon)
    for share, text in ((0.0, f"{limit / MM:+g}"), (0.5, "0"), (1.0, f"{-limit / MM:+g}")):
        y = plot.y + share * plot.h
        canvas.lines(palette.RIM, [(plot.x, y), (plot.right, y)], 0.6)
        canvas.text(plot.x - 4 * unit, y - 6 * unit, text, 9.0, palette.FAINT, "right")
    with canvas.clip(plot):
        for trace in traces:
            points = placed(trace)
            gaps = np.flatnonzero(np.isnan(trace.error))
            for piece in np.split(points, gaps):
                canvas.lines(trace.colour, piece[np.isfinite(piece[:, 1])], trace.width)
    x, y = placed(traces[-1])[-1].tolist()
    if np.isfinite(y):
        canvas.dot(traces[-1].colour, (x, min(max(y, plot.y), plot.bottom)), 2.6)


def _draw_time_axis(canvas: Canvas, plot: Box, horizon: float) -> None:
    unit, y = canvas.unit, plot.bottom + 2 * canvas.unit
    step = first_at_least(horizon / MINUTE / 9.0, TICKS) * MINUTE
    for number in range(int(horizon / step + 1e-9) + 1):
        x = plot.x + number * step / horizon * plot.w
        canvas.lines(palette.RIM, [(x, plot.y), (x, plot.bottom)], 0.6)
        if x < plot.right - 46 * unit:
            hours, minutes = divmod(round(number * step / MINUTE), 60)
            # The first one, centred, would touch the lowest number of the other axis.
            canvas.text(x, y, f"{hours}:{minutes:02d}", 9.0, palette.FAINT, "centre" if number else "left")
    canvas.text(plot.right, y, f"{horizon / HOUR:.3g} h", 9.0, palette.FAINT, "right")
