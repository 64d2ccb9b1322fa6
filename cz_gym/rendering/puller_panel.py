"""The whole crystal above its crucible: to scale, its error against the reference magnified."""

from __future__ import annotations

import numpy as np

from cz_gym.task import HEATER_RANGE
from cz_gym.units import MM

from . import palette
from .canvas import TIMES, Box, Canvas, paired
from .geometry import Scale, first_at_least
from .palette import Colour
from .record import Ending, Floats, Record

HALF_WIDTH = 0.29
"""Share of the panel's width that r_0 takes [-]."""
MELT_LEVEL = 0.73
"""Share of the panel's height above the melt's surface [-]."""
DEPTH_IN_R_CR = 0.45
"""Depth of the full melt as drawn, in crucible radii: the plant's melt is a heat capacity and has no depth [-]."""
SHOULDER_IN_R_0 = 0.55
"""Height of the drawn shoulder, in crystal radii: an episode begins after it [-]."""
MAGNIFICATIONS = (40.0, 20.0, 10.0, 5.0, 2.0)
"""Of the radius error [-]."""
LARGEST = 0.2
"""Largest magnified error, in r_0 [-]."""
MOST_POINTS = 160
"""Points of the drawn surface, at most."""


def magnification(record: Record) -> float:
    """Magnification of the radius error: the largest that keeps it legible."""
    largest = max(float(np.abs(record.error).max()), 0.1 * MM)
    return 1.0 / first_at_least(largest / (LARGEST * record.puller.r_0), tuple(1.0 / one for one in MAGNIFICATIONS))


def draw(
    canvas: Canvas, box: Box, record: Record, magnified: float | None = None, colour: Colour = palette.TRUE
) -> None:
    """Heaters, crucible, melt and crystal, its surface in that colour.

    ``magnified`` is used instead of :func:`magnification`.
    """
    per_metre = HALF_WIDTH * box.w / record.puller.r_0
    scale = Scale(box.x + box.w / 2.0, 0.0, box.y + MELT_LEVEL * box.h, per_metre)
    magnified, unit, bar = magnified or magnification(record), canvas.unit, 50.0 * MM * per_metre
    x, y = box.right - 10.0 * unit, box.y + 24.0 * unit
    canvas.lines(palette.FAINT, np.array([[x - 3 * unit, y], [x, y], [x, y + bar], [x - 3 * unit, y + bar]]), 1.0)
    canvas.text(x - 5 * unit, y + bar / 2 - 6 * unit, "50 mm", 9.0, palette.FAINT, "right")
    with canvas.clip(box):
        _crucible(canvas, box, scale, record)
        _crystal(canvas, box, scale, record, magnified, colour)
    canvas.text(box.x + 8 * unit, box.y + 18 * unit, f"error {TIMES}{magnified:g}", 9.5, colour)


def crucible_rise(record: Record) -> float:
    """How far the crucible was lifted to hold the melt's level [m]: what the crystal took from the melt."""
    q = record.config.parameters
    solid = float(np.sum(np.diff(record.column("length")) * np.square(record.column("r_c")[1:])))
    return q.rho_s * solid / (q.rho_l * q.R_cr * q.R_cr)


