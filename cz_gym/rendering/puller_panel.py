"""The whole crystal above its crucible: to scale, its error against the reference magnified."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cz_gym.task import HEATER_RANGE
from cz_gym.units import MM

from . import palette
from .canvas import TIMES, Box, Canvas, paired
from .geometry import Scale, ladder
from .record import Record

Floats = npt.NDArray[np.float64]
HALF_WIDTH = 0.29
"""Share of the panel's width that r_0 takes [-]."""
MELT_LEVEL = 0.73
"""Share of the panel's height above the melt's surface [-]."""
DEPTH_IN_R_CR = 0.45
"""Depth of the full melt as drawn, in crucible radii: the plant's melt is a heat capacity and has no depth [-]."""
SHOULDER_IN_R_0 = 0.55
"""Height of the drawn shoulder, in crystal radii: an episode begins after it [-]."""
GAINS = (40.0, 20.0, 10.0, 5.0, 2.0)
"""Magnifications of the radius error [-]."""
LARGEST = 0.2
"""Largest magnified error, in r_0 [-]."""
MOST_POINTS = 160


def gain(record: Record) -> float:
    """Magnification of the radius error: the largest that keeps it legible."""
    largest = max(float(np.abs(record.column("r_c") - record.column("r_ref")).max()), 0.1 * MM)
    return 1.0 / ladder(largest / (LARGEST * record.puller.r_0), tuple(1.0 / value for value in GAINS))


def scale_of(box: Box, r_0: float) -> Scale:
    """The panel's scale, the same across and up."""
    scale = HALF_WIDTH * box.w / r_0
    return Scale(box.x + box.w / 2.0, 0.0, box.y + MELT_LEVEL * box.h, scale, scale)


def ground(canvas: Canvas, box: Box, r_0: float) -> None:
    """What lies under every picture of a puller: how long 50 mm are."""
    unit, bar = canvas.unit, 50.0 * MM * scale_of(box, r_0).up
    x, y = box.right - 10.0 * unit, box.y + 24.0 * unit
    canvas.lines(palette.FAINT, np.array([[x - 3 * unit, y], [x, y], [x, y + bar], [x - 3 * unit, y + bar]]), 1.0)
    canvas.text(x - 5 * unit, y + bar / 2 - 6 * unit, "50 mm", 9.0, palette.FAINT, "right")


def draw(canvas: Canvas, box: Box, record: Record, magnified: float | None = None) -> None:
    """Heaters, crucible, melt and crystal; ``magnified`` sets the gain instead of :func:`gain`."""
    scale = scale_of(box, record.puller.r_0)
    magnified = magnified or gain(record)
    with canvas.clip(box):
        _crucible(canvas, box, scale, record)
        _crystal(canvas, box, scale, record, magnified)
    canvas.text(box.x + 8 * canvas.unit, box.y + 18 * canvas.unit, f"error {TIMES}{magnified:g}", 9.5, palette.TRUE)


def crucible_rise(record: Record) -> float:
    """How far the crucible was lifted to hold the melt's level [m]: what the crystal took from the melt."""
    q = record.config.parameters
    length = record.column("length")
    solid = float(np.sum(np.diff(length) * np.square(record.column("r_c")[1:])))
    return q.rho_s * solid / (q.rho_l * q.R_cr * q.R_cr)


def _crucible(canvas: Canvas, box: Box, scale: Scale, record: Record) -> None:
    unit, p = canvas.unit, record.puller
    heat = (record.now.Q_H - p.Q_H_0) / HEATER_RANGE
    hot = palette.mix(palette.mix(palette.GRAPHITE, palette.ALARM, 0.45), palette.MELT_TOP, 0.5 + 0.5 * heat)
    level, rim, wall = scale.y_0, 14.0 * unit, 5.0 * unit
    depth = record.config.parameters.R_cr * DEPTH_IN_R_CR * scale.up
    bottom = level + depth - crucible_rise(record) * scale.up
    for x in (box.x + 5.0 * unit, box.right - 10.0 * unit):
        canvas.rectangle(hot, Box(x, level - 4.0 * unit, 5.0 * unit, box.bottom - level - 4.0 * unit), 2.0)
    left, right = box.x + 15.0 * unit, box.right - 15.0 * unit
    top = level - rim - crucible_rise(record) * scale.up
    canvas.rectangle(palette.QUARTZ, Box(left, top, right - left, bottom + wall - top), 3.0)
    canvas.rectangle(palette.PANEL, Box(left + wall, top - wall, right - left - 2.0 * wall, level - top + wall))
    with canvas.clip(Box(left + wall, level, right - left - 2.0 * wall, bottom - level)):
        canvas.shade(Box(left + wall, level, right - left - 2.0 * wall, depth), palette.MELT_TOP, palette.MELT_DEEP)
    for x in (left + 3.2 * wall, right - 3.2 * wall):
        _break(canvas, x, top - 2.0 * unit, bottom + wall + 2.0 * unit)


