"""The body's plant as control engineers write it: its state space, and G_p and G_m of the growth dynamics."""

from typing import Any, NamedTuple

import numpy as np

from cz_gym.physics.linearisation import StateSpace
from cz_gym.physics.linearisation import linearise as linearise_process
from cz_gym.physics.meniscus import HURLE, MeniscusModel

from .plant import NO_DISTURBANCE, Disturbance, Inputs, Puller, State, growth
from .process import BODY

STATES = State._fields
"""Rows and columns of A."""
LOADS = ("Q_d", "dT_i")
INPUTS = (*Inputs._fields, *LOADS)
"""Columns of B and D: both inputs, then both disturbances."""
OUTPUTS = ("r_c", "r_br", "v_g", "alpha_c")
"""Rows of C and D."""


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


def linearise(
    puller: Puller,
    meniscus: MeniscusModel = HURLE,
    x: State | None = None,
    u: Inputs | None = None,
    d: Disturbance = NO_DISTURBANCE,
) -> StateSpace:
    """Linearise the plant and its bright ring at a state, by default the operating point.

    States :data:`STATES`, inputs :data:`INPUTS`, outputs :data:`OUTPUTS`.
    """

    def seen(x: Any, u: Any, d: Any) -> Any:
        at_interface = growth(x, d, puller, meniscus.slope)
        ring = x.r_c + meniscus.ring_offset(x.r_c, x.h_c, puller)
        return x.r_c, ring, at_interface.v_g, np.arctan(at_interface.tan_alpha)

    at = x or puller.state_0, u or puller.inputs_0, d
    return linearise_process(BODY, puller, meniscus, at, LOADS, seen)


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
