from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cz_gym.errors import CzError
from cz_gym.physics.parameters import Parameters
from cz_gym.puller import DEFAULT, KEYS, Puller, find_puller, read_puller, to_toml, value_of, write_puller
from cz_gym.units import KILO, MM


def file(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(f"format = 1\n{text}", "utf-8")
    return path


@st.composite
def pullers(draw: st.DrawFn) -> Puller:
    parts: dict[str, dict[str, object]] = {"parameters": {}, "drives": {}, "sensors": {}, "melt": {}, "": {}}
    for key in KEYS:
        if key.field in ("heater_max", "pull_max", "g", "sigma_SB", "alpha_0", "rho_l", "sigma", "phi_b", "T_m"):
            continue
        middle = value_of(DEFAULT, key)
        low, high = (max(key.low, -100.0) * float(key.size), min(key.high, 100.0) * float(key.size))
        if key.part == "parameters":
            low, high = 0.9 * middle, 1.1 * middle
        value = draw(st.none() | st.floats(low, high, allow_subnormal=False))
        if value is not None:
            other = draw(st.floats(low, high, allow_subnormal=False))
            parts[key.part][key.field] = tuple(sorted((value, other))) if key.drawn else value
    kinds = {name: type(getattr(DEFAULT, name))(**found) for name, found in parts.items() if name}
    return Puller(draw(st.sampled_from(["my puller", "Züchtung 3", '"q"\\'])), **kinds, **parts[""])  # type: ignore[arg-type]


@settings(max_examples=60, deadline=None)
@given(puller=pullers())
def test_what_is_written_is_read_again_bit_for_bit(puller: Puller, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("puller") / "mine.toml"
    write_puller(puller, path)
    again = read_puller(path)
    assert again == puller
    assert again.hash == puller.hash
    assert to_toml(again) == to_toml(puller)


def test_what_a_file_does_not_say_keeps_the_defaults_value_and_is_listed(tmp_path: Path) -> None:
    puller = read_puller(file(tmp_path, "[crystal]\nradius_mm = 100\n[sensors]\ncamera_noise_mm = [0, 0.05]\n"))
    assert puller.parameters == Parameters(r_0=100 * MM)
    assert puller.sensors.camera_noise == (0.0, 0.05 * MM)
    assert puller.name == "mine"
    assert "C_1_J_per_K" in puller.missing
    assert not {"radius_mm", "camera_noise_mm"} & set(puller.missing)


def test_the_default_file_is_the_puller_of_every_environment_without_one() -> None:
    default = find_puller("default")
    assert default == DEFAULT == find_puller(None)
    assert default.label == ""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[crystal]\nradius_mmm = 150", "did you mean 'radius_mm'"),
        ("[crystal]\nradius_m = 0.15", "did you mean 'radius_mm'"),
        ("[crystal]\nC_1_J_per_K = 5e4", "belongs in [hot_zone]"),
        ("[crystall]\nradius_mm = 150", "did you mean '[crystal]'"),
        ("[crystal]\nradius_mm = 0.15", "did you mean 150 (0.15 m)"),
        ("[crystal]\nT_m_K = true", "must be a number"),
        ("[crystal]\nradius_mm = [1, 2]", "must be a number"),
        ("[crystal]\nradius_mm = inf", "must be a number"),
        ("[crystal]\nradius_mm = 1e9999", "no plausible number"),
        ("[crystal]\nradius_mm = 300", "must be wider than the crystal"),
        ("[hot_zone]\nT_a_K = 25", "did you mean 298.15 (25 °C)"),
        ("[hot_zone]\nC_1_J_per_K = 57", "did you mean 57000 (57 kJ/K)"),
        ("[drives]\nheater_range_kW = 5000", "did you mean 5 (5000 W)"),
        ("[drives]\nheater_max_kW = 20", "excludes the operating point, which needs"),
        ("[drives]\npull_max_mm_per_min = 1", "excludes the operating point, whose pull speed is 1.2"),
        ("[sensors]\ncamera_noise_mm = [0.1, 0.05]", "low <= high"),
        ("[sensors]\ninterval_s = 2000", "did you mean 2 (2000 ms)"),
        ("name = 5", "must be up to 80 printable characters"),
        ("crystal = 5", "must be a table"),
        ("[crystal", "mine.toml"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = file(tmp_path, text)
    with pytest.raises(CzError) as refused:
        read_puller(path)
    assert said in str(refused.value)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


def test_other_formats_and_unknown_pullers_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "old.toml"
    path.write_text("[crystal]\n")
    with pytest.raises(CzError, match="expected 'format = 1'"):
        read_puller(path)
    with pytest.raises(CzError, match="unknown puller 'defaul': did you mean 'default'"):
        find_puller("defaul")
    with pytest.raises(CzError, match="No such file"):
        find_puller("none.toml")
    with pytest.raises(CzError, match="excludes the operating point"):
        replace(DEFAULT, drives=DEFAULT.drives._replace(heater_max=20 * KILO))
