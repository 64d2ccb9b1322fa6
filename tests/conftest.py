"""Settings and fixtures of all tests: one folder for compiled code, a refused command, small trainings.

Where an optional package is not installed, the tests that need it are skipped, whole modules where they import it.
"""

import importlib.util
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

# Threads of torch and of NumPy's linear algebra wait for each other by spinning, all the longer beside other workers.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("CZ_GYM_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "cz-gym"))

import numpy as np
import pytest
from hypothesis import settings

from cz_gym.support.command_line import OPTIONAL

os.environ["SDL_VIDEODRIVER"] = os.environ["SDL_AUDIODRIVER"] = "dummy"  # no test opens a window
ROOT = Path(__file__).parents[1]
CACHE = Path(os.environ["CZ_GYM_CACHE_DIR"])

settings.register_profile("repeatable", deadline=None, derandomize=True, database=None, max_examples=40)
settings.register_profile("long", deadline=None, database=None, max_examples=20_000)
settings.load_profile("repeatable")

LARGE = ("torch", "stable_baselines3", "scipy.stats", "matplotlib.pyplot", "asyncua", "pandas", "control")
DOCUMENTING = ("sphinx", "myst_parser", "sybil", "jupytext", "nbformat")
ABSENT = tuple(name for name in (*OPTIONAL, *DOCUMENTING) if importlib.util.find_spec(name) is None)
if sys.platform == "win32":
    collect_ignore = ["stress"]  # signals, pipes and limits of memory as POSIX has them


def pytest_sessionstart():
    """Parallel workers begin with different parts of what most tests need: each compiles, then loads the others'."""
    if "PYTEST_XDIST_WORKER" not in os.environ or not importlib.util.find_spec("filelock"):
        return
    from cz_gym import CzEnv
    from cz_gym.config import make_config
    from cz_gym.crystal.process import CRYSTAL
    from cz_gym.engine.tangents import DifferentiableBatch
    from cz_gym.support.files import locked

    def stepped(**settings):
        env = CzEnv(**settings)
        env.reset(seed=0)
        env.step(np.zeros(2, np.float32))

    def derivatives():
        batch = DifferentiableBatch(make_config(observation="measured", action="direct"), 1)
        batch.reset([0])
        batch.step(np.zeros((1, 2)))

    parts = [lambda: stepped(observation="camera"), lambda: stepped(process=CRYSTAL), derivatives]
    first = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw")) % len(parts)
    for number in (*range(first, len(parts)), *range(first)):
        if number == (first - 1) % len(parts):  # the last one, which the other worker may still compile
            for package in LARGE:
                with suppress(ImportError):
                    importlib.import_module(package)
        (CACHE / f"part-{number}").mkdir(parents=True, exist_ok=True)
        with locked(CACHE / f"part-{number}", patience=3600.0):
            parts[number]()


def python(*arguments: str, cwd: Path = ROOT, env: dict[str, str] | None = None) -> str:
    """The output of Python with these arguments; its exit code must be 0."""
    done = subprocess.run([sys.executable, *arguments], cwd=cwd, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def lacks(error):
    """Whether an error comes from an optional package that is not installed."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and str(error.name).partition(".")[0] in ABSENT:
            return True
        error = error.__cause__ or error.__context__
    return False


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    report = yield
    failed = report.failed and report.call.excinfo
    if failed and lacks(failed.value):
        report.outcome, report.longrepr = "skipped", (str(collector.path), 0, "Skipped: no optional package")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    try:
        return (yield)
    except Exception as error:
        if lacks(error):
            pytest.skip(str(error))
        raise


@pytest.fixture
def refused(capsys):
    """A function that runs a command which must refuse its arguments; the one line that it says."""

    def run(main, arguments):
        try:
            code = main([*arguments])
        except SystemExit as left:
            code = left.code
        said = capsys.readouterr()
        assert (code, said.out, said.err.count("\n")) == (2, "", 1), said
        return said.err

    return run


@pytest.fixture
def few_crystals(monkeypatch):
    """Training runs of this process pick and judge on two crystals each."""
    from cz_gym.agents import recipes
    from cz_gym.evaluation.protocol import VALIDATION_SEEDS

    monkeypatch.setattr(recipes, "SELECTION_SEEDS", VALIDATION_SEEDS[:2])
    monkeypatch.setattr(recipes, "JUDGING_SEEDS", VALIDATION_SEEDS[2:4])
    monkeypatch.setattr("cz_gym.agents.from_sb3.JUDGING_SEEDS", VALIDATION_SEEDS[2:4])


@pytest.fixture(scope="session")
def ppo():
    """An algorithm that has learned a little, for tests that leave it as it is."""
    from tests.small_learners import SMALL, trained

    return trained(SMALL)


@pytest.fixture
def rng():
    return np.random.default_rng(20)
