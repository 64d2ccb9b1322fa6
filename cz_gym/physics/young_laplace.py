"""The exact meniscus: the axisymmetric Young-Laplace equation, solved by shooting and tabulated for the plant.

With the arc length s running inward from the flat melt, phi the slope against the horizontal and lengths in
capillary constants (Huh and Scriven, J. Colloid Interface Sci. 30, 1969):

    r_s = -cos(phi),   z_s = sin(phi),   phi_s = 2 z + sin(phi) / r.

Far out the surface is linear, z = c K_0(sqrt(2) r), which starts the shooting at a height of 1e-6. At the triple
point phi = pi/2 - theta. :data:`YOUNG_LAPLACE` is the solution as polynomials that compile into the step::

    gym.make("Cz-v0", meniscus=YOUNG_LAPLACE)

The coefficients in ``young_laplace.json`` interpolate :func:`solve` at the Chebyshev points of both variables, turned
into powers: ``SLOPE`` the correction in :func:`lift`, ``RING`` and ``TAIL`` those in :func:`exact_ring_offset`. A test
compares them with :func:`solve`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.special import k0e, k1e

from cz_gym.jit.compile import jittable

from .meniscus import MeniscusModel, hurle_height, profile, ring_point

Floats = npt.NDArray[np.float64]
SQRT_2 = math.sqrt(2.0)
SLOPE, RING, TAIL = (np.array(rows) for rows in json.loads(Path(__file__).with_suffix(".json").read_text()).values())
"""Coefficients of the polynomials [-], shapes (9, 16), (9, 22) and (7, 8)."""
TAIL_HEIGHT = 1e-6
"""Height at which the linear tail hands over to the shooting [a]."""
NARROWEST = 0.3
"""Largest a / r_c in the table: crystals of at least 25 mm radius, in silicon."""
LOWEST, HIGHEST = 0.1, 1.265
"""Meniscus heights in the table [a]; the slope's table reaches down to zero."""
RING_SLOPES = (math.radians(0.5), math.radians(15.0))
"""Slopes phi_b of the bright ring in the table [rad]."""
RING_REFERENCE = float(ring_point(math.radians(3.5)))
"""X_b at which the ring's first table stands [-]; the second moves it to another slope."""
_RTOL, _ATOL, _SHOTS = 1e-11, 1e-13, 60


class Solution(NamedTuple):
    """Exact menisci, arrays of one shape."""

    theta: Floats
    """Angle between meniscus and vertical at the triple point [rad]."""
    ring_offset: Floats
    """Distance from the triple point out to the bright ring [m]."""


def solve(r_c: npt.ArrayLike, h_c: npt.ArrayLike, a: float, phi_b: npt.ArrayLike) -> Solution:
    """Solve the meniscus that rises to h_c [m] at a crystal of radius r_c [m]; arguments broadcast.

    ``a`` is the capillary constant [m], ``phi_b`` the slope of the bright ring [rad]. Raises ArithmeticError if
    no such meniscus was found.
    """
    r, h, slope = (np.atleast_1d(part) for part in np.broadcast_arrays(np.divide(r_c, a), np.divide(h_c, a), phi_b))
    start = _shoot(lambda outer: _rise(outer, h)[0], r + _planar_width(h), r)
    _, phi = _rise(start, h)
    ring, _ = _turn(start, slope)
    shape = np.broadcast_shapes(np.shape(r_c), np.shape(h_c), np.shape(phi_b))
    return Solution((0.5 * math.pi - phi).reshape(shape), (a * (ring - r)).reshape(shape))


def solve_height(r_c: npt.ArrayLike, theta: npt.ArrayLike, a: float) -> Floats:
    """Exact height [m] at which the meniscus leaves a crystal of radius r_c [m] at angle theta [rad]."""
    r, phi = (np.atleast_1d(part) for part in np.broadcast_arrays(np.divide(r_c, a), 0.5 * math.pi - np.asarray(theta)))
    start = _shoot(lambda outer: _turn(outer, phi)[0], r + _planar_width(SQRT_2 * np.sin(0.5 * phi)), r)
    height: Floats = a * _turn(start, phi)[1]
    return height.reshape(np.broadcast_shapes(np.shape(r_c), np.shape(theta)))


