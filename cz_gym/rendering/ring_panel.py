"""What the camera reports and nothing else: the bright ring from above, against where it should be."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cz_gym.units import MM

from . import palette
from .canvas import TIMES, Box, Canvas, paired
from .geometry import first_at_least
from .record import Record
from .triple_point import RANGES, TOLERANCE

SPAN = 0.32
"""Half of the arc that is drawn [rad]."""
RECENT = 120
"""Samples whose largest error sets the magnification."""


def draw(canvas: Canvas, box: Box, record: Record) -> None:
    """The near arc of the ring by the camera (less the operator's bias) and of its reference, the error magnified."""
    unit, now, errors = canvas.unit, record.now, record.seen_error[-RECENT:]
    limit = first_at_least(1.1 * float(np.nanmax(np.abs(errors), initial=0.0)), RANGES)
    angle, radius = np.linspace(-SPAN, SPAN, 60), 0.5 * box.w / np.sin(SPAN)
    per_metre = 0.3 * box.h / limit
    x, y_0 = box.x + 0.5 * box.w, box.y + 0.45 * box.h - radius * np.cos(0.5 * SPAN)

    def arc(error: float) -> npt.NDArray[np.float64]:
        at = radius + error * per_metre
        return paired(x + at * np.sin(angle), y_0 + at * np.cos(angle))

    canvas.rectangle(palette.PANEL, box, 4.0)
    with canvas.clip(box):
        for band in (-TOLERANCE, TOLERANCE):
            canvas.lines(palette.RIM, arc(band), 1.0)
        canvas.dashes(palette.REFERENCE, arc(0.0), 1.2)
        if np.isfinite(errors[-1]):
            canvas.lines(palette.CAMERA, arc(float(errors[-1])), 3.0)
    canvas.title(box, "bright ring by the camera, from above")
    enlarged = f"error enlarged {TIMES}{per_metre * now.r_ref / radius:.0f}"
    said = f"dashes: reference, lines: {TOLERANCE / MM:g} mm beside it; {enlarged}"
    canvas.text(box.x + 8 * unit, box.bottom - 18 * unit, said, 9.5, palette.FAINT)
