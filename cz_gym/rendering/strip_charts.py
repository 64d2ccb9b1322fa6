"""Strip charts over the whole episode: radius error and pull speed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cz_gym.config import Config
from cz_gym.units import HOUR, MINUTE, MM, MM_PER_MIN

from . import palette
from .canvas import Box, Canvas, paired
from .geometry import first_at_least
from .palette import Colour
from .record import Floats, Record
from .triple_point import RANGES, TOLERANCE

TICKS = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0)
"""Steps of the time axis [min]."""
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


def error_range(records: Sequence[Record]) -> float:
    """Half height of a chart that shows the radius errors of all records [m]."""
    return first_at_least(1.15 * max((_largest(record.error) for record in records), default=0.0), RANGES)


def _largest(error: Floats) -> float:
    """The largest error, 0 without any; those that are no number do not count."""
    return float(np.nanmax(np.abs(error), initial=0.0))


def draw(canvas: Canvas, upper: Box, lower: Box, record: Record, blind: bool = False) -> None:
    """Radius error, true unless ``blind`` and by the camera, above the pull speed, both over the horizon."""
    draw_errors(canvas, upper, [] if blind else [(record, palette.TRUE)], camera=record)
    names = (
        (38, "radius error [mm]", palette.FAINT), (136, "by the camera", palette.CAMERA), (220, "true", palette.TRUE),
    )  # fmt: skip
    for x, name, colour in names[: 2 if blind else 3]:
        canvas.text(upper.x + x * canvas.unit, upper.y + 4 * canvas.unit, name, 9.5, colour)
    _draw_pull(canvas, lower, record)


def draw_errors(
    canvas: Canvas, box: Box, records: Sequence[tuple[Record, Colour]], camera: Record | None = None
) -> None:
    """True radius errors against time, one line a record; ``camera`` adds what it saw, and can stand alone."""
    unit, limit, traces = canvas.unit, error_range([record for record, _ in records]), []
    plot = box.inner(38.0 * unit, 18.0 * unit, 10.0 * unit, 14.0 * unit)
    config = (camera or records[0][0]).config
    if camera is not None:
        seen = camera.seen_error
        limit = limit if records else first_at_least(1.15 * _largest(seen), RANGES)
        traces.append(Trace(camera.column("t"), seen, palette.mix(palette.PANEL, palette.CAMERA, 0.55), 0.8))
    band = min(TOLERANCE / limit, 1.0) * plot.h / 2.0
    canvas.rectangle(palette.BAND, Box(plot.x, plot.y + plot.h / 2.0 - band, plot.w, 2.0 * band))
    _time_axis(canvas, plot, config.horizon)
    for value in (-limit, 0.0, limit):
        _level(canvas, plot, value, -limit, limit, f"{value / MM:+g}" if value else "0")
    traces += [Trace(record.column("t"), record.error, colour, 1.7) for record, colour in records]
    _traces(canvas, plot, config, traces, -limit, limit)


def _draw_pull(canvas: Canvas, box: Box, record: Record) -> None:
    """The pull speed against time, between 0 and twice nominal."""
    unit, nominal = canvas.unit, record.puller.v_0
    plot = box.inner(38.0 * unit, 18.0 * unit, 10.0 * unit, 5.0 * unit)
    for value in (0.0, nominal, 2.0 * nominal):
        _level(canvas, plot, value, 0.0, 2.0 * nominal, f"{value / MM_PER_MIN:.1f}")
    canvas.text(box.x + 38 * unit, box.y + 2 * unit, "pull speed [mm/min], 5 min mean", 9.5, palette.DRIVE)
    t, v_p = record.column("t"), record.column("v_p")
    traces = [
        Trace(t, v_p, palette.mix(palette.PANEL, palette.DRIVE, 0.4), 0.6),
        Trace(t, running_mean(v_p, record.config.control_interval), palette.DRIVE, 1.6),
    ]
    _traces(canvas, plot, record.config, traces, 0.0, 2.0 * nominal)


def running_mean(values: Floats, interval: float) -> Floats:
    """The mean of each value and those of the SMOOTH seconds before it, as far as there are any."""
    size = max(round(SMOOTH / interval), 1)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - size, 0)
    mean: Floats = (sums[ends] - sums[starts]) / (ends - starts)
    return mean


def _traces(canvas: Canvas, plot: Box, config: Config, traces: list[Trace], low: float, high: float) -> None:
    """Lines between two values of the plot's lower and upper edge; a dot is the newest value of the last."""
    size = math.ceil(config.steps * PIXELS * canvas.unit / plot.w)

    def placed(t: Floats, values: Floats) -> Floats:
        y = plot.bottom - (values - low) / (high - low) * plot.h
        return paired(plot.x + t / config.horizon * plot.w, y)

    with canvas.clip(plot):
        for trace in traces:
            for piece in _pieces(placed(*thinned(trace.t, trace.values, size))):
                canvas.lines(trace.colour, piece, trace.width)
    newest = traces[-1]
    ((x, y),) = placed(newest.t[-1:], np.clip(newest.values[-1:], low, high))
    if np.isfinite(y):
        canvas.dot(newest.colour, (x, y), 2.6)


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
    y = plot.bottom - (value - low) / (high - low) * plot.h
    canvas.line(palette.RIM, (plot.x, y), (plot.right, y), 0.6)
    canvas.text(plot.x - 4 * canvas.unit, y - 6 * canvas.unit, text, 9.0, palette.FAINT, "right")


def _time_axis(canvas: Canvas, plot: Box, horizon: float) -> None:
    unit, below = canvas.unit, plot.bottom + 2 * canvas.unit
    step = first_at_least(horizon / MINUTE / 9.0, TICKS) * MINUTE
    for number in range(int(horizon / step + 1e-9) + 1):
        x = plot.x + number * step / horizon * plot.w
        canvas.line(palette.RIM, (x, plot.y), (x, plot.bottom), 0.6)
        if x < plot.right - 46 * unit:
            hours, minutes = divmod(round(number * step / MINUTE), 60)
            # The first one would reach into the lowest number of the other axis.
            canvas.text(x, below, f"{hours}:{minutes:02d}", 9.0, palette.FAINT, "centre" if number else "left")
    canvas.text(plot.right, below, f"{horizon / HOUR:.3g} h", 9.0, palette.FAINT, "right")
