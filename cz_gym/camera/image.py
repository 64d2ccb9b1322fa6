"""From rays to images: radiance, pixels, shot noise, and the images of an environment's slots.

A ray is traced through each corner of the pixels. A pixel whose corners agree has their mean; where they differ, at the
ring and other edges, it has the mean of SUB x SUB rays, so that an edge can move by fractions of a pixel.
"""

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.body.plant import Puller
from cz_gym.episodes.record import FIRST_FRAME
from cz_gym.episodes.rng import WORDS, normal, seed_stream
from cz_gym.jit.cache import hashed
from cz_gym.jit.compile import jittable, kernel
from cz_gym.physics.meniscus import HURLE, MeniscusModel

from .rays import CRYSTAL, FLAT, MELT, SHIELD, WALL, Ray, first_hit, make_scene, mirror
from .view import COLUMNS, IMAGE, ROWS, View

SUB = 4
"""Rays along each side of a pixel with an edge."""
TOLERANCE = 12.0
"""Difference between a pixel's corners that counts as an edge [grey values]."""
REFLECTIONS = 2
"""The first makes the ring's outer part and edge, the second the part nearer to the crystal."""
_RADIUS_STEPS = 4
"""Steps of the fixed point that gives the crystal's radius for a reading of the ring."""
_APART = 1e-4
"""Distance in q of a mirrored ray's bracket from its start [-]."""
_GOLDEN = 0.6180339887498949
"""Golden ratio: shifts the rays of successive columns evenly."""


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
def _pixel(row: Any, column: Any, corners: Any, scene: Any, view: Any) -> Any:
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
            total += grey_value(row + down, column + right, scene, view)
    return total / (SUB * SUB)


@jittable
def _rounded(value: Any, noisy: Any, stream: Any, view: Any) -> Any:
    if noisy:
        value += np.sqrt(max(value, 0.0) / view.electrons) * normal(stream)
    return np.uint8(min(max(value + 0.5, 0.0), 255.0))


@jittable
def expose(scene: Any, view: Any, noisy: Any, stream: Any, image: Any) -> None:
    """Write the image of a scene, uint8 (ROWS, COLUMNS, 1); with shot noise from ``stream`` if ``noisy``.

    The left half is traced; the right half is its mirror image, because everything is symmetric about the axis.
    """
    corners = np.zeros((2, COLUMNS // 2 + 1))
    for row in range(-1, ROWS):
        for column in range(COLUMNS // 2 + 1):
            corners[(row + 1) % 2, column] = grey_value(1.0 * (row + 1), 1.0 * column, scene, view)
        if row < 0:
            continue
        for column in range(COLUMNS // 2):
            value = _pixel(row, column, corners, scene, view)
            image[row, column, 0] = _rounded(value, noisy, stream, view)
            image[row, COLUMNS - 1 - column, 0] = _rounded(value, noisy, stream, view)


def _show(scene: Any, view: Any, image: Any) -> None:
    expose(scene, view, False, np.zeros(WORDS, np.uint64), image)


_show_scene = kernel(_show)


def picture(r_c: float, h_c: float, puller: Puller, view: View) -> npt.NDArray[np.uint8]:
    """The image, without noise, of a crystal of radius r_c on a meniscus of height h_c [m]; shape of IMAGE."""
    image = np.zeros(IMAGE, np.uint8)
    _show_scene(make_scene(r_c, h_c, puller), view, image)
    return image


@lru_cache(maxsize=8)
def build_look(meniscus: MeniscusModel = HURLE) -> Any:
    """Compile ``look(slots, active, view, images, start, stop)``: the images of the active slots.

    A slot's image shows the crystal whose bright ring is at the last reading, errors included, on the meniscus of that
    moment. It is black while the reading is flagged invalid. ``images``: uint8 of shape (n, ROWS, COLUMNS, 1).
    """
    ring_offset = meniscus.ring_offset

    def look(slots: Any, active: Any, view: Any, images: Any, start: int, stop: int) -> None:
        stream = np.zeros(WORDS, np.uint64)
        for i in range(start, stop):
            if not active[i]:
                continue
            slot = slots[i]
            image, p = images[i], slot.puller
            if slot.valid == 0.0:
                image[:] = 0
                continue
            ring = slot.ring + p.ring_bias
            r_c = ring - p.ring_bias
            for _ in range(_RADIUS_STEPS):
                r_c = ring - ring_offset(r_c, slot.h_seen, p)
            seed_stream(stream, slot.key, FIRST_FRAME + slot.k_seen)
            noisy = slot.episode.camera_sd > 0.0
            expose(make_scene(r_c, slot.h_seen, p), view, noisy, stream, image)

    return kernel(look, hashed(*meniscus.functions))
