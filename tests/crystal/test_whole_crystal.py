"""``CzCrystal-v0``: its plant's limit, balances and order; its recipe; stages, scenarios and ends."""

import csv
import math
from collections import namedtuple
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cz_gym
from cz_gym import Parameters, decode, make_puller
from cz_gym.body.process import BODY
from cz_gym.config import make_config
from cz_gym.crystal import plant, recipe, signals
from cz_gym.crystal.plant import CrystalState, Disturbance, at_interface, complete, rates
from cz_gym.crystal.process import CRYSTAL, linear_recipe, nominal_recipe
from cz_gym.crystal.recipe import growth_rate, shape_at
from cz_gym.env import CzCrystalEnv, CzCrystalVectorEnv
from cz_gym.episodes.draw import Episode, Factors
from cz_gym.episodes.scenarios import NOMINAL
from cz_gym.physics import plant as body
from cz_gym.physics.meniscus import HURLE, hurle_height, hurle_slope
from cz_gym.physics.parameters import CrystalRecipe
from cz_gym.physics.plant import DRAW_SPAN, melt_left
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.process import Inputs, rk4
from cz_gym.puller.file import DEFAULT, PullerFile, find_puller, from_toml
from cz_gym.support.errors import CzError
from cz_gym.support.units import HOUR, MM
from cz_gym.tools import recipe as command
from tests.physics.test_meniscus import solve

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


@pytest.mark.parametrize("L", [0.03, 0.06, 0.2, 0.5, 0.9, 1.15, 1.22])
def test_the_plant_moves_along_the_recipe_under_its_drives(L):
    """The recipe is found backwards, from the shape to the drives; the plant's own equations must lead along it."""
    p, table = nominal_recipe(DESIGN, HURLE)
    x, (row, share), near = recipe.state_at(L, table, p, EPISODE), recipe.place(L, p), 5e-4
    u = Inputs(*(float(recipe.look_up(table, row, share, at)) for at in (recipe._v_p, recipe._Q_H)))
    moves = rates(x, u, Disturbance(0.0, 0.0), p, HURLE)
    before, after = (np.array(recipe.state_at(L + side * near, table, p, EPISODE)) for side in (-1.0, 1.0))
    np.testing.assert_allclose(moves, (after - before) / (2.0 * near) * moves.L, rtol=0.03, atol=1e-11)


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


def test_hurles_height_against_the_exact_meniscus():
    """Where the wall is vertical, from the crown's start on: the exact height is within a share of Hurle's."""
    radius, share = np.array([10.0, 20.0, 40.0, 87.5]) * MM, np.array([0.043, 0.014, 0.014, 0.014])
    theta = math.radians(11.0)
    height = hurle_height(radius, theta, make_puller().a)
    low, high = (solve(radius, height / (1.0 + side * share)).theta - theta for side in (1.0, -1.0))
    assert (low * high < 0.0).all()


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


@pytest.mark.parametrize(
    ("value", "still", "moves"),
    [
        ("slope", (40, 55, 70), (39, 71)),
        ("slope", (1140, 1200, 1245), (1139, 1246)),
        ("v_g", (50, 60, 75), (49, 76)),
        ("v_g", (135,), (134, 180)),
        ("v_g", (1190, 1265), (1189,)),
    ],
)
def test_slope_and_growth_rate_stand_still_between_the_lengths_of_the_design(value, still, moves):
    """A crown of 90 mm, a body that ends at 1090 mm, a tail of 175 mm; lengths in mm."""
    first, *others = (getattr(shape_at(L * MM, DESIGN, EPISODE), value) for L in (*still, *moves))
    np.testing.assert_allclose(others[: len(still) - 1], first, rtol=1e-12)
    assert (np.abs(np.array(others[len(still) - 1 :]) / first - 1.0) > 5e-7).all()


def test_a_stage_that_begins_at_a_length_is_all_of_the_episodes():
    q = complete(Parameters(), DEFAULT, 0.5)
    assert [getattr(q, stage) for stage in plant.STAGES] == [stage == "body" for stage in plant.STAGES]


