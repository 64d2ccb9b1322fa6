"""The shape of a crystal and its growth rate against the length L [m] grown since the crown began.

``p`` holds the numbers of a :class:`cz_gym.physics.parameters.CrystalRecipe`, ``e`` the episode's change of the
reference, whose start and duration are lengths [m] here. All functions take complex lengths, for derivatives.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from cz_gym.episodes.draw import FREEZES, Stream
from cz_gym.episodes.rng import uniform
from cz_gym.jit import jittable, labelled
from cz_gym.physics.plant import DRAW_SPAN, HEIGHT_MAX_IN_A, fourth_power, quintic
from cz_gym.process import DONE, GROWS, LOST
from cz_gym.support.units import HOUR, MM

from .plant import CrystalState, at_interface, crystal_flux, depth, meniscus_mass, wall

_OPENS, _ROUNDS = 40.0 / 90.0, 20.0 / 90.0
"""Shares of the crown over which its slope rises and falls."""
_CLOSES, _ENDS = 50.0 / 175.0, 20.0 / 175.0
"""Shares of the tail over which its slope rises and falls."""
_SLOWS, _SPEEDS, _SPEED = 50.0 / 90.0, 75.0 / 90.0, 60.0 / 90.0
"""Shares of the crown over which the growth rate falls, after which it rises, and over which it rises."""
_KNEE = 0.5
"""Length over which the body's falling growth rate begins and ends, in lengths of the crown [-]."""
_TAIL_SPEEDS = 100.0 / 175.0
"""Share of the tail over which the growth rate rises."""


class Shape(NamedTuple):
    """The recipe at a length."""

    r: Any
    """Radius [m]."""
    slope: Any
    """dr/dL, the tangent of the cone angle [-]."""
    v_g: Any
    """Growth rate [m/s]."""


@jittable
def step(L: Any, at: Any, over: Any) -> Any:
    """From 0 to 1 along the quintic of the schedules, over a length from ``at`` on [-]."""
    s = (L - at) / over
    if s.real <= 0.0:
        return 0.0 * s
    return 0.0 * s + 1.0 if s.real >= 1.0 else quintic(s)


@jittable
def ramp(L: Any, at: Any, over: Any) -> Any:
    """Integral of :func:`step` along the length [m]."""
    s = (L - at) / over
    if s.real <= 0.0:
        return 0.0 * s
    return L - at - 0.5 * over if s.real >= 1.0 else over * s * s * s * s * (2.5 + s * (s - 3.0))


@jittable
def shape_at(L: Any, p: Any, e: Any) -> Any:
    """:class:`Shape` at a length; before the crown and after the tail a cylinder."""
    crown, tail, body_ends = p.crown_length, p.tail_length, p.crown_length + p.body_length
    opens, rounds = _OPENS * crown, _ROUNDS * crown
    closes, ends = _CLOSES * tail, _ENDS * tail
    rounds_at, ends_at = crown - rounds, body_ends + tail - ends
    wide = (p.r_0 - p.r_start) / (rounds_at + 0.5 * rounds - 0.5 * opens)
    amount, over = e.reference_amount, e.reference_duration
    narrow = (p.r_0 + amount - p.r_start) / (tail - 0.5 * ends - 0.5 * closes)
    r = (
        p.r_start
        + wide * (ramp(L, 0.0, opens) - ramp(L, rounds_at, rounds))
        + amount * step(L, e.reference_start, over)
        - narrow * (ramp(L, body_ends, closes) - ramp(L, ends_at, ends))
    )
    s = (L - e.reference_start) / over
    bend = 30.0 * (s * (1.0 - s)) ** 2 if 0.0 < s.real < 1.0 else 0.0 * s
    slope = (
        wide * (step(L, 0.0, opens) - step(L, rounds_at, rounds))
        + amount / over * bend
        - narrow * (step(L, body_ends, closes) - step(L, ends_at, ends))
    )
    return Shape(r, slope, growth_rate(L, p))


