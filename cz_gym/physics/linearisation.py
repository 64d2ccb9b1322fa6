"""The plant as control engineers write it: a state space at any point, and G_p and G_m of the growth dynamics.

Derivatives are taken by complex step through the very functions that are simulated, so they are exact to rounding:
f'(x) = Im f(x + i h) / h with a step h so small that nothing is subtracted (Squire and Trapp, SIAM Review 1998).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.plant import NO_DISTURBANCE, Disturbance, Inputs, Puller, State, growth, rates

from .meniscus import HURLE, MeniscusModel

Floats = npt.NDArray[np.float64]
STATES = State._fields
"""Rows and columns of A."""
INPUTS = (*Inputs._fields, "Q_d", "dT_i")
"""Columns of B and D: both inputs, then both disturbances."""
OUTPUTS = ("r_c", "r_br", "v_g", "alpha_c")
"""Rows of C and D."""
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


class RadiusModel(NamedTuple):
    """Pull speed to bright ring at constant melt temperature, as a series of two transfer functions.

    G_p(s) = numerator / ((s - poles[0]) (s - poles[1])) from v_p to r_c, G_m(s) = lead s + constant from r_c to r_br.
    """

    numerator: float
    """Gain of G_p [1/s]."""
    poles: tuple[float, float]
    """Poles of G_p, that of the cone angle first, then that of the meniscus height [rad/s]."""
    lead: float
    """Coefficient of s in G_m [s]."""
    constant: float
    """Static gain of G_m [-]."""

    @property
    def zero(self) -> float:
        """Zero of G_m [rad/s]; in the right half plane it is the inverse response."""
        return -self.constant / self.lead


def jacobian(function: Callable[..., Any], at: tuple[float, ...]) -> Floats:
    """Derivatives of a function of len(at) numbers that returns a tuple, by complex step; shape (values, len(at))."""
    columns = []
    for j in range(len(at)):
        shifted: list[complex] = list(at)
        shifted[j] = complex(at[j], _STEP)
        columns.append(np.imag(np.array(function(*shifted), np.complex128)) / _STEP)
    return np.stack(columns, axis=1)


def linearise(
    puller: Puller,
    meniscus: MeniscusModel = HURLE,
    x: State | None = None,
    u: Inputs | None = None,
    d: Disturbance = NO_DISTURBANCE,
) -> StateSpace:
    """Linearise the plant and its bright ring at a state, by default the operating point.

    States :data:`STATES`, inputs :data:`INPUTS`, outputs :data:`OUTPUTS`. The point need not be a steady state: the
    result describes deviations from the trajectory through it.
    """
    x, u = x or puller.state_0, u or puller.inputs_0

    def motion(*values: Any) -> Any:
        state, inputs, load = _labelled(values, d)
        return rates(state, inputs, load, puller, meniscus.slope)

    def seen(*values: Any) -> Any:
        state, _, load = _labelled(values, d)
        at_interface = growth(state, load, puller, meniscus.slope)
        return (
            state.r_c,
            state.r_c + meniscus.ring_offset(state.r_c, state.h_c, puller),
            at_interface.v_g,
            np.arctan(at_interface.tan_alpha),
        )

    point = (*x, *u, d.Q_d, d.dT_i)
    AB, CD = jacobian(motion, point), jacobian(seen, point)
    n = len(STATES)
    return StateSpace(AB[:, :n], AB[:, n:], CD[:, :n], CD[:, n:])


def radius_model(puller: Puller, meniscus: MeniscusModel = HURLE) -> RadiusModel:
    """G_p and G_m at the operating point, melt temperature held (Part II, section on the linearised model).

    With r_c' = A_rr r_c + A_rh h_c and h_c' = A_hh h_c + v_p (the height does not feel the radius), G_p's numerator is
    A_rh and its poles are A_rr and A_hh; eliminating h_c from r_br = C_r r_c + C_h h_c gives G_m.
    """
    A, B, C, _ = linearise(puller, meniscus)
    r, h = STATES.index("r_c"), STATES.index("h_c")
    C_r, C_h = C[OUTPUTS.index("r_br"), [r, h]]
    lead = C_h / A[r, h]
    return RadiusModel(
        numerator=float(A[r, h] * B[h, INPUTS.index("v_p")]),
        poles=(float(A[r, r]), float(A[h, h])),
        lead=float(lead),
        constant=float(C_r - lead * A[r, r]),
    )


def _labelled(values: tuple[Any, ...], d: Disturbance) -> tuple[State, Inputs, Disturbance]:
    n = len(STATES)
    return State(*values[:n]), Inputs(*values[n : n + 2]), Disturbance(values[-2], values[-1], d.melt)
