"""The table of signals of a whole crystal, as :mod:`cz_gym.body.signals` is of a body.

References are those of the length that has grown: against time the gain from pull speed to radius would change sign in
the crown.
"""

import math
from typing import Annotated, Any, NamedTuple

import numpy as np

from cz_gym.body import signals as body
from cz_gym.body.signals import outside
from cz_gym.jit import jittable
from cz_gym.physics.meniscus import hurle_slope
from cz_gym.physics.plant import bias_offset, drift
from cz_gym.process import DONE, HEATER_SCALE, PULL_SCALE, Past, Relative, read_drives, signals
from cz_gym.process import Channel as Channel
from cz_gym.support.units import MINUTE, MM

from . import recipe
from .plant import CrystalState, Disturbance, at_interface, meniscus_mass
from .recipe import end, height_inside, shape_at, value

_MEASURED, _STATE, _LOGGED = map(signals, (body.Measured, body.TrueState, body.Logged))
NEAR, FAR = 5.0 * MM, 25.0 * MM
"""Lengths ahead for which the recipe is observed [m]."""
CONSTANT_ERROR, WAVE_ERROR, WAVELENGTH = 1.36, 1.28, 0.3
"""The recipe's error along the crystal, in multiples of the final error that the scenario draws: a constant, and the
amplitude of a wave of this length [m]. On "randomized" their standard deviations are 3 K and 2 K."""
_ONE_WAVE = 100.0 * MINUTE
"""Start of the scenario's error that shifts the wave by its whole length [s]."""
WEIGHT_STEP = 0.01
"""Resolution of the load cell [kg]."""
LOAD_CELL_NOISE = 0.05 / (0.05 * MM)
"""Standard deviation of the load cell's white noise, in multiples of the one that the scenario draws for the camera
[kg/m]: up to 50 g on "randomized"."""
_T, _R = 10.0, 20.0 * MM


@jittable
def recipe_error(L: Any, e: Any) -> Any:
    """Error of the heater temperature in the recipe that is given, at a length [K]."""
    wave = np.sin(2.0 * math.pi * (L / WAVELENGTH + e.recipe_start / _ONE_WAVE))
    return e.recipe_amount * (CONSTANT_ERROR + WAVE_ERROR * wave)


@jittable
def weight(x: Any, noise: Any, p: Any) -> Any:
    """The load cell's reading [N]: crystal and meniscus, at Hurle's angle, and its noise [kg], in whole steps.

    A small imaginary part is not rounded.
    """
    h_c = height_inside(x.h_c, p)
    hangs = x.M_s + meniscus_mass(x.r_c, h_c, hurle_slope(x.r_c, h_c, p)[1], p) + noise
    return p.g * WEIGHT_STEP * np.rint(hangs.real / WEIGHT_STEP) + p.g * (hangs - hangs.real)


@jittable
def later(L: Any, by: Any, p: Any) -> Any:
    """A length further on [m], at most the whole crystal's."""
    further, last = L + by, end(p)
    return further if further.real < last else last + 0.0 * L


class Measured(NamedTuple):
    """Readings and recipe in a puller's control computer, in SI units; arrays of the batch's shape where decoded.

    Radii count from r_0, temperatures and the recipe's drives from the body's operating point.
    """

    ring_error: Annotated[
        Any,
        Channel("m", MM, "camera reading minus the recipe's ring at this length; the last valid error while invalid"),
    ]
    valid: Annotated[Any, Channel("1", 1.0, "1 if the camera shows a ring and says its reading is good, else 0")]
    r_ref: Annotated[Any, Channel("m", _R, "radius reference minus r_0, at this length")]
    r_ref_5mm: Annotated[Any, Channel("m", _R, "the same 5 mm later")]
    r_ref_25mm: Annotated[Any, Channel("m", _R, "the same 25 mm later")]
    T_1_ref: Annotated[Any, Channel("K", _T, "recipe of the heater temperature minus nominal, at this length")]
    T_1_ref_5mm: Annotated[Any, Channel("K", _T, "the same 5 mm later")]
    T_1_ref_25mm: Annotated[Any, Channel("K", _T, "the same 25 mm later")]
    T_1: Annotated[Any, Channel("K", _T, "pyrometer reading minus nominal")]
    v_p: Annotated[Any, Channel("m/s", PULL_SCALE, "applied pull speed minus the recipe's; the scale is v_0")]
    Q_H: Annotated[Any, Channel("W", HEATER_SCALE, "applied heater power minus the recipe's")]
    v_p_mean: Annotated[Any, _MEASURED["v_p_mean"]]
    alpha_ref: Annotated[Any, Channel("rad", 0.5, "cone angle of the recipe")]
    L: Annotated[Any, Channel("m", 0.2, "length grown since the crown began")]
    v_p_ref: Annotated[Any, Channel("m/s", PULL_SCALE, "the recipe's pull speed minus v_0; the scale is v_0")]
    Q_H_ref: Annotated[Any, Channel("W", HEATER_SCALE, "the recipe's heater power minus nominal")]
    weight: Annotated[Any, Channel("N", 5.0, "the load cell's reading minus the recipe's weight at this length")]
    edge_error: Annotated[
        Any, Channel("m", MM, "camera reading of the crystal's edge minus r_ref; the last valid error while invalid")
    ]
    edge_valid: Annotated[Any, Channel("1", 1.0, "1 if the camera shows no ring but the crystal's edge, else 0")]


