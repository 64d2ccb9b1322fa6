"""The column of numbers: radius, drives and temperatures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cz_gym.units import KILO, MM, MM_PER_MIN

from . import palette
from .canvas import Box, Canvas
from .palette import Colour
from .record import Record


class SetPoints(NamedTuple):
    """What a player asks of the drives."""

    v_p: float
    """Pull speed [m/s]."""
    Q_H: float
    """Heater power [W]."""


class Row(NamedTuple):
    """A line of the column."""

    name: str
    value: str
    colour: Colour = palette.FAINT


def groups(record: Record, set_points: SetPoints | None = None) -> list[list[Row]]:
    """The rows of a record's newest sample; the first of each group is a signal, those below it its references.

    ``set_points`` of the drives are added.
    """
    p, last, asked = record.puller, record.last, set_points
    pull, heater = last("v_p") / MM_PER_MIN, last("Q_H") / KILO
    drives = [
        [Row("pull speed", f"{pull:.2f} mm/min", palette.DRIVE), Row("nominal", f"{p.v_0 / MM_PER_MIN:.2f}")],
        [Row("heater", f"{heater:.2f} kW", palette.DRIVE), Row("nominal", f"{p.Q_H_0 / KILO:.2f}")],
    ]
    if asked is not None:
        drives[0].append(Row("set by hand", f"{asked.v_p / MM_PER_MIN:.2f}", palette.INK))
        drives[1].append(Row("set by hand", f"{asked.Q_H / KILO:.2f}", palette.INK))
    T_1 = [Row("heater T_1", f"{last('T_1'):.1f} K", palette.TEMPERATURE), Row("recipe", f"{last('T_1_ref'):.1f}")]
    T_b = [Row("melt T_b", f"{last('T_b'):.2f} K", palette.TEMPERATURE), Row("nominal", f"{p.T_b_0:.2f}")]
    return [*drives, T_1, T_b]


def draw(canvas: Canvas, box: Box, record: Record, set_points: SetPoints | None = None) -> None:
    """The true radius error in large figures, then the groups of rows."""
    unit, left, right = canvas.unit, box.x + 8 * canvas.unit, box.right - 8 * canvas.unit
    canvas.text(left, box.y + 5 * unit, "true radius error", colour=palette.FAINT)
    error = _in_mm(float(record.error[-1]), "+.2f")
    canvas.text(box.x + box.w / 2.0, box.y + 18 * unit, error, 19, palette.TRUE, "centre", True)
    radius = [
        Row("by the camera", _in_mm(float(record.camera_error[-1]) + record.last("r_ref")), palette.CAMERA),
        Row("reference", _in_mm(record.last("r_ref")), palette.REFERENCE),
    ]
    y = box.y + 45 * unit
    for group in (radius, *groups(record, set_points)):
        for row in group:
            canvas.text(left, y, row.name, colour=palette.FAINT)
            canvas.text(right, y, row.value, 9.5, row.colour, "right", row is group[0])
            y += 13 * unit
        y += 9 * unit


def _in_mm(length: float, form: str = ".2f") -> str:
    """A length in mm; what is not a number is a reading that failed."""
    return f"{length / MM:{form}} mm" if np.isfinite(length) else "no reading"
