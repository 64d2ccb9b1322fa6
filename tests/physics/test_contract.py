"""The contract of physics: each row of the page's table against the code, agreements and known misses alike."""

import re

import numpy as np
import pytest

from cz_gym import Parameters, make_puller
from cz_gym.body.process import OUTPUTS, linearise, radius_model
from cz_gym.config import make_config
from cz_gym.crystal import recipe
from cz_gym.crystal.process import APART, CRYSTAL, lengths, nominal_recipe
from cz_gym.episodes.scenarios import TRACED_SLOPE
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "physics.md").read_text()
TABLE = PAGE.split("## The contract of physics")[1].split("\n\n## ")[0]
LINES = (line for line in TABLE.splitlines() if line.startswith("| ") and "quantity" not in line)
ROWS = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in LINES]
LAYER, TRACED = Parameters(R=7e-4), make_puller(Parameters(phi_b=TRACED_SLOPE))
SILICON = 22.0
"""Conductivity of the crystal at its melting point [W/m/K]."""


def superheat(q):
    p = make_puller(q)
    return p.T_b_0 - p.T_m


def flux(q):
    """Nominal flux from the melt [W/m2], from its definition with a resistance."""
    p = make_puller(q)
    return superheat(q) / (p.h_0 / p.k_l + q.R)


def flux_by_wall(q):
    """Flux that a kelvin of the crucible's wall adds, in balance, the meniscus held [W/m2/K]."""
    p = make_puller(q)
    melt = linearise(p)
    by_flux = p.k_l / (p.h_0 + p.layer)
    warms = -melt.A[4, 3] / melt.A[4, 4]  # the melt's balance: 0 = A_bb dT_b + A_b2 dT_2
    return by_flux * warms


def body():
    """The recipe in the body, without 100 mm at either end."""
    config = make_config("nominal", process=CRYSTAL, stage="whole")
    p, table = nominal_recipe(config.parameters._replace(**dict.fromkeys(APART, 0.0)), config.meniscus)
    at, L = recipe.RecipeRow(*table.T), lengths(p)
    inside = (p.crown_length + 0.1 <= L) & (p.crown_length + p.body_length - 0.1 >= L)
    return recipe.RecipeRow(*(column[inside] for column in at))


def warming():
    at = body()
    return 60.0 * (at.T_1[-1] - at.T_1[0]) / (at.t[-1] - at.t[0])


def energy():
    at = body()
    return np.trapezoid(at.Q_H, at.t) / 3.6e6 / (at.M_s[-1] - at.M_s[0])


def ring_gain(**changes):
    return linearise(make_puller(Parameters(**changes))).C[OUTPUTS.index("r_br"), 1]


ONE, TWO = radius_model(make_puller(lam=1.0)), radius_model(make_puller(lam=0.0))
OURS = {
    "numerator of $G_p$, Model II [1/s]": lambda: TWO.numerator,
    "numerator of $G_p$, Model I [1/s]": lambda: ONE.numerator,
    "pole of the height, Model I [rad/s]": lambda: ONE.poles[1],
    "pole of the cone angle, Model I [rad/s]": lambda: ONE.poles[0],
    "lead of $G_m$, Model II [s]": lambda: TWO.lead,
    "lead of $G_m$, Model I [s]": lambda: ONE.lead,
    "right-half-plane zero, Model II [rad/s]": lambda: TWO.zero,
    "right-half-plane zero, traced ring [rad/s]": lambda: radius_model(TRACED).zero,
    "ring outside the crystal [mm]": lambda: 1e3 * make_puller().ring_bias,
    "the same, `randomized-traced` [mm]": lambda: 1e3 * TRACED.ring_bias,
    "ring by the height [-]": ring_gain,
    "the same, `randomized-traced` [-]": lambda: ring_gain(phi_b=TRACED_SLOPE),
    "nominal meniscus height [mm]": lambda: 1e3 * make_puller().h_0,
    "growth angle [deg]": lambda: np.degrees(Parameters().alpha_0),
    "density of the melt [kg/m³]": lambda: Parameters().rho_l,
    "emissivity of the melt [-]": lambda: Parameters().eps,
    "flux at the interface per superheat of the meniscus [kW/m²/K]": lambda: flux(Parameters()) / 5.02e3,
    "melt above its melting point [K]": lambda: superheat(Parameters()),
    "the same, `melt-layer` [K]": lambda: superheat(LAYER),
    "resistance between melt and interface [1e-4 m²K/W]": lambda: 1e4 * superheat(Parameters()) / flux(Parameters()),
    "the same, `melt-layer` [1e-4 m²K/W]": lambda: 1e4 * superheat(LAYER) / flux(LAYER),
    "flux by the wall's temperature [W/m²/K]": lambda: flux_by_wall(Parameters()),
    "the same, `melt-layer` [W/m²/K]": lambda: flux_by_wall(LAYER),
    "gradient in the crystal at the interface [K/mm]": lambda: make_puller().Phi_s / SILICON / 1e3,
    "heater at 57.6 kW [°C]": lambda: make_puller().T_1_0 - 273.15,
    "rise of the heater over the body [K/min]": warming,
    "energy in the body, without melting down [kWh/kg]": energy,
}
"""Each row's number from the code."""


def test_the_table_has_a_row_for_each_number():
    assert [row[0] for row in ROWS] == list(OURS)


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_a_row_is_what_the_code_computes(row):
    """The number with the page's digits; "agrees" within its band, else the distance from the band's nearest end."""
    what, shown, _, band, verdict, _ = row
    value = float(OURS[what]())
    digits = len(re.sub(r"e.*", "", shown).lstrip("-0.").replace(".", ""))
    assert float(f"{value:.{digits}g}") == pytest.approx(float(shown), rel=1e-12), value
    ends = [float(end) for end in band.split(" to ")]
    nearest = min(ends, key=lambda end: abs(value - end))
    inside = min(ends) <= value <= max(ends)
    miss = f"miss: {100.0 * (value / nearest - 1.0):+.1f} %"
    assert verdict == ("agrees" if inside else miss)


def test_the_layer_changes_no_flux_at_the_interface():
    assert flux(LAYER) == pytest.approx(flux(Parameters()), rel=1e-12)
