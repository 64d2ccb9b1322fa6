"""From rays to images: radiance, pixels, shot noise, and the images of an environment's slots.

A ray is traced through each corner of the pixels. A pixel whose corners agree has their mean; where they differ, at the
ring and other edges, it has the mean of SUB x SUB rays, so that an edge can move by fractions of a pixel.
"""

import math
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.integrate import trapezoid
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from cz_gym.body.process import BODY
from cz_gym.episodes.draw import FIRST_FRAME
from cz_gym.episodes.rng import WORDS, normal, seed_stream
from cz_gym.jit import hashed, jittable, kernel
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.plant import Puller
from cz_gym.process import Process
from cz_gym.support.errors import CzError
from cz_gym.support.units import MM

from .view import (
    COLUMNS,
    CRYSTAL,
    FLAT,
    IMAGE,
    MELT,
    ROWS,
    SHIELD,
    WALL,
    Ray,
    Scene,
    View,
    first_hit,
    make_scene,
    mirror,
    profile_at,
    project,
)

SUB = 4
"""Rays along each side of a pixel with an edge."""
TOLERANCE = 12.0
"""Difference between a pixel's corners that counts as an edge [grey values]."""
REFLECTIONS = 2
"""Largest number of reflections: the first makes the ring's outer part and edge, the second its inner part."""
_APART = 1e-4
"""Distance in q of a mirrored ray's bracket from its start [-]."""
_GOLDEN = 0.6180339887498949
"""Golden ratio: shifts the rays of successive columns evenly."""


@jittable
def first_row(inwards: Any, view: Any) -> Any:
    """Row of the view in which an image begins whose middle lies ``inwards`` of the optical axis [m] on the melt."""
    point = project(view.camera.aim - inwards, 0.0, 0.0, view)
    return np.rint(point.row - 0.5 * ROWS)


@jittable
def sight(row: Any, column: Any, view: Any) -> Any:
    """The ray from the lens through pixel coordinates (:func:`cz_gym.camera.view.project`)."""
    u = (column - 0.5 * COLUMNS) * view.pixel
    v = (row - 0.5 * ROWS) * view.pixel
    return Ray(view.x, 0.0, view.z, v * view.cos_tilt - view.sin_tilt, u, -view.cos_tilt - v * view.sin_tilt)


@jittable
def _just_off(q: Any, ray: Any) -> Any:
    """q on the profile beside the point where a ray leaves the melt; the ray is outside the melt there."""
    if q < 0.0:
        return FLAT
    return q + _APART if ray.dz < 0.0 else q - _APART


@jittable
def emitted(hit: Any, scene: Any, view: Any) -> Any:
    """Radiance that a surface itself emits, without the light that it mirrors."""
    if hit.what == MELT:
        return view.melt
    if hit.what == WALL:
        return view.wall
    if hit.what == SHIELD:
        return view.shield
    if hit.what == CRYSTAL:
        far = view.camera.crystal_far_temperature
        cooled = np.exp(-(hit.z - scene.h_c) / view.camera.crystal_cooling)
        T = far + (view.camera.crystal_temperature - far) * cooled
        return view.camera.crystal_emissivity * np.exp(view.wien * (1.0 / view.camera.wall_temperature - 1.0 / T))
    return view.opening


@jittable
def radiance(ray: Any, scene: Any, view: Any) -> Any:
    """Radiance that arrives along a ray from the lens, mirrored by the melt REFLECTIONS times at most."""
    light, share, q = 0.0, 1.0, scene.q_c
    for _ in range(REFLECTIONS + 1):
        hit = first_hit(ray, q, scene, view)
        light += share * emitted(hit, scene, view)
        if hit.what != MELT:
            break
        share *= view.mirrored
        ray = mirror(ray, hit)
        q = _just_off(hit.q, ray)
    return light


@jittable
def grey_value(row: Any, column: Any, scene: Any, view: Any) -> Any:
    """Brightness at pixel coordinates [grey values], not rounded."""
    return view.gain * radiance(sight(row, column, view), scene, view)