@jittable
def measure(x: Any, u: Any, nominal: Any, memory: Any, readings: Any, slot: Any, t: Any) -> Any:
    """Readings and recipe of a slot at the time t of its sample [s]."""
    p, e, L, read = slot.puller, slot.episode, x.L, read_drives(u, slot)
    near, far = later(L, NEAR, p), later(L, FAR, p)
    now, shift = shape_at(L, p, e), drift(t, e) - p.T_1_0
    moves = 1.0 * (slot.k_seen == slot.k)  # a held edge has no derivative
    ring = readings.ring - now.r - value(L, slot, recipe._ring)
    edge = slot.edge + moves * (x.r_c - x.r_c.real) - now.r
    return Measured(
        ring_error=slot.valid * ring + (1.0 - slot.valid) * slot.ring_error,
        valid=slot.valid,
        r_ref=now.r - p.r_0,
        r_ref_5mm=shape_at(near, p, e).r - p.r_0,
        r_ref_25mm=shape_at(far, p, e).r - p.r_0,
        T_1_ref=value(L, slot, recipe._T_1) + recipe_error(L, e) + shift,
        T_1_ref_5mm=value(near, slot, recipe._T_1) + recipe_error(near, e) + shift,
        T_1_ref_25mm=value(far, slot, recipe._T_1) + recipe_error(far, e) + shift,
        T_1=readings.T_1 - (p.T_1_0 + e.told_temperature),
        v_p=read.v_p - nominal.v_p,
        Q_H=read.Q_H - nominal.Q_H,
        v_p_mean=e.pull_scale * memory.v_p_mean + (e.pull_scale - 1.0) * nominal.v_p + e.pull_offset,
        alpha_ref=np.arctan(now.slope),
        L=L,
        v_p_ref=nominal.v_p - p.v_0,
        Q_H_ref=nominal.Q_H - (p.Q_H_0 + e.told_power),
        weight=weight(x, slot.load_cell, p) - p.g * (value(L, slot, recipe._M_s) + value(L, slot, recipe._M_men)),
        edge_error=slot.edge_valid * edge + (1.0 - slot.edge_valid) * slot.edge_error,
        edge_valid=slot.edge_valid,
    )


_SHARED = signals(Measured)


class TrueState(NamedTuple):
    """The true state and the disturbances; deviations, SI units. For bounds and for training; no agent acts on it."""

    r_c_error: Annotated[Any, Channel("m", MM, "true radius minus the recipe's at this length")]
    h_c: Annotated[Any, Channel("m", MM, "true meniscus height minus the recipe's")]
    T_1: Annotated[Any, Channel("K", 5.0, "true heater temperature minus the perfect recipe's")]
    T_2: Annotated[Any, Channel("K", 5.0, "true susceptor temperature minus the perfect recipe's")]
    T_b: Annotated[Any, Channel("K", 5.0, "true melt temperature minus the perfect recipe's")]
    r_ref: Annotated[Any, _SHARED["r_ref"]]
    r_ref_5mm: Annotated[Any, _SHARED["r_ref_5mm"]]
    r_ref_25mm: Annotated[Any, _SHARED["r_ref_25mm"]]
    T_1_ref: Annotated[
        Any, Channel("K", 5.0, "recipe of the heater temperature, as it is given, minus the perfect one")
    ]
    v_p: Annotated[Any, _SHARED["v_p"]]
    Q_H: Annotated[Any, _SHARED["Q_H"]]
    v_p_mean: Annotated[Any, _SHARED["v_p_mean"]]
    alpha_ref: Annotated[Any, _SHARED["alpha_ref"]]
    L: Annotated[Any, _SHARED["L"]]
    v_p_ref: Annotated[Any, _SHARED["v_p_ref"]]
    Q_H_ref: Annotated[Any, _SHARED["Q_H_ref"]]
    M_s: Annotated[Any, Channel("kg", 0.5, "true mass of the crystal minus the recipe's at this length")]
    dT_i: Annotated[Any, _STATE["dT_i"]]
    Q_d: Annotated[Any, _STATE["Q_d"]]
    ring_offset: Annotated[Any, _STATE["ring_offset"]]
    lam: Annotated[Any, _STATE["lam"]]