def odd(**changes):
    return {"puller": PullerFile("odd", recipe=CrystalRecipe()._replace(**changes))}


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (odd(v_crown=3e-5), "at a length of .* mm the melt would have to be colder"),
        (odd(M_0=62.333), "the charge of 62.333 kg is used up"),  # 62.329 kg of crystal, 0.009 kg of meniscus
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
    link = 4.0 * p.kappa_12 * np.array([p.T_1_0, p.T_2_0]) ** 3  # a kelvin of drift in T_1, held in T_2
    assert at.load == pytest.approx(-p.G_2b * link[0] / (link[1] + p.G_2b), rel=1e-3)


MIX = {"crown": 0.4, "body": 0.3, "tail": 0.3}
PLAIN = {"observation": "measured", "action": "direct", "info": "all"}


def test_where_stages_begin_and_end():
    env = CzCrystalVectorEnv(200, scenario="randomized", stage={"crown": 1, "body": 1, "tail": 1, "whole": 1}, **PLAIN)
    _, info = env.reset(seed=0)
    slots, L = env._batch.memory.slots, info["L"]
    crown, tail = (L == 0.0) & (slots["stop"] < 1.0), np.abs(L - 1.04) < 1e-9
    whole, body = (L == 0.0) & (slots["stop"] > 1.0), (L >= 0.09) & (L < 1.0)
    assert (crown | tail | whole | body).all()
    assert min(crown.sum(), tail.sum(), whole.sum(), body.sum()) > 30
    np.testing.assert_allclose(slots["stop"][crown], 0.15)
    np.testing.assert_allclose(slots["stop"][tail | whole], 1.265)
    grown = slots["stop"][body] - L[body]
    assert (grown > 3 * HOUR * 1.6e-5).all()
    assert (grown < 3 * HOUR * 2.2e-5).all()
    from_here = CzCrystalEnv(scenario="nominal", stage=0.5, **PLAIN)
    assert from_here.reset(seed=0)[1]["L"] == 0.5
    assert from_here._slots["stop"][0] == pytest.approx(0.5 + 1.13 / 60 * 10.8, rel=0.01)


@pytest.mark.parametrize("name", sorted(cz_gym.SCENARIOS))
def test_every_scenario_grows_some_minutes_from_each_stage(name):
    """What a scenario spreads over three hours is spread over the stage; readings are what was told and measured."""
    env = CzCrystalVectorEnv(12, scenario=name, stage=MIX, **PLAIN)
    observation, info = env.reset(seed=3)
    slots = env._batch.memory.slots
    e = slots["episode"]
    assert (slots["freezes"] <= 1.01 * 4.4 * HOUR).all()
    assert (e["drift_start"] + e["drift_duration"] < 1.2 * 2.5 * HOUR * 200 / 180).all()
    for _ in range(30):
        observation, _, terminated, _, info = env.step(np.zeros((12, 2), np.float32))
        assert not terminated.any()
        seen = decode(observation, *env.config.ranges, env.config.process)
        np.testing.assert_allclose(seen.L, info["L"], atol=1e-6)
        misread = (e["pull_scale"] - 1.0) * info["v_p"]
        np.testing.assert_allclose(seen.v_p, info["v_p"] - info["v_p_ref"] + misread, atol=1e-11)
    assert (np.abs(info["r_c"] - info["r_ref"]) < 3 * MM).all()


def test_previews_are_what_is_told_at_that_length_later():
    """Where nothing but the recipe's own error moves it."""
    env = CzCrystalEnv(scenario="only-recipe", stage=0.02, control_interval=20.0, **PLAIN)
    rows = [env.reset(seed=0)[0], *(env.step(np.zeros(2, np.float32))[0] for _ in range(150))]
    seen = decode(np.array(rows), *env.config.ranges, env.config.process)
    for signal, apart in (("r_ref", 0.02 * MM), ("T_1_ref", 0.02)):
        for name, by in (("5mm", 5.0 * MM), ("25mm", 25.0 * MM)):
            reached = seen.L + by < seen.L[-1]
            later = np.interp(seen.L[reached] + by, seen.L, getattr(seen, signal))
            assert reached.sum() > 5
            np.testing.assert_allclose(getattr(seen, f"{signal}_{name}")[reached], later, atol=apart)


