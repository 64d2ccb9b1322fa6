"""The plant of a whole crystal: the body's equations, with heat into the crystal, melt and level that change.

The crystal gives off heat as a fin does; the melt loses the crystal's mass, and its depth changes the wall that heats
it. On a crystal without end over a charge without end, with m = beta = 0, these are the equations of
:mod:`cz_gym.body.plant`.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from cz_gym.body.plant import Puller, derive_puller, heating, interface
from cz_gym.episodes.draw import randomised
from cz_gym.jit.compile import force_inlined, jittable, joined
from cz_gym.physics.arithmetic import clip


class State(NamedTuple):
    """Plant state x."""

    r_c: Any
    """Crystal radius [m]."""
    h_c: Any
    """Meniscus height [m]."""
    T_1: Any
    """Heater (pyrometer) temperature [K]."""
    T_2: Any
    """Susceptor and crucible temperature [K]."""
    T_b: Any
    """Melt bulk temperature [K]."""
    L: Any
    """Length grown since the crown began [m]."""
    A_s: Any
    """Area of the crystal's side, the neck's included [m2]."""
    M_s: Any
    """Mass of the crystal, the neck's included [kg]."""
    N: Any
    """Dopant in the melt, relative to the charge's [-]."""


class Disturbance(NamedTuple):
    """Disturbance d, held over a substep."""

    Q_d: Any
    """Heat load on the melt [W], positive heats."""
    dT_i: Any
    """Fluctuation of the temperature that drives the interface flux [K]."""


LONG = 30.0
"""Length of a fin from which on nothing changes, in its own lengths [-]; a complex tanh of 400 overflows."""
NO_DISTURBANCE = Disturbance(0.0, 0.0)


class Grown(NamedTuple):
    """The constants of a crystal, besides those of its puller: recipe, fin, charge and stages."""

    alpha_0: float
    """Contact angle [rad]."""
    rho_s: float
    """Density of the crystal [kg/m3]."""
    rho_l: float
    """Density of the melt [kg/m3]."""
    g: float
    """Gravity [m/s2]."""
    rim: float
    """Mass that a metre of radius of a vertical meniscus carries at its rim, 2 pi sigma / g [kg/m]."""
    H_ref: float
    """Depth of the whole charge in the crucible [m]."""
    l_0: float
    """Length over which the body's side takes up its heat flux, k_s (T_m - T_fin) / Phi_s,0 [m]."""
    M_0: float
    neck_length: float
    r_start: float
    crown_length: float
    body_length: float
    tail_length: float
    v_start: float
    v_crown: float
    v_body: float
    v_body_end: float
    v_tail: float
    k_s: float
    m: float
    beta: float
    k_0: float
    crown: float
    body: float
    tail: float
    whole: float
    begins: float


Crystal: Any = NamedTuple("Crystal", [(name, float) for name in (*Puller._fields, *Grown._fields)])  # type: ignore[misc]
"""The constants of one puller and its crystal: the body's operating point, and :class:`Grown`."""


@jittable
def derive(q: Any, f: Any, m: Any) -> Any:
    """The drawn puller at the body's operating point, with the constants of its crystal."""
    drawn = randomised(q, f)
    p = derive_puller(drawn, f.lam, m.height, m.ring_offset)
    grown = Grown(
        alpha_0=q.alpha_0, rho_s=q.rho_s, rho_l=q.rho_l, g=q.g, rim=2.0 * math.pi * drawn.sigma / q.g,
        H_ref=q.M_0 / (q.rho_l * math.pi * q.R_cr**2), l_0=q.k_s * (q.T_m - q.T_fin) / p.Phi_s,
        M_0=q.M_0, neck_length=q.neck_length, r_start=q.r_start,
        crown_length=q.crown_length, body_length=q.body_length, tail_length=q.tail_length,
        v_start=q.v_start, v_crown=q.v_crown, v_body=q.v_body, v_body_end=q.v_body_end, v_tail=q.v_tail,
        k_s=q.k_s, m=q.m, beta=q.beta, k_0=q.k_0,
        crown=q.crown, body=q.body, tail=q.tail, whole=q.whole, begins=q.begins,
    )  # fmt: skip
    return joined(Crystal, p, grown)


@force_inlined
def meniscus_mass(r_c: Any, h_c: Any, cos_theta: Any, p: Any) -> Any:
    """Mass that the meniscus holds above the melt's level [kg]: the exact balance of forces."""
    return p.rho_l * math.pi * r_c * r_c * h_c + p.rim * r_c * cos_theta


@force_inlined
def depth(M_s: Any, M_men: Any, p: Any) -> Any:
    """Depth of the melt in the crucible, relative to that of the whole charge [-]."""
    return (p.M_0 - M_s - M_men) / p.M_0


@force_inlined
def crystal_flux(r_c: Any, A_s: Any, deep: Any, p: Any) -> Any:
    """Heat flux from the interface into the crystal Phi_s [W/m2], at this relative depth of the melt."""
    thin = p.r_0 / r_c
    fin = np.tanh(clip(A_s / (2.0 * math.pi * r_c * p.l_0) * np.sqrt(thin), LONG))
    return p.Phi_s * thin**p.m * (1.0 - p.beta * (1.0 - deep)) * fin


@force_inlined
def wall(deep: Any, p: Any) -> Any:
    """Conductance of the crucible's wetted wall [W/K]."""
    return p.G_2b * (p.R_cr + 2.0 * p.H_ref * deep) / (p.R_cr + 2.0 * p.H_ref)


class Interface(NamedTuple):
    """What follows from the state at the interface."""

    v_g: Any
    """Growth rate [m/s]."""
    tan_alpha: Any
    """Tangent of the cone angle [-]."""
    Phi_l: Any
    """Heat flux from the melt [W/m2]."""
    Phi_s: Any
    """Heat flux into the crystal [W/m2]."""
    M_men: Any
    """Mass of the meniscus [kg]."""
    deep: Any
    """Depth of the melt relative to the whole charge's [-]."""


@force_inlined
def at_interface(x: Any, d: Any, p: Any, slope: Any) -> Any:
    """:class:`Interface` of a state."""
    sin_theta, cos_theta = slope(x.r_c, x.h_c, p)
    M_men = meniscus_mass(x.r_c, x.h_c, cos_theta, p)
    deep = depth(x.M_s, M_men, p)
    Phi_s = crystal_flux(x.r_c, x.A_s, deep, p)
    grown = interface(x, d, p, Phi_s, sin_theta, cos_theta)
    return Interface(grown.v_g, grown.tan_alpha, grown.Phi_l, Phi_s, M_men, deep)


@force_inlined
def rates(x: Any, u: Any, d: Any, p: Any, m: Any) -> Any:
    """Time derivatives of the state; design equations of section 10."""
    at = at_interface(x, d, p, m.slope)
    heat = heating(x, u, p, wall(at.deep, p), at.Phi_l)
    M_s_dot = p.rho_s * math.pi * x.r_c * x.r_c * at.v_g
    left = p.M_0 - x.M_s
    leaves = p.C_b / p.M_0 * (x.T_b - p.T_m) * M_s_dot
    return State(
        at.v_g * at.tan_alpha,
        u.v_p - at.v_g,
        heat.heater,
        heat.crucible,
        (heat.melt + d.Q_d + leaves) / (p.C_b * (left / p.M_0)),
        at.v_g,
        2.0 * math.pi * x.r_c * at.v_g * np.sqrt(1.0 + at.tan_alpha * at.tan_alpha),
        M_s_dot,
        -p.k_0 * x.N / left * M_s_dot,
    )
