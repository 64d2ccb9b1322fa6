"""Slow controllers: fewer episodes, cached and resumed, and run only when asked for."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cz_gym
import cz_gym.agents
from cz_gym.baselines import OpenLoop
from cz_gym.baselines.clairvoyant import Clairvoyant
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import SPEED, Metrics, metrics, names_of
from cz_gym.evaluation.protocol import Case, Contender
from cz_gym.evaluation.rollout import rollout
from cz_gym.tools import benchmark, registry
from cz_gym.tools import run as runner
from cz_gym.tools.episodes import values_of
from cz_gym.tools.run import code_behind, sources_behind
from tests.observed import PLAIN

CONFIG = make_config(horizon=300.0, **PLAIN)
SEEDS = range(5)


@dataclass(frozen=True)
class Snail(OpenLoop):
    """Does nothing, and says so in its settings."""

    setting: float = 0.0

    @property
    def hash(self):
        return repr(self)


def slow(policy):
    return Contender("snail", lambda config: policy, "measured", "slow", slow=True)


@dataclass(frozen=True)
class Fixed(Case):
    """A row of given settings and seeds."""

    given: Any = CONFIG
    these: Any = SEEDS

    def config(self, *arguments):
        return self.given

    design_config = config

    def seeds(self, episodes):
        return self.these


def sample(folder, policy=None, config=CONFIG, seeds=SEEDS):
    row = Fixed("some", "randomized", "", given=config, these=seeds)
    return runner.run([slow(policy or Snail())], [row], 500, folder)


@pytest.fixture
def counted(monkeypatch):
    """Seeds of every episode that was really run; with a -1 before it, the next block is interrupted."""
    ran = []

    def counting(policy, config, seeds, *more):
        if ran[-1:] == [-1]:
            raise KeyboardInterrupt
        ran.extend(seeds)
        return rollout(policy, config, seeds, *more)

    monkeypatch.setattr(runner, "rollout", counting)
    monkeypatch.setattr(runner, "BLOCK", 2)
    return ran


def values(benchmark):
    return values_of(benchmark.episodes, names_of(Metrics))[0]


def test_episodes_are_run_once_and_are_those_of_one_rollout(tmp_path, counted):
    """But for the first, which runs again for its signals."""
    first, again = sample(tmp_path, seeds=range(2)), sample(tmp_path)
    assert counted == [0, 1, 0, 2, 3, 4]
    direct = rollout(OpenLoop(), CONFIG, SEEDS)
    assert again.episodes["seed"].tolist() == [*SEEDS]
    assert (again.episodes[SPEED] > 0.0).all()
    np.testing.assert_allclose(values(again), np.stack(metrics(direct), axis=-1), rtol=1e-12)
    np.testing.assert_array_equal(values(again)[:2], values(first))
    for ours, theirs in zip(again.signals["some", "snail"], direct.episode(0), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path, counted):
    sample(tmp_path, seeds=range(2))
    counted.append(-1)
    with pytest.raises(KeyboardInterrupt):
        sample(tmp_path)
    counted.clear()
    assert values(sample(tmp_path)).shape == (5, len(names_of(Metrics)))
    assert counted == [0, 2, 3, 4]


def test_cached_episodes_serve_no_other_settings_plant_or_scenario(tmp_path, counted):
    others = (
        (Snail(), CONFIG),
        (Snail(setting=1.0), CONFIG),
        (Snail(), CONFIG.with_scenario("hard")),
        (Snail(), replace(CONFIG, parameters=CONFIG.parameters._replace(k_l=60.0))),
        (Snail(), replace(CONFIG, horizon=600.0)),
    )
    for policy, config in others:
        sample(tmp_path, policy, config, range(1))
    assert counted == [0] * 5


def test_a_damaged_file_is_written_anew_and_rows_of_other_settings_stay(tmp_path, counted):
    whole = sample(tmp_path, seeds=range(2))
    sample(tmp_path, Snail(setting=1.0), seeds=range(2))
    np.testing.assert_array_equal(values(sample(tmp_path, seeds=range(2))), values(whole))
    assert counted == [0, 1, 0, 1, 0]
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-20])
    np.testing.assert_array_equal(values(sample(tmp_path, seeds=range(2))), values(whole))
    assert counted[5:] == [0, 1]


@pytest.mark.parametrize("package", runner.COMPUTING)
def test_another_version_of_a_package_that_computes_runs_cached_episodes_again(package, tmp_path, counted, monkeypatch):
    sample(tmp_path, seeds=range(1))
    versions = runner.software(runner.COMPUTING)["packages"]
    monkeypatch.setattr(runner, "software", lambda packages: {"packages": {**versions, package: "99"}})
    sample(tmp_path, seeds=range(1))
    assert counted == [0, 0]


@pytest.mark.parametrize(
    ("room", "computes"),
    [
        *((name, True) for name in ("physics", "body", "episodes", "engine", "evaluation/metrics.py")),
        *((name, False) for name in ("rendering/canvas.py", "camera", "tools/report")),
    ],
)
def test_the_cache_key_holds_the_code_that_computes_and_not_the_code_that_draws(room, computes):
    """Kernels, draws and random streams were once left out; an edited palette threw hours of episodes away."""
    place, sources = Path(cz_gym.__file__).parent / room, {*sources_behind(Snail.__module__)}
    files = {*(place.rglob("*.py") if place.is_dir() else [place])}
    assert files <= sources if computes else not files & sources
    assert Path(__file__) in sources
    assert code_behind(Snail.__module__) != code_behind(Clairvoyant.__module__)


@pytest.fixture
def small(monkeypatch, tmp_path):
    """A registry of two quick controllers and a slow one that is a bound, two episodes for it, no agents."""
    snail = replace(slow(Snail()), name="clairvoyant", default=False, privileged=True)
    quick = tuple(registry.find_controller(name) for name in ("open-loop", "paper"))
    monkeypatch.setattr(cz_gym.agents, "shipped_names", list)
    monkeypatch.setitem(registry.KNOWN, "Cz-v0", (*quick, snail))
    monkeypatch.setattr(runner, "SLOW_EPISODES", 2)
    monkeypatch.setattr(benchmark, "CACHE", tmp_path / "cache")
    return tmp_path / "out"


def taking_part(arguments):
    given = benchmark.parse([*arguments, "--scenarios", "randomized,nominal"])
    return [each.name for each in benchmark.contenders_of(given, benchmark.cases_of(given))]


def test_slow_controllers_run_only_when_asked_for(small, refused):
    line = refused(benchmark.main, ["--controllers", "paper,clairvoyant", "--json", str(small / "all.json")])
    assert line == "cz-gym benchmark: 'clairvoyant' is slow: add --slow to run it on the first 50 episodes\n"
    assert not small.exists()
    for wanted in ([], ["--controllers", "all"]):
        assert "clairvoyant" not in taking_part(wanted)
        assert "clairvoyant" in taking_part([*wanted, "--slow"])


@pytest.mark.slow
def test_all_takes_those_that_are_cached_and_names_the_others(small, capsys):
    everyone = ["--controllers", "all", "--episodes", "2"]
    nominal = ["--scenarios", "nominal", "--json", str(small / "all.json")]
    assert benchmark.main([*everyone, *nominal]) == 0
    said = capsys.readouterr().out
    assert "nominal (1 crystal)" in said
    assert "left out of all: clairvoyant, which are slow" in said
    arguments = ["--controllers", "clairvoyant", "--slow", "--scenarios", "nominal", "--episodes", "2", "--quiet"]
    assert benchmark.main([*arguments, "--json", str(small / "one.json")]) == 0
    assert "clairvoyant" not in taking_part(everyone)  # nominal is cached, randomized is not
    assert benchmark.main([*everyone, *nominal, "--overwrite"]) == 0
    assert "left out" not in capsys.readouterr().out
    assert "clairvoyant" in json.loads((small / "all.json").read_text())["results"]["nominal"]
    assert "clairvoyant" not in taking_part([])  # without names only the default takes part, whatever is cached
