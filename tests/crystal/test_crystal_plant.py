"""The plant of a whole crystal: its limit, its balances, its order, and the meniscus down to the crown's start."""

import math
from collections import namedtuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from cz_gym import Parameters, make_puller
from cz_gym.crystal import plant, recipe
from cz_gym.crystal.plant import CrystalState, Disturbance, at_interface, complete, rates
from cz_gym.crystal.process import nominal_recipe
from cz_gym.crystal.recipe import shape_at
from cz_gym.episodes.draw import Episode, Factors
from cz_gym.physics import plant as body
from cz_gym.physics.meniscus import HURLE, hurle_height, hurle_slope
from cz_gym.physics.numerics import rk4
from cz_gym.physics.schedule import melt_left
from cz_gym.process import Inputs
from cz_gym.puller.file import DEFAULT
from cz_gym.support.units import MM
from tests.physics.test_young_laplace import solve

DESIGN = complete(Parameters(), DEFAULT)
EPISODE = Episode()


@pytest.mark.parametrize("lam", [0.0, 0.4, 1.0])
def test_a_crystal_without_end_over_a_charge_without_end_is_the_body(lam, rng):
    endless = DESIGN._replace(M_0=1e18, m=0.0, beta=0.0)
    p, q = plant.derive(endless, Factors(lam=lam), HURLE), make_puller(lam=lam)
    n = 300
    x = body.State(
        rng.uniform(0.05, 0.1, n), rng.uniform(0.002, 0.009, n), q.T_1_0 + rng.normal(0, 20, n),
        q.T_2_0 + rng.normal(0, 10, n), q.T_b_0 + rng.normal(0, 3, n),
    )  # fmt: skip
    u = Inputs(rng.uniform(0, 4e-5, n), q.Q_H_0 + rng.uniform(-1e4, 1e4, n))
    Q_d, dT_i = rng.normal(0, 1000, n), rng.normal(0, 1, n)
    each = (map(float, numbers) for numbers in zip(*x, *u, Q_d, dT_i, strict=True))
    found = [
        rates(CrystalState(r_c, h_c, *T, 1.0, 1e9, 0.0, 1.0), Inputs(v_p, Q_H), Disturbance(*load), p, HURLE)
        for r_c, h_c, *T, v_p, Q_H, Q, dT in each
        for load in [(Q, dT)]
    ]
    here = np.array(found).T
    there = body.rates(x, u, body.Disturbance(Q_d, dT_i, melt_left(0.0, EPISODE)), q, hurle_slope)
    for mine, bodys in zip(here, there, strict=False):
        np.testing.assert_allclose(mine, bodys, rtol=1e-12, atol=1e-12 * np.abs(bodys).max())


Audit = namedtuple("Audit", (*CrystalState._fields, "gained"))
"""The state, and the heat that came from outside less what left."""


def audited(x, u, d, p, m):
    rate = rates(CrystalState(*x[:9]), u, d, p, m)
    Phi_l = at_interface(x, d, p, m.slope).Phi_l
    surface = p.emission * math.pi * (p.R_cr**2 - x.r_c**2) * (x.T_b**4 - p.T_e**4)
    gain = u.Q_H - p.G_1a * (x.T_1 - p.T_a) - surface - math.pi * x.r_c**2 * Phi_l + d.Q_d
    return Audit(*rate, gain)


def heat_in(x, p):
    """Heat in heater, crucible and melt, which counts from its melting point: a crystal takes none away there [J]."""
    return p.C_1 * x.T_1 + p.C_2 * x.T_2 + p.C_b * (p.M_0 - x.M_s) / p.M_0 * (x.T_b - p.T_m)


@pytest.mark.slow
def test_mass_dopant_and_energy_over_a_whole_crystal():
    """Under a load; the heat is audited, the mass a quadrature of its shape, the dopant follows Scheil's law."""
    p, table = nominal_recipe(DESIGN, HURLE)
    x, d = Audit(*map(float, recipe.state_at(0.0, table, p, EPISODE)), 0.0), Disturbance(3.0, 0.01)
    start, lengths, faces = x, [x.L], [math.pi * x.r_c**2]
    while x.L < 1.262:
        row, share = recipe.place(x.L, p)
        v_p, Q_H, T_1 = (recipe.look_up(table, row, share, at) for at in (recipe._v_p, recipe._Q_H, recipe._T_1))
        u = Inputs(v_p + 0.003 * (x.r_c - shape_at(x.L, p, EPISODE).r), Q_H + 1500.0 * (T_1 - x.T_1))
        assert abs(x.r_c - shape_at(x.L, p, EPISODE).r) < 8 * MM
        before, x = x, rk4(audited, x, u, d, p, 5.0, HURLE)
        middle = rk4(audited, before, u, d, p, 2.5, HURLE)
        lengths += [middle.L, x.L]
        faces += [math.pi * middle.r_c**2, math.pi * x.r_c**2]
    grown = heat_in(x, p) - heat_in(start, p)
    assert abs(grown - x.gained) < 1e-9 * heat_in(x, p)
    L, face = np.array(lengths), np.array(faces)
    a, b = np.diff(L)[::2], np.diff(L)[1::2]  # Simpson's rule for unequal halves
    third = (a + b) / 6.0
    volume = np.sum(
        third * ((2 - b / a) * face[:-2:2] + (a + b) ** 2 / (a * b) * face[1::2] + (2 - a / b) * face[2::2])
    )
    assert x.M_s - start.M_s == pytest.approx(p.rho_s * volume, rel=1e-9)
    scheil = start.N * ((p.M_0 - x.M_s) / (p.M_0 - start.M_s)) ** p.k_0
    assert pytest.approx(scheil, rel=1e-9) == x.N
    assert at_interface(x, d, p, hurle_slope).deep * p.M_0 + x.M_s == pytest.approx(p.M_0, abs=1.0)


def test_rk4_converges_with_the_fourth_order_in_the_crown():
    p, table = nominal_recipe(DESIGN, HURLE)
    x, u, d = recipe.state_at(0.02, table, p, EPISODE), Inputs(2.4e-5, 5.6e4), Disturbance(200.0, 0.3)
    exact = solve_ivp(
        lambda t, y: rates(CrystalState(*y), u, d, p, HURLE), (0, 40), x, "DOP853", rtol=1e-13, atol=1e-15
    )
    scale, errors = np.maximum(np.abs(exact.y[:, -1]), 1e-6), []
    for steps in (4, 8, 16):
        y = x
        for _ in range(steps):
            y = rk4(rates, y, u, d, p, 40.0 / steps, HURLE)
        errors.append(np.abs((np.array(y) - exact.y[:, -1]) / scale).max())
    assert 3.8 < math.log2(errors[0] / errors[2]) / 2.0 < 4.6
    assert errors[1] < 1e-6


@pytest.mark.parametrize(("radius", "share"), [(10, 0.042), (20, 0.013), (40, 0.013), (87.5, 0.013)])
def test_hurles_height_against_the_exact_meniscus(radius, share):
    """Where the wall is vertical, from the crown's start on."""
    a, theta = make_puller().a, math.radians(11.0)
    exact = brentq(lambda h: solve(radius * MM, h).theta.item() - theta, 3 * MM, 7 * MM, xtol=1e-7)
    assert abs(hurle_height(radius * MM, theta, a) / exact - 1.0) < share + 1e-3
