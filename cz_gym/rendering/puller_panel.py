"""The whole crystal above its crucible: to scale, its error against the reference magnified."""

from __future__ import annotations

import numpy as np

from cz_gym.units import MM

from . import palette
from .canvas import TIMES, Box, Canvas
from .record import Ending, Record

HALF_WIDTH = 0.29
"""Share of the panel's width that r_0 takes [-]."""
MELT_LEVEL = 0.73
"""Share of the panel's height above the melt's surface [-]."""
DEPTH_IN_R_CR = 0.45
"""Depth of the melt as drawn, in crucible radii: the plant's melt is a heat capacity and has no depth [-]."""
SHOULDER_IN_R_0 = 0.55
"""Height of the cone on the crystal as drawn, in crystal radii: an episode begins after the shoulder [-]."""
MAGNIFICATIONS = (40.0, 20.0, 10.0, 5.0)
"""Possible magnifications of the radius error, above the least, 2 [-]."""
LARGEST = 0.2
"""Largest magnified error, in r_0 [-]."""


def magnification(record: Record) -> float:
    """Magnification of the radius error: the largest that leaves the crystal in the panel."""
    room = LARGEST * record.puller.r_0 / max(float(np.abs(record.error).max()), 0.1 * MM)
    return next((one for one in MAGNIFICATIONS if one <= room), 2.0)


def draw(canvas: Canvas, box: Box, record: Record) -> None:
    """Crucible, melt and crystal."""
    scale, level = HALF_WIDTH * box.w / record.puller.r_0, box.y + MELT_LEVEL * box.h
    magnified, bar = magnification(record), 50.0 * MM * scale
    # The crucible is as wide as the panel has room for: the real one is wider.
    depth = record.config.parameters.R_cr * DEPTH_IN_R_CR * scale
    crucible = Box(box.x + 10.0, level - 14.0, box.w - 20.0, depth + 19.0)
    canvas.rectangle(palette.QUARTZ, crucible)
    canvas.rectangle(palette.PANEL, crucible.inner(5.0, 0.0, 5.0, 5.0))
    canvas.rectangle(palette.MELT, crucible.inner(5.0, 14.0, 5.0, 5.0))
    with canvas.clip(box):
        _draw_crystal(canvas, box, level, scale, record, magnified)
    x, y = box.right - 10.0, box.y + 24.0
    canvas.lines(palette.FAINT, [x - 3, x, x, x - 3], [y, y, y + bar, y + bar])
    canvas.text(x - 5, y + bar / 2 - 6, "50 mm", palette.FAINT, 9.0, 1.0)
    canvas.text(box.x + 8, box.y + 18, f"error {TIMES}{magnified:g}", palette.TRUE)


def _draw_crystal(canvas: Canvas, box: Box, level: float, scale: float, record: Record, magnified: float) -> None:
    """The crystal on its seed; ``level`` is the melt's surface, ``scale`` the pixels per metre."""
    x, (r_c, r_ref, z) = box.x + box.w / 2.0, record.surface()
    half, y = (r_ref + magnified * (r_c - r_ref)) * scale, level - z * scale
    cone = float(y[-1]) - SHOULDER_IN_R_0 * record.puller.r_0 * scale
    canvas.lines(palette.FAINT, x, [box.y, cone], 2.0)
    foot = level if record.ending is not Ending.DETACHED else y[0]
    outline, down = np.r_[half[0], half, 0.0], np.r_[foot, y, cone]
    canvas.polygon(palette.CRYSTAL, np.r_[x + outline, x - outline[::-1]], np.r_[down, down[::-1]])
    for side in (-1.0, 1.0):
        canvas.lines(palette.REFERENCE, x + side * r_ref * scale, y, 0.8)
        canvas.lines(palette.TRUE, x + side * half, y, 1.6)
