"""Installation: one package with four dependencies, by every way of installing it."""

import importlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

import cz_gym
from tests.conftest import ROOT, python
from tests.golden.digest import digest

SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = SETTINGS["project"]
BESIDE = ("agents", "baselines", "examples")
"""Folders that stand beside the package and are packages in it."""
UNPACKED = {"build", "dist", "runs", "results", "venv", "__pycache__"}
"""Folders that no build needs, beside the hidden ones."""
NAMES = """
import importlib, sys
for name in ("cz_gym", "cz_gym.tools.registry", "cz_gym.agents.contract"):
    print(importlib.import_module(name).__file__)
assert "cz_gym.baselines" in sys.modules
assert not {"baselines", "agents"} & set(sys.modules)
"""
SMOKE = """
import gymnasium as gym
import numpy as np
env = gym.make("cz_gym:Cz-v0", scenario="puller", observation="history")
observation, _ = env.reset(seed=1)
for _ in range(20):
    observation, *_ = env.step(env.action_space.sample())
assert np.isfinite(observation).all()
from cz_gym.baselines import CompensatedPID
import cz_gym.baselines.analysis
batch = gym.make_vec("Cz-v0", num_envs=2, vectorization_mode="vector_entry_point")
batch.reset(seed=1)
assert CompensatedPID().predict(batch.step(np.zeros((2, 2)))[0])[0].shape == (2, 2)
"""
ABSENT = """
import sys
class Blind:
    def __init__(self, finder):
        self.finder = finder
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in {absent} else self.finder.find_spec(name, path, target)
sys.meta_path[:] = map(Blind, sys.meta_path)
"""


def printed(code, place, cwd):
    """Lines that a fresh process prints, which finds packages in ``place``, as an installer left it, before others."""
    prelude = (
        "import site, sys\n"
        "sys.meta_path[:] = [f for f in sys.meta_path if 'editable' not in getattr(f, '__module__', '')]\n"
        "for name in [name for name in sys.modules if 'editable' in name]:\n"
        "    del sys.modules[name]\n"
        f"sys.path[:] = [{str(place)!r}] + [p for p in sys.path if p not in ('', {str(ROOT)!r})]\n"
        f"site.addsitedir({str(place)!r})\n"
    )
    return python("-W", "error", "-c", prelude + code, cwd=cwd).split()


@pytest.mark.slow
def test_a_clone_finds_its_packages_without_an_installation():
    """As after ``pip install .``, whose package the clone's own folder hides."""
    code = "import cz_gym.baselines, cz_gym.agents; print(cz_gym.baselines.__file__)"
    assert printed(f"import sys; sys.path.insert(0, {str(ROOT)!r}); {code}", ROOT / "docs", ROOT) == [
        str(ROOT / "baselines" / "__init__.py")
    ]


def test_every_package_is_listed():
    found = {
        ".".join(("cz_gym", *file.parent.relative_to(ROOT / (top if top == "cz_gym" else ".")).parts))
        for top in ("cz_gym", *BESIDE)
        for file in (ROOT / top).rglob("__init__.py")
    }
    listed = SETTINGS["tool"]["setuptools"]["packages"]
    assert sorted(listed) == sorted(found)


def test_versions_agree_and_core_dependencies_are_four():
    assert cz_gym.__version__ == PROJECT["version"]
    assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text()
    names = [requirement.partition(">")[0] for requirement in PROJECT["dependencies"]]
    assert names == ["gymnasium", "numpy", "scipy", "numba", "llvmlite"]


def required(extra):
    """Requirements of the project with an extra, on Python 3.11."""
    parse = pytest.importorskip("packaging.requirements").Requirement
    extras = PROJECT["optional-dependencies"]
    every = [*map(parse, [*PROJECT["dependencies"], *extras[extra]])]
    for own in [each for each in every if each.name == PROJECT["name"]]:
        every.remove(own)
        every += [parse(text) for name in own.extras for text in extras[name]]
    return [each for each in every if not each.marker or each.marker.evaluate({"python_version": "3.11"})]