def _planar_width(h: Floats) -> Floats:
    """Distance from the height h to the tail's height on the planar meniscus [a]."""
    width: Floats = profile(TAIL_HEIGHT, 1.0) - profile(h, 1.0)
    return width


def _shoot(inner: Callable[[Floats], Floats], outer: Floats, wanted: Floats) -> Floats:
    """Secant iteration on the tail's radius until the meniscus ends at the wanted radius."""
    miss = inner(outer) - wanted
    rate = np.ones_like(miss)
    for _ in range(_SHOTS):
        if np.max(np.abs(miss) / wanted) < 1e-12:
            return outer
        step = -miss / rate
        missed = inner(outer + step) - wanted
        moved = np.abs(step) > 1e-9 * wanted
        rate = np.where(moved, (missed - miss) / np.where(moved, step, 1.0), rate)
        outer, miss = outer + step, missed
    if np.max(np.abs(miss) / wanted) < 1e-10:
        return outer
    raise ArithmeticError("no Young-Laplace meniscus found for these radii and heights")


def _tail_slope(outer: Floats) -> Floats:
    """Slope [rad] of z = c K_0(sqrt(2) r) where z is the tail's height."""
    slope: Floats = np.arctan(TAIL_HEIGHT * SQRT_2 * k1e(SQRT_2 * outer) / k0e(SQRT_2 * outer))
    return slope


def _rise(outer: Floats, h: Floats) -> tuple[Floats, Floats]:
    """Radius and slope where the meniscus has risen to h, with log(z) as the running variable."""
    span = np.log(h / TAIL_HEIGHT)

    def slopes(tau: float, y: Floats) -> Floats:
        r, phi = y.reshape(2, -1)
        z = TAIL_HEIGHT * np.exp(tau * span)
        ds = z * span / np.sin(phi)
        return np.concatenate([-np.cos(phi) * ds, (2.0 * z + np.sin(phi) / r) * ds])

    r, phi = _integrate(slopes, outer, _tail_slope(outer))
    return r, phi


def _turn(outer: Floats, phi_end: Floats) -> tuple[Floats, Floats]:
    """Radius and height where the meniscus has turned to the slope phi_end, with log(phi) running."""
    first = _tail_slope(outer)
    span = np.log(phi_end / first)

    def slopes(tau: float, y: Floats) -> Floats:
        r, z = y.reshape(2, -1)
        phi = first * np.exp(tau * span)
        ds = phi * span / (2.0 * z + np.sin(phi) / r)
        return np.concatenate([-np.cos(phi) * ds, np.sin(phi) * ds])

    return _integrate(slopes, outer, np.full_like(outer, TAIL_HEIGHT))


def _integrate(slopes: Callable[[float, Floats], Floats], first: Floats, second: Floats) -> tuple[Floats, Floats]:
    y = np.concatenate([first, second])
    run = solve_ivp(slopes, (0.0, 1.0), y, method="DOP853", rtol=_RTOL, atol=_ATOL)
    if not run.success:
        raise ArithmeticError("no Young-Laplace meniscus rises that high at a crystal this narrow")
    r, other = run.y[:, -1].reshape(2, -1)
    return r, other


@jittable
def polynomial(c: Any, x: Any, y: Any) -> Any:
    """Sum of c[i, j] x^i y^j by Horner's rule; c of shape (m, n)."""
    total = 0.0 * (x + y)
    for i in range(c.shape[0] - 1, -1, -1):
        row = 0.0 * y + c[i, c.shape[1] - 1]
        for j in range(c.shape[1] - 2, -1, -1):
            row = row * y + c[i, j]
        total = total * x + row
    return total


