import re
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cz_gym import SCENARIOS, CzEnv, CzVectorEnv, decode, make_puller
from cz_gym.config import Config, make_config
from cz_gym.engine.tangents import DifferentiableBatch
from cz_gym.episodes.scenarios import ALL, HARD, PULLER, RANDOMIZED, adapt_scenario
from cz_gym.physics.parameters import MACHINE, CrystalRecipe, Parameters
from cz_gym.puller import file as files
from cz_gym.puller.file import DEFAULT, FOLDER, PullerFile, chosen_puller, doubts, find_puller, read_puller, to_toml
from cz_gym.support.errors import CzError
from cz_gym.support.units import KILO, MM, MM_PER_MIN
from cz_gym.tools import puller as describe
from tests.observed import PLAIN

SHIPPED = sorted(path.stem for path in FOLDER.glob("*.toml"))
WIDE = find_puller("silicon-300mm")
AS_THEY_ARE = ("heater_max", "pull_max", "g", "sigma_SB", "alpha_0", "rho_l", "sigma", "phi_b", "T_m", "heater_step")


def file(folder, text):
    path = folder / "mine.toml"
    path.write_text(text if "format" in text else f"format = 1\n{text}", "utf-8")
    return path


@st.composite
def pullers(draw):
    parameters, recipe, own = {}, {}, {}
    for symbol, quantity in MACHINE.items():
        if symbol in AS_THEY_ARE:
            continue
        parts = (part for part, kind in ((parameters, Parameters), (recipe, CrystalRecipe)) if symbol in kind._fields)
        middle, part = files.value_of(DEFAULT, quantity), next(parts, own)
        low, high = (max(quantity.low, -100.0) * quantity.size, min(quantity.high, 100.0) * quantity.size)
        if part is not own:
            low, high = 0.9 * middle, 1.1 * middle
        value = draw(st.none() | st.floats(low, high, allow_subnormal=False))
        if value is not None:
            other = draw(st.floats(low, high, allow_subnormal=False))
            part[symbol] = tuple(sorted((value, other))) if quantity.drawn else value
    name = draw(st.sampled_from(["my puller", "Züchtung 3", '"q"\\']))
    return PullerFile(name, Parameters(**parameters), CrystalRecipe(**recipe), **own)


@settings(max_examples=60, deadline=None)
@given(puller=pullers())
@example(puller=PullerFile("ends", camera_noise=(5e-324, 1e-305), pyrometer_drift=(-100.0, 100.0), heater_step=0.3))
def test_what_is_written_is_read_again_bit_for_bit(puller, tmp_path_factory):
    path = tmp_path_factory.mktemp("puller") / "mine.toml"
    files.write_puller(puller, path)
    again = read_puller(path)
    assert (again, again.hash, to_toml(again)) == (puller, puller.hash, to_toml(puller))


