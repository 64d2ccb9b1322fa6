"""Slow controllers: fewer episodes, cached and resumed, and run only when asked for."""

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tqdm import tqdm

import benchmark
import cz_gym
from cz_gym.baselines import registry
from cz_gym.baselines.bounds.clairvoyant import Clairvoyant
from cz_gym.baselines.pid.open_loop import OpenLoop
from cz_gym.config import make_config
from cz_gym.evaluation import results, runner
from cz_gym.evaluation.cache import code_behind, hash_sources, sources_behind
from cz_gym.evaluation.contenders import Contender
from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.results import Controller, Sample
from cz_gym.evaluation.rollout import rollout
from cz_gym.evaluation.runner import Job
from tests.samples import sample_of

CONFIG = make_config(horizon=300.0)
SEEDS = range(5)
WHO = Controller("snail", "measured", "slow", slow=True)


@dataclass(frozen=True)
class Snail(OpenLoop):
    """Does nothing, and says so in its settings."""

    setting: float = 0.0

    @property
    def hash(self) -> str:
        return repr(self)


def sample(folder: Path, policy: Any = None, config: Any = CONFIG, seeds: Any = SEEDS) -> Sample:
    row: Any = SimpleNamespace(name="some", config=lambda *_: config, design_config=lambda *_: config)
    bar = tqdm(disable=True)
    plan: Any = SimpleNamespace(cache=folder, seeds=lambda *_: seeds)
    job = Job(plan, row, Contender(WHO, lambda _: [policy or Snail()]))
    for number, part in runner.in_turn(job.pieces, bar):
        job.keep(job.pieces[number], part)
    return job.sample()


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Seeds of every episode that was really run; with a -1 before it, the next block is interrupted."""
    ran: list[int] = []

    def counting(policy: Any, config: Any, seeds: Any, progress: Any) -> Any:
        if ran[-1:] == [-1]:
            raise KeyboardInterrupt
        ran.extend(seeds)
        return rollout(policy, config, seeds, progress)

    monkeypatch.setattr(runner, "rollout", counting)
    monkeypatch.setattr(runner, "BLOCK", 2)
    return ran


def test_episodes_are_run_once_and_are_those_of_one_rollout(tmp_path: Path, counted: list[int]) -> None:
    first, again = sample(tmp_path, seeds=range(2)), sample(tmp_path)
    direct = sample_of(WHO, [rollout(OpenLoop(), CONFIG, SEEDS)])
    assert counted == [0, 1, 2, 3, 4]
    assert again.seeds == direct.seeds
    assert again.microseconds_per_step > 0.0
    np.testing.assert_allclose(again.values, direct.values, rtol=1e-12)
    np.testing.assert_array_equal(again.values[:, :2], first.values)
    for ours, theirs in zip(again.example, direct.example, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path: Path, counted: list[int]) -> None:
    sample(tmp_path, seeds=range(2))
    counted.append(-1)
    with pytest.raises(KeyboardInterrupt):
        sample(tmp_path)
    counted.clear()
    assert sample(tmp_path).values.shape == (1, 5, len(metric_names()))
    assert counted == [2, 3, 4]


def test_other_settings_plants_and_scenarios_share_nothing(tmp_path: Path, counted: list[int]) -> None:
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


def test_a_damaged_file_is_run_again(tmp_path: Path, counted: list[int]) -> None:
    whole = sample(tmp_path, seeds=range(2))
    for path in tmp_path.glob("*/1.npz"):
        path.write_bytes(path.read_bytes()[:100])
    np.testing.assert_allclose(sample(tmp_path, seeds=range(2)).values, whole.values, rtol=1e-12)
    assert counted == [0, 1, 1]


def test_only_the_first_episodes_have_signals(
    tmp_path: Path, counted: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    direct = rollout(OpenLoop(), CONFIG, SEEDS)
    for examples in (1, 3, 2):
        for module in (runner, results):
            monkeypatch.setattr(module, "EXAMPLES", examples)
        found = sample(tmp_path)
        assert len(found.examples) == examples
        for i, signals in enumerate(found.examples):
            np.testing.assert_array_equal(signals.r_c, direct.signals.r_c[:, i])
    # Asked for more signals, episodes that were cached without them run again; asked for fewer, none does.
    assert counted == [0, 1, 2, 3, 4, 1, 2]


def test_code_counts_and_text_does_not(tmp_path: Path) -> None:
    module = tmp_path / "thing.py"
    hashes = []
    for text in ('"""A."""\nx = 1\n"""B."""\n', '"""C."""\n# why\nx = (\n    1\n)\n', "x = 2\n"):
        module.write_text(text)
        hashes.append(hash_sources([module]))
    assert hashes[0] == hashes[1] != hashes[2]


@pytest.mark.parametrize("room", ["physics", "episodes", "engine", "cost.py", "evaluation/metrics.py"])
def test_whatever_makes_a_figure_is_in_the_key(room: str) -> None:
    """Kernels, sensors, draws and random streams were once left out."""
    place, sources = Path(cz_gym.__file__).parent / room, sources_behind(Snail.__module__)
    assert {*(place.rglob("*.py") if place.is_dir() else [place])} <= {*sources}
    assert sources[-1] == Path(__file__)
    assert code_behind(Snail.__module__) == hash_sources(sources) != code_behind(Clairvoyant.__module__)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A registry of two quick controllers and a slow one that is a bound, two episodes for it, no agents."""
    snail = registry.Entry("clairvoyant", lambda config: Snail(), "measured", "slow", False, privileged=True, slow=True)
    quick = tuple(registry.find_controller(name) for name in ("open-loop", "paper"))
    monkeypatch.setattr(benchmark, "SHIPPED", ())
    monkeypatch.setattr(registry, "CONTROLLERS", (*quick, snail))
    monkeypatch.setattr(runner, "SLOW_EPISODES", 2)
    monkeypatch.setattr(benchmark, "CACHE", tmp_path / "cache")
    return tmp_path / "out"


