"""The triple point to scale: crystal edge with the grown surface above it, meniscus, melt, bright ring."""

import math
from typing import Any, NamedTuple

import numpy as np

from cz_gym.body.plant import Puller
from cz_gym.body.task import HEIGHT_MAX_IN_A, HEIGHT_MIN
from cz_gym.physics.meniscus import MeniscusModel, profile, profile_scale
from cz_gym.support.units import MM

from . import palette
from .canvas import Box, Canvas, first_at_least
from .palette import Colour
from .record import CrystalRecord, Ending, Floats, Record

INSIDE = 11.0 * MM
"""Distance that the panel shows inside r_0, at least [m]; crystals are lost at 8 mm."""
WIDER, LEAST_WIDTH, DEEP = 1.45, 14.0 * MM, 0.2
"""Width of a whole crystal's panel in largest radii [-], the least radius that counts [m], and the melt's share of the
panel's height [-]."""
BELOW, ABOVE = 9.0 * MM, 24.0 * MM
"""Heights that it shows below the melt's surface, and above it at least [m]."""
POINTS = 48
"""Points of a drawn meniscus."""
LOWEST = 1e-3
"""Height at which a drawn meniscus ends, far out where it is flat [meniscus heights]."""
EDGE_MARK: Colour = (0, 30, 60)
"""The mark of the crystal's radius on the melt, dark because the melt is bright."""


class Scale(NamedTuple):
    """A linear map from radii and heights [m] to nominal pixels; heights run up, pixels down."""

    x_0: float
    """Pixel of the crystal's axis."""
    y_0: float
    """Pixel of the melt's surface."""
    per_metre: float
    """Pixels per metre."""

    def x(self, r: Any) -> Any:
        """Pixels across of radii [m]."""
        return self.x_0 + r * self.per_metre

    def y(self, z: Any) -> Any:
        """Pixels down of heights [m]."""
        return self.y_0 - z * self.per_metre


def scale_of(box: Box, record: Record) -> Scale:
    """The panel's scale: from 11 mm inside r_0 to 11 mm outside the nominal ring, at least; of a whole crystal from its
    axis outwards, wider while the crown grows.
    """
    if isinstance(record, CrystalRecord):
        per_metre = box.w / (WIDER * max(record.column("r_ref").max(), LEAST_WIDTH))
        return Scale(box.x, box.bottom - DEEP * box.h, per_metre)
    across = 2.0 * INSIDE + record.puller.ring_bias
    per_metre = min(box.w / across, box.h / (BELOW + ABOVE))
    axis = box.x + 0.5 * box.w - (record.puller.r_0 + 0.5 * record.puller.ring_bias) * per_metre
    return Scale(axis, box.bottom - BELOW * per_metre, per_metre)


def meniscus_curve(
    r_c: float, h_c: float, p: Puller, model: MeniscusModel, phi_b: float, lowest: float = HEIGHT_MIN
) -> tuple[Floats, Floats, float]:
    """Radius and height [m] along Hurle's profile, from the triple point outwards, and the height of the bright ring.

    The profile is Hurle's whatever the model; its slope at the triple point is the model's own. Heights are clipped to
    their limits, as the ring of a failed state is measured.
    """
    h = min(max(h_c, lowest), HEIGHT_MAX_IN_A * p.a)
    M = float(profile_scale(r_c, h, model.slope(r_c, h, p)[1], p.a))
    z = h * LOWEST ** np.linspace(0.0, 1.0, POINTS)
    return r_c + profile(z, M) - profile(h, M), z, M * math.sqrt(1.0 - math.cos(phi_b))


