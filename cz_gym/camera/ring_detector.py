"""Detector of the bright ring in an image, which returns the crystal's radius.

Scan lines run from the melt towards the axis, at fixed angles about it, in the horizontal plane of the ring's outer
edge at the operating point. The edge lies near the first sample halfway between dark melt and ring. Its exact place is
that of a sharp step with the same total light: pixels add up light, so this hardly depends on where in a pixel the edge
falls. SciPy's robust least squares fits a circle about the axis, so that a few lines may be wrong. The operator's bias,
the reading at the puller's steady state minus r_0, is subtracted, as in the plant.
"""

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.integrate import trapezoid
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from cz_gym.body.plant import Puller
from cz_gym.errors import CzError
from cz_gym.support.units import MM

from .image import picture
from .rays import Scene, make_scene, profile_at
from .view import View, project

Floats = npt.NDArray[np.float64]
ANGLES = np.radians(np.linspace(-24.0, 24.0, 121))
"""Angles of the scan lines about the axis, 0 towards the camera [rad]."""
OUTER, INNER, SPACING = 16.0 * MM, 10.0 * MM, 0.1 * MM
"""Start of the scan lines outside r_0, their end inside r_0, and the distance of their samples [m]."""
REACH = (2.0, 1.5)
"""Reach of the integral over an edge, outside and inside the first guess [pixels]."""
LEAST_CONTRAST = 40.0
"""Smallest rise from dark melt to ring that counts as an edge [grey values]."""
LEAST_SHARE = 0.95
"""Smallest contrast of a ring, as a share of the operating point's; a ring thinner than a pixel has less."""
LEAST_LINES = 60
"""Smallest number of scan lines with an edge."""
ROBUST = 0.1 * MM
"""Scale of the robust loss: distance from the circle beyond which an edge has less weight [m]."""


class Ring(NamedTuple):
    """The ring in an image."""

    radius: float
    """Radius of the ring's outer edge minus the operator's bias [m]; NaN without a ring."""
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
    """The ring's exact outer edge: the nearest point to the camera that mirrors the wall's upper end into it.

    Its normal halves the angle between camera and wall's end: phi = (gamma + beta) / 2, both from the vertical. NaN if
    the meniscus is nowhere steep enough.
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

    It is calibrated on the puller's steady state: ``bias`` [m] is the operator's, ``shape`` [m] the deviation of each
    scan line from the mean (seen from the side, another slope mirrors the wall). ``height`` [m] is that of the scan
    lines' plane, ``pixel`` [m] the height of a pixel in it. Raises CzError if the view shows no ring in that state.
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
        image = picture(puller.r_0, puller.h_0, puller, view)
        edges, self.contrast = self.find_edges(image)
        if np.isfinite(edges).all():
            self.shape = edges - edges.mean()
        self.bias = self.read(image).radius - puller.r_0
        if not math.isfinite(self.bias):
            raise CzError(
                "this camera shows no bright ring at the puller's operating point: the wall it mirrors "
                "or the ring itself lies outside the image; check tilt, aim and wall_height"
            )

    def read(self, image: npt.NDArray[np.uint8]) -> Ring:
        """The ring in an image of shape (ROWS, COLUMNS) or (ROWS, COLUMNS, 1)."""
        edges, contrast = self.find_edges(image)
        has_edge = np.isfinite(edges)
        if has_edge.sum() < LEAST_LINES or contrast < LEAST_SHARE * self.contrast:
            return Ring(math.nan, edges)
        radii = edges[has_edge] - self.shape[has_edge]
        start = [float(np.median(radii))]
        fit = least_squares(partial(np.subtract, radii), start, loss="soft_l1", f_scale=ROBUST, xtol=1e-12)
        return Ring(float(fit.x[0]) - self.bias, edges)

    def find_edges(self, image: npt.NDArray[np.uint8]) -> tuple[Floats, float]:
        """Radius of the outer edge on each scan line [m], NaN without an edge; and the contrast [grey values]."""
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