@jittable
def true_state(slot: Any, measured: Any, t: Any) -> Any:
    """True state and disturbances of a slot at the time t of its sample [s]."""
    p, x, L = slot.puller, slot.x, slot.x.L
    return TrueState(
        r_c_error=x.r_c - p.r_0 - measured.r_ref,
        h_c=x.h_c - value(L, slot, recipe._h_c),
        T_1=x.T_1 - value(L, slot, recipe._T_1),
        T_2=x.T_2 - value(L, slot, recipe._T_2),
        T_b=x.T_b - value(L, slot, recipe._T_b),
        r_ref=measured.r_ref,
        r_ref_5mm=measured.r_ref_5mm,
        r_ref_25mm=measured.r_ref_25mm,
        T_1_ref=recipe_error(L, slot.episode) + drift(t, slot.episode) + slot.episode.told_temperature,
        v_p=slot.v_p - slot.v_p_nominal,
        Q_H=slot.Q_H - slot.Q_H_nominal,
        v_p_mean=slot.v_p_mean,
        alpha_ref=measured.alpha_ref,
        L=L,
        v_p_ref=measured.v_p_ref,
        Q_H_ref=measured.Q_H_ref,
        M_s=x.M_s - value(L, slot, recipe._M_s),
        dT_i=slot.dT_i,
        Q_d=slot.Q_d,
        ring_offset=bias_offset(t, slot.episode),
        lam=p.lam,
    )


class Logged(NamedTuple):
    """The entries of a step's ``info``, in SI units."""

    r_c: Annotated[Any, _LOGGED["r_c"]]
    r_br: Annotated[Any, _LOGGED["r_br"]]
    r_ref: Annotated[Any, Channel("m", 1.0, "radius reference at this length")]
    L: Annotated[Any, Channel("m", 1.0, "length grown since the crown began")]
    h_c: Annotated[Any, _LOGGED["h_c"]]
    h_ref: Annotated[Any, Channel("m", 1.0, "meniscus height of the recipe")]
    alpha_c: Annotated[Any, _LOGGED["alpha_c"]]
    v_g: Annotated[Any, _LOGGED["v_g"]]
    v_p: Annotated[Any, Channel("m/s", 1.0, "applied pull speed relative to the melt's surface")]
    v_p_ref: Annotated[Any, Channel("m/s", 1.0, "pull speed of the recipe")]
    Q_H: Annotated[Any, _LOGGED["Q_H"]]
    Q_H_ref: Annotated[Any, Channel("W", 1.0, "heater power of the recipe")]
    v_p_mean: Annotated[Any, Channel("m/s", 1.0, "exponential 30 min mean of v_p - v_p_ref")]
    T_1: Annotated[Any, _LOGGED["T_1"]]
    T_1_ref: Annotated[Any, Channel("K", 1.0, "recipe of the heater temperature, as it is given")]
    T_b: Annotated[Any, _LOGGED["T_b"]]
    M_s: Annotated[Any, Channel("kg", 1.0, "true mass of the crystal, its neck included")]
    weight: Annotated[Any, Channel("N", 1.0, "the load cell's reading, with noise")]
    H: Annotated[Any, Channel("m", 1.0, "depth of the melt in the crucible, which the lift follows")]
    v_over_G: Annotated[Any, Channel("1", 1.0, "v/G, growth rate by temperature gradient, relative to the recipe's")]
    dopant: Annotated[Any, Channel("1", 1.0, "dopant that the crystal takes up, relative to its first part's")]
    r_br_measured: Annotated[Any, Channel("m", 1.0, "the camera's reading of the ring, where it shows one")]
    edge_measured: Annotated[
        Any, Channel("m", 1.0, "the camera's reading of the crystal's edge, where it shows no ring")
    ]
    edge_valid: Annotated[Any, Channel("bool", 1.0, "whether the camera shows no ring but the crystal's edge")]
    ring_offset: Annotated[Any, _LOGGED["ring_offset"]]
    term_radius: Annotated[Any, _LOGGED["term_radius"]]
    term_pull: Annotated[Any, _LOGGED["term_pull"]]
    term_pull_step: Annotated[Any, _LOGGED["term_pull_step"]]
    term_heater_step: Annotated[Any, _LOGGED["term_heater_step"]]
    cost: Annotated[Any, Channel("1", 1.0, "1 if |r_c - r_ref| > 0.5 mm or v_p_mean is more than 3 % of v_0, else 0")]
    stage: Annotated[Any, Channel("1", 1.0, "0 crown, 1 body, 2 tail, by the length")]
    succeeded: Annotated[Any, Channel("bool", 1.0, "whether the length was reached")]
    action_clipped: Annotated[Any, _LOGGED["action_clipped"]]


