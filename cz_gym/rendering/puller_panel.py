"""The whole crystal above its crucible: to scale, its error against the reference magnified."""

from __future__ import annotations

import numpy as np

from cz_gym.units import MM

from . import palette
from .canvas import TIMES, Box, Canvas
from .geometry import Floats, Scale, first_at_least, paired
from .palette import Colour
from .record import Ending, Record

HALF_WIDTH = 0.29
"""Share of the panel's width that r_0 takes [-]."""
MELT_LEVEL = 0.73
"""Share of the panel's height above the melt's surface [-]."""
DEPTH_IN_R_CR = 0.45
"""Depth of the melt as drawn, in crucible radii: the plant's melt is a heat capacity and has no depth [-]."""
SHOULDER_IN_R_0 = 0.55
"""Height of the cone on the crystal as drawn, in crystal radii: an episode begins after the shoulder [-]."""
MAGNIFICATIONS = (40.0, 20.0, 10.0, 5.0, 2.0)
"""Possible magnifications of the radius error [-]."""
LARGEST = 0.2
"""Largest magnified error, in r_0 [-]."""
MOST_POINTS = 160
"""Largest number of points of the drawn surface."""


def magnification(record: Record) -> float:
    """Magnification of the radius error: the largest that leaves the crystal in the panel."""
    largest = max(float(np.abs(record.error).max()), 0.1 * MM)
    return 1.0 / first_at_least(largest / (LARGEST * record.puller.r_0), tuple(1.0 / one for one in MAGNIFICATIONS))


def draw(
    canvas: Canvas, box: Box, record: Record, magnified: float | None = None, colour: Colour = palette.TRUE
) -> None:
    """Crucible, melt and crystal, its surface in a colour.

    ``magnified`` is used instead of :func:`magnification`.
    """
    per_metre = HALF_WIDTH * box.w / record.puller.r_0
    scale = Scale(box.x + box.w / 2.0, 0.0, box.y + MELT_LEVEL * box.h, per_metre)
    magnified, unit, bar = magnified or magnification(record), canvas.unit, 50.0 * MM * per_metre
    _draw_crucible(canvas, box, scale.y_0, record.config.parameters.R_cr * DEPTH_IN_R_CR * per_metre)
    with canvas.clip(box):
        _draw_crystal(canvas, box, scale, record, magnified, colour)
    x, y = box.right - 10.0 * unit, box.y + 24.0 * unit
    canvas.lines(palette.FAINT, [(x - 3 * unit, y), (x, y), (x, y + bar), (x - 3 * unit, y + bar)], 1.0)
    canvas.text(x - 5 * unit, y + bar / 2 - 6 * unit, "50 mm", 9.0, palette.FAINT, "right")
    canvas.text(box.x + 8 * unit, box.y + 18 * unit, f"error {TIMES}{magnified:g}", colour=colour)


def _draw_crucible(canvas: Canvas, box: Box, level: float, depth: float) -> None:
    """Crucible and melt, as wide as the panel has room for: the real one is wider."""
    side, wall = 10.0 * canvas.unit, 5.0 * canvas.unit
    crucible = Box(box.x + side, level - 14.0 * canvas.unit, box.w - 2.0 * side, 14.0 * canvas.unit + depth + wall)
    canvas.rectangle(palette.QUARTZ, crucible)
    canvas.rectangle(palette.PANEL, crucible.inner(wall, 0.0, wall, wall))
    canvas.rectangle(palette.MELT, Box(box.x + side + wall, level, box.w - 2.0 * (side + wall), depth))


def _draw_crystal(canvas: Canvas, box: Box, scale: Scale, record: Record, magnified: float, colour: Colour) -> None:
    x, (r_c, r_ref, z) = scale.x_0, (_thinned(values) for values in record.surface())
    half, y = (r_ref + magnified * (r_c - r_ref)) * scale.per_metre, scale.y(z)
    cone = float(y[-1]) - SHOULDER_IN_R_0 * record.puller.r_0 * scale.per_metre
    canvas.lines(palette.FAINT, [(x, box.y), (x, cone)], 2.0)
    melt = scale.y_0 if record.ending is not Ending.DETACHED else y[0]
    outline, down = np.r_[half[0], half, 0.0], np.r_[melt, y, cone]
    canvas.polygon(palette.CRYSTAL, np.concatenate([paired(x + outline, down), paired(x - outline, down)[::-1]]))
    for side in (-1.0, 1.0):
        canvas.lines(palette.REFERENCE, paired(x + side * r_ref * scale.per_metre, y), 0.8)
        canvas.lines(colour, paired(x + side * half, y), 1.6)


def _thinned(values: Floats) -> Floats:
    """About MOST_POINTS of the values at most, the first and the last among them."""
    if len(values) <= MOST_POINTS:
        return values
    kept: Floats = values[np.linspace(0, len(values) - 1, MOST_POINTS).astype(int)]
    return kept
