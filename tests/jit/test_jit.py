"""Compiled code and its hash: the changed equation runs, in fresh processes, without a compiler, cache or home."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cz_gym import HURLE, CzEnv, Parameters
from cz_gym.body.process import BODY
from cz_gym.config import make_config
from cz_gym.engine.kernels import build_kernels
from cz_gym.jit import CachedCode, Store, cache_folder, hash_files, jittable, kernel, source_hash
from cz_gym.physics.meniscus import hurle_height
from tests.conftest import ROOT, python

FACTOR = """
from cz_gym import SCENARIOS
from cz_gym.episodes import draw
from cz_gym.jit import cache_folder
a = draw.factors_from_key(SCENARIOS["randomized"], (0.0, 1.0), (1, 2)).a
print(cache_folder(), a, sum(draw._factors.stats.cache_hits.values()), sep="|")
"""


@pytest.fixture
def package(tmp_path):
    """A folder that holds a copy of the package."""
    left_out = shutil.ignore_patterns("__pycache__", "agents", "baselines")
    shutil.copytree(ROOT / "cz_gym", tmp_path / "copy" / "cz_gym", ignore=left_out)
    return tmp_path / "copy"


def run(code, folder=ROOT, cache=None, **changed):
    """The output of a fresh process, split at bars; ``changed`` variables of its environment are removed by None."""
    changed = {"CZ_GYM_CACHE_DIR": cache and str(cache), "PYTHONPATH": str(folder), **changed}
    environment = {name: value for name, value in {**os.environ, **changed}.items() if value is not None}
    return python("-B", "-W", "error", "-c", code, cwd=folder, env=environment).strip().split("|")


@pytest.mark.slow
def test_changed_physics_is_never_run_from_an_old_cache(package, tmp_path):
    """The edited function is compiled into a loop that stands in another, unchanged module."""
    cache = tmp_path / "cache"
    folder, factor, hits = run(FACTOR, package, cache)
    assert (Path(folder).parent, hits) == (cache, "0")
    assert run(FACTOR, package, cache) == [folder, factor, "1"]
    file = package / "cz_gym" / "episodes" / "draw.py"
    file.write_text(file.read_text().replace("return 1.0 + spread *", "return 1.01 + spread *"))
    other, changed, hits = run(FACTOR, package, cache)
    assert float(changed) == pytest.approx(0.01 + float(factor))
    assert (other != folder, hits) == (True, "0")


@pytest.mark.parametrize(
    ("file", "before", "after", "same"),
    [
        ("physics/meniscus.py", '"""', '"""Edited: ', True),
        ("rendering/picture.py", "import", "SIZE = 1.0\nimport", True),
        ("physics/meniscus.py", "B = 1.0", "B = 1.01", False),
        ("physics/young_laplace.json", "1", "2", False),
    ],
)
def test_only_code_that_may_be_compiled_in_is_another_cache(file, before, after, same, package):
    module, hash_before = package / "cz_gym" / file, source_hash(package / "cz_gym")
    text = module.read_text()
    module.write_text(text.replace(before, after, 1))
    assert module.read_text() != text
    assert (source_hash(package / "cz_gym") == hash_before) is same


@pytest.mark.slow
def test_damaged_code_is_compiled_again(tmp_path):
    cache = tmp_path / "cache"
    folder, factor, _ = run(FACTOR, ROOT, cache)
    (file,) = Path(folder).rglob("*factors*.code")
    file.write_bytes(file.read_bytes()[:1000])
    assert run(FACTOR, ROOT, cache) == [folder, factor, "0"]
    assert run(FACTOR, ROOT, cache) == [folder, factor, "1"]
    assert not list(Path(folder).rglob("*.new"))


def test_code_for_other_types_is_not_used_and_a_full_disk_keeps_nothing(tmp_path, monkeypatch):
    store = Store(tmp_path, "kernel")
    store.save("floats", 1)
    store.save("integers", 2)
    os.replace(store.path("floats"), store.path("integers"))
    assert (store.load("integers"), store.load("floats")) == (None, None)
    store.save("integers", 3)
    assert store.load("integers") == 3

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("cz_gym.support.files.os.replace", full)
    store.save("floats", 1)
    assert store.load("floats") is None
    assert list(tmp_path.iterdir()) == [store.path("integers")]


@pytest.mark.slow
def test_processes_that_compile_at_once_all_have_it_right(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "CZ_GYM_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", FACTOR]
    several = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    printed = {process.communicate()[0].split("|")[1] for process in several}
    assert all(process.returncode == 0 for process in several)
    assert printed == {run(FACTOR, ROOT, tmp_path)[1]}
    assert run(FACTOR, ROOT, tmp_path)[2] == "1"


@pytest.fixture
def fresh(monkeypatch):
    """The choice of a cache folder, made anew and forgotten."""
    cache_folder.cache_clear()
    yield monkeypatch
    cache_folder.cache_clear()


def test_no_vector_mathematics_that_rounds_otherwise(package, tmp_path, fresh):
    fresh.delenv("NUMBA_DISABLE_INTEL_SVML", raising=False)
    code = "import cz_gym, numba\nprint(numba.config.DISABLE_INTEL_SVML, numba.config.USING_SVML)"
    assert run(code, package, tmp_path / "cache") == ["1 False"]


def test_without_a_writable_folder_nothing_is_cached(fresh, tmp_path):
    """No name, a home that is not there, a read-only file system."""
    (tmp_path / "file").write_text("in the way")
    for variable, value in (("CZ_GYM_CACHE_DIR", ""), ("XDG_CACHE_HOME", str(tmp_path / "file"))):
        cache_folder.cache_clear()
        fresh.setenv(variable, value)
        assert cache_folder() is None
        assert kernel(lambda x: x + 1)(1) == 2
        fresh.delenv(variable)
    fresh.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cache_folder.cache_clear()
    assert cache_folder() == next((tmp_path / "cache" / "cz-gym").iterdir())
    cache_folder.cache_clear()
    fresh.setattr("tempfile.TemporaryFile", lambda **options: os.stat("/no/such/place"))
    assert cache_folder() is None


def test_a_users_meniscus_is_never_run_from_a_cache():
    """No hash sees the user's own functions change."""

    @jittable
    def height(r_c, theta, a):
        return 1.1 * hurle_height(r_c, theta, a)

    for meniscus, kept in ((HURLE, True), (HURLE._replace(height=height), False)):
        assert isinstance(build_kernels(BODY, meniscus).step._cache, CachedCode) is kept


