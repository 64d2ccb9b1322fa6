"""The triple point to scale: crystal edge with the grown surface above it, meniscus, melt, bright ring.

Beside it the same surface, at the same heights, with its error against the reference magnified.
"""

from __future__ import annotations

import math

import numpy as np

from cz_gym.units import MM

from . import palette
from .canvas import TIMES, Box, Canvas, paired
from .geometry import Scale, clipped_height, first_at_least, meniscus_curve, ring_height
from .palette import Colour
from .record import Ending, Floats, Record

INSIDE = 11.0 * MM
"""How far the panel reaches from r_0 towards the axis, at the default puller [m]; failures lie at 8 mm."""
BELOW, ABOVE = 9.0 * MM, 24.0 * MM
"""How far it reaches below the melt's surface, and above it at least [m]."""
MARK: Colour = (0, 30, 60)
"""Of the crystal's radius where it is marked on the melt, dark as the melt is bright."""
ON_MELT: Colour = (60, 20, 0)
"""Of words on the melt."""
RANGES = tuple(value * MM for value in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0))
"""Half widths of the magnified error [m]."""
TOLERANCE = 0.5 * MM
"""Half width of the shaded band [m]: the benchmark's tolerance."""


def scale_of(box: Box, record: Record) -> Scale:
    """The panel's scale: from 11 mm inside r_0 to 11 mm outside the nominal ring, at least.

    A wide panel shows more to both sides, so that enough of the crystal is to be seen.
    """
    across = 2.0 * INSIDE + record.puller.ring_bias
    per_metre = min(box.w / across, box.h / (BELOW + ABOVE))
    x_0 = box.x + INSIDE * per_metre + 0.5 * (box.w - across * per_metre)
    return Scale(x_0, record.puller.r_0, box.bottom - BELOW * per_metre, per_metre)


def error_range(error: Floats) -> float:
    """Half width of a magnified surface that shows a whole error [m]."""
    return first_at_least(1.1 * float(np.abs(error).max()), RANGES)


def draw(canvas: Canvas, box: Box, record: Record, limit: float | None = None, colour: Colour = palette.TRUE) -> None:
    """The cross-section, its marks and the magnified surface, the crystal's in that colour.

    ``limit`` [m] is the magnified one's half width unless it fits itself.
    """
    scale, now, unit = scale_of(box, record), record.now, canvas.unit
    r_c, r_ref, z = record.surface(max((scale.y_0 - box.y) / scale.per_metre - now.h_c, 0.0))
    with canvas.clip(box):
        # Crystal and melt as if there were no gas between.
        canvas.shade(Box(box.x, box.y, box.w, scale.y_0 - box.y), palette.CRYSTAL_COLD, palette.CRYSTAL_HOT)
        canvas.shade(Box(box.x, scale.y_0, box.w, box.bottom - scale.y_0), palette.MELT_TOP, palette.MELT_DEEP)
        _gas_and_meniscus(canvas, box, scale, record, r_c, z)
        reference = scale.points(np.append(r_ref[0], r_ref), np.append(0.0, z))
        canvas.dashes(palette.REFERENCE, reference, 1.2)
        surface = scale.points(r_c, z)
        canvas.lines(colour, surface, 2.2)
        if record.ending is not Ending.DETACHED:
            _ring(canvas, box, scale, record)
        edge = (float(surface[0, 0]), float(surface[0, 1]))
        canvas.dot(palette.INK, edge, 3.2)
        canvas.dot(colour, edge, 2.2)
    _axis(canvas, box, scale)
    canvas.text(box.x + 7.0 * unit, box.y + 30 * unit, "crystal", 10, palette.INK)
    canvas.text(box.x + 7.0 * unit, scale.y_0 + 8 * unit, "melt", 9.5, ON_MELT, bold=True)
    x, right = float(scale.x(record.puller.r_0 + 0.62 * INSIDE)), box.right - 8.0 * unit
    inset = Box(x, box.y + 44.0 * unit, right - x, scale.y_0 - box.y - 70.0 * unit)
    _magnified(canvas, inset, scale, r_c - r_ref, z, limit or error_range(r_c - r_ref), colour)


