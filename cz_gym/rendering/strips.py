"""Strip charts over the whole episode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.units import HOUR, MINUTE, MM, MM_PER_MIN

from . import palette
from .canvas import Box, Canvas, paired
from .edge_panel import RANGES, TOLERANCE
from .geometry import ladder
from .palette import Colour
from .record import Record

Floats = npt.NDArray[np.float64]
TICKS = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0)
"""Steps of the time axis [min]."""


SEEN = palette.mix(palette.PANEL, palette.CAMERA, 0.55)
SMOOTH = 5.0 * MINUTE
"""Length of the running mean drawn over the pull speed [s]."""
PIXELS = 1.4
"""Width that is drawn by one lowest and one highest value [nominal px]."""


class Trace(NamedTuple):
    """A line in a chart."""

    t: Floats
    values: Floats
    colour: Colour
    width: float


def boxes(canvas: Canvas, box: Box) -> tuple[Box, Box]:
    """The panels of the radius error and of the pull speed."""
    unit = canvas.unit
    upper = Box(box.x, box.y, box.w, 0.64 * box.h)
    return upper, Box(box.x, upper.bottom + 6.0 * unit, box.w, box.h - upper.h - 6.0 * unit)


def reach_of(records: Sequence[Record]) -> float:
    """Half height of a chart that holds the radius errors of all records [m]."""
    largest = max(float(np.abs(record.column("r_c") - record.column("r_ref")).max()) for record in records)
    return ladder(1.15 * largest, RANGES)


def ground(canvas: Canvas, box: Box, record: Record, reach: float) -> None:
    """What lies under every picture whose error chart reaches so far [m]: panels, axes and names."""
    unit, (upper, lower) = canvas.unit, boxes(canvas, box)
    error_ground(canvas, upper, record.config.horizon, reach)
    for x, name, colour in ((38, "radius error [mm]", palette.FAINT), (136, "true", palette.TRUE),
                            (167, "by the camera", palette.CAMERA)):  # fmt: skip
        canvas.text(upper.x + x * unit, upper.y + 4 * unit, name, 9.5, colour)
    canvas.panel(lower)
    plot, top = _pull_plot(canvas, lower), 2.0 * record.puller.v_0
    for value in (0.0, record.puller.v_0, top):
        _level(canvas, plot, value, 0.0, top, f"{value / MM_PER_MIN:.1f}")
    canvas.text(lower.x + 38 * unit, lower.y + 2 * unit, "pull speed [mm/min], 5 min mean", 9.5, palette.DRIVE)


def draw(canvas: Canvas, box: Box, record: Record, reach: float) -> None:
    """Radius error, true and by the camera, above the pull speed, both over the horizon."""
    upper, lower = boxes(canvas, box)
    error(canvas, upper, [(record, palette.TRUE)], reach, camera=record)
    pull(canvas, lower, record)


def plot_of(canvas: Canvas, box: Box) -> Box:
    """The part of the error chart's panel that lines are drawn in."""
    unit = canvas.unit
    return box.inner(38.0 * unit, 18.0 * unit, 10.0 * unit, 14.0 * unit)


def _pull_plot(canvas: Canvas, box: Box) -> Box:
    unit = canvas.unit
    return box.inner(38.0 * unit, 18.0 * unit, 10.0 * unit, 5.0 * unit)


def error_ground(canvas: Canvas, box: Box, horizon: float, reach: float) -> None:
    """Panel, tolerance band and axes of the error chart."""
    canvas.panel(box)
    plot = plot_of(canvas, box)
    band = min(TOLERANCE / reach, 1.0) * plot.h / 2.0
    canvas.rectangle(palette.BAND, Box(plot.x, plot.y + plot.h / 2.0 - band, plot.w, 2.0 * band))
    _time_axis(canvas, plot, horizon)
    for value in (-reach, 0.0, reach):
        _level(canvas, plot, value, -reach, reach, f"{value / MM:+g}" if value else "0")


