from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import cz_gym
from cz_gym import SCENARIOS, CzVectorEnv, Scenario, decode, make_puller
from cz_gym.config import Config, make_config
from cz_gym.differentiable import DifferentiableBatch
from cz_gym.env import CzEnv
from cz_gym.episodes.scenarios import ALL, HARD, PULLER, RANDOMIZED
from cz_gym.errors import CzError
from cz_gym.machine.puller import (
    DEFAULT,
    KEYS,
    PullerFile,
    find_puller,
    on,
    read_puller,
    to_toml,
    value_of,
    write_puller,
)
from cz_gym.physics.parameters import Parameters
from cz_gym.support.units import KILO, MM, MM_PER_MIN
from tests.observed import PLAIN

SHIPPED = sorted(path.stem for path in cz_gym.machine.puller.FOLDER.glob("*.toml"))
WIDE = find_puller("silicon-300mm")


def file(folder, text):
    path = folder / "mine.toml"
    path.write_text(f"format = 1\n{text}", "utf-8")
    return path


@st.composite
def pullers(draw):
    parameters = {}
    own = {}
    for key in KEYS:
        if key.field in ("heater_max", "pull_max", "g", "sigma_SB", "alpha_0", "rho_l", "sigma", "phi_b", "T_m"):
            continue
        middle = value_of(DEFAULT, key)
        low, high = (max(key.low, -100.0) * float(key.size), min(key.high, 100.0) * float(key.size))
        if key.field in Parameters._fields:
            low, high = 0.9 * middle, 1.1 * middle
        value = draw(st.none() | st.floats(low, high, allow_subnormal=False))
        if value is not None:
            other = draw(st.floats(low, high, allow_subnormal=False))
            part = parameters if key.field in Parameters._fields else own
            part[key.field] = tuple(sorted((value, other))) if key.drawn else value
    return PullerFile(draw(st.sampled_from(["my puller", "Züchtung 3", '"q"\\'])), Parameters(**parameters), **own)


@settings(max_examples=60, deadline=None)
@given(puller=pullers())
@example(puller=PullerFile("ends", camera_noise=(5e-324, 1e-305), pyrometer_drift=(-100.0, 100.0)))
def test_what_is_written_is_read_again_bit_for_bit(puller, tmp_path_factory):
    path = tmp_path_factory.mktemp("puller") / "mine.toml"
    write_puller(puller, path)
    again = read_puller(path)
    assert again == puller
    assert again.hash == puller.hash
    assert to_toml(again) == to_toml(puller)


def test_what_a_file_does_not_say_keeps_the_defaults_value_and_is_listed(tmp_path):
    puller = read_puller(file(tmp_path, "[crystal]\nradius_mm = 100\n[sensors]\ncamera_noise_mm = [0, 0.05]\n"))
    assert puller.parameters == Parameters(r_0=100 * MM)
    assert puller.camera_noise == (0.0, 0.05 * MM)
    assert puller.name == "mine"
    assert "C_1_J_per_K" in puller.missing
    assert not {"radius_mm", "camera_noise_mm"} & set(puller.missing)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[crystal]\nradius_mmm = 150", "did you mean 'radius_mm'"),
        ("[crystal]\nradius_mm = nan", "radius_mm must be a number, not NaN"),
        ("[crystal]\nC_1_J_per_K = 5e4", "belongs in [hot_zone]"),
        ("[crystall]\nradius_mm = 150", "did you mean '[crystal]'"),
        ("[crystal]\nradius_mm = 0.15", "did you mean 150 (0.15 m)"),
        ("[crystal]\nradius_mm = [1, 2]", "must be a number, not [1, 2]"),
        ("[crystal]\nradius_mm = 1e9999", "no plausible number"),
        ("[crystal]\nradius_mm = 300", "must be wider than the crystal"),
        ("[hot_zone]\nT_a_K = 25", "did you mean 298.15 (25 °C)"),
        ("[hot_zone]\nC_1_J_per_K = 57", "did you mean 57000 (57 kJ/K)"),
        ("[drives]\nheater_range_kW = 5000", "did you mean 5 (5000 W)"),
        ("[drives]\nheater_max_kW = 20", "excludes the operating point, which needs"),
        ("[drives]\npull_max_mm_per_min = 1", "excludes the operating point, whose pull speed is 1.2"),
        ("[sensors]\ncamera_noise_mm = [0.1, 0.05]", "low <= high, not [0.1, 0.05]"),
        ("[sensors]\ninterval_s = 2000", "did you mean 2 (2000 ms)"),
        ("name = 5", "must be up to 80 printable characters"),
        ("[crystal", "mine.toml"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, text, said):
    path = file(tmp_path, text)
    with pytest.raises(CzError) as refused:
        read_puller(path)
    assert said in str(refused.value)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


def test_other_formats_and_unknown_pullers_are_refused(tmp_path):
    path = tmp_path / "old.toml"
    path.write_text("[crystal]\n")
    with pytest.raises(CzError, match="expected 'format = 1'"):
        read_puller(path)
    with pytest.raises(CzError, match="unknown puller 'defaul': did you mean 'default'"):
        find_puller("defaul")


