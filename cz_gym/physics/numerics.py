"""Arithmetic of numbers and of labelled tuples: limits, and the integration of any process."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.jit import compiled_as, force_inlined, jittable
from cz_gym.process import Inputs, Process


@jittable
def clip(value: Any, limit: Any) -> Any:
    """The value limited to +-limit, a complex one by its real part; NaN stays NaN."""
    if value.real < -limit:
        return -limit
    return limit if value.real > limit else value


def along(x: Any, s: Any, k: Any) -> Any:
    """The labelled tuple x + s k."""
    return type(x)(*(value + s * rate for value, rate in zip(x, k, strict=True)))


@compiled_as(along)
def _along(x: Any, s: Any, k: Any) -> Any:
    fields = ", ".join(f"x.{name} + s * k.{name}" for name in x.instance_class._fields)
    return [f"return X({fields})"], {"X": x.instance_class}


def plus_product(start: Any, s: Any, k: Any, rows: Any, j: Any) -> Any:
    """``start`` plus the sum of s k times column j of ``rows``, one row for each field of k, in their order."""
    for row, value in enumerate(k):
        start = start + (s * value) * rows[row, j]
    return start


@compiled_as(plus_product)
def _plus_product(start: Any, s: Any, k: Any, rows: Any, j: Any) -> Any:
    terms = (f"(s * k.{name}) * rows[{row}, j]" for row, name in enumerate(k.instance_class._fields))
    return [f"return {' + '.join(['start', *terms])}"], {}


@force_inlined
def rk4(rates: Any, x: Any, u: Any, d: Any, p: Any, dt: Any, m: Any) -> Any:
    """One classical Runge-Kutta step of dt [s], inputs and disturbance held."""
    k_1 = rates(x, u, d, p, m)
    k_2 = rates(along(x, 0.5 * dt, k_1), u, d, p, m)
    k_3 = rates(along(x, 0.5 * dt, k_2), u, d, p, m)
    k_4 = rates(along(x, dt, k_3), u, d, p, m)
    return along(along(along(along(x, dt / 6.0, k_1), dt / 3.0, k_2), dt / 3.0, k_3), dt / 6.0, k_4)


# A process as control engineers write it: a state space at any point.
#
# Derivatives are taken by complex step through the very functions that are simulated, so they are exact to rounding:
# f'(x) = Im f(x + i h) / h with a step h so small that nothing is subtracted (Squire and Trapp, SIAM Review 1998).

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