def test_what_a_file_does_not_say_keeps_the_defaults_value_and_is_listed(tmp_path):
    text = "\ufeffformat = 1\n[crystal]\nradius_mm = 100\n[sensors]\ncamera_noise_mm = [0, 0.05]\n"
    puller = read_puller(file(tmp_path, text))  # with the mark that Windows' editors put first
    assert puller.parameters == Parameters(r_0=100 * MM)
    assert (puller.camera_noise, puller.name) == ((0.0, 0.05 * MM), "mine")
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
        ("[crystal]\nT_m_K = 3103", "must lie within 200 to 3000"),  # silicon carbide, which has no melt
        ("[crystal]\nT_m_K = 2900", "the heater would have to be at 38"),
        ("[hot_zone]\nT_a_K = 25", "did you mean 298.15 (25 °C)"),
        ("[hot_zone]\nC_1_J_per_K = 57", "did you mean 57000 (57 kJ/K)"),
        ("[drives]\nheater_range_kW = 5000", "did you mean 5 (5000 W)"),
        ("[drives]\nheater_max_kW = 20", "excludes the operating point, which needs"),
        ("[drives]\npull_max_mm_per_min = 1", "excludes the operating point, whose pull speed is 1.2"),
        ("[drives]\nheater_step_W = 10000", "no less than the heater's range, 10 kW"),
        ("[drives]\nheater_lag_s = [0, 2000]", "did you mean 2 (2000 ms)"),
        ("[sensors]\ncamera_noise_mm = [0.1, 0.05]", "low <= high, not [0.1, 0.05]"),
        ("[sensors]\ninterval_s = 2000", "did you mean 2 (2000 ms)"),
        ("name = 5", "must be up to 80 printable characters"),
        ("[crystal", "mine.toml"),
        ("format = 2", "expected 'format = 1'"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, text, said):
    path = file(tmp_path, text)
    with pytest.raises(CzError) as refused:
        read_puller(path)
    assert said in str(refused.value)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[crystal]\nradius_mm = 202", "R_cr_mm = 280 is 1.4 times radius_mm = 202, most are 2 to 4.5 times: is one"),
        ("[crystal]\nradius_mm = 202\n[hot_zone]\nR_cr_mm = 450\nC_b_J_per_K = 3e5", None),  # a 400 mm crystal
        ("[crystal]\nradius_mm = 202\n[hot_zone]\nR_cr_mm = 560", "would be 32 mm deep in a crucible with R_cr_mm"),
        ("[crystal]\nradius_mm = 10.1", "R_cr_mm = 280 is 28 times radius_mm = 10.1"),
        ("[crystal]\npull_speed_mm_per_min = 0.017", "most are 0.05 to 5: did you mean 1.02 (0.017 mm/s)"),
        ("[crystal]\npull_speed_mm_per_min = 10.1", "is unusual, most are 0.05 to 5"),
        ("[hot_zone]\nR_cr_mm = 560", "R_cr_mm = 560 is 6.4 times radius_mm = 87.5"),
        ("[hot_zone]\nT_e_K = 1027", "did you mean 1300.15 (1027 °C)"),
        ("[hot_zone]\nT_e_K = 900", None),  # no heat shield
        ("[drives]\nheater_step_W = 1000", "a coarse step"),
        ("[drives]\nheater_range_kW = 60", "more than the nominal power, 57"),
    ],
)
def test_what_is_improbable_is_questioned_in_one_line(tmp_path, text, said, capsys):
    chosen_puller(str(file(tmp_path, text)))
    missing, *doubts = capsys.readouterr().err.splitlines()
    assert "the default's values for" in missing
    assert said in doubts[0] if said else not doubts


def test_names_are_found_beside_folders_of_the_same_name(tmp_path, monkeypatch):
    with pytest.raises(CzError, match="unknown puller 'defaul': did you mean 'default'"):
        find_puller("defaul")
    monkeypatch.chdir(tmp_path)
    for name in ("default", "germanium", "other"):
        (tmp_path / name).mkdir()
    assert (find_puller("default"), find_puller("germanium").parameters.T_m) == (DEFAULT, 1211.0)
    with pytest.raises(CzError, match="unknown puller 'other'"):
        find_puller("other")


@pytest.mark.slow
def test_the_command_prints_what_a_file_implies(tmp_path, capsys):
    assert describe.main([str(file(tmp_path, "[crystal]\nradius_mm = 202\n[drives]\nheater_lag_s = [2, 5]"))]) == 0
    printed = capsys.readouterr()
    puller = make_puller(Parameters(r_0=0.202))
    for text in (f"{puller.Q_H_0 / KILO:.4g} kW", f"{puller.T_1_0:.0f} K", f"{puller.h_0 / MM:.3g} mm high", "404 mm",
                 "0 to 2.4 mm/min", "heater lag 2 to 5 s", "sigma_N_per_m = 0.72", "latency_s"):  # fmt: skip
        assert text in " ".join(printed.out.split())  # lines wrap
    assert "is one of them a diameter" in printed.err
    assert describe.implied(PullerFile(heater_range=60.0 * KILO))["heater"].startswith("0 to 117.")


@pytest.mark.parametrize("name", SHIPPED)
def test_one_many_and_differentiable_crystals_are_the_same_on_a_puller(name):
    given = {"puller": name, "scenario": "hard", "info": "all"}
    env = gym.make("Cz-v0", **given, **PLAIN).unwrapped
    many = CzVectorEnv(2, **given, **PLAIN)
    twin = DifferentiableBatch(many.config, 2)
    assert env.config == many.config
    assert not doubts(find_puller(name))
    assert env.config.control_interval == find_puller(name).control_interval
    first, _ = env.reset(seed=3)
    rows, _ = many.reset(seed=[3, 4])
    np.testing.assert_array_equal(rows[0], first)
    np.testing.assert_array_equal(twin.reset([3, 4])[1], rows)
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, (100, 2)).astype(np.float32):
        seen, gained, terminated, _, info = env.step(action)
        rows, rewards, lost, _, infos = many.step(np.tile(action, (2, 1)))
        np.testing.assert_array_equal(rows[0], seen)
        np.testing.assert_array_equal(twin.step(np.tile(action, (2, 1))).measured, rows)
        assert (rewards[0], lost[0], infos["r_c"][0]) == (gained, terminated, info["r_c"])
        read = decode(seen, *env.config.ranges)
        np.testing.assert_allclose(read.v_p + env.config.parameters.v_0, info["v_p"], rtol=1e-6)
    assert not terminated


