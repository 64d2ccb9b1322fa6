"""The best corrections of ``ekf-mpc`` within the drives' limits: a Newton step, or CasADi's quadratic programme."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from cz_gym.baselines.bounds.trajectory import Limits
from cz_gym.baselines.policy import Floats

from .model import U, casadi
from .prediction import Prediction

SOLVER = "qrqp"
"""CasADi's own active-set solver."""
NOW = 2 * U
"""Limits on the move to be made now: both inputs and both moves."""


def best_corrections(H: Floats, g: Floats, prediction: Prediction, blocks: tuple[int, ...], limits: Limits) -> Floats:
    """Minimise 1/2 c' H c + g' c for each slot, inputs and moves within limits where a block begins; shape (n, c).

    Only slots that the limits concern need the programme. Where not all limits can be kept at once (within a block the
    law's own moves are not limited), those of the move to be made now are kept; failing that, as when a drive was left
    beyond its limits, the step without limits stands, to be clipped.
    """
    corrections = np.array(-np.linalg.solve(H, g[:, :, None])[:, :, 0], np.float64)
    at = np.cumsum((0, *blocks[:-1]))
    n, n_c = g.shape
    rows = prediction.outputs_c[:, at, 1:].reshape(n, NOW * len(at), n_c)
    free = prediction.outputs[:, at, 1:].reshape(n, NOW * len(at))
    most = np.tile(np.concatenate([limits.span, limits.move]), len(at))
    reached = free + (rows @ corrections[:, :, None])[:, :, 0]
    for i in np.flatnonzero((np.abs(reached) > most).any(axis=1)):
        for kept in (len(most), NOW):
            found = _programme(H[i], g[i], rows[i, :kept], free[i, :kept], most[:kept])
            if found is not None:
                corrections[i] = found
                break
    return corrections


def _programme(H: Floats, g: Floats, rows: Floats, free: Floats, most: Floats) -> Floats | None:
    """The best corrections with |free + rows c| <= most, or None if there are none."""
    solver = _solver(len(g), len(free))
    found = solver(h=H, g=g, a=rows, lba=-most - free, uba=most - free)
    best: Floats = found["x"].full().ravel()
    return best if solver.stats()["success"] else None


@lru_cache(maxsize=4)
def _solver(corrections: int, limited: int) -> Any:
    ca = casadi()
    dense = {"h": ca.Sparsity.dense(corrections, corrections), "a": ca.Sparsity.dense(limited, corrections)}
    quiet = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False}
    return ca.conic("programme", SOLVER, dense, quiet)
