"""The column of numbers: radius, pull speed, heater, heater temperature against its recipe, melt temperature."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cz_gym.task import HEATER_RANGE
from cz_gym.units import KILO, MM, MM_PER_MIN

from . import palette
from .canvas import Box, Canvas
from .palette import Colour
from .record import Record

T_1_RANGE = 20.0
"""T_1 gauge: nominal +- this [K]."""
T_B_RANGE = 3.0
"""T_b gauge: nominal +- this [K]."""
GAP = 6.0


class Gauge(NamedTuple):
    """One gauge: a bar from its origin to its value on a scale from low to high, any unit."""

    name: str
    shown: str
    value: float
    low: float
    high: float
    origin: float
    colour: Colour
    mark: float | None = None
    """A set-point, drawn as a pointer."""
    note: str = ""
    """What stands under the bar."""


class Asked(NamedTuple):
    """What somebody asks of the drives."""

    v_p: float
    """Pull speed [m/s]."""
    Q_H: float
    """Heater power [W]."""


def gauges(record: Record, asked: Asked | None = None) -> tuple[Gauge, ...]:
    """The gauges of a record's newest sample; ``asked`` adds the set-points of the drives."""
    now, p = record.now, record.puller
    v_0, window = p.v_0 / MM_PER_MIN, HEATER_RANGE / KILO
    v_p, Q_H, Q_H_0 = now.v_p / MM_PER_MIN, now.Q_H / KILO, p.Q_H_0 / KILO
    recipe = round(now.T_1 - now.T_1_ref, 1) + 0.0
    return (
        Gauge(
            "pull", f"{v_p:.2f} mm/min", v_p, 0.0, 2.0 * v_0, 0.0, palette.DRIVE,
            None if asked is None else asked.v_p / MM_PER_MIN, f"nominal {v_0:.2f}",
        ),
        Gauge(
            "heater", f"{Q_H:.2f} kW", Q_H, Q_H_0 - window, Q_H_0 + window, Q_H_0, palette.DRIVE,
            None if asked is None else asked.Q_H / KILO, f"nominal {Q_H_0:.2f}",
        ),
        Gauge(
            "T₁ heater", f"{now.T_1:.1f} K", now.T_1, p.T_1_0 - T_1_RANGE, p.T_1_0 + T_1_RANGE, p.T_1_0,
            palette.TEMPERATURE, now.T_1_ref, f"recipe {now.T_1_ref:.1f}, {recipe:+.1f} K",
        ),
        Gauge(
            "T_b melt", f"{now.T_b:.2f} K", now.T_b, p.T_b_0 - T_B_RANGE, p.T_b_0 + T_B_RANGE, p.T_b_0,
            palette.TEMPERATURE, None, f"nominal {p.T_b_0:.2f}, {now.T_b - p.T_b_0:+.2f} K",
        ),
    )  # fmt: skip


def ground(canvas: Canvas, box: Box, record: Record) -> None:
    """What lies under every picture: panels, tracks and names."""
    unit, shown = canvas.unit, gauges(record)
    top, *boxes = _boxes(canvas, box, len(shown))
    canvas.panel(top, "true radius error")
    canvas.text(top.x + 8 * unit, top.y + 40 * unit, "reference", 9.5, palette.FAINT)
    canvas.text(top.x + 8 * unit, top.y + 52 * unit, "by the camera", 9.5, palette.FAINT)
    for gauge, place in zip(shown, boxes, strict=True):
        canvas.panel(place, gauge.name)
        canvas.rectangle(palette.TRACK, _track(canvas, place), 3.0)


def draw(canvas: Canvas, box: Box, record: Record, asked: Asked | None = None) -> None:
    """The column: the radius on top, then a panel a gauge."""
    shown = gauges(record, asked)
    top, *boxes = _boxes(canvas, box, len(shown))
    radius(canvas, top, record)
    for gauge, place in zip(shown, boxes, strict=True):
        _gauge(canvas, place, gauge)


def _boxes(canvas: Canvas, box: Box, count: int) -> list[Box]:
    """The radius' panel and those of so many gauges."""
    gap = GAP * canvas.unit
    height = (box.h - count * gap) / (count + 1.45)
    first = box.y + 1.45 * height + gap
    below = [Box(box.x, first + i * (height + gap), box.w, height) for i in range(count)]
    return [Box(box.x, box.y, box.w, 1.45 * height), *below]


def _track(canvas: Canvas, box: Box) -> Box:
    unit = canvas.unit
    return Box(box.x + 8 * unit, box.y + 20.5 * unit, box.w - 16 * unit, 6.0 * unit)


def radius(canvas: Canvas, box: Box, record: Record) -> None:
    """The true radius error in large figures, with reference and camera under it."""
    now, unit = record.now, canvas.unit
    middle = box.x + box.w / 2.0
    canvas.text(middle, box.y + 16 * unit, f"{(now.r_c - now.r_ref) / MM:+.2f} mm", 19, palette.TRUE, "centre", True)
    canvas.text(box.right - 8 * unit, box.y + 40 * unit, f"{now.r_ref / MM:.2f}", 9.5, palette.REFERENCE, "right")
    camera = f"{now.camera / MM:.2f}" if now.valid > 0.0 else "no reading"
    canvas.text(box.right - 8 * unit, box.y + 52 * unit, camera, 9.5, palette.CAMERA, "right")


def _gauge(canvas: Canvas, box: Box, gauge: Gauge) -> None:
    unit = canvas.unit
    canvas.text(box.right - 8 * unit, box.y + 4 * unit, gauge.shown, 10.5, palette.INK, "right", True)
    track = _track(canvas, box)

    def at(value: float) -> float:
        share = (value - gauge.low) / (gauge.high - gauge.low)
        return track.x + float(np.clip(share, 0.0, 1.0)) * track.w

    left, right = sorted((at(gauge.origin), at(gauge.value)))
    canvas.rectangle(gauge.colour, Box(left, track.y, max(right - left, unit), track.h), 2.0)
    middle = track.x + track.w / 2.0
    canvas.line(palette.FAINT, (middle, track.y - 2 * unit), (middle, track.bottom + 2 * unit), 1.0)
    if gauge.mark is not None:
        x, top = at(gauge.mark), track.y - 1.0 * unit
        pointer = [[x, top + 4 * unit], [x - 4 * unit, top - 3 * unit], [x + 4 * unit, top - 3 * unit]]
        canvas.polygon(palette.RECIPE, np.array(pointer))
    canvas.text(box.x + 8 * unit, track.bottom + 3 * unit, gauge.note, 9.0, palette.FAINT)