@jittable
def _inside(beyond: Any) -> Any:
    """One inside the table, NaN beyond: NaN to the power of zero is one. No ``np.where``, which makes arrays."""
    return np.power(np.nan, 1.0 * beyond)


@jittable
def _curvature(r_c: Any, a: Any) -> Any:
    """a / r_c mapped to [-1, 1], and the ratio itself; NaN for a crystal narrower than the table's."""
    ratio = a / r_c
    ratio = ratio * _inside(np.real(ratio) > NARROWEST)
    return 2.0 * ratio / NARROWEST - 1.0, ratio


@jittable
def lift(r_c: Any, h_c: Any, a: Any) -> Any:
    """1 - sin(theta), tabulated as (h_c/a)^2 (1 + (a/r_c) P): the planar meniscus is exact, P analytic in h_c^2."""
    x, ratio = _curvature(r_c, a)
    square = (h_c / a) * (h_c / a)
    return square * (1.0 + ratio * polynomial(SLOPE, x, 2.0 * square / (HIGHEST * HIGHEST) - 1.0))


@jittable
def exact_slope(r_c: Any, h_c: Any, p: Any) -> Any:
    """Sine and cosine of theta on the exact meniscus; radius and height [m], ``p.a`` the capillary constant [m]."""
    raised = lift(r_c, h_c, p.a)
    return 1.0 - raised, np.sqrt(raised * (2.0 - raised))


@jittable
def exact_height(r_c: Any, theta: Any, a: Any) -> Any:
    """Height [m] at which the tabulated meniscus leaves the crystal at angle theta [rad]; undoes ``exact_slope``.

    Repeats h <- h sqrt((1 - sin(theta)) / lift(h)) from Hurle's height: the lift is nearly h^2, so each turn gains
    more than a digit.
    """
    h = hurle_height(r_c, theta, a)
    for _ in range(30):
        h = h * np.sqrt((1.0 - np.sin(theta)) / lift(r_c, h, a))
    return h


Q_LOW, Q_HIGH = math.acosh(SQRT_2 / HIGHEST), math.acosh(SQRT_2 / LOWEST)
"""Range of the ring table's q [-]."""
X_LOW, X_HIGH = float(ring_point(RING_SLOPES[1])), float(ring_point(RING_SLOPES[0]))
"""Range of the tail table's X_b [-]."""


@jittable
def _between(value: Any, low: Any, high: Any) -> Any:
    return (2.0 * value - (low + high)) / (high - low)


@jittable
def exact_ring_offset(r_c: Any, h_c: Any, p: Any) -> Any:
    """Distance [m] from the triple point out to the bright ring; NaN for h_c >= sqrt(2) a or phi_b off the table.

    The planar meniscus is exact; the first table corrects it for curvature at the reference slope of the ring, in
    q = arccosh(sqrt(2) a / h_c); the second moves the ring from there to the puller's slope.
    """
    x, ratio = _curvature(r_c, p.a)
    q = np.arccosh(SQRT_2 * p.a / h_c)
    planar = RING_REFERENCE - profile(h_c / p.a, 1.0)
    at_reference = planar + ratio * polynomial(RING, x, _between(q, Q_LOW, Q_HIGH))
    y, ratio = _curvature(r_c + p.a * at_reference, p.a)
    moved = (p.X_b - RING_REFERENCE) * _inside((p.X_b < X_LOW) | (p.X_b > X_HIGH))
    return p.a * (at_reference + moved * (1.0 + ratio * polynomial(TAIL, y, _between(p.X_b, X_LOW, X_HIGH))))


_COVERS = f"r_0 >= a / {NARROWEST}, phi_b from {RING_SLOPES[0]:.4f} to {RING_SLOPES[1]:.4f} rad"
YOUNG_LAPLACE = MeniscusModel("young-laplace", exact_slope, exact_ring_offset, exact_height, _COVERS)
"""The exact meniscus as a model for the plant: ``gym.make("Cz-v0", meniscus=YOUNG_LAPLACE)``."""
