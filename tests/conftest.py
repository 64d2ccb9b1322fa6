"""What the tests share: one place for compiled code, and the plant's equations written a second time.

Where a package for training is not installed, the tests that need it are skipped, whole modules where they import it.
"""

import importlib.util
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import settings
from scipy.integrate import solve_ivp

os.environ["SDL_VIDEODRIVER"] = os.environ["SDL_AUDIODRIVER"] = "dummy"  # no test opens a window
CACHE = Path(__file__).parents[1] / ".pytest_cache" / "cz-gym"
os.environ.setdefault("CZ_GYM_CACHE_DIR", str(CACHE))

settings.register_profile("repeatable", deadline=None, derandomize=True, database=None, max_examples=40)
settings.register_profile("long", deadline=None, database=None, max_examples=20_000)
settings.load_profile("repeatable")

HOUR = 3600.0
TRAINING = ("torch", "stable_baselines3", "sb3_contrib", "safetensors", "tensorboard")
ABSENT = tuple(name for name in TRAINING if importlib.util.find_spec(name) is None)
if sys.platform == "win32":
    collect_ignore = ["stress"]  # signals, pipes and limits of memory as POSIX has them


def pytest_sessionstart() -> None:
    """Of parallel workers one compiles what most tests need, the camera's images too; the others then load it."""
    if "PYTEST_XDIST_WORKER" in os.environ and importlib.util.find_spec("filelock"):
        from cz_gym import CzEnv
        from cz_gym.atomic_files import locked

        CACHE.mkdir(parents=True, exist_ok=True)
        with locked(CACHE, patience=600.0):
            env = CzEnv(observation="camera")
            env.reset(seed=0)
            env.step(np.zeros(2, np.float32))


def lacks(error: BaseException | None) -> bool:
    """Whether an error comes from a package for training that is not installed."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and str(error.name).partition(".")[0] in ABSENT:
            return True
        error = error.__cause__ or error.__context__
    return False


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[None]:
    report: Any = yield
    failed = report.failed and report.call.excinfo
    if failed and lacks(failed.value):
        report.outcome, report.longrepr = "skipped", (str(collector.path), 0, "Skipped: no package for training")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    try:
        return (yield)
    except ModuleNotFoundError as error:
        if lacks(error):
            pytest.skip(f"no {error.name}")
        raise


class Truth(NamedTuple):
    """What drives the plant over a stretch of time."""

    v_p: float
    Q_H: float
    Q_d: float = 0.0
    dT_i: float = 0.0
    melt: float = 1.0


def design_rates(x: np.ndarray, u: Truth, p: Any) -> np.ndarray:
    """The design's equations, written a second time from its text: arcsin and arctan, powers of four."""
    r_c, h_c, T_1, T_2, T_b = x
    A, B = h_c / (2 * r_c), 1 - h_c**2 / p.a**2
    theta = np.arcsin(B / np.sqrt(1 + A**2)) - np.arctan(A)
    alpha_c = theta - np.arctan2(p.sin_alpha_0, p.cos_alpha_0)
    Phi_l = p.k_l * (T_b + u.dT_i - p.T_m) * (p.lam / h_c + (1 - p.lam) / p.h_0)
    v_g = (p.Phi_s - Phi_l) / p.rho_dH
    link = p.kappa_12 * (T_1**4 - T_2**4)
    wall = p.G_2b * (T_2 - T_b)
    return np.array(
        [
            v_g * np.tan(alpha_c),
            u.v_p - v_g,
            (u.Q_H - link - p.G_1a * (T_1 - p.T_a)) / p.C_1,
            (link - wall) / p.C_2,
            (wall - p.kappa_b * (T_b**4 - p.T_e**4) - p.Q_i + u.Q_d) / (p.C_b * u.melt),
        ]
    )


def integrated(x: Any, u: Truth, p: Any, dt: float, **options: Any) -> Any:
    """What SciPy's tightest DOP853 makes of them, from x over dt [s]."""
    settings: dict[str, Any] = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-16 * np.abs(x), **options}
    return solve_ivp(lambda _, y: design_rates(y, u, p), (0.0, dt), np.array(x), **settings)


class View:
    """A NumPy record's fields as floats."""

    def __init__(self, record: Any) -> None:
        for name in record.dtype.names:
            setattr(self, name, float(record[name]))


def drawn(env: Any) -> Any:
    """The random series of a scalar environment's episode, drawn from its key as a whole."""
    from cz_gym.episodes.series import draw_episode, new_series

    config = env.config
    series = new_series(int(config.horizon // 5.0) + 2, config.steps + 1)
    draw_episode(config.sole_scenario, tuple(env.get_state().slot.slot["key"].tolist()), series)
    return series


def hold(info: dict[str, Any], p: Any) -> float:
    """Pull action that holds any crystal, from its true state: poles near 0.01 rad/s."""
    return float(1000 * (info["r_c"] - info["r_ref"]) - 700 * (info["h_c"] - p.h_0))


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[[Callable[[list[str]], int], Sequence[str]], str]:
    """A function that runs a command which must refuse its arguments; the one line that it says."""

    def run(main: Callable[[list[str]], int], arguments: Sequence[str]) -> str:
        try:
            code: Any = main([*arguments])
        except SystemExit as left:
            code = left.code
        said = capsys.readouterr()
        assert (code, said.out, said.err.count("\n")) == (2, "", 1), said
        return said.err

    return run


@pytest.fixture
def few_crystals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Training runs of this process pick and judge on two crystals each."""
    from cz_gym.agents.training import validation
    from cz_gym.evaluation.protocol import VALIDATION_SEEDS

    monkeypatch.setattr(validation, "PICKING", VALIDATION_SEEDS[:2])
    monkeypatch.setattr(validation, "JUDGING", VALIDATION_SEEDS[2:4])
    monkeypatch.setattr("cz_gym.agents.from_sb3.JUDGING", VALIDATION_SEEDS[2:4])


@pytest.fixture(scope="session")
def ppo() -> Any:
    """An algorithm that has learned a little, for tests that leave it as it is."""
    from tests.small_learners import SMALL, trained

    return trained(SMALL)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20)
