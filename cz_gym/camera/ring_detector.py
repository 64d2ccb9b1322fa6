"""The bright ring found in an image, and turned back into a radius.

Scan lines run from the melt towards the axis, at fixed angles about it, in the plane where the ring's outer edge lies
at the operating point, where the camera's geometry puts each sample. The edge is near where the grey value first rises
halfway from the dark melt to the ring, and exactly where a sharp step would hold as much light: pixels add up light,
so this hardly depends on where in a pixel the edge falls. A circle about the puller's axis is fitted by SciPy's
robust least squares, so that single lines may be wrong. As in the plant, the operator's bias is taken off: what the
detector says of this puller's own steady state, less r_0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.integrate import trapezoid
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from cz_gym.errors import CzError
from cz_gym.physics.plant import Puller
from cz_gym.units import MM

from .image import picture
from .rays import Scene, make_scene, profile_at
from .view import View, project

Floats = npt.NDArray[np.float64]
ANGLES = np.radians(np.linspace(-24.0, 24.0, 121))
"""Angles of the scan lines about the axis, 0 towards the camera [rad]."""
OUTER, INNER, SPACING = 16.0 * MM, 10.0 * MM, 0.1 * MM
"""A scan line begins so far outside r_0, ends so far inside, with a sample every so often [m]."""
REACH = (2.0, 1.5)
"""How far outside and inside its first guess an edge is looked at [pixels]."""
LEAST_CONTRAST = 40.0
"""Least rise from the dark melt to the ring [grey values]."""
LEAST_SHARE = 0.95
"""Least contrast, as a share of the operating point's: a ring too thin to fill a pixel is none."""
LEAST_LINES = 60
"""Least scan lines with an edge."""
ROBUST = 0.1 * MM
"""Distance from the circle beyond which an edge counts for less [m]."""


class Ring(NamedTuple):
    """What a detector says of an image."""

    radius: float
    """Radius of the ring's outer edge less the operator's bias [m]; NaN where no ring was found."""
    edges: Floats
    """Radius at each scan line, bias included [m], shape (lines,); NaN where there is no edge."""


class Edge(NamedTuple):
    """A point of the meniscus."""

    slope: float
    """Slope against the horizontal [rad]."""
    r: float
    """Distance from the axis [m]."""
    z: float
    """Height above the melt [m]."""


def wall_edge(scene: Scene, view: View) -> Edge:
    """The point nearest to the camera that mirrors the upper end of the wall into it: the ring's outer edge, exactly.

    There the normal halves the angle between camera and wall's end, phi = (gamma + beta) / 2, both from the vertical.
    NaN if the meniscus is nowhere as steep.
    """
    slope, edge = 0.0, Edge(0.0, scene.r_c, scene.h_c)
    for _ in range(60):
        towards_lens = math.atan2(view.x - edge.r, view.z - edge.z)
        towards_wall = math.atan2(view.camera.crucible_radius - edge.r, view.camera.wall_height - edge.z)
        slope = 0.5 * (towards_lens + towards_wall)
        q = math.acosh(1.0 / math.sin(0.5 * slope))
        r, z, _, _ = profile_at(q, scene)
        edge = Edge(slope, float(r), float(z))
    return edge if edge.z <= scene.h_c else Edge(math.nan, math.nan, math.nan)


class RingDetector:
    """Reads the ring's radius from images of one view of one puller.

    ``bias`` [m] is what it takes off, measured on the puller's own steady state, and ``shape`` [m] by how much each
    scan line differs there (seen from the side another slope mirrors the wall); ``height`` [m] the plane of its scan
    lines; ``pixel`` [m] a pixel's height there. Raises ValueError if the view shows no
    ring there.
    """

    def __init__(self, view: View, puller: Puller) -> None:
        at_rest = wall_edge(make_scene(puller.r_0, puller.h_0, puller), view)
        self.height = at_rest.z
        self.radii: Floats = np.arange(puller.r_0 + OUTER, puller.r_0 - INNER, -SPACING)
        x, y = self.radii * np.cos(ANGLES)[:, None], self.radii * np.sin(ANGLES)[:, None]
        self._where = project(x, y, self.height, view)
        rows = project(np.array([at_rest.r, at_rest.r + SPACING]), 0.0, at_rest.z, view).row
        self.pixel = SPACING / float(rows[1] - rows[0])
        self._reach = tuple(round(pixels * self.pixel / SPACING) for pixels in REACH)
        self.bias, self.shape, self.contrast = 0.0, np.zeros(len(ANGLES)), 0.0
        edges, self.contrast = self.find_edges(picture(puller.r_0, puller.h_0, puller, view))
        if np.isfinite(edges).all():
            self.shape = edges - edges.mean()
        self.bias = self.read(picture(puller.r_0, puller.h_0, puller, view)).radius - puller.r_0
        if not math.isfinite(self.bias):
            raise CzError(
                "this camera shows no bright ring at the puller's operating point: the wall it mirrors "
                "or the ring itself lies outside the image; check tilt, aim and wall_height"
            )

    def read(self, image: npt.NDArray[np.uint8]) -> Ring:
        """Find the ring in an image, shape (ROWS, COLUMNS) or (ROWS, COLUMNS, 1)."""
        edges, contrast = self.find_edges(image)
        found = np.isfinite(edges)
        if found.sum() < LEAST_LINES or contrast < LEAST_SHARE * self.contrast:
            return Ring(math.nan, edges)
        radii = edges[found] - self.shape[found]

        def misses(radius: Floats) -> Floats:
            return radii - radius

        fit = least_squares(misses, [float(np.median(radii))], loss="soft_l1", f_scale=ROBUST, xtol=1e-12)
        return Ring(float(fit.x[0]) - self.bias, edges)

    def find_edges(self, image: npt.NDArray[np.uint8]) -> tuple[Floats, float]:
        """Radius of the ring's outer edge on each scan line [m], NaN where there is none, and its contrast [greys]."""
        grey = np.asarray(image, np.float64).reshape(image.shape[:2])
        lines = map_coordinates(grey, [self._where.row - 0.5, self._where.column - 0.5], order=1, mode="nearest")
        peak = np.argmax(lines, axis=1)
        dark = np.where(np.arange(lines.shape[1]) <= peak[:, None], lines, np.inf).min(axis=1)
        high = lines.max(axis=1)
        first = np.argmax(lines >= 0.5 * (dark + high)[:, None], axis=1)
        outside, inside = self._reach
        sound = (high - dark >= LEAST_CONTRAST) & (first >= outside) & (first + inside < lines.shape[1])
        at = np.where(sound, first, outside)
        step = np.take_along_axis(lines, at[:, None] + np.arange(-outside, inside + 1), axis=1)
        if not sound.any():
            return np.full(len(lines), np.nan), 0.0
        low, rise = step[sound, 0].mean(), (step[sound, -1] - step[sound, 0]).mean()
        filled = trapezoid(step - low, dx=SPACING, axis=1) / rise
        radius: Floats = np.where(sound, self.radii[at + inside] + filled, np.nan)
        return radius, float(rise)
