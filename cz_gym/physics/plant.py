"""The plant: states, inputs, disturbances, the derived operating point, rates of change, and signals of time alone.

Everything here is a pure function of labelled tuples in SI units, kelvin and radians. ``p`` is a
:class:`Puller`, or a NumPy record with the same field names (what the compiled loop holds per slot); fields
may be floats, arrays or complex numbers. Heat flows both ways between melt and crystal: the interface takes
pi r_c^2 Phi_l from the melt, and the crystal covers a part of the surface that radiates.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from cz_gym.jit import force_inlined, jittable
from cz_gym.process import NO_OPERATING_POINT
from cz_gym.process import Inputs as Inputs
from cz_gym.process import rk4 as runge_kutta
from cz_gym.support.errors import CzError
from cz_gym.support.units import HOUR, MM

from .meniscus import HURLE, MeniscusModel, ring_point
from .parameters import Parameters, check_parameters

DRAW_SPAN = 3.0 * HOUR
"""Span [s] over which "uniform over the episode" is drawn, whatever the horizon: a draw never depends on it."""


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


class Disturbance(NamedTuple):
    """Disturbance d, held over a substep."""

    Q_d: Any
    """Heat load on the melt [W], positive heats."""
    dT_i: Any
    """Fluctuation of the temperature that drives the interface flux [K]."""
    melt: Any
    """Share of the initial melt heat capacity left [-]."""


class Growth(NamedTuple):
    """Growth at the interface."""

    v_g: Any
    """Growth rate [m/s]."""
    tan_alpha: Any
    """Tangent of the cone angle alpha_c = theta - alpha_0 [-]."""
    Phi_l: Any
    """Heat flux from the melt into the interface [W/m2]."""


class Heating(NamedTuple):
    """Rates of heater and crucible, and the heat that stays in the melt."""

    heater: Any
    """Rate of the heater's temperature [K/s]."""
    crucible: Any
    """Rate of the crucible's temperature [K/s]."""
    melt: Any
    """Heat that stays in the melt, without disturbance [W]."""


class Puller(NamedTuple):
    """The constants of one puller: the parameters in the rates, and those that follow from its operating point."""

    lam: float
    """Share of conduction in the interface flux [-]: 1 is Model I, 0 is Model II."""
    a: float
    """Capillary constant, a^2 = 2 sigma / (rho_l g) [m]."""
    sin_alpha_0: float
    """Sine of the contact angle [-]."""
    cos_alpha_0: float
    """Cosine of the contact angle [-]."""
    X_b: float
    """X(z_b) / M of the bright ring's slope [-]."""
    k_l: float
    """Thermal conductivity of the melt [W/m/K]."""
    layer: float
    """Depth of still melt that has the boundary layer's resistance, k_l R [m]."""
    rho_dH: float
    """Latent heat per volume of crystal, rho_s dH [J/m3]."""
    T_m: float
    """Melting temperature [K]."""
    C_1: float
    """Heat capacity of the heater [J/K]."""
    C_2: float
    """Heat capacity of susceptor and crucible [J/K]."""
    C_b: float
    """Heat capacity of the melt bulk [J/K]."""
    kappa_12: float
    """Radiative link heater to susceptor [W/K4]."""
    G_1a: float
    """Insulation loss of the heater [W/K]."""
    T_a: float
    """Ambient temperature [K]."""
    G_2b: float
    """Conductance of the quartz wall [W/K]."""
    emission: float
    """Radiation of the melt surface, eps sigma_SB [W/m2/K4]."""
    R_cr: float
    """Radius of the crucible [m]."""
    T_e: float
    """Temperature the melt surface sees [K]."""
    r_0: float
    """Nominal radius [m]."""
    v_0: float
    """Nominal pull speed [m/s]."""
    h_0: float
    """Nominal meniscus height, where alpha_c = 0 [m]."""
    Phi_s: float
    """Heat flux into the crystal [W/m2]."""
    T_1_0: float
    """Nominal heater temperature [K]."""
    T_2_0: float
    """Nominal susceptor temperature [K]."""
    T_b_0: float
    """Nominal melt temperature, T_m + dT_0 + Phi_l,0 R [K]."""
    Q_H_0: float
    """Nominal heater power [W]."""
    ring_bias: float
    """The operator's bias: bright ring minus radius at the operating point [m]."""

    @property
    def state_0(self) -> State:
        """The operating point's state."""
        return State(self.r_0, self.h_0, self.T_1_0, self.T_2_0, self.T_b_0)

    @property
    def inputs_0(self) -> Inputs:
        """The operating point's inputs."""
        return Inputs(self.v_0, self.Q_H_0)


