"""The recipe: open loop on it, what cannot be grown, the command, and the linearisation along it."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from cz_gym.body.process import BODY
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL, linear_recipe, nominal_recipe
from cz_gym.crystal.recipe import growth_rate, shape_at
from cz_gym.env import CzCrystalEnv
from cz_gym.episodes.draw import Episode
from cz_gym.physics.meniscus import HURLE
from cz_gym.physics.parameters import CrystalRecipe
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.puller.file import DEFAULT, PullerFile, find_puller, from_toml
from cz_gym.support.errors import CzError
from cz_gym.support.units import HOUR, MM
from cz_gym.tools import recipe as command

CALM = {"scenario": "nominal", "observation": "measured", "action": "direct", "info": "all"}


@pytest.mark.parametrize("puller", [None, "silicon-300mm", "germanium"])
@pytest.mark.parametrize("stage", ["crown", "body", "tail"])
def test_open_loop_grows_the_recipes_shape_within_a_tenth_of_a_millimetre(stage, puller):
    smooth = dict.fromkeys(("fluctuation_sd", "heater_step", "pull_slew", "heater_slew"))
    env = CzCrystalEnv(stage=stage, puller=replace(find_puller(puller), **smooth), **CALM)
    env.reset(seed=1)
    error, over = 0.0, False
    while not over:
        _, _, over, cut, info = env.step(np.zeros(2, np.float32))
        error = max(error, abs(info["r_c"] - info["r_ref"]))
        assert not cut
    assert info["succeeded"] == 1.0
    assert error < 0.1 * MM
    assert info["v_over_G"] == pytest.approx(1.0, abs=0.02)


def test_the_recipe_reads_as_the_design_says():
    p, table = nominal_recipe(
        make_config(process=CRYSTAL).parameters._replace(**dict.fromkeys(CRYSTAL.apart, 0.0)), HURLE
    )
    end = table[-9]
    assert end[0] / HOUR == pytest.approx(18.44, abs=0.01)
    assert table[8:60, 3].max() - table[8:60, 3].min() == pytest.approx(25.0, abs=1.5)
    assert table[8, 5] - p.T_m == pytest.approx(22.0, abs=0.2)
    assert table[8:60, 5].min() - p.T_m == pytest.approx(2.4, abs=0.1)


def odd(**changes):
    return {"puller": PullerFile("odd", recipe=CrystalRecipe()._replace(**changes))}


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (odd(v_crown=3e-5), "at a length of .* mm the melt would have to be colder"),
        (odd(M_0=50.0), "at a length of .* mm the charge of 50 kg is used up: the crystal weighs 62.3 kg"),
        (odd(crown_length=0.02, body_length=0.5), "mm the meniscus is out of its range"),
        (odd(body_length=0.0), "a tail needs a body: body_length_mm = 0 must be at least twice crown_length_mm = 90"),
        (odd(r_start=0.09), "start_radius_mm = 90 must be less than radius_mm = 87.5"),
        ({"stage": "crow"}, "unknown stage 'crow': did you mean 'crown'"),
        ({"stage": {"crown": 0.5, "head": 1}}, "unknown stage 'head'; choose from crown, body, tail, whole"),
        ({"stage": {"crown": -1.0}}, "share of stage 'crown' must be a positive number"),
        ({"stage": {}}, "stage must be one of crown, body, tail, whole"),
        ({"stage": 1.3}, "stage = 1.3 m begins outside of the crystal, which is 1.265 m long"),
        ({"meniscus": YOUNG_LAPLACE}, "at a length of 0 mm the meniscus"),
        ({"puller": replace(DEFAULT, heater_max=6.2e4)}, "mm the heater needs more than heater_max_kW = 62"),
        ({"process": BODY, "stage": "crown"}, "only CzCrystal-v0 has stages"),
    ],
)
def test_what_cannot_be_grown_is_refused_in_one_line(settings, said):
    with pytest.raises(CzError, match=said) as refused:
        make_config(**{"process": CRYSTAL, **settings})
    assert "\n" not in str(refused.value)


def test_stage_and_recipe_in_hashes():
    """The recipe is part of the plant, the stage of what a saved state depends on."""
    crown, whole = (make_config(process=CRYSTAL, stage=stage) for stage in ("crown", "whole"))
    slow = PullerFile("slow", recipe=CrystalRecipe(v_body=1.9e-5))
    assert crown.plant_hash == whole.plant_hash != make_config(process=CRYSTAL, puller=slow).plant_hash
    assert crown.hash != whole.hash
    assert slow.hash == DEFAULT.hash
    assert crown.horizon == pytest.approx(1.3 * 2.48 * HOUR, rel=0.01)


def test_a_recipe_in_a_pullers_file():
    told = from_toml("format = 1\n[recipe]\ncharge_kg = 100\nbody_length_mm = 1300\n")
    assert told.recipe == CrystalRecipe(M_0=100.0, body_length=1.3)
    with pytest.raises(CzError, match="charge_kg = 80000"):
        from_toml("format = 1\n[recipe]\ncharge_kg = 80000\n")


def test_the_command_writes_what_an_operator_loads(tmp_path, capsys):
    assert command.main(["germanium", "--out", str(tmp_path)]) == 0
    assert "superheat K" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "recipe.csv").read_text().splitlines()))
    assert float(rows[-1]["length_mm"]) == pytest.approx(620.0)
    assert {"heater_power_kW", "crucible_lift_mm_per_min"} < rows[0].keys()
    assert (tmp_path / "recipe.png").read_bytes()[:4] == b"\x89PNG"
    assert command.main(["no-such"]) == 2


def test_the_linearisation_along_the_recipe():
    """The ring's zero [rad/s] and its share of the height, as a prototype had them; the rates by differences."""
    at = linear_recipe(make_config(process=CRYSTAL).parameters, HURLE)
    crown, body, tail = (np.argmin(np.abs(at.L - L)) for L in (0.06, 0.14, 1.18))
    np.testing.assert_allclose(at.zero[[crown, body]], [0.0034, 0.0227], rtol=0.02)
    assert at.zero[tail] < 0.0
    np.testing.assert_allclose(at.c_h[[crown, body, tail]], [1.99, 0.225, -0.215], atol=0.01)
    p, _ = nominal_recipe(make_config(process=CRYSTAL).parameters, HURLE)
    r, v_g = shape_at(at.L[crown], p, Episode()).r, growth_rate(at.L[crown], p)
    by_radius = 2.0 * np.pi * p.rho_s * r * v_g  # against length a wide crystal gains mass, a fast one none
    np.testing.assert_allclose(at.A[crown, 5], [by_radius, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-4 * by_radius)
    assert at.C[crown, 1, 5] == p.g
