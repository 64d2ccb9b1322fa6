from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "golden"))

from digest import digest

import cz_gym

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
BLOCKED = """
import sys

class Blind:
    def __init__(self, finder):
        self.finder = finder

    def __getattr__(self, name):
        return getattr(self.finder, name)

    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in BANNED else self.finder.find_spec(name, path, target)

sys.meta_path[:] = map(Blind, sys.meta_path)
"""
SMOKE = """
import gymnasium as gym
import numpy as np
env = gym.make("cz_gym:Cz-v0", scenario="puller", observation="history")
env.reset(seed=1)
for _ in range(20):
    observation, reward, *_ = env.step(env.action_space.sample())
assert np.isfinite(observation).all()
import cz_gym
batch = gym.make_vec("Cz-v0", num_envs=2, vectorization_mode="vector_entry_point")
batch.reset(seed=1)
from {baselines} import CompensatedPID
action, state = CompensatedPID().predict(batch.step(np.zeros((2, 2)))[0])
assert action.shape == (2, 2)
print(cz_gym.__file__)
"""


def run(code: str, folder: Path, path: Path) -> str:
    """What a fresh process prints, started in ``folder`` with ``path`` first."""
    prelude = f"import sys\nsys.path[:] = [{str(path)!r}] + [p for p in sys.path if p not in ('', {str(ROOT)!r})]\n"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", prelude + code], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_environment_and_baselines_need_neither_torch_nor_plots(tmp_path: Path) -> None:
    banned = [
        "torch", "stable_baselines3", "sb3_contrib", "matplotlib", "onnxruntime", "onnx", "optuna", "tensorboard",
        "control", "tqdm", "pygame", "casadi",
    ]  # fmt: skip
    code = f"BANNED = {banned!r}\n" + BLOCKED + SMOKE.format(baselines="cz_gym.baselines")
    assert run(code, tmp_path, ROOT) == str(ROOT / "cz_gym" / "__init__.py")


def test_core_dependencies_are_four() -> None:
    names = [requirement.partition(">")[0] for requirement in PROJECT["dependencies"]]
    assert names == ["gymnasium", "numpy", "scipy", "numba"]
    assert set(PROJECT["optional-dependencies"]) == {
        "benchmark",
        "agents",
        "render",
        "mpc",
        "peers",
        "docs",
        "browser",
        "test",
    }


def test_version_stands_once() -> None:
    assert cz_gym.__version__ == PROJECT["version"]


def test_pins_lie_in_the_open_ranges() -> None:
    packaging = pytest.importorskip("packaging.requirements")
    pins = dict(
        line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")
    )
    pins = {name.lower().replace("_", "-"): version for name, version in pins.items()}
    extras = PROJECT["optional-dependencies"]
    for text in [*PROJECT["dependencies"], *extras["benchmark"], *extras["agents"], *extras["docs"], *extras["test"]]:
        requirement = packaging.Requirement(text)
        if requirement.name != "cz-gym":
            assert requirement.specifier.contains(pins[requirement.name.lower()]), text
            assert "<" not in str(requirement.specifier)
    assert pins["torch"] == "2.13.0"


def test_lowest_versions_are_those_of_the_open_ranges() -> None:
    """``make test-lowest`` tests what pyproject.toml promises; torch alone stands where its note says."""
    packaging = pytest.importorskip("packaging.requirements")
    version = pytest.importorskip("packaging.version").Version
    lines = (ROOT / "constraints-lowest.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    extras = PROJECT["optional-dependencies"]
    tested = packaging.Requirement(extras["test"][0]).extras
    wanted = [*PROJECT["dependencies"], *extras["test"][1:], *(text for name in tested for text in extras[name])]
    requirements = [packaging.Requirement(text) for text in wanted]
    assert {requirement.name for requirement in requirements} == set(pins)
    for requirement in requirements:
        (lowest,) = (version(bound.version).release for bound in requirement.specifier)
        if requirement.name != "torch":
            assert version(pins[requirement.name]).release[: len(lowest)] == lowest, requirement


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    names = tracked.stdout.split("\0") if tracked.returncode == 0 else _files()
    source = folder / "source"
    for name in names:
        if name and (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(folder.glob("*.whl"))


def _files() -> list[str]:
    """What lies here if this is no checkout, but for what was made by running it."""
    made = {"build", "__pycache__", ".pytest_cache", ".hypothesis"}
    walked = ((Path(folder).relative_to(ROOT), names) for folder, _, names in os.walk(ROOT, followlinks=True))
    return [str(folder / name) for folder, names in walked if not made & set(folder.parts) for name in names]


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that an installer puts the wheel into; with it, its compiled code is made once."""
    folder = tmp_path_factory.mktemp("installed")
    command = [sys.executable, "-m", "pip", "install", "--disable-pip-version-check", "--quiet", "--no-deps"]
    done = subprocess.run([*command, "--no-index", "--target", str(folder), str(wheel)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_wheel_installs_one_package_and_works_outside_the_checkout(
    wheel: Path, installed: Path, tmp_path: Path
) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    top = {name.partition("/")[0] for name in names}
    assert {name for name in top if not name.endswith(".dist-info")} == {"cz_gym"}
    for needed in ("py.typed", "baselines/__init__.py", "agents/__init__.py", "evaluation/__init__.py"):
        assert f"cz_gym/{needed}" in names
    assert not any("tests" in Path(name).parts for name in names)
    assert any(name.endswith("licenses/LICENSE") for name in names)
    printed = run(SMOKE.format(baselines="cz_gym.baselines"), tmp_path, installed)
    assert printed == str(installed / "cz_gym" / "__init__.py")


def test_an_installed_wheel_gives_the_same_bits(installed: Path, tmp_path: Path) -> None:
    script = str(ROOT / "tests" / "golden" / "digest.py")
    printed = run(f"import runpy\nrunpy.run_path({script!r}, run_name='__main__')", tmp_path, installed)
    assert printed.split() == [digest(), str(installed / "cz_gym" / "__init__.py")]


def test_wheel_carries_the_shipped_agents(wheel: Path) -> None:
    shipped = [*(ROOT / "agents" / "models").glob("*.onnx"), *(ROOT / "agents" / "models").glob("*.json")]
    with zipfile.ZipFile(wheel) as archive:
        for file in shipped:
            assert f"cz_gym/agents/models/{file.name}" in archive.namelist()


def test_readme_example_runs_as_printed(capsys: pytest.CaptureFixture[str]) -> None:
    block = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert block is not None
    exec(compile(block.group(1), "README.md", "exec"), {})
    number = re.search(r"RMSE.*?([0-9.]+) mm", capsys.readouterr().out)
    assert number is not None
    assert 0.0 < float(number.group(1)) < 2.0
