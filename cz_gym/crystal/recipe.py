"""The recipe by flat inversion: from shape and growth rate against length follow height, temperatures and drives.

Nothing is integrated in time. Shape gives the cone angle and with it the meniscus height, growth rate the heat flux
from the melt and with it the melt's temperature; what its rate of change needs gives the crucible's, and so on to the
power.
The result is a table against length, one for each drawn puller, in ``slot.table``.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from cz_gym.body.plant import fourth_power
from cz_gym.jit.compile import jittable

from .plant import State, crystal_flux, depth, meniscus_mass, wall
from .shape import shape_at

ROWS, MARGIN = 512, 8
"""Rows of the table, and those before the crown and after the tail."""
_NEAR = 1.0 / 64.0
"""Distance over which the meniscus height is differentiated, in rows [-]."""


class Setpoint(NamedTuple):
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
    """Heat that the melt must be given beside what heats it [W]; then the heat through the crucible's wall."""


TABLE = (ROWS, len(Setpoint._fields))
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
    T_b = p.T_m + Phi_l / (p.k_l * (p.lam / h_c + (1.0 - p.lam) / p.h_0))
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
    return State(
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
