"""Meniscus and bright ring: two pure functions of radius, height and puller, for any meniscus model.

A meniscus model is a :class:`MeniscusModel`: ``slope`` gives the sine and cosine of the angle theta between
the meniscus and the vertical at the triple point, ``ring_offset`` the distance from the triple point to the
bright ring. The default is Hurle's closed form; both functions compile into the step.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cz_gym.jit import jittable, static

SQRT_2, SQRT_HALF = math.sqrt(2.0), math.sqrt(0.5)


@static
class MeniscusModel(NamedTuple):
    """A model of the meniscus for the plant: its name and its functions.

    ``slope`` and ``ring_offset`` take ``(r_c, h_c, p)``, ``height`` takes ``(r_c, theta, a)``. All three are marked
    ``cz_gym.jit.jittable`` and compile into the step, which makes no array: they hold arithmetic, ``np.sqrt``
    and its like, ``min`` and ``max`` on numbers, but not ``np.where``.
    """

    name: str
    slope: Callable[[Any, Any, Any], Any]
    ring_offset: Callable[[Any, Any, Any], Any]
    height: Callable[[Any, Any, Any], Any]
    covers: str = ""
    """The range in which the functions hold, for people; empty: everywhere."""

    @property
    def functions(self) -> tuple[Callable[[Any, Any, Any], Any], ...]:
        """The model's functions."""
        return self.slope, self.ring_offset, self.height


@jittable
def hurle_slope(r_c: Any, h_c: Any, p: Any) -> Any:
    """Sine and cosine of theta, solving Hurle's A cos(theta) + sin(theta) = B in closed form.

    A = h_c / (2 r_c), B = 1 - h_c^2 / a^2; the branch is theta = arcsin(B / sqrt(1 + A^2)) - arctan(A). Radius
    and height [m], ``p.a`` the capillary constant [m]. Written without angles, and with no difference of nearly equal
    numbers under the root: 1 - B^2 = raised (2 - raised).
    """
    width = 2.0 * r_c
    raised = h_c * h_c / (p.a * p.a)
    B = 1.0 - raised
    root = np.sqrt(h_c * h_c + width * width * (raised * (2.0 - raised)))
    per = 1.0 / (width * width + h_c * h_c)
    return (width * width * B - h_c * root) * per, width * (h_c * B + root) * per


@jittable
def hurle_height(r_c: Any, theta: Any, a: Any) -> Any:
    """Meniscus height [m] at which Hurle's meniscus leaves the crystal at angle theta [rad]."""
    half = a * np.cos(theta) / (4.0 * r_c)
    return a * (np.sqrt(half * half + 1.0 - np.sin(theta)) - half)


@jittable
def profile_scale(r_c: Any, h_c: Any, cos_theta: Any, a: Any) -> Any:
    """Scale M [m] of Hurle's meniscus profile: 1 / M^2 = 1 / a^2 + cos(theta) / (2 r_c h_c)."""
    curved = 2.0 * r_c * h_c
    return a * np.sqrt(curved / (curved + a * a * cos_theta))


@jittable
def profile(z: Any, M: Any) -> Any:
    """Horizontal coordinate X(z) [m] of Hurle's profile at height z [m] above the melt, scale M [m].

    X = M / sqrt(2) arccosh(sqrt(2) M / z) - sqrt(2 M^2 - z^2); arccosh(y) = log(y + sqrt(y^2 - 1)) shares the root.
    """
    width = np.sqrt(2.0 * M * M - z * z)
    return M * SQRT_HALF * np.log((SQRT_2 * M + width) / z) - width


@jittable
def ring_point(phi_b: Any) -> Any:
    """X(z_b) / M at the profile's point of slope phi_b [rad], z_b = M sqrt(1 - cos(phi_b)); M cancels."""
    return profile(np.sqrt(1.0 - np.cos(phi_b)), 1.0)


@jittable
def hurle_ring_offset(r_c: Any, h_c: Any, p: Any) -> Any:
    """Distance X(z_b) - X(h_c) [m] from the triple point out to the bright ring; NaN for h_c >= sqrt(2) a."""
    _, cos_theta = hurle_slope(r_c, h_c, p)
    M = profile_scale(r_c, h_c, cos_theta, p.a)
    return M * p.X_b - profile(h_c, M)


HURLE = MeniscusModel("hurle", hurle_slope, hurle_ring_offset, hurle_height)