@jittable
def growth_rate(L: Any, p: Any) -> Any:
    """Growth rate at a length [m/s]."""
    crown, body_ends, knee = p.crown_length, p.crown_length + p.body_length, _KNEE * p.crown_length
    falls_at = (_SPEEDS + _SPEED) * crown
    fall = (p.v_body_end - p.v_body) / (body_ends - knee - falls_at)
    return (
        p.v_start
        + (p.v_crown - p.v_start) * step(L, 0.0, _SLOWS * crown)
        + (p.v_body - p.v_crown) * step(L, _SPEEDS * crown, _SPEED * crown)
        + fall * (ramp(L, falls_at, knee) - ramp(L, body_ends - knee, knee))
        + (p.v_tail - p.v_body_end) * step(L, body_ends, _TAIL_SPEEDS * p.tail_length)
    )


@jittable
def in_cone(L: Any, p: Any) -> Any:
    """True if a length lies in crown or tail."""
    return (L.real < p.crown_length) | (L.real > p.crown_length + p.body_length)


# The recipe by flat inversion: from shape and growth rate against length follow height, temperatures and drives.
#
# Nothing is integrated in time. Shape gives the cone angle and with it the meniscus height, growth rate the heat flux
# from the melt and with it the melt's temperature; what its rate of change needs gives the crucible's, and so on to
# the power. The result is a table against length, one for each drawn puller, in ``slot.table``.

ROWS, MARGIN = 512, 8
"""Rows of the table, and those before the crown and after the tail."""
_NEAR = 1.0 / 64.0
"""Distance over which the meniscus height is differentiated, in rows [-]."""


class RecipeRow(NamedTuple):
    """A row of the table: the recipe at a length, apart from shape and growth rate."""

    t: Any
    """Time since the crown began [s]."""
    v_p: Any
    """Pull speed relative to the melt's surface [m/s]."""
    Q_H: Any
    """Heater power [W]."""
    T_1: Any
    """Heater temperature [K]."""
    T_2: Any
    """Crucible temperature [K]."""
    T_b: Any
    """Melt temperature [K]."""
    h_c: Any
    """Meniscus height [m]."""
    ring: Any
    """Bright ring minus radius [m]."""
    A_s: Any
    """Area of the crystal's side [m2]."""
    M_s: Any
    """Mass of the crystal [kg]."""
    M_men: Any
    """Mass of the meniscus [kg]."""
    Phi_s: Any
    """Heat flux into the crystal [W/m2]."""
    needed: Any
    """Heat to be given to the melt beyond the heating [W]; then the heat through the crucible's wall."""


TABLE = (ROWS, len(RecipeRow._fields))
_t, _v_p, _Q_H, _T_1, _T_2, _T_b, _h_c, _ring, _A_s, _M_s, _M_men, _Phi_s, _needed = range(TABLE[1])


@jittable
def spacing(p: Any) -> Any:
    """Length between two rows [m]."""
    return (p.crown_length + p.body_length + p.tail_length) / (ROWS - 1 - 2 * MARGIN)


@jittable
def fill(table: Any, p: Any, e: Any, m: Any) -> None:
    """Write the recipe of a puller, whose reference changes as ``e`` says, into an array of shape :data:`TABLE`."""
    dL = spacing(p)
    _grow(table, p, e, dL)
    for row in range(ROWS):
        _balance(table, row, p, e, dL, m)
    for row in range(ROWS):
        gained = p.C_b * ((p.M_0 - table[row, _M_s]) / p.M_0) * _rate(table, row, _T_b, dL, p)
        deep = depth(table[row, _M_s], table[row, _M_men], p)
        through = gained + table[row, _needed]
        table[row, _T_2] = table[row, _T_b] + through / wall(deep, p)
        table[row, _needed] = through
    for row in range(ROWS):
        radiated = p.C_2 * _rate(table, row, _T_2, dL, p) + table[row, _needed]
        table[row, _T_1] = np.sqrt(np.sqrt(fourth_power(table[row, _T_2]) + radiated / p.kappa_12))
        table[row, _needed] = radiated
    for row in range(ROWS):
        lost = p.G_1a * (table[row, _T_1] - p.T_a)
        table[row, _Q_H] = p.C_1 * _rate(table, row, _T_1, dL, p) + table[row, _needed] + lost