NO_DISTURBANCE = Disturbance(0.0, 0.0, 1.0)


class _RingPuller(NamedTuple):
    """The fields the bright ring needs before the rest of the puller is known."""

    a: Any
    sin_alpha_0: Any
    cos_alpha_0: Any
    X_b: Any


@jittable
def derive_puller(q: Any, lam: Any, height: Any, ring_offset: Any) -> Any:
    """Solve the operating point in order: h_0, Phi_l0, Phi_s, Q_i0, T_2, T_1, Q_H0, ring bias.

    A boundary layer under the crystal changes no heat flux there; the melt below it is hotter.
    """
    a = np.sqrt(2.0 * q.sigma / (q.rho_l * q.g))
    h_0 = height(q.r_0, q.alpha_0, a)
    Phi_l_0 = q.k_l * q.dT_0 / h_0
    rho_dH = q.rho_s * q.dH
    Phi_s = Phi_l_0 + rho_dH * q.v_0
    emission = q.eps * q.sigma_SB
    T_b_0 = q.T_m + q.dT_0 + Phi_l_0 * q.R
    covered = math.pi * q.r_0 * q.r_0
    surface_loss = emission * (math.pi * q.R_cr * q.R_cr - covered) * (T_b_0**4 - q.T_e**4)
    through = surface_loss + covered * Phi_l_0
    T_2_0 = T_b_0 + through / q.G_2b
    T_1_0 = np.sqrt(np.sqrt(T_2_0**4 + through / q.kappa_12))
    Q_H_0 = through + q.G_1a * (T_1_0 - q.T_a)
    ring = _RingPuller(a=a, sin_alpha_0=np.sin(q.alpha_0), cos_alpha_0=np.cos(q.alpha_0), X_b=ring_point(q.phi_b))
    bias = ring_offset(q.r_0, h_0, ring)
    return Puller(
        lam=lam, a=a, sin_alpha_0=ring.sin_alpha_0, cos_alpha_0=ring.cos_alpha_0, X_b=ring.X_b,
        k_l=q.k_l, layer=q.k_l * q.R, rho_dH=rho_dH, T_m=q.T_m, C_1=q.C_1, C_2=q.C_2, C_b=q.C_b,
        kappa_12=q.kappa_12, G_1a=q.G_1a, T_a=q.T_a, G_2b=q.G_2b, emission=emission, R_cr=q.R_cr, T_e=q.T_e,
        r_0=q.r_0, v_0=q.v_0, h_0=h_0, Phi_s=Phi_s,
        T_1_0=T_1_0, T_2_0=T_2_0, T_b_0=T_b_0, Q_H_0=Q_H_0, ring_bias=bias,
    )  # fmt: skip


def make_puller(parameters: Parameters | None = None, lam: float = 1.0, meniscus: MeniscusModel = HURLE) -> Puller:
    """The puller of these parameters at its own steady state.

    ``lam`` is the share of conduction [-], 1 for Model I and 0 for Model II. Raises CzError for parameters
    that are no plausible numbers or have no finite operating point.
    """
    if not 0.0 <= lam <= 1.0:
        raise CzError(f"lam (share of conduction) must lie in [0, 1], not {lam!r}")
    q = check_parameters(parameters or Parameters())
    with np.errstate(all="ignore"):
        puller = derive_puller(q, float(lam), meniscus.height, meniscus.ring_offset)
    puller = Puller(*map(float, puller))
    if np.isfinite(puller.a) and not np.all(np.isfinite([puller.h_0, puller.ring_bias])):
        covers = f" ({meniscus.covers}; a = {puller.a:.4g} m)" if meniscus.covers else ""
        raise CzError(
            f"r_0 = {puller.r_0:g} m, alpha_0 or phi_b lies outside the range of the meniscus {meniscus.name!r}{covers}"
            f": its height is {puller.h_0:.4g} m, its bright ring {puller.ring_bias:.4g} m outside the crystal"
        )
    if not np.all(np.isfinite(puller)):
        raise CzError(NO_OPERATING_POINT)
    return puller


