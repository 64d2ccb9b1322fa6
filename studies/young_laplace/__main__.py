"""Compute the polynomials of the exact meniscus and write them to ``cz_gym/physics/young_laplace.json``.

``python -m studies.young_laplace`` compares them with the table there is, and writes only with ``--write``. The exact
solution is sampled at Chebyshev points, where interpolation converges as fast as the function is smooth; what is stored
are the powers' coefficients.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence

import numpy as np
from numpy.polynomial import chebyshev
from scipy.optimize import brentq

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.commands import OneLineParser
from cz_gym.physics import young_laplace as exact
from cz_gym.physics.linearisation import Floats
from cz_gym.physics.meniscus import profile, ring_point
from cz_gym.physics.young_laplace import RING, SLOPE, TABLE, TAIL


def build() -> dict[str, Floats]:
    """Solve the meniscus at the nodes of the tables; a few seconds.

    Coefficients [-] of the polynomials of :func:`cz_gym.physics.young_laplace.polynomial`, by powers.
    """
    wanted = {"SLOPE": (_slope_correction, 9, 16), "RING": (_ring_correction, 9, 22), "TAIL": (_tail_correction, 7, 8)}
    return {name: _fit(*how) for name, how in wanted.items()}


def _fit(function: Callable[[Floats, Floats], Floats], m: int, n: int) -> Floats:
    """Interpolate at the m x n Chebyshev points of [-1, 1]^2 and turn the series into powers."""
    x, y = chebyshev.chebpts1(m), chebyshev.chebpts1(n)
    X, Y = np.meshgrid(x, y, indexing="ij")
    values = function(X.ravel(), Y.ravel()).reshape(m, n)
    series = np.linalg.solve(chebyshev.chebvander(x, m - 1), values)
    series = np.linalg.solve(chebyshev.chebvander(y, n - 1), series.T).T
    return np.apply_along_axis(chebyshev.cheb2poly, 1, np.apply_along_axis(chebyshev.cheb2poly, 0, series))


def _radius(x: Floats) -> Floats:
    return 2.0 / (exact.NARROWEST * (x + 1.0))


def _middle(y: Floats, low: float, high: float) -> Floats:
    return 0.5 * (low + high + y * (high - low))


def _slope_correction(x: Floats, y: Floats) -> Floats:
    r, square = _radius(x), _middle(y, 0.0, exact.HIGHEST**2)
    theta = exact.solve(r, np.sqrt(square), 1.0, np.radians(3.5)).theta
    # 1 - sin(theta) without the cancellation near theta = pi/2.
    lift = 2.0 * np.square(np.sin(0.25 * np.pi - 0.5 * theta))
    return r * (lift / square - 1.0)


def _ring_correction(x: Floats, y: Floats) -> Floats:
    r, q = _radius(x), _middle(y, exact.Q_LOW, exact.Q_HIGH)
    h = exact.SQRT_2 / np.cosh(q)
    offset = exact.solve(r, h, 1.0, np.radians(3.5)).ring_offset
    correction: Floats = r * (offset - (exact.RING_REFERENCE - profile(h, 1.0)))
    return correction


def _tail_correction(x: Floats, y: Floats) -> Floats:
    """How far the ring moves between the reference slope, at radius r, and another one, against the planar meniscus."""
    r, X_b = _radius(x), _middle(y, exact.X_LOW, exact.X_HIGH)
    slope = np.array(
        [brentq(lambda slope, at=at: ring_point(slope) - at, *exact.RING_SLOPES, xtol=1e-16) for at in X_b]
    )
    reference = np.full_like(r, np.radians(3.5))
    start = exact.shoot(lambda outer: exact.turn(outer, reference)[0], r + exact.planar_width(reference), r)
    moved = exact.turn(start, slope)[0] - r
    return r * (moved / (X_b - exact.RING_REFERENCE) - 1.0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code. Compares, and with ``--write`` replaces the table."""
    parser = OneLineParser(
        "python -m studies.young_laplace", "Compute the exact meniscus and compare it with the table."
    )
    parser.add_argument("--write", action="store_true", help=f"replace {TABLE.name} by what was computed")
    return parser.run(_compare, arguments, "benchmark")


def _compare(given: argparse.Namespace) -> None:
    if given.write:
        check_writable(TABLE.parent)
    tables = build()
    if given.write:
        rows = {name: table.tolist() for name, table in tables.items()}
        write_files({TABLE: (json.dumps(rows, indent=1) + "\n").encode()})
    worst = max(float(np.max(np.abs(new - old))) for new, old in zip(tables.values(), (SLOPE, RING, TAIL), strict=True))
    print(f"largest difference from the coefficients there were: {worst:.2g}")
    print(f"wrote {TABLE.name}" if given.write else f"nothing written; --write replaces {TABLE.name}")


if __name__ == "__main__":
    sys.exit(main())