@jittable
def _grow(table: Any, p: Any, e: Any, dL: Any) -> None:
    """Write time, side area and mass: Simpson's rule from row to row, from the neck on."""
    L = -MARGIN * dL
    neck = p.neck_length + L
    table[0, _t], table[0, _A_s] = L / p.v_start, 2.0 * math.pi * p.r_start * neck
    table[0, _M_s] = p.rho_s * math.pi * p.r_start**2 * neck
    at = shape_at(L, p, e)
    for row in range(1, ROWS):
        L = (row - MARGIN) * dL
        middle, to = shape_at(L - 0.5 * dL, p, e), shape_at(L, p, e)
        table[row, _t] = table[row - 1, _t] + dL / 6.0 * (1.0 / at.v_g + 4.0 / middle.v_g + 1.0 / to.v_g)
        side = _side(at) + 4.0 * _side(middle) + _side(to)
        table[row, _A_s] = table[row - 1, _A_s] + dL / 6.0 * side
        face = p.rho_s * math.pi * (at.r**2 + 4.0 * middle.r**2 + to.r**2)
        table[row, _M_s] = table[row - 1, _M_s] + dL / 6.0 * face
        at = to


@jittable
def _side(at: Any) -> Any:
    """Area of the crystal's side a metre of length [m]."""
    return 2.0 * math.pi * at.r * np.sqrt(1.0 + at.slope * at.slope)


@jittable
def _height(L: Any, p: Any, e: Any, m: Any) -> Any:
    """Meniscus height at which the crystal has the recipe's slope [m]."""
    at = shape_at(L, p, e)
    return m.height(at.r, p.alpha_0 + np.arctan(at.slope), p.a)


@jittable
def _balance(table: Any, row: Any, p: Any, e: Any, dL: Any, m: Any) -> None:
    """Write what forces and heat at the interface say of a row: height, ring, pull speed, flux, melt temperature."""
    L = (row - MARGIN) * dL
    at, h_c, near = shape_at(L, p, e), _height(L, p, e, m), _NEAR * dL
    rises = (_height(L + near, p, e, m) - _height(L - near, p, e, m)) / (2.0 * near)
    _, cos_theta = m.slope(at.r, h_c, p)
    M_men = meniscus_mass(at.r, h_c, cos_theta, p)
    Phi_s = crystal_flux(at.r, table[row, _A_s], depth(table[row, _M_s], M_men, p), p)
    Phi_l = Phi_s - p.rho_dH * at.v_g
    T_b = p.T_m + Phi_l / (p.k_l * (p.lam / (h_c + p.layer) + (1.0 - p.lam) / (p.h_0 + p.layer)))
    area = math.pi * at.r * at.r
    surface = p.emission * (math.pi * p.R_cr * p.R_cr - area) * (fourth_power(T_b) - fourth_power(p.T_e))
    leaves = p.C_b / p.M_0 * (T_b - p.T_m) * p.rho_s * area * at.v_g
    table[row, _h_c], table[row, _ring], table[row, _M_men] = h_c, m.ring_offset(at.r, h_c, p), M_men
    table[row, _v_p], table[row, _Phi_s], table[row, _T_b] = at.v_g * (1.0 + rises), Phi_s, T_b
    table[row, _needed] = surface + area * Phi_l - leaves


@jittable
def _rate(table: Any, row: Any, column: Any, dL: Any, p: Any) -> Any:
    """Rate of change in time of a column along the recipe, by differences of the fourth order [1/s]."""
    at = min(max(row, 2), ROWS - 3)
    near = table[at + 1, column] - table[at - 1, column]
    far = table[at + 2, column] - table[at - 2, column]
    v_g = 12.0 * dL / (table[at - 2, _t] - table[at + 2, _t] + 8.0 * (table[at + 1, _t] - table[at - 1, _t]))
    return v_g * (8.0 * near - far) / (12.0 * dL)


@jittable
def place(L: Any, p: Any) -> Any:
    """The row before a length, and the share of the way to the next row; within the table."""
    at = L / spacing(p) + MARGIN
    row = int(min(max(at.real, 1.0), ROWS - 3.0)) if at.real == at.real else 1
    return row, at - row