def _break(canvas: Canvas, x: float, top: float, bottom: float) -> None:
    """The draughtsman's mark for a part left out: the crucible is wider than the panel."""
    y = np.linspace(top, bottom, 24)
    swing = 1.8 * canvas.unit * np.where(np.arange(24) % 2, 1.0, -1.0)
    canvas.lines(palette.PANEL, paired(x + swing, y), 3.0)


def _crystal(canvas: Canvas, box: Box, scale: Scale, record: Record, magnified: float) -> None:
    unit, r_0, x = canvas.unit, record.puller.r_0, scale.x_0
    r_c, r_ref, z = (_thinned(values) for values in record.surface())
    half = (r_ref + magnified * (r_c - r_ref)) * scale.across
    y = scale.y(z)
    shoulder_x, shoulder_y = _shoulder(half[-1], y[-1], r_0 * scale.across)
    neck_y = float(shoulder_y[-1])
    neck, seed = 2.2 * unit, 4.0 * unit
    canvas.line(palette.FAINT, (x, box.y), (x, neck_y), 1.0)
    canvas.rectangle(palette.FAINT, Box(x - seed, neck_y - 34.0 * unit, 2.0 * seed, 12.0 * unit), 2.0)
    canvas.rectangle(palette.SEED, Box(x - neck, neck_y - 24.0 * unit, 2.0 * neck, 26.0 * unit))
    canvas.polygon(palette.SEED, _mirrored(x, shoulder_x, shoulder_y))
    canvas.polygon(palette.CRYSTAL_COLD, _mirrored(x, half, y))
    core, core_y = half[[0, *range(2, len(half) - 1, 5), -1]], y[[0, *range(2, len(half) - 1, 5), -1]]
    for share in np.linspace(0.9, 0.1, 7):
        # Lighter and lighter cores: the body reads as round.
        colour = palette.mix(palette.CRYSTAL_COLD, palette.CRYSTAL_HOT, 0.6 * (1.0 - share))
        canvas.polygon(colour, _mirrored(x - 0.25 * (1.0 - share) * core, share * core, core_y))
    if record.ending is None or record.ending.name != "DETACHED":
        foot = half[0] + 2.5 * unit
        canvas.polygon(
            palette.MELT_TOP,
            np.array([[x - foot, scale.y_0 + 1], [x - half[0], y[0]], [x + half[0], y[0]], [x + foot, scale.y_0 + 1]]),
        )
    reference = r_ref * scale.across
    for side in (-1.0, 1.0):
        canvas.lines(palette.TRUE, paired(x + side * half, y), 1.6)
        canvas.dashes(palette.REFERENCE, paired(x + side * reference, y), 0.8)


def _shoulder(half: float, y: float, nominal: float) -> tuple[Floats, Floats]:
    """A shoulder from the body's top to the neck, pixels from the axis and down."""
    angle = np.linspace(0.0, 0.5 * np.pi, 14)
    across = 0.06 * nominal + (half - 0.06 * nominal) * np.cos(angle) ** 1.4
    return across, y - SHOULDER_IN_R_0 * nominal * np.sin(angle)


def _mirrored(x: float | Floats, half: Floats, y: Floats) -> Floats:
    """A body of revolution's outline, from half its width at each height."""
    right, left = paired(x + half, y), paired(x - half, y)
    return np.concatenate([right, left[::-1]])


def _thinned(values: Floats) -> Floats:
    """At most about MOST_POINTS of the values, the first and the last among them."""
    if len(values) <= MOST_POINTS:
        return values
    kept: Floats = values[np.unique(np.linspace(0, len(values) - 1, MOST_POINTS).astype(int))]
    return kept