TWO_MENISCI = """
import sys
import gymnasium as gym
import numpy as np
from cz_gym import HURLE, make_puller
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
for name in sys.argv[1:]:
    meniscus = {"hurle": HURLE, "exact": YOUNG_LAPLACE}[name]
    env = gym.make("cz_gym:Cz-v0", scenario="nominal", model="I", meniscus=meniscus, info="all")
    env.reset(seed=0)
    for _ in range(20):
        info = env.step(np.zeros(2, np.float32))[4]
    assert abs(info["r_c"] - make_puller(meniscus=meniscus).r_0) < 1e-12, name
"""


@pytest.mark.slow
def test_code_of_two_menisci_that_two_processes_compiled_does_not_mix(tmp_path, monkeypatch):
    """Symbols had the same names: the linker took one meniscus for the other, and a crystal at rest grew."""
    monkeypatch.setenv("CZ_GYM_CACHE_DIR", str(tmp_path))
    for names in (["hurle"], ["exact"], ["hurle", "exact"], ["exact", "hurle"]):
        python("-c", TWO_MENISCI, *names)


def test_a_changed_equation_is_another_plant_and_the_same_said_otherwise_is_not(monkeypatch):
    def with_rates(change):
        return make_config(process=BODY._replace(rates=lambda *at: change(BODY.rates(*at)))).plant_hash

    assert with_rates(lambda x: x) == make_config().plant_hash
    assert with_rates(lambda x: x._replace(T_b=x.T_b * (1.0 + 1e-8))) != make_config().plant_hash
    assert with_rates(lambda x: x._replace(T_b=x.T_b * (1.0 + 1e-14))) == make_config().plant_hash
    assert make_config(parameters=Parameters(eps=0.201)).plant_hash != make_config().plant_hash


def stretched(by):
    """Hurle's meniscus, its height stretched."""

    @jittable
    def height(r_c, theta, a):
        return by * HURLE.height(r_c, theta, a)

    return HURLE._replace(name="stretched", height=height)


def test_two_menisci_of_one_factory_are_two_plants():
    hashes = {make_config(meniscus=stretched(by)).plant_hash for by in (1.0, 1.01, 1.02)}
    assert len(hashes) == 3
    assert make_config().plant_hash in hashes
    assert make_config(meniscus=stretched(1.01)).plant_hash in hashes
    assert make_config(meniscus=HURLE._replace(name="another name")).plant_hash == make_config().plant_hash


def test_the_hash_of_files_counts_code_and_not_text(tmp_path):
    module, hashes = tmp_path / "thing.py", []
    for text in ('"""A."""\nx = 1\n"""B."""\n', '"""C."""\n# why\nx = (\n    1\n)\n', "x = 2\n"):
        module.write_text(text)
        hashes.append(hash_files([module]))
    assert hashes[0] == hashes[1] != hashes[2]
    assert hash_files([module]) != hash_files([module.rename(tmp_path / "other.py")])


STEPS = """
import gymnasium as gym, numpy as np, cz_gym
one = gym.make("Cz-v0", scenario="puller", observation="measured")
two = cz_gym.CzVectorEnv(2, scenario="puller", observation="measured")
shown = one.reset(seed=1)[0], two.reset(seed=[1, 2])[0][0]
for _ in range(3):
    shown = one.step(np.zeros(2))[0], two.step(np.zeros((2, 2)))[0][0]
assert (shown[0] == shown[1]).all()
print(*shown[0])
"""
NOBODY = """
import pwd
def missing(user): raise KeyError(user)
pwd.getpwuid = missing
from cz_gym.jit import cache_folder
print(cache_folder())
"""


def test_the_environment_gives_the_same_numbers_without_a_compiler():
    env = CzEnv(scenario="puller", observation="measured")
    seen = env.reset(seed=1)[0]
    for _ in range(3):
        seen = env.step(np.zeros(2))[0]
    printed = [float(word) for word in run(STEPS, NUMBA_DISABLE_JIT="1")[0].split()]
    assert printed == pytest.approx(seen.tolist(), rel=1e-5, abs=1e-6)


@pytest.mark.skipif(sys.platform == "win32", reason="users as POSIX has them")
def test_a_user_without_a_home_has_no_cache():
    assert run(NOBODY, HOME=None, XDG_CACHE_HOME=None) == ["None"]
