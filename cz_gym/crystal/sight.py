"""View of the camera on a whole crystal: the bright ring where there is one, else the crystal's edge.

The ring is the crucible's bare wall, mirrored by the meniscus. Its outer edge is where the meniscus halves the angle
between the lens and the wall's upper end; a meniscus that is nowhere so steep mirrors the dark heat shield alone. No
ray is traced here: tests compare with the ray tracer of :mod:`cz_gym.camera`.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from cz_gym.jit import jittable
from cz_gym.physics.meniscus import SQRT_2, hurle_slope, profile, profile_scale

LEAST_PIXELS = 1.0
"""Width from which on a ring can be read [pixels]."""
EDGE_NOISE = 2.0
"""Standard deviation of the edge's white noise, in multiples of the one that the scenario draws for the ring: half of
its contrast, an estimate [-]."""
EDGE_BIAS = 5.0
"""Standard deviation of the edge's error that a crystal keeps, in the same multiples: up to 0.25 mm on "randomized", an
estimate [-]."""
_TIMES = 2


class RingEdge(NamedTuple):
    """Outer edge of the mirrored wall."""

    slope: Any
    """Slope of the meniscus at the edge [rad]."""
    r: Any
    """Distance from the axis [m]."""
    z: Any
    """Height above the melt [m]; not below h_c: there is no ring."""


@jittable
def steepness(r: Any, z: Any, p: Any) -> Any:
    """Slope against the horizontal that mirrors the wall's upper end into the lens from a point [rad]."""
    return 0.5 * (np.arctan2(p.lens_x - r, p.lens_z - z) + np.arctan2(p.R_cr - r, p.wall_height - z))


@jittable
def ring_edge(r_c: Any, h_c: Any, p: Any) -> Any:
    """:class:`RingEdge` on Hurle's meniscus: the slope needed at the crystal, then at the point that has it."""
    _, cos_theta = hurle_slope(r_c, h_c, p)
    M = profile_scale(r_c, h_c, cos_theta, p.a)
    slope, r, z = 0.0, r_c, h_c
    for _ in range(_TIMES):
        slope = steepness(r, z, p)
        z = SQRT_2 * M * np.sin(0.5 * slope)
        if not z < h_c:
            return RingEdge(slope, r_c, h_c)
        r = r_c + profile(z, M) - profile(h_c, M)
    return RingEdge(slope, r, z)


@jittable
def ring_pixels(r_c: Any, h_c: Any, p: Any) -> Any:
    """Width of the ring in the image, down its middle [pixels]; 0 where there is none."""
    edge = ring_edge(r_c, h_c, p)
    across, up = p.lens_x - r_c, p.lens_z - h_c
    return ((edge.r - r_c) * up + (h_c - edge.z) * across) / ((across * across + up * up) * p.pixel)


@jittable
def shows_ring(r_c: Any, h_c: Any, p: Any) -> Any:
    """True if the camera shows a readable ring around a crystal [m]."""
    return ring_pixels(r_c, h_c, p) >= LEAST_PIXELS


def slope_of(r_c: float, h_c: float, p: Any) -> float:
    """Slope of Hurle's meniscus at the crystal [rad]."""
    return 0.5 * math.pi - math.asin(float(hurle_slope(r_c, h_c, p)[0]))