def draw(canvas: Canvas, box: Box, record: Record) -> None:
    """Draw the cross-section of crystal edge, meniscus and melt."""
    scale = scale_of(box, record)
    r_c, r_ref, z = record.surface(max((scale.y_0 - box.y) / scale.per_metre - record.last("h_c"), 0.0))
    x, y = scale.x(r_c), scale.y(z)
    with canvas.clip(box):
        # Crystal and melt fill the panel; then the gas is cut out.
        canvas.rectangle(palette.CRYSTAL, box)
        canvas.rectangle(palette.MELT, Box(box.x, scale.y_0, box.w, box.bottom - scale.y_0))
        detached = record.ending is Ending.DETACHED
        if detached:
            canvas.polygon(palette.GAS, np.r_[x, x[-1], box.right, box.right], np.r_[y, box.y, box.y, y[0]])
            canvas.rectangle(palette.GAS, Box(box.x, y[0], box.w, scale.y_0 - y[0]))
        else:
            config, h_c = record.config, record.last("h_c")
            r, h, z_b = meniscus_curve(
                r_c[0], h_c, record.puller, config.meniscus, config.parameters.phi_b, record.lowest
            )
            out, down, right, level = scale.x(r), scale.y(h), box.right + 9, scale.y_0 + 1
            gas_x, gas_y = np.r_[x[::-1], out, right, right, x[-1]], np.r_[y[::-1], down, down[-1], box.y, box.y]
            canvas.polygon(palette.GAS, gas_x, gas_y)
            canvas.polygon(palette.MELT, np.r_[out, right, box.x, box.x], np.r_[down, level, level, down[0]])
        canvas.lines(palette.REFERENCE, scale.x(np.r_[r_ref[0], r_ref]), scale.y(np.r_[0.0, z]), 0.8)
        canvas.lines(palette.TRUE, x, y, 2.2)
        if not detached:
            _draw_ring(canvas, box, scale, (scale.x(record.last("r_br")), scale.y(z_b)), (out[0], down[0]))
        canvas.dot(palette.INK, x[0], y[0], 3.2)
        canvas.dot(palette.TRUE, x[0], y[0], 2.2)
    _draw_axis(canvas, box, scale)
    canvas.text(box.x + 7, box.y + 30, "crystal", size=10)
    canvas.text(box.x + 7, scale.y_0 + 24, "melt", palette.ON_MELT, bold=True)
    canvas.text(scale.x(r_ref[-1]) + 5, box.y + 30, "reference")


def _draw_ring(canvas: Canvas, box: Box, scale: Scale, ring: tuple[float, float], edge: tuple[float, float]) -> None:
    """The bright ring, and vertical marks of its radius and the crystal's; pixels of both."""
    x, bottom = ring[0], box.bottom - 21
    canvas.dot(palette.CAMERA, *ring, 3.2)
    canvas.lines(palette.CAMERA, x, [ring[1], bottom])
    canvas.lines(EDGE_MARK, edge[0], [edge[1], bottom])
    room, anchor = (5, 0.0) if x + 64 < box.right else (-5, 1.0)
    canvas.text(x + room, scale.y_0 + 8, "bright ring", palette.ON_MELT, 9.5, anchor, True)
    canvas.text(edge[0] - 5, scale.y_0 + 8, "r_c", EDGE_MARK, 9.5, 1.0, True)


def _draw_axis(canvas: Canvas, box: Box, scale: Scale) -> None:
    """Radii in mm along the lower edge."""
    y, per_mm = box.bottom - 16, scale.per_metre * MM
    canvas.rectangle(palette.PANEL, Box(box.x, y, box.w, 16.0))
    step = first_at_least(box.w / per_mm / 9.0, (5.0, 10.0, 20.0, 50.0))
    first, last = ((x - scale.x_0) / per_mm / step for x in (box.x, box.right))
    for number in range(math.ceil(first), math.floor(last) + 1):
        x = scale.x_0 + number * step * per_mm
        canvas.lines(palette.FAINT, x, [y, y + 3])
        if box.x + 8 < x < box.right - 52:
            canvas.text(x, y + 4, f"{number * step:g}", palette.FAINT, 9.0, 0.5)
    canvas.text(box.right - 4, y + 4, "r [mm]", palette.FAINT, 9.0, 1.0)