def test_the_default_file_changes_nothing():
    assert find_puller("default") == DEFAULT == find_puller(None)
    assert find_puller("default").label == "default"
    for scenario in (*SCENARIOS, ALL, {"hard": 0.5, "puller": 0.5}):
        plain, filed = make_config(scenario), make_config(scenario, puller="default")
        assert (filed, filed.hash, filed.made_for, filed.identity) == (
            plain, plain.hash, plain.made_for, plain.identity)  # fmt: skip


def test_the_machine_is_the_files_and_the_crystal_the_scenarios():
    lagging = replace(WIDE, heater_lag=(0.0, 10.0), heater_dead_time=(5.0, 5.0), pyrometer_filter=(0.0, 20.0))
    assert len({WIDE.hash, lagging.hash, replace(WIDE, heater_lag=(5.0, 5.0)).hash,
                replace(WIDE, heater_dead_time=(5.0, 5.0)).hash}) == 4  # fmt: skip
    slow = adapt_scenario(lagging, PULLER)
    assert (slow.actuators.heater_lag, slow.actuators.heater_dead_time) == ((0.0, 10.0), (5.0, 5.0))
    assert slow.sensor.pyrometer_filter == (0.0, 20.0)
    drawn = replace(PULLER, actuators=replace(PULLER.actuators, heater_lag=(0.0, 10.0)))
    assert adapt_scenario(WIDE, drawn).actuators.heater_lag == (0.0, 10.0)  # a time stays as it is
    scenario = adapt_scenario(WIDE, PULLER)
    longer, faster = 150.0 / 87.5, 0.8 / 1.2
    assert scenario.sensor.camera_noise == WIDE.camera_noise
    assert (scenario.sensor.latency, scenario.interface.tau_fast) == (1.0, 40.0)
    assert scenario.actuators.pull_window == pytest.approx(0.4 * MM_PER_MIN)
    assert scenario.sensor.bias_offset == pytest.approx((-0.3 * longer * MM, 0.3 * longer * MM))
    assert (scenario.recipe, scenario.pullers.melt_loss) == (PULLER.recipe, PULLER.pullers.melt_loss)
    assert scenario.reference.amount[1] == pytest.approx(faster * PULLER.reference.amount[1])
    bare = replace(WIDE, pull_window=None, pull_slew=None, heater_slew=None)
    assert adapt_scenario(bare, PULLER).actuators.pull_window == pytest.approx(0.5 * faster * MM_PER_MIN)
    assert adapt_scenario(bare, PULLER).actuators.heater_slew == pytest.approx(1.5 * 2000.0 / 60.0)
    assert adapt_scenario(bare, HARD).hash != adapt_scenario(WIDE, HARD).hash != HARD.hash
    assert adapt_scenario(WIDE, scenario) == scenario
    assert adapt_scenario(WIDE, ALL).shares == ALL.shares
    with pytest.raises(CzError, match="is on another puller"):
        adapt_scenario(bare, scenario)


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


def test_what_is_left_alone_grows_as_fast_as_the_plant_does():
    """A small error on germanium, whose melt is small, by simulation with nominal drives."""
    text = describe.implied(find_puller("germanium"))["left alone"]
    said = [float(minutes) for minutes in re.findall(r"in ([\d.]+) min", text)]
    assert describe.implied(DEFAULT)["left alone"].startswith("Model I dies out, Model II grows")
    for model, minutes in zip(("I", "II"), said, strict=True):
        env = CzEnv("nominal", model=model, puller="germanium", action="direct", horizon=7200.0)
        env.reset(seed=0)
        errors = []
        for _ in range(env.unwrapped.config.steps):
            *_, over, cut, info = env.step(np.array([0.002, 0.0], np.float32) * (len(errors) < 60))
            errors.append(abs(info["r_c"] - info["r_ref"]))
            if over or cut:
                break
        late = np.log(errors[-1200:])
        assert 60.0 / np.polyfit(np.arange(len(late)) / 60.0, late, 1)[0] / 60.0 == pytest.approx(minutes, rel=0.2)
