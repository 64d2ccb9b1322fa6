"""The triple point to scale: crystal edge with the grown surface above it, meniscus, melt, bright ring.

Beside it the same surface, at the same heights, with its error against the reference magnified.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from cz_gym.units import MM

from . import palette
from .canvas import TIMES, Box, Canvas, paired
from .geometry import Scale, beside, height_inside, ladder, meniscus_curve, ring_height
from .record import Ending, Record

Floats = npt.NDArray[np.float64]
INSIDE = 11.0 * MM
"""How far the panel reaches from r_0 towards the axis, at the default puller [m]; failures lie at 8 mm."""
BELOW = 9.0 * MM
"""How far it reaches below the melt's surface [m]."""
ABOVE = 24.0 * MM
"""How far it reaches above it, at least [m]."""
RANGES = tuple(value * MM for value in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0))
"""Half widths of the magnified error [m]."""
TOLERANCE = 0.5 * MM
"""Half width of the shaded band [m]: the benchmark's tolerance."""


def scale_of(box: Box, record: Record) -> Scale:
    """The panel's scale, the same across and up: from 11 mm inside r_0 to 11 mm outside the nominal ring, at least.

    A wide panel shows more to both sides, so that enough of the crystal is to be seen.
    """
    across = 2.0 * INSIDE + record.puller.ring_bias
    per_metre = min(box.w / across, box.h / (BELOW + ABOVE))
    x_0 = box.x + INSIDE * per_metre + 0.5 * (box.w - across * per_metre)
    return Scale(x_0, record.puller.r_0, box.bottom - BELOW * per_metre, per_metre, per_metre)


def ground(canvas: Canvas, box: Box, record: Record) -> None:
    """What lies under every picture of a puller: crystal and melt as if there were no air, axis and words."""
    scale, unit = scale_of(box, record), canvas.unit
    with canvas.clip(box):
        canvas.shade(Box(box.x, box.y, box.w, scale.y_0 - box.y), palette.CRYSTAL_COLD, palette.CRYSTAL_HOT)
        canvas.shade(Box(box.x, scale.y_0, box.w, box.bottom - scale.y_0), palette.MELT_TOP, palette.MELT_DEEP)
    _axis(canvas, box, scale)
    canvas.text(box.x + 7.0 * unit, box.y + 30 * unit, "crystal", 10, palette.INK)
    canvas.text(box.x + 7.0 * unit, box.bottom - 31 * unit, "melt", 10, palette.INK)


def draw(canvas: Canvas, box: Box, record: Record, reach: float | None = None) -> None:
    """The cross-section, its marks and the magnified surface; ``reach`` [m] is its half width unless it fits itself."""
    scale = scale_of(box, record)
    now = record.now
    top = (scale.y_0 - box.y) / scale.up
    r_c, r_ref, z = record.surface(max(top - now.h_c, 0.0))
    detached = record.ending is Ending.DETACHED
    with canvas.clip(box):
        _bodies(canvas, box, scale, record, r_c, z)
        reference = scale.points(np.append(r_ref[0], r_ref), np.append(0.0, z))
        canvas.dashes(palette.REFERENCE, reference, 1.2)
        surface = scale.points(r_c, z)
        canvas.lines(palette.TRUE, surface, 2.2)
        if not detached:
            _ring(canvas, box, scale, record)
        edge = (float(surface[0, 0]), float(surface[0, 1]))
        canvas.dot(palette.INK, edge, 3.2)
        canvas.dot(palette.TRUE, edge, 2.2)
    x, right = float(scale.x(record.puller.r_0 + 0.62 * INSIDE)), box.right - 8.0 * canvas.unit
    inset = Box(x, box.y + 44.0 * canvas.unit, right - x, scale.y_0 - box.y - 70.0 * canvas.unit)
    _magnified(canvas, inset, scale, r_c - r_ref, z, reach or reach_of(r_c - r_ref))


def reach_of(error: Floats) -> float:
    """Half width of the magnified surface that holds an error [m]."""
    return ladder(1.1 * float(np.abs(error).max()), RANGES)