@force_inlined
def growth(x: Any, d: Any, p: Any, slope: Any) -> Any:
    """Growth rate from the interface's heat balance, and the cone angle from the meniscus slope."""
    sin_theta, cos_theta = slope(x.r_c, x.h_c, p)
    return interface(x, d, p, p.Phi_s, sin_theta, cos_theta)


@force_inlined
def interface(x: Any, d: Any, p: Any, Phi_s: Any, sin_theta: Any, cos_theta: Any) -> Any:
    """Growth with this heat flux into the crystal [W/m2], at this angle of the meniscus."""
    Phi_l = p.k_l * (x.T_b + d.dT_i - p.T_m) * (p.lam / (x.h_c + p.layer) + (1.0 - p.lam) / (p.h_0 + p.layer))
    v_g = (Phi_s - Phi_l) / p.rho_dH
    sin_alpha = sin_theta * p.cos_alpha_0 - cos_theta * p.sin_alpha_0
    cos_alpha = cos_theta * p.cos_alpha_0 + sin_theta * p.sin_alpha_0
    return Growth(v_g, sin_alpha / cos_alpha, Phi_l)


@jittable
def fourth_power(T: Any) -> Any:
    """T^4, as two squarings."""
    square = T * T
    return square * square


@force_inlined
def rates(x: Any, u: Any, d: Any, p: Any, slope: Any) -> Any:
    """Time derivatives of the state [m/s, m/s, K/s, K/s, K/s] (docs/physics.md)."""
    at_interface = growth(x, d, p, slope)
    heat = heating(x, u, p, p.G_2b, at_interface.Phi_l)
    return State(
        at_interface.v_g * at_interface.tan_alpha,
        u.v_p - at_interface.v_g,
        heat.heater,
        heat.crucible,
        (heat.melt + d.Q_d) / (p.C_b * d.melt),
    )


@force_inlined
def heating(x: Any, u: Any, p: Any, G_2b: Any, Phi_l: Any) -> Any:
    """Rates of heater and crucible, and the melt's heat, at this wall [W/K] and flux into the interface [W/m2]."""
    radiated = p.kappa_12 * (fourth_power(x.T_1) - fourth_power(x.T_2))
    into_melt = G_2b * (x.T_2 - x.T_b)
    covered = math.pi * x.r_c * x.r_c
    open_surface = math.pi * p.R_cr * p.R_cr - covered
    surface_loss = p.emission * open_surface * (fourth_power(x.T_b) - fourth_power(p.T_e))
    into_crystal = covered * Phi_l
    return Heating(
        (u.Q_H - radiated - p.G_1a * (x.T_1 - p.T_a)) / p.C_1,
        (radiated - into_melt) / p.C_2,
        into_melt - surface_loss - into_crystal,
    )


@force_inlined
def rk4(x: Any, u: Any, d: Any, p: Any, dt: Any, slope: Any) -> Any:
    """One classical Runge-Kutta step of dt [s], inputs and disturbance held."""
    return runge_kutta(rates, x, u, d, p, dt, slope)


@jittable
def hidden_load(p_drift: Any, p: Any) -> Any:
    """Heat load Q_d [W] that a recipe shifted by p_drift [K] would exactly cancel (static equivalence).

    Solves kappa_12 ((T_1,0 + p_drift)^4 - T_2^4) = G_2b (T_2 - T_b0) for T_2 by Newton from T_2,0: four steps
    reach rounding error for |p_drift| up to 100 K. Then Q_d = -G_2b (T_2 - T_2,0).
    """
    T_1 = p.T_1_0 + p_drift
    hot = p.kappa_12 * fourth_power(T_1) + p.G_2b * p.T_b_0
    T_2 = p.T_2_0 + 0.0 * p_drift
    for _ in range(4):
        cube = T_2 * T_2 * T_2
        excess = p.kappa_12 * cube * T_2 + p.G_2b * T_2 - hot
        T_2 = T_2 - excess / (4.0 * p.kappa_12 * cube + p.G_2b)
    return -p.G_2b * (T_2 - p.T_2_0)


