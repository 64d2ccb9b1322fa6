"""The exact meniscus: the axisymmetric Young-Laplace equation, tabulated for the plant.

With the arc length s running inward from the flat melt, phi the slope against the horizontal and lengths in
capillary constants (Huh and Scriven, J. Colloid Interface Sci. 30, 1969):

    r_s = -cos(phi),   z_s = sin(phi),   phi_s = 2 z + sin(phi) / r.

Far out the surface is linear, z = c K_0(sqrt(2) r); at the triple point phi = pi/2 - theta. :data:`YOUNG_LAPLACE` is
the solution as polynomials that compile into the step::

    gym.make("Cz-v0", meniscus=YOUNG_LAPLACE)

The coefficients in ``young_laplace.json`` interpolate solutions by shooting at the Chebyshev points of both variables,
turned into powers: ``SLOPE`` corrects :func:`lift`, ``RING`` and ``TAIL`` correct :func:`exact_ring_offset`. A test
solves the equation again and compares (``tests/physics/test_meniscus.py``).
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.jit import jittable

from .meniscus import MeniscusModel, hurle_height, profile, ring_point

SQRT_2 = math.sqrt(2.0)
SLOPE, RING, TAIL = (np.array(rows) for rows in json.loads(Path(__file__).with_suffix(".json").read_text()).values())
"""Coefficients of the polynomials [-], shapes (9, 16), (9, 22) and (7, 8)."""
NARROWEST = 0.3
"""Largest a / r_c in the table: crystals of at least 25 mm radius, in silicon."""
LOWEST, HIGHEST = 0.1, 1.265
"""Meniscus heights in the table [a]; the slope's table reaches down to zero."""
RING_SLOPES = (math.radians(0.5), math.radians(15.0))
"""Slopes phi_b of the bright ring in the table [rad]."""
RING_REFERENCE = float(ring_point(math.radians(3.5)))
"""X_b at which the ring's first table stands [-]; the second moves it to another slope."""


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