def _bodies(canvas: Canvas, box: Box, scale: Scale, record: Record, r_c: Floats, z: Floats) -> None:
    """The atmosphere and the melt of the meniscus as areas."""
    now, level = record.now, scale.y_0
    surface = scale.points(r_c, z)
    above = np.concatenate([[[surface[-1, 0], box.y]], surface[::-1]])
    if record.ending is Ending.DETACHED:
        canvas.polygon(palette.ATMOSPHERE, beside(above, box, right=True))
        foot = float(scale.y(now.h_c))
        canvas.rectangle(palette.ATMOSPHERE, Box(box.x, foot, box.w, level - foot))
        return
    r, height = meniscus_curve(now.r_c, now.h_c, record.puller, record.config.meniscus)
    meniscus = scale.points(r, height)
    outline = np.concatenate([above, meniscus, [[box.right + 9, meniscus[-1, 1]], [box.right + 9, box.y]]])
    canvas.polygon(palette.ATMOSPHERE, outline)
    melt = np.concatenate([[[box.x, meniscus[0, 1]]], meniscus, [[box.right, level + 1], [box.x, level + 1]]])
    canvas.polygon(palette.MELT_TOP, melt)
    edge_x, edge_y = meniscus[0].tolist()
    canvas.line(palette.GLOW, (box.x, edge_y), (edge_x, edge_y), 1.2)
    canvas.lines(palette.mix(palette.MELT_TOP, palette.GLOW, 0.6), meniscus, 1.0)


def _ring(canvas: Canvas, box: Box, scale: Scale, record: Record) -> None:
    now, p = record.now, record.puller
    z_b = ring_height(now.r_c, now.h_c, p, record.config.meniscus, record.config.parameters.phi_b)
    x, y = float(scale.x(now.r_br)), float(scale.y(z_b))
    canvas.glow(palette.GLOW, x, y, 17.0)
    canvas.dot(palette.CAMERA, (x, y), 2.6)
    canvas.line(palette.CAMERA, (x, y), (x, box.bottom - 21.0 * canvas.unit), 1.0)
    edge = float(scale.x(now.r_c))
    foot = float(scale.y(height_inside(now.h_c, p.a)))
    canvas.line(palette.TRUE, (edge, foot), (edge, box.bottom - 21.0 * canvas.unit), 1.0)
    canvas.text(x + 5 * canvas.unit, scale.y_0 + 8 * canvas.unit, "bright ring", 9.5, (60, 20, 0), bold=True)
    canvas.text(edge - 5 * canvas.unit, scale.y_0 + 8 * canvas.unit, "r_c", 9.5, (0, 30, 60), "right", bold=True)


def _axis(canvas: Canvas, box: Box, scale: Scale) -> None:
    """Radii in mm along the lower edge, and what a length of 5 mm is upwards."""
    unit = canvas.unit
    y = box.bottom - 16.0 * unit
    canvas.rectangle(palette.PANEL, Box(box.x, y, box.w, 16.0 * unit))
    reach = (box.x - scale.x_0) / scale.across + scale.r_0, (box.right - scale.x_0) / scale.across + scale.r_0
    step = ladder((reach[1] - reach[0]) / 9.0 / MM, (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)) * MM
    for number in range(math.ceil(reach[0] / step), math.floor(reach[1] / step) + 1):
        x = float(scale.x(number * step))
        canvas.line(palette.FAINT, (x, y), (x, y + 3 * unit), 1.0)
        if box.x + 8 * unit < x < box.right - 52 * unit:
            canvas.text(x, y + 4 * unit, f"{number * step / MM:g}", 9.0, palette.FAINT, "centre")
    canvas.text(box.right - 4 * unit, y + 4 * unit, "r [mm]", 9.0, palette.FAINT, "right")


def _magnified(canvas: Canvas, box: Box, scale: Scale, error: Floats, z: Floats, reach: float) -> None:
    unit = canvas.unit
    middle, across = box.x + box.w / 2.0, box.w / 2.0 / reach
    canvas.rectangle(palette.PANEL, box, 4.0)
    band = min(TOLERANCE * across, box.w / 2.0)
    canvas.rectangle(palette.BAND, Box(middle - band, box.y, 2.0 * band, box.h))
    canvas.dashes(palette.REFERENCE, np.array([[middle, box.y], [middle, box.bottom]]), 1.0)
    with canvas.clip(box):
        points = paired(middle + error * across, scale.y(z))
        shown = points[points[:, 1] < box.bottom + 40]
        canvas.lines(palette.TRUE, shown, 2.0)
    canvas.frame(box)
    canvas.text(
        middle, box.y - 13 * unit, f"surface error {TIMES}{across / scale.across:.0f}", 9.5, palette.TRUE, "centre"
    )
    for x, anchor, value in ((box.x, "left", -reach), (box.right, "right", reach)):
        canvas.text(x, box.bottom + 2 * unit, f"{value / MM:+g}", 9.0, palette.FAINT, anchor)
    canvas.text(middle, box.bottom + 2 * unit, "0 mm", 9.0, palette.FAINT, "centre")