@pytest.mark.parametrize("name", SHIPPED)
def test_one_many_and_differentiable_crystals_are_the_same_on_a_puller(name):
    given = {"puller": name, "scenario": "hard", "info": "all"}
    env = gym.make("Cz-v0", **given, **PLAIN).unwrapped
    many = CzVectorEnv(2, **given, **PLAIN)
    twin = DifferentiableBatch(many.config, 2)
    assert env.config == many.config
    assert env.config.control_interval == find_puller(name).control_interval
    first, _ = env.reset(seed=3)
    rows, _ = many.reset(seed=3)
    np.testing.assert_array_equal(rows[0], first)
    np.testing.assert_array_equal(twin.reset([3, 4])[1], rows)
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, (100, 2)).astype(np.float32):
        seen, gained, terminated, _, info = env.step(action)
        rows, rewards, lost, _, infos = many.step(np.tile(action, (2, 1)))
        np.testing.assert_array_equal(rows[0], seen)
        np.testing.assert_array_equal(twin.step(np.tile(action, (2, 1))).measured, rows)
        assert (rewards[0], lost[0]) == (gained, terminated)
        read = decode(seen, *env.config.ranges)
        np.testing.assert_allclose(read.v_p + env.config.parameters.v_0, info["v_p"], rtol=1e-6)
        assert infos["r_c"][0] == info["r_c"]
    assert not terminated


def test_the_default_file_changes_nothing():
    assert find_puller("default") == DEFAULT == find_puller(None)
    assert find_puller("default").label == "default"
    mixed = {"hard": 0.5, "puller": 0.5}
    for scenario in (*SCENARIOS, ALL, mixed):
        plain, filed = make_config(scenario), make_config(scenario, puller="default")
        assert filed == plain
        assert (filed.hash, filed.made_for, filed.identity) == (plain.hash, plain.made_for, plain.identity)


def test_the_machine_is_the_files_and_the_crystal_the_scenarios():
    scenario = on(WIDE, PULLER)
    assert isinstance(scenario, Scenario)
    longer, faster = 150.0 / 87.5, 0.8 / 1.2
    assert scenario.sensor.camera_noise == WIDE.camera_noise
    assert (scenario.sensor.latency, scenario.interface.tau_fast) == (1.0, 40.0)
    assert scenario.actuators.pull_window == pytest.approx(0.4 * MM_PER_MIN)
    assert scenario.sensor.bias_offset == pytest.approx((-0.3 * longer * MM, 0.3 * longer * MM))
    assert scenario.recipe == PULLER.recipe
    assert scenario.reference.amount[1] == pytest.approx(faster * PULLER.reference.amount[1])
    assert scenario.pullers.melt_loss == PULLER.pullers.melt_loss
    bare = replace(WIDE, pull_window=None, pull_slew=None, heater_slew=None)
    assert on(bare, PULLER).actuators.pull_window == pytest.approx(0.5 * faster * MM_PER_MIN)
    assert on(bare, PULLER).actuators.heater_slew == pytest.approx(1.5 * 2000.0 / 60.0)
    assert on(bare, HARD).hash != on(WIDE, HARD).hash != HARD.hash
    assert on(WIDE, scenario) == scenario
    assert on(WIDE, ALL).shares == ALL.shares
    with pytest.raises(CzError, match="is on another puller"):
        on(bare, scenario)


def test_limits_actions_and_episodes_are_in_proportion_to_the_puller():
    config = make_config("randomized", puller=WIDE, **PLAIN)
    assert config.control_interval == 2.0
    assert config.radius_limit == pytest.approx(8.0 * MM * 150.0 / 87.5)
    env = CzEnv.from_config(config, info="all")
    env.reset(seed=1, options={"scenario": "nominal"})
    power = env.step(np.array([1.0, 1.0], np.float32))[-1]["Q_H"]
    nominal = make_puller(WIDE.parameters).Q_H_0
    assert power - nominal == pytest.approx(3.0 * KILO * 2.0 / 60.0)  # its slew, on the nominal scenario too
    ceiling = replace(WIDE, heater_max=nominal + 5 * KILO, pull_max=0.9 * MM_PER_MIN)
    narrow = make_config("nominal", puller=ceiling)
    assert narrow.heater_range == pytest.approx(5 * KILO)
    assert narrow.scenario.scenarios[0].actuators.pull_window == pytest.approx(0.1 * MM_PER_MIN)


def test_another_pullers_states_actions_and_parameters_are_refused():
    env, other = CzEnv(puller=WIDE), CzEnv(puller=replace(WIDE, latency=2.0))
    env.reset(seed=1)
    other.reset(seed=1)
    with pytest.raises(CzError, match="saved under other settings"):
        other.set_state(env.get_state())
    with pytest.raises(CzError, match=r"parameters are those of the puller 'silicon-300mm'"):
        make_config(puller=WIDE, parameters=Parameters())
    with pytest.raises(CzError, match=r"puller must be a puller file"):
        make_config(puller=Config())
    assert make_config().with_scenario("randomized").scenario == RANDOMIZED
    assert "silicon-300mm (" in str(env.config.made_for)