@jittable
def look_up(table: Any, row: Any, share: Any, column: Any) -> Any:
    """A column between two rows: the cubic through two rows on either side with their mean slopes."""
    a, b, c, d = table[row - 1, column], table[row, column], table[row + 1, column], table[row + 2, column]
    bent = 2.0 * a - 5.0 * b + 4.0 * c - d + share * (3.0 * (b - c) + d - a)
    return b + 0.5 * share * (c - a + share * bent)


@jittable
def value(L: Any, slot: Any, column: Any) -> Any:
    """A column of a slot's table at a length."""
    row, share = place(L, slot.puller)
    return look_up(slot.table, row, share, column)


@jittable
def state_at(L: Any, table: Any, p: Any, e: Any) -> Any:
    """The state of a crystal that has followed the recipe to a length."""
    row, share = place(L, p)
    M_s = look_up(table, row, share, _M_s)
    return CrystalState(
        shape_at(L, p, e).r,
        look_up(table, row, share, _h_c),
        look_up(table, row, share, _T_1),
        look_up(table, row, share, _T_2),
        look_up(table, row, share, _T_b),
        L,
        look_up(table, row, share, _A_s),
        M_s,
        ((p.M_0 - M_s) / p.M_0) ** p.k_0,
    )


# The task: the part of the crystal that an episode grows, and the limits within which it grows.

HEIGHT_MIN = 0.6 * MM
"""Lowest meniscus before it freezes [m]."""
CONE_LIMIT = 1.5
"""Largest radius error in the cones, in multiples of the body's [-]."""
LEAST_RADIUS = 0.2
"""Smallest radius, in multiples of the neck's [-]."""
BODY_TIME = 3.0 * HOUR
"""Time of the recipe that the stage "body" grows [s]."""
AFTER_CROWN, BEFORE_TAIL = 60.0 * MM, 50.0 * MM
"""Length of body that the stage "crown" ends with, and that the stage "tail" begins with [m]."""
SHORTEST_CHANGE = 0.05
"""Least share of the body over which a reference changes [-]."""
START = int(Stream.START)
"""The random stream of the episode's start, of which the stage is drawn."""
_LOW, _JUMP = 5.0 * MM, 1.2 * MM


@jittable
def end(p: Any) -> Any:
    """Length of the whole crystal [m]."""
    return p.crown_length + p.body_length + p.tail_length


@jittable
def time_at(L: Any, table: Any, p: Any) -> Any:
    """Time [s] at which the recipe reaches a length."""
    row, share = place(L, p)
    return look_up(table, row, share, 0)


@jittable
def length_at(t: Any, table: Any, p: Any) -> Any:
    """Length [m] that the recipe has reached at a time [s]."""
    row = 1
    while row < ROWS - 2 and table[row + 1, 0] < t:
        row += 1
    share = (t - table[row, 0]) / (table[row + 1, 0] - table[row, 0])
    return (row + share - MARGIN) * spacing(p)


@jittable
def span(stage: Any, u: Any, table: Any, p: Any) -> Any:
    """Lengths [m] at which a stage (its number in :data:`.parameters.STAGES`) begins and ends; u in [0, 1) draws."""
    body_ends = p.crown_length + p.body_length
    if p.begins >= 0.0:
        return p.begins, min(length_at(time_at(p.begins, table, p) + BODY_TIME, table, p), end(p))
    if stage == 0:
        return 0.0, p.crown_length + min(AFTER_CROWN, p.body_length)
    if stage == 1:
        first, last = time_at(p.crown_length, table, p), time_at(body_ends, table, p)
        begins = first + u * max(last - BODY_TIME - first, 0.0)
        return length_at(begins, table, p), min(length_at(begins + BODY_TIME, table, p), body_ends)
    return (body_ends - min(BEFORE_TAIL, p.body_length) if stage == 2 else 0.0), end(p)


@jittable
def draw_stage(slot: Any) -> Any:
    """Number of the stage that the episode grows, and a number in [0, 1) for where it begins."""
    p = slot.puller
    u, v = uniform(slot.streams[START]), uniform(slot.streams[START])
    stage = 0
    for upto in (p.crown, p.crown + p.body, p.crown + p.body + p.tail):
        stage += 1 if u >= upto else 0
    return stage, v


