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


Row = tuple[str, str, Colour]
"""Name, value and its colour."""


def groups(record: Record, set_points: SetPoints | None = None) -> list[list[Row]]:
    """The rows of a record's newest sample; the first of each group is a signal, those below it its references."""
    p, last = record.puller, record.last
    rows = [
        [_row("by the camera", record.camera_error[-1] + last("r_ref"), MM, "mm", palette.CAMERA),
         _row("reference", last("r_ref"), MM, "mm", palette.REFERENCE)],
        [_row("pull speed", last("v_p"), MM_PER_MIN, "mm/min", palette.DRIVE), _row("nominal", p.v_0, MM_PER_MIN)],
        [_row("heater", last("Q_H"), KILO, "kW", palette.DRIVE), _row("nominal", p.Q_H_0, KILO)],
        [_row("heater T_1", last("T_1"), 1.0, "K", palette.TEMPERATURE), _row("recipe", last("T_1_ref"))],
        [_row("melt T_b", last("T_b"), 1.0, "K", palette.TEMPERATURE), _row("nominal", p.T_b_0)],
    ]  # fmt: skip
    if set_points is not None:
        rows[1].append(_row("set by hand", set_points.v_p, MM_PER_MIN, colour=palette.INK))
        rows[2].append(_row("set by hand", set_points.Q_H, KILO, colour=palette.INK))
    return rows


def _row(name: str, value: float, scale: float = 1.0, unit: str = "", colour: Colour = palette.FAINT) -> Row:
    """A row of a value in SI units; what is not a number is a reading that failed."""
    return name, f"{value / scale:.2f} {unit}".rstrip() if np.isfinite(value) else "no reading", colour


def draw(canvas: Canvas, box: Box, record: Record, set_points: SetPoints | None = None) -> None:
    """The true radius error in large figures, then the groups of rows."""
    unit, left, right = canvas.unit, box.x + 8 * canvas.unit, box.right - 8 * canvas.unit
    canvas.text(left, box.y + 5 * unit, "true radius error", colour=palette.FAINT)
    error = f"{record.error[-1] / MM:+.2f} mm"
    canvas.text(box.x + box.w / 2.0, box.y + 18 * unit, error, 19, palette.TRUE, "centre", True)
    y = box.y + 45 * unit
    for group in groups(record, set_points):
        for name, value, colour in group:
            canvas.text(left, y, name, colour=palette.FAINT)
            canvas.text(right, y, value, 9.5, colour, "right", name == group[0][0])
            y += 13 * unit
        y += 9 * unit