def error(
    canvas: Canvas, box: Box, records: Sequence[tuple[Record, Colour]], reach: float, camera: Record | None = None
) -> None:
    """True radius errors against time, one line a record; ``camera`` adds what it saw."""
    traces = []
    if camera is not None:
        seen = np.where(camera.column("valid") > 0.0, camera.column("camera"), np.nan)
        traces.append(Trace(camera.column("t"), seen - camera.column("r_ref"), SEEN, 0.8))
    for record, colour in records:
        traces.append(Trace(record.column("t"), record.column("r_c") - record.column("r_ref"), colour, 1.7))
    _lines(canvas, plot_of(canvas, box), records[0][0].config, traces, -reach, reach)


def pull(canvas: Canvas, box: Box, record: Record) -> None:
    """The pull speed against time, between 0 and twice nominal."""
    t, v_p = record.column("t"), record.column("v_p")
    traces = [
        Trace(t, v_p, palette.mix(palette.PANEL, palette.DRIVE, 0.4), 0.6),
        Trace(t, running_mean(v_p, record.config.control_interval), palette.DRIVE, 1.6),
    ]
    _lines(canvas, _pull_plot(canvas, box), record.config, traces, 0.0, 2.0 * record.puller.v_0)


def running_mean(values: Floats, interval: float) -> Floats:
    """The mean of each value and those of the SMOOTH seconds before it, as far as there are any."""
    size = max(round(SMOOTH / interval), 1)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - size, 0)
    mean: Floats = (sums[ends] - sums[starts]) / (ends - starts)
    return mean


def _lines(canvas: Canvas, plot: Box, config: Config, traces: list[Trace], low: float, high: float) -> None:
    horizon, size = config.horizon, math.ceil(config.steps * PIXELS * canvas.unit / plot.w)
    with canvas.clip(plot):
        for trace in traces:
            t, values = thinned(trace.t, trace.values, size)
            x = plot.x + t / horizon * plot.w
            y = plot.bottom - (values - low) / (high - low) * plot.h
            for piece in _pieces(paired(x, y)):
                canvas.lines(trace.colour, piece, trace.width)
    newest = traces[-1]
    x, value = plot.x + newest.t[-1] / horizon * plot.w, float(np.clip(newest.values[-1], low, high))
    canvas.dot(newest.colour, (x, plot.bottom - (value - low) / (high - low) * plot.h), 2.6)


def _pieces(points: Floats) -> list[Floats]:
    """The stretches between gaps (NaN)."""
    gaps = np.isnan(points[:, 1])
    if not gaps.any():
        return [points]
    return [piece[~np.isnan(piece[:, 1])] for piece in np.split(points, np.flatnonzero(gaps))]


def thinned(t: Floats, values: Floats, size: int) -> tuple[Floats, Floats]:
    """Lowest and highest value of each stretch of ``size``, at its middle; all values if that saves nothing."""
    if size < 3 or not len(values):
        return t, values
    starts = np.arange(0, len(values), size)
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    middle = np.minimum(starts + size // 2, len(values) - 1)
    return np.repeat(t[middle], 2), paired(low, high).ravel()


def _level(canvas: Canvas, plot: Box, value: float, low: float, high: float, text: str) -> None:
    unit = canvas.unit
    y = plot.bottom - (value - low) / (high - low) * plot.h
    canvas.line(palette.RIM, (plot.x, y), (plot.right, y), 0.6)
    canvas.text(plot.x - 4 * unit, y - 6 * unit, text, 9.0, palette.FAINT, "right")


def _time_axis(canvas: Canvas, plot: Box, horizon: float) -> None:
    unit = canvas.unit
    step = ladder(horizon / MINUTE / 9.0, TICKS) * MINUTE
    for number in range(int(horizon / step + 1e-9) + 1):
        x = plot.x + number * step / horizon * plot.w
        canvas.line(palette.RIM, (x, plot.y), (x, plot.bottom), 0.6)
        if x < plot.right - 46 * unit:
            canvas.text(x, plot.bottom + 2 * unit, clock(number * step), 9.0, palette.FAINT, "centre")
    canvas.text(plot.right, plot.bottom + 2 * unit, f"{horizon / HOUR:.3g} h", 9.0, palette.FAINT, "right")


def clock(t: float) -> str:
    """A time [s] as hours and minutes."""
    minutes = round(t / MINUTE)
    return f"{minutes // 60}:{minutes % 60:02d}"