@pytest.mark.parametrize("file", ["constraints.txt", "constraints-lowest.txt"])
def test_pins_lie_in_the_open_ranges(file):
    """And ``make test-lowest`` tests the lowest versions of all it names; torch alone stands where its note says."""
    version = pytest.importorskip("packaging.version").Version
    lines = [line for line in (ROOT / file).read_text().splitlines() if not line.startswith("#")]
    pins = {name.lower().replace("_", "-"): pin for name, pin in (line.split("==") for line in lines)}
    requirements = required("test")
    for requirement in requirements:
        (bound,) = (each for each in requirement.specifier if each.operator != "<")
        pin, least = pins[requirement.name.lower()], version(bound.version).release
        assert bound.operator == ">=", requirement
        assert requirement.specifier.contains(pin), requirement
        if "lowest" in file and requirement.name != "torch":
            assert version(pin).release[: len(least)] == least, requirement
    if "lowest" in file:
        assert {requirement.name for requirement in requirements} == set(pins)


@pytest.mark.parametrize("extra", ["benchmark", "docs", "test"])
def test_the_lock_holds_the_pinned_versions_with_hashes(extra):
    locked = tomllib.loads((ROOT / f"pylock.{extra}.toml").read_text())["packages"]
    lines = (line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines()[1:])
    pins = {plain(name): version for name, version in lines}
    assert {each["name"]: each["version"] for each in locked if each["name"] in pins}.items() <= pins.items()
    files = [file for each in locked for file in (*each.get("wheels", ()), *filter(None, [each.get("sdist")]))]
    assert all(file["hashes"]["sha256"] for file in files)
    names = {each["name"] for each in locked}
    assert {plain(each.name) for each in required(extra)} - names <= {"torch"}
    assert "torch" not in names, "pip's settings say which build of it to take"


LOCKED = """lock-version = "1.0"
created-by = "test"
[[packages]]
name = "nowhere"
version = "1.0"
wheels = [{{ path = "{wheel}", hashes = {{ sha256 = "{hash}" }} }}]
"""


@pytest.mark.parametrize(("tag", "code", "said"), [("any", 2, "Hash mismatch"), ("win32", 0, "by constraints")])
def test_make_stops_at_another_hash_and_goes_on_without_a_lock_for_this_machine(tag, code, said, tmp_path):
    pytest.importorskip("uv")
    wheel = tmp_path / f"nowhere-1.0-py3-none-{tag}.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("nowhere-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: nowhere\nVersion: 1.0\n")
    (tmp_path / "pylock.benchmark.toml").write_text(LOCKED.format(wheel=wheel.name, hash="0" * 64))
    (tmp_path / ".venv").mkdir()
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    line = ["make", "-s", "-f", ROOT / "Makefile", f"BIN={Path(sys.executable).parent}", "install=true"]
    done = subprocess.run([*line, ".venv/.ready-benchmark"], cwd=tmp_path, capture_output=True, text=True)
    assert said in done.stdout + done.stderr
    assert done.returncode == code


def test_actions_are_pinned_by_hash():
    uses = re.findall(r"uses: (\S+)", "".join(file.read_text() for file in (ROOT / ".github").rglob("*.yml")))
    assert len(uses) > 5
    assert all(re.fullmatch(r"[\w/-]+@[0-9a-f]{40}", each) for each in uses)


def test_environment_and_baselines_need_neither_torch_nor_plots():
    absent = {"torch", "stable_baselines3", "sb3_contrib", "matplotlib", "onnxruntime", "onnx", "tensorboard"}
    absent |= {"control", "tqdm", "pygame", "casadi"}
    python("-W", "error", "-c", ABSENT.replace("{absent}", repr(absent)) + SMOKE, cwd=ROOT)


@pytest.mark.parametrize("command", ["train.py", "benchmark.py", "-m cz_gym bode", "-m cz_gym data"])
def test_outside_the_virtual_environment_one_line_says_so(command):
    line = [sys.executable, "-S", *command.split()]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, env={"PATH": os.environ["PATH"]})
    assert done.returncode != 0
    assert "gymnasium is missing: run .venv/bin/python" in done.stderr
    assert done.stderr.count("\n") == 1