@jittable
def _pixel(row: Any, column: Any, top: Any, corners: Any, scene: Any, view: Any) -> Any:
    """Brightness of a pixel whose upper and lower corners are in the two rows of ``corners``.

    No two rays of a pixel share a row or a column, so that a level edge also moves in SUB x SUB steps. They are
    shifted from column to column, so that an edge across many columns moves smoothly.
    """
    above, below = row % 2, (row + 1) % 2
    a, b = corners[above, column], corners[above, column + 1]
    c, d = corners[below, column], corners[below, column + 1]
    if max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) < TOLERANCE:
        return 0.25 * (a + b + c + d)
    total, offset = 0.0, (column * _GOLDEN) % 1.0
    for i in range(SUB):
        for j in range(SUB):
            down, right = (i + (j + offset) / SUB) / SUB, (j + (i + 0.5) / SUB) / SUB
            total += grey_value(top + row + down, column + right, scene, view)
    return total / (SUB * SUB)


@jittable
def _rounded(value: Any, noisy: Any, stream: Any, view: Any) -> Any:
    if noisy:
        value += np.sqrt(max(value, 0.0) / view.electrons) * normal(stream)
    return np.uint8(min(max(value + 0.5, 0.0), 255.0))


@jittable
def expose(scene: Any, view: Any, noisy: Any, stream: Any, image: Any, top: Any) -> None:
    """Write the image of a scene, uint8 (ROWS, COLUMNS, 1); with shot noise from ``stream`` if ``noisy``.

    ``top`` is the row of the view in which the image begins, a whole number: 0 unless the image follows a crystal.

    The left half is traced; the right half is its mirror image, because everything is symmetric about the axis.
    """
    corners = np.zeros((2, COLUMNS // 2 + 1))
    for row in range(-1, ROWS):
        for column in range(COLUMNS // 2 + 1):
            corners[(row + 1) % 2, column] = grey_value(top + row + 1.0, 1.0 * column, scene, view)
        if row < 0:
            continue
        for column in range(COLUMNS // 2):
            value = _pixel(row, column, top, corners, scene, view)
            image[row, column, 0] = _rounded(value, noisy, stream, view)
            image[row, COLUMNS - 1 - column, 0] = _rounded(value, noisy, stream, view)


def _show(scene: Any, view: Any, image: Any) -> None:
    expose(scene, view, False, np.zeros(WORDS, np.uint64), image, 0.0)


_show_scene = kernel(_show)


def picture(r_c: float, h_c: float, puller: Puller, view: View) -> npt.NDArray[np.uint8]:
    """The image, without noise, of a crystal of radius r_c on a meniscus of height h_c [m]; shape of IMAGE."""
    image = np.zeros(IMAGE, np.uint8)
    _show_scene(make_scene(r_c, h_c, puller), view, image)
    return image


@lru_cache(maxsize=8)
def build_render(process: Process = BODY, meniscus: MeniscusModel = HURLE) -> Any:
    """Compile ``render(slots, active, view, images, start, stop)``: the images of the active slots.

    A slot's image shows the crystal of the last reading, errors included, on the meniscus of that moment
    (:class:`cz_gym.process.InImage`), or is black. ``images``: uint8 of shape (n, ROWS, COLUMNS, 1).
    """
    in_image = process.in_image

    def render(slots: Any, active: Any, view: Any, images: Any, start: int, stop: int) -> None:
        stream = np.zeros(WORDS, np.uint64)
        for i in range(start, stop):
            if not active[i]:
                continue
            slot, image = slots[i], images[i]
            seen = in_image(slot, meniscus)
            if np.isnan(seen.r_c):
                image[:] = 0
                continue
            seed_stream(stream, slot.key, FIRST_FRAME + slot.k_seen)
            noisy = slot.episode.camera_sd > 0.0
            scene = make_scene(seen.r_c, slot.h_seen, slot.puller)
            expose(scene, view, noisy, stream, image, first_row(seen.inwards, view))

    return kernel(render, hashed(in_image, *meniscus.functions))


# Detector of the bright ring in an image, which returns the crystal's radius.
#
# Scan lines run from the melt towards the axis, at fixed angles about it, in the horizontal plane of the ring's outer
# edge at the operating point. The edge lies near the first sample halfway between dark melt and ring. Its exact place
# is that of a sharp step with the same total light: pixels add up light, so this hardly depends on where in a pixel
# the edge falls. SciPy's robust least squares fits a circle about the axis, so that a few lines may be wrong. The
# operator's bias, the reading at the puller's steady state minus r_0, is subtracted, as in the plant.

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
