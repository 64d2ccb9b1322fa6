"""Metres to pixels, the meniscus as a curve, and the choice of a round scale."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.physics.meniscus import MeniscusModel, profile, profile_scale
from cz_gym.physics.plant import Puller
from cz_gym.task import HEIGHT_MAX_IN_A, HEIGHT_MIN
from cz_gym.units import MM

Floats = npt.NDArray[np.float64]
POINTS = 48
"""Points of a drawn meniscus."""
LOWEST = 1e-3
"""Height at which a drawn meniscus ends, far out where it is flat [meniscus heights]."""
RANGES = tuple(value * MM for value in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0))
"""Half widths of an axis of radius errors [m]."""
TOLERANCE = 0.5 * MM
"""Half width of the shaded band around no error [m]: the benchmark's tolerance."""


class Scale(NamedTuple):
    """A linear map of metres to pixels; heights run up, pixels down."""

    x_0: float
    """Pixel of the radius r_0."""
    r_0: float
    """Radius there [m]."""
    y_0: float
    """Pixel of the melt's surface."""
    per_metre: float
    """Pixels a metre."""

    def points(self, r: npt.ArrayLike, z: npt.ArrayLike) -> Floats:
        """Pixels of radii and heights [m], shape (n, 2)."""
        return paired(self.x(r), self.y(z))

    def x(self, r: npt.ArrayLike) -> Floats:
        """Pixels across of radii [m]."""
        return self.x_0 + (np.asarray(r, np.float64) - self.r_0) * self.per_metre

    def y(self, z: npt.ArrayLike) -> Floats:
        """Pixels down of heights [m]."""
        return self.y_0 - np.asarray(z, np.float64) * self.per_metre


def paired(x: npt.ArrayLike, y: npt.ArrayLike) -> Floats:
    """Points of coordinates that broadcast to one axis, shape (n, 2)."""
    points = np.empty((np.broadcast(x, y).size, 2))
    points[:, 0], points[:, 1] = x, y
    return points


def first_at_least(value: float, steps: tuple[float, ...]) -> float:
    """The first of increasing steps that is at least a value, or the last."""
    return next((step for step in steps if step >= value), steps[-1])


def error_range(*errors: Floats) -> float:
    """Half width of an axis on which all these radius errors fit [m]; NaN does not count."""
    return first_at_least(1.1 * max(float(np.nanmax(np.abs(error), initial=0.0)) for error in errors), RANGES)


def clipped_height(h_c: float, a: float) -> float:
    """Meniscus height clipped to its limits, as the ring of a failed state is measured [m]."""
    return min(max(h_c, HEIGHT_MIN), HEIGHT_MAX_IN_A * a)


def meniscus_curve(r_c: float, h_c: float, p: Puller, model: MeniscusModel) -> tuple[Floats, Floats]:
    """Radius and height [m] along Hurle's profile, from the triple point outwards, shape (POINTS,) each.

    The profile is Hurle's whatever the model; its slope at the triple point is the model's own.
    """
    h = clipped_height(h_c, p.a)
    M = _profile_scale(r_c, h, p, model)
    z = h * LOWEST ** np.linspace(0.0, 1.0, POINTS)
    return r_c + profile(z, M) - profile(h, M), z


def ring_height(r_c: float, h_c: float, p: Puller, model: MeniscusModel, phi_b: float) -> float:
    """Height of the bright ring above the melt [m], z_b = M sqrt(1 - cos(phi_b))."""
    return float(_profile_scale(r_c, clipped_height(h_c, p.a), p, model) * np.sqrt(1.0 - np.cos(phi_b)))


def _profile_scale(r_c: float, h: float, p: Puller, model: MeniscusModel) -> float:
    """The profile's scale M [m]."""
    _, cos_theta = model.slope(r_c, h, p)
    return float(profile_scale(r_c, h, cos_theta, p.a))
