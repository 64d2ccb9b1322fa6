"""The column of numbers: radius, pull speed, heater, heater temperature against its recipe, melt temperature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cz_gym.task import HEATER_RANGE
from cz_gym.units import KILO, MM, MM_PER_MIN

from . import palette
from .canvas import Box, Canvas
from .palette import Colour
from .record import Record

T_1_RANGE, T_B_RANGE = 20.0, 3.0
"""Half width of the gauges of T_1 and T_b, nominal in the middle [K]."""


MEASURED = 3
"""How many of the gauges a puller has sensors for: all but the melt's temperature."""


class Gauge(NamedTuple):
    """One gauge: a bar from its origin to its value on a scale from low to high, any unit."""

    name: str
    shown: str
    value: float
    low: float
    high: float
    origin: float
    colour: Colour
    set_point: float | None = None
    """Drawn as a pointer."""
    note: str = ""
    """What stands under the bar."""


class SetPoints(NamedTuple):
    """What somebody asks of the drives."""

    v_p: float
    """Pull speed [m/s]."""
    Q_H: float
    """Heater power [W]."""


def gauges(record: Record, set_points: SetPoints | None = None) -> tuple[Gauge, ...]:
    """The gauges of a record's newest sample; ``set_points`` of the drives are marked."""
    now, p = record.now, record.puller
    v_0, window = p.v_0 / MM_PER_MIN, HEATER_RANGE / KILO
    v_p, Q_H, Q_H_0 = now.v_p / MM_PER_MIN, now.Q_H / KILO, p.Q_H_0 / KILO
    recipe = round(now.T_1 - now.T_1_ref, 1) + 0.0
    return (
        Gauge(
            "pull", f"{v_p:.2f} mm/min", v_p, 0.0, 2.0 * v_0, 0.0, palette.DRIVE,
            None if set_points is None else set_points.v_p / MM_PER_MIN, f"nominal {v_0:.2f}",
        ),
        Gauge(
            "heater", f"{Q_H:.2f} kW", Q_H, Q_H_0 - window, Q_H_0 + window, Q_H_0, palette.DRIVE,
            None if set_points is None else set_points.Q_H / KILO, f"nominal {Q_H_0:.2f}",
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


def draw(
    canvas: Canvas, boxes: Sequence[Box], record: Record, set_points: SetPoints | None = None, blind: bool = False
) -> None:
    """The radius in the first box, then a gauge a box; ``blind`` leaves out what no sensor of the puller shows."""
    _radius(canvas, boxes[0], record, blind)
    for gauge, box in zip(gauges(record, set_points)[: MEASURED if blind else None], boxes[1:], strict=False):
        _gauge(canvas, box, gauge)


def _radius(canvas: Canvas, box: Box, record: Record, blind: bool) -> None:
    """The radius error in large figures, true or by the camera, with reference and camera under it."""
    now, unit = record.now, canvas.unit
    canvas.title(box, "error by the camera" if blind else "true radius error")
    seen, colour = (float(record.seen_error[-1]), palette.CAMERA) if blind else (now.r_c - now.r_ref, palette.TRUE)
    error = f"{seen / MM:+.2f} mm" if np.isfinite(seen) else "no reading"
    canvas.text(box.x + box.w / 2.0, box.y + 16 * unit, error, 19, colour, "centre", True)
    camera = f"{now.camera / MM:.2f}" if now.valid > 0.0 else "no reading"
    for y, name, value, colour in (
        (40, "reference", f"{now.r_ref / MM:.2f}", palette.REFERENCE), (52, "by the camera", camera, palette.CAMERA)
    ):  # fmt: skip
        canvas.text(box.x + 8 * unit, box.y + y * unit, name, 9.5, palette.FAINT)
        canvas.text(box.right - 8 * unit, box.y + y * unit, value, 9.5, colour, "right")


def _gauge(canvas: Canvas, box: Box, gauge: Gauge) -> None:
    unit = canvas.unit
    canvas.title(box, gauge.name)
    canvas.text(box.right - 8 * unit, box.y + 4 * unit, gauge.shown, 10.5, palette.INK, "right", True)
    track = Box(box.x + 8 * unit, box.y + 20.5 * unit, box.w - 16 * unit, 6.0 * unit)
    canvas.rectangle(palette.TRACK, track, 3.0)

    def at(value: float) -> float:
        share = (value - gauge.low) / (gauge.high - gauge.low)
        return track.x + float(np.clip(share, 0.0, 1.0)) * track.w

    left, right = sorted((at(gauge.origin), at(gauge.value)))
    canvas.rectangle(gauge.colour, Box(left, track.y, max(right - left, unit), track.h), 2.0)
    middle = track.x + track.w / 2.0
    canvas.line(palette.FAINT, (middle, track.y - 2 * unit), (middle, track.bottom + 2 * unit), 1.0)
    if gauge.set_point is not None:
        x, top = at(gauge.set_point), track.y - 1.0 * unit
        pointer = [[x, top + 4 * unit], [x - 4 * unit, top - 3 * unit], [x + 4 * unit, top - 3 * unit]]
        canvas.polygon(palette.RECIPE, np.array(pointer))
    canvas.text(box.x + 8 * unit, track.bottom + 3 * unit, gauge.note, 9.0, palette.FAINT)