def test_the_command_says_how_many_episodes_a_slow_controller_met(small: Path) -> None:
    arguments = ["--episodes", "3", "--scenarios", "randomized", "--controllers", "open-loop,paper,clairvoyant"]
    assert benchmark.main([*arguments, "--slow", "--out", str(small), "--quiet"]) == 0
    data = json.loads((small / "benchmark.json").read_text())
    assert data["results"]["randomized"]["clairvoyant"]["rmse_mm"]["n"] == 2
    assert data["results"]["randomized"]["paper"]["rmse_mm"]["n"] == 3
    assert data["paired"]["randomized"]["clairvoyant"]["rmse_mm"]["n"] == 2
    assert data["provenance"]["scenarios"]["randomized"]["episodes"] == 3
    assert "| clairvoyant (n = 2) |" in (small / "report.md").read_text()
    rows = list(csv.DictReader((small / "episodes.csv").read_text().splitlines()))
    assert [row["seed"] for row in rows if row["controller"] == "clairvoyant"] == ["2000000", "2000001"]
    assert len(list((small.parent / "cache").glob("clairvoyant-randomized-*/*.npz"))) == 2


def taking_part(arguments: list[str]) -> list[str]:
    plan = benchmark.make_plan(benchmark.parse([*arguments, "--scenarios", "randomized,nominal"]), "")
    return [contender.controller.name for contender in plan.contenders]


def test_slow_controllers_run_only_when_asked_for(small: Path, refused: Any) -> None:
    line = refused(benchmark.main, ["--controllers", "paper,clairvoyant", "--out", str(small)])
    assert line == "benchmark.py: 'clairvoyant' is slow: add --slow to run it on the first 50 episodes\n"
    assert not small.exists()
    for wanted in ([], ["--controllers", "all"]):
        assert "clairvoyant" not in taking_part(wanted)
        assert "clairvoyant" in taking_part([*wanted, "--slow"])


def test_all_takes_those_that_are_cached_and_names_the_others(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    everyone = ["--controllers", "all", "--episodes", "2"]
    nominal = ["--scenarios", "nominal", "--json", str(small.parent / "all.json")]
    assert benchmark.main([*everyone, *nominal]) == 0
    said = capsys.readouterr().out
    assert "nominal (1 crystal)" in said
    assert "left out of all: clairvoyant, which are slow" in said
    arguments = ["--controllers", "clairvoyant", "--slow", "--scenarios", "nominal", "--episodes", "2", "--quiet"]
    assert benchmark.main([*arguments, "--json", str(small.parent / "one.json")]) == 0
    assert "clairvoyant" not in taking_part(everyone)  # nominal is cached, randomized is not
    assert benchmark.main([*everyone, *nominal]) == 0
    assert "left out" not in capsys.readouterr().out
    data = json.loads((small.parent / "all.json").read_text())
    assert "clairvoyant" in data["results"]["nominal"]
    assert "clairvoyant" not in taking_part([])  # without names only the default takes part, whatever is cached
