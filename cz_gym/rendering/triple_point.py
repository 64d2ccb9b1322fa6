"""The triple point to scale: crystal edge with the grown surface above it, meniscus, melt, bright ring."""

from __future__ import annotations

import math

import numpy as np

from cz_gym.units import MM

from . import palette
from .canvas import Box, Canvas
from .geometry import (
    Floats,
    Scale,
    clipped_height,
    first_at_least,
    meniscus_curve,
    ring_height,
)
from .palette import Colour
from .record import Ending, Record

INSIDE = 11.0 * MM
"""Distance that the panel shows inside r_0, at least [m]; crystals are lost at 8 mm."""
BELOW, ABOVE = 9.0 * MM, 24.0 * MM
"""Heights that it shows below the melt's surface, and above it at least [m]."""
EDGE_MARK: Colour = (0, 30, 60)
"""The mark of the crystal's radius on the melt, dark because the melt is bright."""


def scale_of(box: Box, record: Record) -> Scale:
    """The panel's scale: from 11 mm inside r_0 to 11 mm outside the nominal ring, at least."""
    across = 2.0 * INSIDE + record.puller.ring_bias
    per_metre = min(box.w / across, box.h / (BELOW + ABOVE))
    x_0 = box.x + INSIDE * per_metre + 0.5 * (box.w - across * per_metre)
    return Scale(x_0, record.puller.r_0, box.bottom - BELOW * per_metre, per_metre)


def draw(canvas: Canvas, box: Box, record: Record, colour: Colour = palette.TRUE) -> None:
    """The cross-section, the crystal's surface in a colour."""
    scale, unit = scale_of(box, record), canvas.unit
    r_c, r_ref, z = record.surface(max((scale.y_0 - box.y) / scale.per_metre - record.last("h_c"), 0.0))
    surface = scale.points(r_c, z)
    with canvas.clip(box):
        # Crystal and melt fill the panel; then the gas is cut out.
        canvas.rectangle(palette.CRYSTAL, box)
        canvas.rectangle(palette.MELT, Box(box.x, scale.y_0, box.w, box.bottom - scale.y_0))
        _draw_gas_and_meniscus(canvas, box, scale, record, surface)
        canvas.lines(palette.REFERENCE, scale.points(np.append(r_ref[0], r_ref), np.append(0.0, z)), 0.8)
        canvas.lines(colour, surface, 2.2)
        if record.ending is not Ending.DETACHED:
            _draw_ring(canvas, box, scale, record)
        edge = (float(surface[0, 0]), float(surface[0, 1]))
        canvas.dot(palette.INK, edge, 3.2)
        canvas.dot(colour, edge, 2.2)
    _draw_axis(canvas, box, scale)
    canvas.text(box.x + 7.0 * unit, box.y + 30 * unit, "crystal", 10)
    canvas.text(box.x + 7.0 * unit, scale.y_0 + 24 * unit, "melt", colour=palette.ON_MELT, bold=True)
    canvas.text(float(scale.x(r_ref[-1])) + 5 * unit, box.y + 30 * unit, "reference")


def _draw_gas_and_meniscus(canvas: Canvas, box: Box, scale: Scale, record: Record, surface: Floats) -> None:
    level, r_c, h_c = scale.y_0, record.last("r_c"), record.last("h_c")
    beside = np.concatenate([[[surface[-1, 0], box.y]], surface[::-1]])
    if record.ending is Ending.DETACHED:
        canvas.polygon(palette.GAS, np.concatenate([beside, [[box.right, beside[-1, 1]], [box.right, box.y]]]))
        foot = float(scale.y(h_c))
        canvas.rectangle(palette.GAS, Box(box.x, foot, box.w, level - foot))
        return
    meniscus = scale.points(*meniscus_curve(r_c, h_c, record.puller, record.config.meniscus))
    corners = [[box.right + 9, meniscus[-1, 1]], [box.right + 9, box.y]]
    canvas.polygon(palette.GAS, np.concatenate([beside, meniscus, corners]))
    edge = meniscus[0].tolist()
    melt = [[box.right, level + 1], [box.x, level + 1], [box.x, edge[1]]]
    canvas.polygon(palette.MELT, np.concatenate([meniscus, melt]))


def _draw_ring(canvas: Canvas, box: Box, scale: Scale, record: Record) -> None:
    """The bright ring, and vertical marks of its radius and the crystal's."""
    r_c, h_c, p, unit = record.last("r_c"), record.last("h_c"), record.puller, canvas.unit
    z_b = ring_height(r_c, h_c, p, record.config.meniscus, record.config.parameters.phi_b)
    x, y, bottom = float(scale.x(record.last("r_br"))), float(scale.y(z_b)), box.bottom - 21.0 * unit
    canvas.dot(palette.CAMERA, (x, y), 3.2)
    canvas.lines(palette.CAMERA, [(x, y), (x, bottom)], 1.0)
    edge = float(scale.x(r_c))
    canvas.lines(EDGE_MARK, [(edge, float(scale.y(clipped_height(h_c, p.a)))), (edge, bottom)], 1.0)
    room, anchor = (5.0, "left") if x + 64.0 * unit < box.right else (-5.0, "right")
    y = scale.y_0 + 8 * unit
    canvas.text(x + room * unit, y, "bright ring", 9.5, palette.ON_MELT, anchor, True)
    canvas.text(edge - 5 * unit, y, "r_c", 9.5, EDGE_MARK, "right", True)


def _draw_axis(canvas: Canvas, box: Box, scale: Scale) -> None:
    """Radii in mm along the lower edge."""
    unit = canvas.unit
    y = box.bottom - 16.0 * unit
    canvas.rectangle(palette.PANEL, Box(box.x, y, box.w, 16.0 * unit))
    low, high = ((x - scale.x_0) / scale.per_metre + scale.r_0 for x in (box.x, box.right))
    step = first_at_least((high - low) / 9.0 / MM, (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)) * MM
    for number in range(math.ceil(low / step), math.floor(high / step) + 1):
        x = float(scale.x(number * step))
        canvas.lines(palette.FAINT, [(x, y), (x, y + 3 * unit)], 1.0)
        if box.x + 8 * unit < x < box.right - 52 * unit:
            canvas.text(x, y + 4 * unit, f"{number * step / MM:g}", 9.0, palette.FAINT, "centre")
    canvas.text(box.right - 4 * unit, y + 4 * unit, "r [mm]", 9.0, palette.FAINT, "right")
