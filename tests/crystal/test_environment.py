"""``CzCrystal-v0`` as an environment: checkers, batch, saved states, scenarios along a crystal, its end."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import cz_gym
from cz_gym.crystal import signals
from cz_gym.env import CzCrystalEnv, CzCrystalVectorEnv
from cz_gym.episodes.scenarios import NOMINAL
from cz_gym.physics.schedule import DRAW_SPAN
from cz_gym.spaces import decode
from cz_gym.support.units import HOUR, MM

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
        np.testing.assert_allclose(seen.v_p, info["v_p"] - info["v_p_ref"], atol=1e-11)
    assert (np.abs(info["r_c"] - info["r_ref"]) < 3 * MM).all()


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


def test_a_crown_freezes_when_the_pull_stops():
    env = CzCrystalEnv(scenario="nominal", stage=0.05, **PLAIN)
    env.reset(seed=0)
    over = False
    while not over:
        *_, over, _, info = env.step(np.array([-1.0, 0.0], np.float32))
    assert info["succeeded"] == 0.0
    assert info["h_c"] < 1.0 * MM
    assert env._slots["k"][0] < 100


def test_weight_and_lean_info():
    env = gym.make("CzCrystal-v0", scenario="nominal", observation="measured", action="direct").unwrapped
    env.reset(seed=0)
    observation, *_, info = env.step(np.zeros(2, np.float32))
    assert info.keys() == {"r_c", "r_ref", "cost", "succeeded"}
    seen = decode(observation, *env.config.ranges, env.config.process)
    assert abs(seen.weight) <= 0.5 * 9.81 * signals.WEIGHT_STEP + 1e-4


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
