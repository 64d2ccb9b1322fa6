"""The whole crystal above its crucible: to scale, its error against the reference magnified."""

from __future__ import annotations

import numpy as np

from cz_gym.task import HEATER_RANGE
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
"""Height of the shoulder as drawn, in crystal radii: an episode begins after it [-]."""
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
    """Heaters, crucible, melt and crystal, its surface in a colour.

    ``magnified`` is used instead of :func:`magnification`.
    """
    per_metre = HALF_WIDTH * box.w / record.puller.r_0
    scale = Scale(box.x + box.w / 2.0, 0.0, box.y + MELT_LEVEL * box.h, per_metre)
    magnified, unit, bar = magnified or magnification(record), canvas.unit, 50.0 * MM * per_metre
    x, y = box.right - 10.0 * unit, box.y + 24.0 * unit
    canvas.lines(palette.FAINT, [(x - 3 * unit, y), (x, y), (x, y + bar), (x - 3 * unit, y + bar)], 1.0)
    canvas.text(x - 5 * unit, y + bar / 2 - 6 * unit, "50 mm", 9.0, palette.FAINT, "right")
    with canvas.clip(box):
        _draw_crucible(canvas, box, scale, record)
        _draw_crystal(canvas, box, scale, record, magnified, colour)
    canvas.text(box.x + 8 * unit, box.y + 18 * unit, f"error {TIMES}{magnified:g}", colour=colour)


def _draw_crucible(canvas: Canvas, box: Box, scale: Scale, record: Record) -> None:
    """Heaters, the brighter the more power; crucible and melt, drawn broken because they are wider than the panel."""
    unit, level, wall = canvas.unit, scale.y_0, 5.0 * canvas.unit
    heat = (record.last("Q_H") - record.puller.Q_H_0) / HEATER_RANGE
    for x in (box.x + 5.0 * unit, box.right - 10.0 * unit):
        heater = Box(x, level - 4.0 * unit, 5.0 * unit, box.bottom - level - 4.0 * unit)
        canvas.rectangle(palette.mix(palette.ALARM, palette.MELT_TOP, 0.5 + 0.5 * heat), heater)
    depth = record.config.parameters.R_cr * DEPTH_IN_R_CR * scale.per_metre
    crucible = Box(box.x + 15.0 * unit, level - 14.0 * unit, box.w - 30.0 * unit, 14.0 * unit + depth + wall)
    inside = crucible.inner(wall, 0.0, wall, wall)
    canvas.rectangle(palette.QUARTZ, crucible)
    canvas.rectangle(palette.PANEL, inside)
    canvas.shade(Box(inside.x, level, inside.w, depth), palette.MELT_TOP, palette.MELT_DEEP)
    y = np.linspace(crucible.y - 2.0 * unit, crucible.bottom + 2.0 * unit, 24)
    zigzag = 1.8 * unit * np.where(np.arange(24) % 2, 1.0, -1.0)
    for x in (inside.x + 2.2 * wall, inside.right - 2.2 * wall):
        canvas.lines(palette.PANEL, paired(x + zigzag, y), 3.0)


def _draw_crystal(canvas: Canvas, box: Box, scale: Scale, record: Record, magnified: float, colour: Colour) -> None:
    unit, x = canvas.unit, scale.x_0
    r_c, r_ref, z = (_thinned(values) for values in record.surface())
    half, y = (r_ref + magnified * (r_c - r_ref)) * scale.per_metre, scale.y(z)
    _draw_shoulder_and_seed(canvas, box, x, half[-1], y[-1], record.puller.r_0 * scale.per_metre)
    canvas.polygon(palette.CRYSTAL_COLD, _mirrored(x, half, y))
    core, core_y = (values[[0, *range(2, len(half) - 1, 5), -1]] for values in (half, y))
    for share in np.linspace(0.9, 0.1, 7):
        # Lighter and lighter cores make the body look round.
        lighter = palette.mix(palette.CRYSTAL_COLD, palette.CRYSTAL_HOT, 0.6 * (1.0 - share))
        canvas.polygon(lighter, _mirrored(x - 0.25 * (1.0 - share) * core, share * core, core_y))
    if record.ending is not Ending.DETACHED:
        foot = np.array([half[0] + 2.5 * unit, half[0]])
        canvas.polygon(palette.MELT_TOP, _mirrored(x, foot, np.array([scale.y_0 + 1, y[0]])))
    for side in (-1.0, 1.0):
        canvas.lines(colour, paired(x + side * half, y), 1.6)
        canvas.dashes(palette.REFERENCE, paired(x + side * r_ref * scale.per_metre, y), 0.8)


def _draw_shoulder_and_seed(canvas: Canvas, box: Box, x: float, half: float, y: float, nominal: float) -> None:
    """The shoulder on a body that ends at y with that half width, and the seed on its cable above it [px]."""
    unit, angle = canvas.unit, np.linspace(0.0, 0.5 * np.pi, 14)
    across = 0.06 * nominal + (half - 0.06 * nominal) * np.cos(angle) ** 1.4
    down = y - SHOULDER_IN_R_0 * nominal * np.sin(angle)
    top = float(down[-1])
    canvas.lines(palette.FAINT, [(x, box.y), (x, top)], 1.0)
    canvas.rectangle(palette.FAINT, Box(x - 4.0 * unit, top - 34.0 * unit, 8.0 * unit, 12.0 * unit))
    canvas.rectangle(palette.SEED, Box(x - 2.2 * unit, top - 24.0 * unit, 4.4 * unit, 26.0 * unit))
    canvas.polygon(palette.SEED, _mirrored(x, across, down))


def _mirrored(x: float | Floats, half: Floats, y: Floats) -> Floats:
    """The outline of a body of revolution from its half width at each height."""
    return np.concatenate([paired(x + half, y), paired(x - half, y)[::-1]])


def _thinned(values: Floats) -> Floats:
    """About MOST_POINTS of the values at most, the first and the last among them."""
    if len(values) <= MOST_POINTS:
        return values
    kept: Floats = values[np.linspace(0, len(values) - 1, MOST_POINTS).astype(int)]
    return kept