def _crucible(canvas: Canvas, box: Box, scale: Scale, record: Record) -> None:
    unit, p = canvas.unit, record.puller
    heat = (record.now.Q_H - p.Q_H_0) / HEATER_RANGE
    hot = palette.mix(palette.mix(palette.GRAPHITE, palette.ALARM, 0.45), palette.MELT_TOP, 0.5 + 0.5 * heat)
    level, wall = scale.y_0, 5.0 * unit
    rise = crucible_rise(record) * scale.per_metre
    depth = record.config.parameters.R_cr * DEPTH_IN_R_CR * scale.per_metre
    top, bottom = level - 14.0 * unit - rise, level + depth - rise
    for x in (box.x + 5.0 * unit, box.right - 10.0 * unit):
        canvas.rectangle(hot, Box(x, level - 4.0 * unit, 5.0 * unit, box.bottom - level - 4.0 * unit), 2.0)
    left, right = box.x + 15.0 * unit, box.right - 15.0 * unit
    inside = right - left - 2.0 * wall
    canvas.rectangle(palette.QUARTZ, Box(left, top, right - left, bottom + wall - top), 3.0)
    canvas.rectangle(palette.PANEL, Box(left + wall, top - wall, inside, level - top + wall))
    with canvas.clip(Box(left + wall, level, inside, bottom - level)):
        canvas.shade(Box(left + wall, level, inside, depth), palette.MELT_TOP, palette.MELT_DEEP)
    # A zigzag is the draughtsman's mark for a part left out: the crucible is wider than the panel.
    y = np.linspace(top - 2.0 * unit, bottom + wall + 2.0 * unit, 24)
    zigzag = 1.8 * unit * np.where(np.arange(24) % 2, 1.0, -1.0)
    for x in (left + 3.2 * wall, right - 3.2 * wall):
        canvas.lines(palette.PANEL, paired(x + zigzag, y), 3.0)


def _crystal(canvas: Canvas, box: Box, scale: Scale, record: Record, magnified: float, surface: Colour) -> None:
    unit, x = canvas.unit, scale.x_0
    r_c, r_ref, z = (_thinned(values) for values in record.surface())
    half, y = (r_ref + magnified * (r_c - r_ref)) * scale.per_metre, scale.y(z)
    _shoulder_and_seed(canvas, box, x, half[-1], y[-1], record.puller.r_0 * scale.per_metre)
    canvas.polygon(palette.CRYSTAL_COLD, _mirrored(x, half, y))
    core, core_y = (values[[0, *range(2, len(half) - 1, 5), -1]] for values in (half, y))
    for share in np.linspace(0.9, 0.1, 7):
        # Lighter and lighter cores: the body reads as round.
        colour = palette.mix(palette.CRYSTAL_COLD, palette.CRYSTAL_HOT, 0.6 * (1.0 - share))
        canvas.polygon(colour, _mirrored(x - 0.25 * (1.0 - share) * core, share * core, core_y))
    if record.ending is not Ending.DETACHED:
        foot = np.array([half[0] + 2.5 * unit, half[0]])
        canvas.polygon(palette.MELT_TOP, _mirrored(x, foot, np.array([scale.y_0 + 1, y[0]])))
    for side in (-1.0, 1.0):
        canvas.lines(surface, paired(x + side * half, y), 1.6)
        canvas.dashes(palette.REFERENCE, paired(x + side * r_ref * scale.per_metre, y), 0.8)


def _shoulder_and_seed(canvas: Canvas, box: Box, x: float, half: float, y: float, nominal: float) -> None:
    """A shoulder on a body that ends at y with that half width, and neck and seed on a cable above it [px]."""
    unit, angle = canvas.unit, np.linspace(0.0, 0.5 * np.pi, 14)
    across = 0.06 * nominal + (half - 0.06 * nominal) * np.cos(angle) ** 1.4
    down = y - SHOULDER_IN_R_0 * nominal * np.sin(angle)
    neck, seed, top = 2.2 * unit, 4.0 * unit, float(down[-1])
    canvas.line(palette.FAINT, (x, box.y), (x, top), 1.0)
    canvas.rectangle(palette.FAINT, Box(x - seed, top - 34.0 * unit, 2.0 * seed, 12.0 * unit), 2.0)
    canvas.rectangle(palette.SEED, Box(x - neck, top - 24.0 * unit, 2.0 * neck, 26.0 * unit))
    canvas.polygon(palette.SEED, _mirrored(x, across, down))


def _mirrored(x: float | Floats, half: Floats, y: Floats) -> Floats:
    """A body of revolution's outline, from half its width at each height."""
    return np.concatenate([paired(x + half, y), paired(x - half, y)[::-1]])


def _thinned(values: Floats) -> Floats:
    """At most about MOST_POINTS of the values, the first and the last among them."""
    if len(values) <= MOST_POINTS:
        return values
    kept: Floats = values[np.unique(np.linspace(0, len(values) - 1, MOST_POINTS).astype(int))]
    return kept