def test_the_recipes_error_runs_with_length():
    """On "randomized" a constant of 3 K and a wave of 2 K over 0.3 m, root mean square."""
    env = CzCrystalVectorEnv(4000, scenario="randomized", stage="crown", threads=1, **PLAIN)
    env.reset(seed=0)
    e = env._batch.memory.slots["episode"].view(np.recarray)
    told = np.array([signals.recipe_error(L, e) for L in np.linspace(0.0, 0.3, 24, endpoint=False)])
    assert np.sqrt(np.mean(told.mean(axis=0) ** 2)) == pytest.approx(3.0, rel=0.05)
    assert np.sqrt(np.mean(told.var(axis=0))) == pytest.approx(2.0, rel=0.05)


def test_times_of_a_scenario_stretch_to_a_whole_crystal():
    """The steady drift of "puller" gains 18 K over 18 hours, as it gains 18 K over three."""
    env = CzCrystalEnv(scenario="puller", stage="whole", **PLAIN)
    env.reset(seed=0)
    assert env._slots["episode"]["drift_rate"][0] * 18.44 * HOUR == pytest.approx(0.1 / 60 * DRAW_SPAN, rel=0.05)


def test_a_changed_reference_is_part_of_the_recipe():
    env = CzCrystalEnv(scenario="reference-a", stage="body", **PLAIN)
    env.reset(seed=0)
    over = False
    while not over:
        *_, over, _, info = env.step(np.zeros(2, np.float32))
    assert info["succeeded"] == 1.0
    assert 85 * MM - 1e-9 <= info["r_ref"] <= 87.5 * MM
    assert abs(info["r_c"] - info["r_ref"]) < 0.05 * MM


@pytest.mark.parametrize(("moved", "by"), [("r_c", 13 * MM), ("h_c", 9 * MM), ("T_b", -4.0), ("r_c", -49 * MM)])
def test_how_a_crystal_is_lost(moved, by):
    env = CzCrystalEnv(scenario="nominal", stage=0.05, **PLAIN)
    env.reset(seed=0)
    env._slots["x"][moved] += by
    *_, gained, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert (terminated, truncated, info["succeeded"]) == (True, False, 0.0)
    assert gained < -900.0


def test_weight_and_lean_info():
    env = gym.make("CzCrystal-v0", scenario="nominal", observation="measured", action="direct").unwrapped
    env.reset(seed=0)
    observation, *_, info = env.step(np.zeros(2, np.float32))
    assert info.keys() == {"r_c", "r_ref", "cost", "succeeded", "action_clipped"}
    seen = decode(observation, *env.config.ranges, env.config.process)
    assert abs(seen.weight) <= 0.5 * 9.81 * signals.WEIGHT_STEP + 1e-4
    assert abs(seen.ring_error) < 0.05 * MM  # the crystal is on its recipe, the ring too


def test_the_load_cell_is_as_noisy_as_its_scenario_says():
    """Two crystals of one scenario that differ in the camera's noise alone: the weights differ by the load cell's."""
    sensor = replace(NOMINAL.sensor, camera_noise=(0.05 * MM, 0.05 * MM))
    weights = []
    for scenario in (NOMINAL, replace(NOMINAL, sensor=sensor)):
        envs = CzCrystalVectorEnv(200, scenario=scenario, **PLAIN)
        envs.reset(seed=0)
        weights.append([envs.step(np.zeros((200, 2), np.float32))[4]["weight"] for _ in range(20)])
    noise = np.subtract(*weights[::-1]) / 9.81
    assert np.std(noise) == pytest.approx(0.05, rel=0.03)
    assert abs(np.corrcoef(noise[1:].ravel(), noise[:-1].ravel())[0, 1]) < 0.04, "white"
