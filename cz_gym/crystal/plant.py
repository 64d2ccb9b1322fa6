"""The parameters of a whole crystal, its stages, and its plant."""

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from cz_gym.episodes.draw import randomised
from cz_gym.jit import force_inlined, jittable, joined, labelled
from cz_gym.physics.parameters import (
    CrystalRecipe,
    Parameters,
    Sight,
    check_numbers,
    check_parameters,
    sight_of,
)
from cz_gym.physics.plant import Puller, derive_puller, heating, interface
from cz_gym.process import clip
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.units import MM

STAGES = ("crown", "body", "tail", "whole")
"""The parts of a crystal that an episode can grow."""
APART = (*STAGES, "begins", "heater_max")
"""Parameters that say which part is grown, and what the heater can do: the plant does not depend on them."""
DRAWN = -1.0
"""Value of ``begins`` where each stage begins at its own length."""
CrystalParameters: Any = NamedTuple(  # type: ignore[misc]
    "CrystalParameters",
    [(name, float) for name in (*Parameters._fields, *CrystalRecipe._fields, *Sight._fields, *APART)],
)
"""A puller's :class:`~cz_gym.physics.parameters.Parameters`, its :class:`~cz_gym.physics.parameters.CrystalRecipe`, its
camera's :class:`~cz_gym.physics.parameters.Sight`, the
share of episodes [-] that grow each of the :data:`STAGES`, the length [m] at which they begin, or :data:`DRAWN`, and
the heater's largest power [W]."""


def complete(parameters: Any, machine: Any, stage: Any = None) -> Any:
    """:data:`CrystalParameters` of a puller, the recipe in its file, and a stage, by default the crown.

    A stage is a name, names with their shares of the episodes, or the length [m] at which three hours of growth begin.
    Parameters that are complete keep their recipe, and without a stage their own.
    """
    if isinstance(parameters, CrystalParameters):
        return parameters if stage is None else parameters._replace(**_shares(stage, parameters))
    given = check_parameters(parameters)
    check_numbers("recipe's", machine.recipe)
    power = math.inf if machine.heater_max is None else machine.heater_max
    sight = sight_of(machine.pose(given), given.r_0)
    whole = CrystalParameters(*given, *map(float, machine.recipe), *sight, 1.0, 0.0, 0.0, 0.0, DRAWN, power)  # type: ignore[call-arg]
    return check_shape(whole if stage is None else whole._replace(**_shares(stage, whole)))


def check_shape(q: Any) -> Any:
    """Return the parameters; raise CzError for a crystal that has no such shape, or not in this crucible."""
    if q.body_length < 2.0 * q.crown_length:
        raise CzError(
            f"a tail needs a body: body_length_mm = {q.body_length / MM:g} must be at least twice crown_length_mm = "
            f"{q.crown_length / MM:g}"
        )
    if q.r_start >= q.r_0:
        raise CzError(f"start_radius_mm = {q.r_start / MM:g} must be less than radius_mm = {q.r_0 / MM:g}")
    return q


def _shares(stage: Any, q: Any) -> dict[str, float]:
    """The stages' shares and where they begin, as fields of the parameters."""
    fields: dict[str, Any] = dict.fromkeys(STAGES, 0.0) | {"begins": DRAWN}
    if isinstance(stage, Real) and not isinstance(stage, bool):
        end = q.crown_length + q.body_length + q.tail_length
        if not 0.0 <= stage < end:  # type: ignore[operator]
            raise CzError(f"stage = {float(stage):g} m begins outside of the crystal, which is {end:g} m long")
        return fields | {"body": 1.0, "begins": float(stage)}
    shares = {stage: 1.0} if isinstance(stage, str) else stage
    if not (isinstance(shares, Mapping) and shares):
        raise CzError(
            f"stage must be one of {', '.join(STAGES)}, a dict of them with shares, or a length, not {stage!r}"
        )
    for name, share in shares.items():
        if name not in STAGES:
            raise CzError(unknown_name_message("stage", name, STAGES, ", or a length in metres"))
        if not (isinstance(share, Real) and not isinstance(share, bool) and 0.0 < share < math.inf):  # type: ignore[operator]
            raise CzError(f"the share of stage {name!r} must be a positive number, not {share!r}")
    total = math.fsum(map(float, shares.values()))
    return fields | {name: float(share) / total for name, share in shares.items()}


def named(text: str) -> Any:
    """A stage as a command line has it: a name, or a length [m]."""
    try:
        return float(text)
    except ValueError:
        return text


def parts(q: Any) -> tuple[Parameters, CrystalRecipe]:
    """The puller's and the recipe's numbers in the parameters."""
    return labelled(Parameters, q), labelled(CrystalRecipe, q)


# The plant of a whole crystal: the body's equations, with heat into the crystal, melt and level that change.
#
# The crystal gives off heat as a fin does; the melt loses the crystal's mass, and its depth changes the wall that
# heats it. On a crystal without end over a charge without end, with m = beta = 0, these are the equations of
# :mod:`cz_gym.physics.plant`.


class CrystalState(NamedTuple):
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
    """The constants of a crystal, besides those of its puller: recipe, fin, charge, camera and stages."""

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
    lens_x: float
    lens_z: float
    wall_height: float
    pixel: float
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
        lens_x=q.lens_x, lens_z=q.lens_z, wall_height=q.wall_height, pixel=q.pixel,
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
    """Growth, heat fluxes and meniscus at the interface, which follow from the state."""

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
    """Growth, heat fluxes and meniscus at the interface of a state."""
    sin_theta, cos_theta = slope(x.r_c, x.h_c, p)
    M_men = meniscus_mass(x.r_c, x.h_c, cos_theta, p)
    deep = depth(x.M_s, M_men, p)
    Phi_s = crystal_flux(x.r_c, x.A_s, deep, p)
    grown = interface(x, d, p, Phi_s, sin_theta, cos_theta)
    return Interface(grown.v_g, grown.tan_alpha, grown.Phi_l, Phi_s, M_men, deep)


@force_inlined
def rates(x: Any, u: Any, d: Any, p: Any, m: Any) -> Any:
    """Time derivatives of the state, in SI units (docs/crystal.md)."""
    at = at_interface(x, d, p, m.slope)
    heat = heating(x, u, p, wall(at.deep, p), at.Phi_l)
    M_s_dot = p.rho_s * math.pi * x.r_c * x.r_c * at.v_g
    left = p.M_0 - x.M_s
    leaves = p.C_b / p.M_0 * (x.T_b - p.T_m) * M_s_dot
    return CrystalState(
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