@jittable
def out_of_tolerance(slot: Any, measured: Any) -> Any:
    """Constraint's cost of a step: 1 if radius or mean pull speed is out of tolerance, else 0."""
    error = slot.x.r_c - slot.puller.r_0 - measured.r_ref
    return outside(error, slot.v_p_mean / slot.puller.v_0)


@jittable
def succeeded(slot: Any) -> Any:
    """Success of an episode: 1 once its length was reached, else 0."""
    return 1.0 if slot.over == DONE else 0.0


@jittable
def part_at(L: Any, p: Any) -> Any:
    """Part of the crystal at a length: 0 in the crown, 1 in the body, 2 in the tail."""
    if p.crown_length > L:
        return 0.0
    return 1.0 if p.crown_length + p.body_length >= L else 2.0


@jittable
def logged(slot: Any, measured: Any, cost: Any, t: Any, ring: Any, m: Any) -> Any:
    """:class:`Logged` of a slot at its sample's time t [s], growth taken at a height within the limits; ``ring`` [m] is
    the true bright ring."""
    p, x, L = slot.puller, slot.x, slot.x.L
    inside = CrystalState(x.r_c, height_inside(x.h_c, p), x.T_1, x.T_2, x.T_b, L, x.A_s, x.M_s, x.N)
    at = at_interface(inside, Disturbance(slot.Q_d, slot.dT_i), p, m.slope)
    now, Phi_s = shape_at(L, p, slot.episode), value(L, slot, recipe._Phi_s)
    left = (p.M_0 - x.M_s) / p.M_0
    return Logged(
        r_c=x.r_c,
        r_br=ring,
        r_ref=p.r_0 + measured.r_ref,
        L=L,
        h_c=x.h_c,
        h_ref=value(L, slot, recipe._h_c),
        alpha_c=np.arctan(at.tan_alpha),
        v_g=at.v_g,
        v_p=slot.v_p,
        v_p_ref=slot.v_p_nominal,
        Q_H=slot.Q_H,
        Q_H_ref=slot.Q_H_nominal,
        v_p_mean=slot.v_p_mean,
        T_1=x.T_1,
        T_1_ref=p.T_1_0 + slot.episode.told_temperature + measured.T_1_ref,
        T_b=x.T_b,
        M_s=x.M_s,
        weight=weight(x, slot.load_cell, p),
        H=at.deep * p.H_ref,
        v_over_G=(at.v_g / at.Phi_s) / (now.v_g / Phi_s),
        dopant=x.N / left,
        r_br_measured=slot.ring,
        edge_measured=slot.edge,
        edge_valid=slot.edge_valid,
        ring_offset=bias_offset(t, slot.episode),
        term_radius=cost.radius,
        term_pull=cost.pull,
        term_pull_step=cost.pull_step,
        term_heater_step=cost.heater_step,
        cost=out_of_tolerance(slot, measured),
        stage=part_at(L, p),
        succeeded=succeeded(slot),
        action_clipped=slot.clipped,
    )


class BriefInfo(NamedTuple):
    """The entries of ``info="lean"``."""

    r_c: Any
    r_ref: Any
    cost: Any
    succeeded: Any


@jittable
def brief_info(slot: Any, measured: Any) -> Any:
    """True radius, its reference, whether the crystal is out of tolerance, and whether it is long enough."""
    r_ref = slot.puller.r_0 + measured.r_ref
    return BriefInfo(slot.x.r_c, r_ref, out_of_tolerance(slot, measured), succeeded(slot))


PAST = (*body.PAST, Past("edge_error", 0.2 * MM))
"""Signals whose past "history" shows."""
RELATIVE = (
    Relative("r_ref_5mm", "r_ref", 2.0 * MM, "change of the radius reference within 5 mm"),
    Relative("r_ref_25mm", "r_ref", 10.0 * MM, "change of the radius reference within 25 mm"),
    Relative("T_1_ref_5mm", "T_1_ref", 2.0, "change of the recipe within 5 mm"),
    Relative("T_1_ref_25mm", "T_1_ref", 5.0, "change of the recipe within 25 mm"),
    Relative("T_1", "T_1_ref", 2.0, "pyrometer reading minus recipe"),
)
"""The signals that "history" shows relative to another one."""