def _gas_and_meniscus(canvas: Canvas, box: Box, scale: Scale, record: Record, r_c: Floats, z: Floats) -> None:
    """The gas beside the crystal and the melt of the meniscus as areas."""
    now, level = record.now, scale.y_0
    surface = scale.points(r_c, z)
    beside = np.concatenate([[[surface[-1, 0], box.y]], surface[::-1]])
    if record.ending is Ending.DETACHED:
        to_the_right = [[box.right, beside[-1, 1]], [box.right, beside[0, 1]]]
        canvas.polygon(palette.GAS, np.concatenate([beside, to_the_right]))
        foot = float(scale.y(now.h_c))
        canvas.rectangle(palette.GAS, Box(box.x, foot, box.w, level - foot))
        return
    r, height = meniscus_curve(now.r_c, now.h_c, record.puller, record.config.meniscus)
    meniscus = scale.points(r, height)
    outline = np.concatenate([beside, meniscus, [[box.right + 9, meniscus[-1, 1]], [box.right + 9, box.y]]])
    canvas.polygon(palette.GAS, outline)
    melt = np.concatenate([[[box.x, meniscus[0, 1]]], meniscus, [[box.right, level + 1], [box.x, level + 1]]])
    canvas.polygon(palette.MELT_TOP, melt)
    edge_x, edge_y = meniscus[0].tolist()
    canvas.line(palette.GLOW, (box.x, edge_y), (edge_x, edge_y), 1.2)
    canvas.lines(palette.mix(palette.MELT_TOP, palette.GLOW, 0.6), meniscus, 1.0)


def _ring(canvas: Canvas, box: Box, scale: Scale, record: Record) -> None:
    """The bright ring, and its radius beside the crystal's, marked down to the axis."""
    now, p, unit = record.now, record.puller, canvas.unit
    z_b = ring_height(now.r_c, now.h_c, p, record.config.meniscus, record.config.parameters.phi_b)
    x, y, bottom = float(scale.x(now.r_br)), float(scale.y(z_b)), box.bottom - 21.0 * unit
    canvas.glow(palette.GLOW, x, y, 17.0)
    canvas.dot(palette.CAMERA, (x, y), 2.6)
    canvas.line(palette.CAMERA, (x, y), (x, bottom), 1.0)
    edge = float(scale.x(now.r_c))
    canvas.line(MARK, (edge, float(scale.y(clipped_height(now.h_c, p.a)))), (edge, bottom), 1.0)
    room, anchor = (5.0, "left") if x + 64.0 * unit < box.right else (-5.0, "right")
    canvas.text(x + room * unit, scale.y_0 + 8 * unit, "bright ring", 9.5, ON_MELT, anchor, True)
    canvas.text(edge - 5 * unit, scale.y_0 + 8 * unit, "r_c", 9.5, MARK, "right", bold=True)


def _axis(canvas: Canvas, box: Box, scale: Scale) -> None:
    """Radii in mm along the lower edge."""
    unit = canvas.unit
    y = box.bottom - 16.0 * unit
    canvas.rectangle(palette.PANEL, Box(box.x, y, box.w, 16.0 * unit))
    low, high = ((x - scale.x_0) / scale.per_metre + scale.r_0 for x in (box.x, box.right))
    step = first_at_least((high - low) / 9.0 / MM, (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)) * MM
    for number in range(math.ceil(low / step), math.floor(high / step) + 1):
        x = float(scale.x(number * step))
        canvas.line(palette.FAINT, (x, y), (x, y + 3 * unit), 1.0)
        if box.x + 8 * unit < x < box.right - 52 * unit:
            canvas.text(x, y + 4 * unit, f"{number * step / MM:g}", 9.0, palette.FAINT, "centre")
    canvas.text(box.right - 4 * unit, y + 4 * unit, "r [mm]", 9.0, palette.FAINT, "right")


def _magnified(canvas: Canvas, box: Box, scale: Scale, error: Floats, z: Floats, limit: float, colour: Colour) -> None:
    """The surface's error [m] between -limit and limit."""
    unit = canvas.unit
    middle, per_metre = box.x + box.w / 2.0, box.w / 2.0 / limit
    canvas.rectangle(palette.PANEL, box, 4.0)
    band = min(TOLERANCE * per_metre, box.w / 2.0)
    canvas.rectangle(palette.BAND, Box(middle - band, box.y, 2.0 * band, box.h))
    canvas.dashes(palette.REFERENCE, np.array([[middle, box.y], [middle, box.bottom]]), 1.0)
    with canvas.clip(box):
        points = paired(middle + error * per_metre, scale.y(z))
        canvas.lines(colour, points[points[:, 1] < box.bottom + 40], 2.0)
    canvas.rectangle(palette.RIM, box, line=max(1, round(unit)))
    title = f"surface error {TIMES}{per_metre / scale.per_metre:.0f}"
    canvas.text(middle, box.y - 13 * unit, title, 9.5, colour, "centre")
    for x, anchor, text in (
        (box.x, "left", f"{-limit / MM:+g}"), (middle, "centre", "0 mm"), (box.right, "right", f"{limit / MM:+g}")
    ):  # fmt: skip
        canvas.text(x, box.bottom + 2 * unit, text, 9.0, palette.FAINT, anchor)