def brought(requirements, extras=(), found=()):
    """Names of the packages that pip installs for requirements, with all that they require themselves."""
    found = set(found)
    for each in map(importlib.import_module("packaging.requirements").Requirement, requirements):
        if each.marker and not any(each.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            continue
        if (name := plain(each.name)) not in found or each.extras:
            found |= brought(metadata.requires(name) or [], each.extras, found | {name})
    return found


def plain(name):
    return re.sub("[-_.]+", "-", name).lower()


USES = {
    "benchmark": "run('benchmark --controllers paper --scenarios nominal --episodes 1 --quiet --out', out)",
    "agents": "import cz_gym.agents.train, cz_gym.agents.apg, cz_gym.agents.from_sb3, cz_gym.agents.asymmetric",
    "render": "import gymnasium; e = gymnasium.make('cz_gym:Cz-v0', render_mode='rgb_array'); e.reset(); e.render()",
    "mpc": "from examples.mpc import mpc; import cz_gym.config as c; mpc(c.make_config('nominal')).programme",
    "data": "run('data --policies paper --scenarios nominal --episodes 1 --out', out)",
    "cluster": "import cz_gym.evaluation.parallel as c, distributed; distributed.Client; c.versions()",
    "plant": "import cz_gym.tools.serve.opcua; run('export --plant --to fmu --out', out)",
}
"""What a user of each extra does with it."""


@pytest.mark.slow
@pytest.mark.parametrize("extra", USES)
def test_an_extra_alone_brings_all_that_its_use_needs(extra, tmp_path):
    """Minari imports Pillow and does not require it: it was there because matplotlib was."""
    pytest.importorskip("packaging.requirements")
    names = brought([*PROJECT["dependencies"], *PROJECT["optional-dependencies"][extra]])
    owners = metadata.packages_distributions().items()
    absent = {module for module, of in owners if not {"cz-gym", "setuptools", *names} & set(map(plain, of))}
    run = "def run(words, out):\n    assert main([*words.split(), out]) == 0\n"
    code = f"from cz_gym_command import main\n{run}out = {str(tmp_path / 'out')!r}\n{USES[extra]}"
    python("-c", ABSENT.replace("{absent}", repr(absent)) + code, cwd=ROOT)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A checkout, without what no build needs."""
    folder = tmp_path_factory.mktemp("source")

    def left_out(place, names):
        return {name for name in names if name in UNPACKED or name[0] == "."}

    shutil.copytree(ROOT, folder, ignore=left_out, dirs_exist_ok=True)
    return folder


@pytest.mark.slow
def test_the_wheel_holds_one_package_and_what_it_needs(source, tmp_path):
    python("-m", "build", "--no-isolation", "--outdir", str(tmp_path), str(source))
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as archive:
        names = set(archive.namelist())
        archive.extractall(tmp_path / "installed")
    tops = {name.partition("/")[0] for name in names if ".dist-info/" not in name}
    assert tops == {"cz_gym", "cz_gym_command.py"}
    parts = {part for name in names for part in Path(name).parts}
    assert not parts & {"tests", "studies", "docs", "results"}
    assert "cz_gym/examples/sb3_ppo.py" in names
    assert not any(name.startswith("examples/") for name in names)
    shipped = [f"cz_gym/agents/models/{file.name}" for file in (ROOT / "agents" / "models").glob("*-*.*")]
    assert {"cz_gym/py.typed", *shipped} <= names
    assert len(shipped) > 10
    assert any(name.endswith("licenses/LICENSE") for name in names)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        kept = {name.partition("/")[2] for name in archive.getnames()}
    assert {"Makefile", "train.py", "studies/paper/__main__.py", "tests/conftest.py", "CITATION.cff"} <= kept
    home = tmp_path / "installed" / "cz_gym"
    modules = [home / "__init__.py", home / "tools/registry.py", home / "agents/contract.py"]
    assert printed(NAMES, home.parent, tmp_path) == list(map(str, modules))
    script = str(ROOT / "tests" / "golden" / "digest.py")
    code = f"{SMOKE}\nimport runpy\nrunpy.run_path({script!r}, run_name='__main__')"
    assert printed(code, home.parent, tmp_path) == [digest(), str(modules[0])]


@pytest.mark.slow
def test_an_editable_install_finds_the_folders_beside_the_package(source, tmp_path):
    code = f"from setuptools.build_meta import build_editable\nbuild_editable({str(tmp_path)!r})"
    python("-c", code, cwd=source)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as archive:
        archive.extractall(tmp_path / "installed")
    modules = ["cz_gym/__init__.py", "cz_gym/tools/registry.py", "agents/contract.py"]
    assert printed(NAMES, tmp_path / "installed", tmp_path) == [str(source / name) for name in modules]