def disturbance(t: Any, dT_i: Any, e: Any, p: Any) -> Disturbance:
    """Disturbance at a point t [s] of the 5 s grid, with the interface fluctuation [K] drawn there."""
    return Disturbance(hidden_load(drift(t, e), p), dT_i, melt_left(t, e))


# The task: the limits within which a crystal grows.

RADIUS_LIMIT = 8.0 * MM
"""Largest |r_c - r_ref| of the default puller [m]."""
HEIGHT_MIN = 1.2 * MM
"""Lowest meniscus before it freezes [m]."""
HEIGHT_MAX_IN_A = 1.24
"""Highest meniscus before it detaches [capillary constants]."""


def radius_limit(r_0: Any) -> Any:
    """Largest |r_c - r_ref| of a puller of nominal radius r_0 [m]: :data:`RADIUS_LIMIT`, in proportion to r_0."""
    return RADIUS_LIMIT * (r_0 / Parameters().r_0)


@jittable
def within_limits(r_c: Any, h_c: Any, r_ref: Any, a: Any, radius_limit: Any = RADIUS_LIMIT) -> Any:
    """True while the crystal grows; false if the meniscus freezes or detaches, the radius is lost, or one is NaN."""
    return (np.abs(r_c - r_ref) <= radius_limit) & (h_c >= HEIGHT_MIN) & (h_c <= HEIGHT_MAX_IN_A * a)


def check_height(puller: Puller) -> None:
    """Raise CzError unless the meniscus is within its limits at the puller's operating point."""
    highest = HEIGHT_MAX_IN_A * puller.a
    if not HEIGHT_MIN <= puller.h_0 <= highest:
        raise CzError(
            f"the nominal meniscus height {puller.h_0 / MM:.3g} mm of these parameters lies outside its limits, "
            f"{HEIGHT_MIN / MM:.3g} to {highest / MM:.3g} mm; check r_0, alpha_0, sigma and rho_l"
        )


# Signals of an episode that depend on time t [s] alone; ``e`` is an :class:`cz_gym.episodes.draw.Episode` or a record
# with its fields.


@jittable
def progress(t: Any, start: Any, duration: Any) -> Any:
    """Share of a ramp that is done at t [-], from 0 to 1."""
    return np.minimum(np.maximum((t - start) / duration, 0.0), 1.0)


@jittable
def quintic(s: Any) -> Any:
    """10 s^3 - 15 s^4 + 6 s^5: from 0 to 1 with zero rate and curvature at both ends."""
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


@jittable
def drift(t: Any, e: Any) -> Any:
    """Drift p(t) of the hot zone [K]."""
    return e.drift_amount * progress(t, e.drift_start, e.drift_duration) + e.drift_rate * t


@jittable
def recipe(t: Any, e: Any) -> Any:
    """Recipe T_1,ref(t) - T_1,0 = e(t) + p(t) [K]: its error plus the drift."""
    return e.recipe_amount * progress(t, e.recipe_start, e.recipe_duration) + drift(t, e)


@jittable
def reference(t: Any, e: Any) -> Any:
    """r_ref(t) - r_0 [m]."""
    return e.reference_amount * quintic(progress(t, e.reference_start, e.reference_duration))


@jittable
def melt_left(t: Any, e: Any) -> Any:
    """Share of the melt's heat capacity left [-]."""
    return 1.0 - e.melt_loss * progress(t, 0.0, DRAW_SPAN)


@jittable
def bias_offset(t: Any, e: Any) -> Any:
    """Offset of the ring [m] that no sensor shows: wrong bias, melt level and drift."""
    return e.ring_offset + e.bias_drift_amount * progress(t, e.bias_drift_start, e.bias_drift_duration)


@jittable
def ripple(t: Any, e: Any) -> Any:
    """Rotation-synchronous ripple of the ring [m] in a frame taken at t [s]."""
    return e.ripple_amplitude * np.sin(e.ripple_omega * t + e.ripple_phase)


@jittable
def pyrometer_drift(t: Any, e: Any) -> Any:
    """Drift of the pyrometer [K]."""
    return e.pyrometer_drift * progress(t, 0.0, DRAW_SPAN)
