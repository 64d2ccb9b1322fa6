"""A process as control engineers write it: a state space at any point.

Derivatives are taken by complex step through the very functions that are simulated, so they are exact to rounding:
f'(x) = Im f(x + i h) / h with a step h so small that nothing is subtracted (Squire and Trapp, SIAM Review 1998).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.process import Inputs, Process

Floats = npt.NDArray[np.float64]
_STEP = 1e-30


class StateSpace(NamedTuple):
    """x' = A x + B u, y = C x + D u, all deviations from the point of linearisation; SI units, radians."""

    A: Floats
    """Shape (n, n)."""
    B: Floats
    """Shape (n, inputs)."""
    C: Floats
    """Shape (outputs, n)."""
    D: Floats
    """Shape (outputs, inputs)."""


def jacobian(function: Callable[..., Any], at: tuple[float, ...]) -> Floats:
    """Derivatives of a function of len(at) numbers that returns a tuple, by complex step; shape (values, len(at))."""
    columns = []
    for j in range(len(at)):
        shifted: list[complex] = list(at)
        shifted[j] = complex(at[j], _STEP)
        columns.append(np.imag(np.array(function(*shifted), np.complex128)) / _STEP)
    return np.stack(columns, axis=1)


def linearise(
    process: Process, p: Any, m: Any, at: tuple[Any, Any, Any], loads: tuple[str, ...], outputs: Callable[..., Any]
) -> StateSpace:
    """Linearise a process with constants p on a meniscus m around state, inputs and disturbance ``at``.

    Inputs are the drives and the fields ``loads`` of the disturbance; ``outputs(x, u, d)`` is a tuple. The point need
    not be a steady state: the result describes deviations from the trajectory through it.
    """
    x, u, d = at
    n, driven = len(x), len(x) + len(u)

    def labelled(values: tuple[Any, ...]) -> tuple[Any, Any, Any]:
        held = d._replace(**dict(zip(loads, values[driven:], strict=True)))
        return type(x)(*values[:n]), Inputs(*values[n:driven]), held

    point = (*x, *u, *(getattr(d, name) for name in loads))
    AB = jacobian(lambda *values: process.rates(*labelled(values), p, m), point)
    CD = jacobian(lambda *values: outputs(*labelled(values)), point)
    return StateSpace(AB[:, :n], AB[:, n:], CD[:, :n], CD[:, n:])