@jittable
def reference_along(slot: Any) -> None:
    """Turn the reference's change from times into lengths: three hours are the length of the body."""
    p, e = slot.puller, slot.episode
    start, over = e.reference_start / DRAW_SPAN, max(e.reference_duration / DRAW_SPAN, SHORTEST_CHANGE)
    e.reference_start = p.crown_length + min(start, 1.0 - SHORTEST_CHANGE) * p.body_length
    e.reference_duration = min(over, 1.0 - min(start, 1.0 - SHORTEST_CHANGE)) * p.body_length


@jittable
def stretch(slot: Any, times: Any) -> None:
    """Stretch what a scenario spreads over three hours; what lasts some seconds or minutes keeps its duration."""
    e = slot.episode
    e.drift_start, e.drift_duration, e.drift_rate = (
        e.drift_start * times,
        e.drift_duration * times,
        e.drift_rate / times,
    )
    e.bias_drift_start, e.bias_drift_duration = e.bias_drift_start * times, e.bias_drift_duration * times
    for which in range(FREEZES):
        later = (times - 1.0) * slot.freezes[which, 0]
        slot.freezes[which, 0] += later
        slot.freezes[which, 1] += later


@jittable
def height_inside(h_c: Any, p: Any) -> Any:
    """The meniscus height limited to its range, so that a failed state can still be measured."""
    top = HEIGHT_MAX_IN_A * p.a
    if h_c.real < HEIGHT_MIN:
        return HEIGHT_MIN + 0.0 * h_c
    return top + 0.0 * h_c if h_c.real > top else h_c


@jittable
def within_limits(x: Any, r_ref: Any, limit: Any, p: Any) -> Any:
    """True while the crystal grows: meniscus, radius and superheat within their limits; false if one is NaN."""
    radius = (np.abs(x.r_c - r_ref) <= limit) & (x.r_c >= LEAST_RADIUS * p.r_start)
    meniscus = (x.h_c >= HEIGHT_MIN) & (x.h_c <= HEIGHT_MAX_IN_A * p.a)
    return radius & meniscus & (x.T_b >= p.T_m)


FAILURE_MODES = ("frozen", "detached", "off", "cold")
"""Ways to lose a crystal: meniscus too low, meniscus too high, radius too far off, melt below its melting point."""


def relative_margin(at: Any, limit: Any, q: Any) -> Any:
    """Relative distance of logged signals to the limit of each of :data:`FAILURE_MODES`; the least one names the loss.

    After an impossible jump the state is the one before, which is still within all limits. ``limit`` is the largest
    radius error of the body [m], q the parameters.
    """
    a = (2.0 * q.sigma / (q.rho_l * q.g)) ** 0.5
    body_ends = q.crown_length + q.body_length
    cone = np.where((q.crown_length <= at.L) & (body_ends >= at.L), 1.0, CONE_LIMIT)
    radius = np.minimum(1.0 - np.abs(at.r_c - at.r_ref) / (limit * cone), at.r_c / (LEAST_RADIUS * q.r_start) - 1.0)
    return (at.h_c - HEIGHT_MIN) / _LOW, (HEIGHT_MAX_IN_A * a - at.h_c) / a, radius, at.T_b - q.T_m


@jittable
def accept(slot: Any, x: Any, new: Any, u: Any, d: Any, t: Any, dt: Any, limit: Any, m: Any) -> Any:
    """The state after a substep and whether the crystal grows on, is lost, or long enough.

    After an impossible jump it is the state before. Low menisci freeze as those of a body do
    (:func:`cz_gym.body.process.accept_substep`).
    """
    p = slot.puller
    widest = limit * CONE_LIMIT if in_cone(new.L, p) else limit
    inside = within_limits(new, shape_at(new.L, p, slot.episode).r, widest, p)
    grows = inside
    if inside and x.h_c < _LOW:
        grows = x.h_c + 0.5 * dt * (u.v_p - at_interface(x, d, p, m.slope).v_g) >= HEIGHT_MIN
    if not grows and (inside or not (np.abs(new.r_c - x.r_c) < _JUMP and np.abs(new.h_c - x.h_c) < _JUMP)):
        new = labelled(CrystalState, x)
    long_enough = DONE if slot.stop <= new.L else GROWS
    return new, (long_enough if grows else LOST)
