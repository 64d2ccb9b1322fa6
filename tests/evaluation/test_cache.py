"""Slow controllers: fewer episodes, cached and resumed; compared on the episodes that both met; the optimality gap."""

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
from cz_gym.atomic_files import write_files
from cz_gym.baselines import registry
from cz_gym.baselines.bounds.clairvoyant import Clairvoyant
from cz_gym.baselines.pid.open_loop import OpenLoop
from cz_gym.config import make_config
from cz_gym.evaluation import results, runner
from cz_gym.evaluation.cache import code_behind, earlier_bound, hash_sources, sources_behind
from cz_gym.evaluation.contenders import Contender
from cz_gym.evaluation.files import to_csv, to_json
from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.protocol import TEST_SEEDS, find_row
from cz_gym.evaluation.report.markdown import markdown
from cz_gym.evaluation.results import Benchmark, Controller, Sample, summarise
from cz_gym.evaluation.rollout import Signals, rollout
from cz_gym.evaluation.runner import Job
from cz_gym.evaluation.statistics import Resamples, optimality_gap

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
    job = Job(plan, row, Contender(WHO, lambda _: [policy or Snail()]), bar)
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
    direct = Sample.of(WHO, [rollout(OpenLoop(), CONFIG, SEEDS)])
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


@pytest.mark.parametrize("room", ["physics", "episodes", "engine", "task.py", "evaluation/metrics.py"])
def test_whatever_makes_a_figure_is_in_the_key(room: str) -> None:
    """Kernels, sensors, draws and random streams were once left out."""
    place, sources = Path(cz_gym.__file__).parent / room, sources_behind(Snail.__module__)
    assert {*(place.rglob("*.py") if place.is_dir() else [place])} <= {*sources}
    assert sources[-1] == Path(__file__)
    assert code_behind(Snail.__module__) == hash_sources(sources) != code_behind(Clairvoyant.__module__)


def made(name: str, errors: list[float], costs: list[float] | None = None, **facts: Any) -> Sample:
    """A sample with these RMSEs [mm] and costs."""
    values = np.zeros((1, len(errors), len(metric_names())))
    values[0, :, 0] = errors
    values[0, :, metric_names().index("cost")] = errors if costs is None else costs
    signals = Signals(*(np.zeros(3) for _ in Signals._fields))
    return Sample(Controller(name, "measured", "", **facts), tuple(range(len(errors))), values, 1.0, (signals,), 5.0)


def benchmark_of(*samples: Sample) -> Benchmark:
    return Benchmark((summarise(find_row("randomized"), samples),), "", ())


def test_the_gap_is_zero_at_the_bound_and_one_at_the_reference() -> None:
    bound, reference = np.array([[0.0, 1.0]]), np.array([[4.0, 9.0]])
    resamples = Resamples.draw(2)
    assert optimality_gap(bound, reference, bound, resamples) == (0.0, (0.0, 0.0), 2)
    assert optimality_gap(reference, reference, bound, resamples) == (1.0, (1.0, 1.0), 2)
    found = optimality_gap(np.array([[2.0, 5.0]]), reference, bound, resamples)
    assert found is not None
    assert found.mean == pytest.approx((3.5 - 0.5) / (6.5 - 0.5))
    assert found.ci95 == pytest.approx((0.5, 0.5))
    assert optimality_gap(bound, bound, bound, resamples) is None


def test_different_numbers_of_episodes_meet_on_those_of_both() -> None:
    samples = [
        made("paper", [1.0, 2.0, 30.0], [8.0, 4.0, 99.0]),
        made("lqg", [0.5, 0.4, 9.0], [3.0, 1.0, 99.0]),
        made("clairvoyant", [0.0, 0.1], [1.0, 1.0], privileged=True),
        made("mpc", [0.6, 0.5]),
        made("ppo", [0.4, 0.3, 9.0], training_seeds=(0,)),
    ]
    result = summarise(find_row("randomized"), samples)
    by_name = {outcome.controller.name: outcome for outcome in result.outcomes}
    assert len(result.seeds) == 3
    assert by_name["mpc"].paired["rmse_mm"][::2] == pytest.approx((0.55 - 1.5, 2))
    assert by_name["lqg"].paired["rmse_mm"][::2] == pytest.approx((9.9 / 3 - 11.0, 3))
    assert by_name["mpc"].improvement[::2] == (1.0, 2)
    gap, gap_radius = by_name["lqg"].gap, by_name["lqg"].gap_radius
    assert gap is not None
    assert gap_radius is not None
    assert gap.mean == pytest.approx((2.0 - 1.0) / (6.0 - 1.0))
    assert gap_radius.mean == pytest.approx(((0.25 + 0.16) / 2 - 0.005) / (2.5 - 0.005))
    assert {name: outcome.gap.n for name, outcome in by_name.items()} == dict.fromkeys(by_name, 2)
    # On the two episodes of all, lqg is the better rival; on its own three it would seem worse than mpc.
    assert result.verdicts[0].rival == "lqg"
    assert result.verdicts[0].difference[::2] == pytest.approx((-0.2 / 3, 3))


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


def test_slow_controllers_run_only_when_asked_for(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert benchmark.main(["--controllers", "paper,clairvoyant", "--out", str(small)]) == 2
    assert capsys.readouterr().err == (
        "benchmark.py: 'clairvoyant' is slow: add --slow to run it on the first 50 episodes\n"
    )
    assert not small.exists()
    for wanted in ([], ["--controllers", "all"]):
        assert "clairvoyant" not in taking_part(wanted)
        assert "clairvoyant" in taking_part([*wanted, "--slow"])


def test_all_takes_those_that_are_cached_and_names_the_others(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    everyone = ["--controllers", "all", "--episodes", "2"]
    nominal = ["--scenarios", "nominal", "--json", str(small.parent / "all.json")]
    assert benchmark.main([*everyone, *nominal]) == 0
    assert "left out of all: clairvoyant, which are slow" in capsys.readouterr().out
    arguments = ["--controllers", "clairvoyant", "--slow", "--scenarios", "nominal", "--episodes", "2", "--quiet"]
    assert benchmark.main([*arguments, "--json", str(small.parent / "one.json")]) == 0
    assert "clairvoyant" not in taking_part(everyone)  # nominal is cached, randomized is not
    assert benchmark.main([*everyone, *nominal]) == 0
    assert "left out" not in capsys.readouterr().out
    data = json.loads((small.parent / "all.json").read_text())
    assert "clairvoyant" in data["results"]["nominal"]
    assert "clairvoyant" not in taking_part([])  # without names only the default takes part, whatever is cached


@pytest.fixture(scope="module")
def paper() -> Sample:
    """The paper's controller on two crystals."""
    run = rollout(registry.CompensatedPID(), find_row("randomized").config(), TEST_SEEDS[:2])
    return Sample.of(Controller("paper", "measured", ""), [run])


@pytest.fixture
def earlier(tmp_path: Path, paper: Sample) -> Path:
    """A folder with the results of an earlier run with a bound, on two crystals."""
    samples = (paper, made("clairvoyant", [0.1, 0.2], [0.3, 0.5], privileged=True, slow=True))
    done = benchmark_of(*(replace(sample, seeds=TEST_SEEDS[:2]) for sample in samples))
    folder = tmp_path / "earlier"
    write_files({folder / "benchmark.json": to_json(done).encode(), folder / "episodes.csv": to_csv(done).encode()})
    return folder


def test_gaps_are_measured_from_an_earlier_bound(
    earlier: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark, "BOUNDS", earlier)
    arguments = ["--episodes", "3", "--scenarios", "randomized,hard", "--controllers", "open-loop,paper"]
    assert benchmark.main([*arguments, "--out", str(tmp_path / "new"), "--quiet"]) == 0
    data = json.loads((tmp_path / "new" / "benchmark.json").read_text())
    assert list(data["optimality_gap"]) == list(data["optimality_gap_radius"]) == ["randomized"]
    lines = list(csv.DictReader((tmp_path / "new" / "episodes.csv").read_text().splitlines()))
    for metric, power, best in (("cost", 1, (0.3 + 0.5) / 2), ("rmse_mm", 2, (0.01 + 0.04) / 2)):
        ours, theirs = (
            np.mean([float(line[metric]) ** power for line in lines if line["controller"] == name][:2])
            for name in ("open-loop", "paper")
        )
        found = data["optimality_gap" if power == 1 else "optimality_gap_radius"]["randomized"]["open-loop"]
        assert found["mean"] == pytest.approx((ours - best) / (theirs - best), rel=1e-3)
        assert found["n"] == 2
    assert data["provenance"]["gap_from_kept_episodes"] == {"randomized": 2}
    report = (tmp_path / "new" / "report.md").read_text()
    assert "`clairvoyant` of an earlier run (results/bounds), on the first 2 crystals" in report
    assert "`python benchmark.py --slow --controllers paper,clairvoyant --scenarios hard` runs it" in report


def test_a_bound_is_used_only_beside_the_same_figures_of_the_same_controller(earlier: Path, paper: Sample) -> None:
    """A plant, a scenario or code that moves the paper's figures moves the bound's too."""
    row = find_row("randomized")
    found = earlier_bound(earlier, row, [paper])
    assert found is not None
    assert found.seeds == (2_000_000, 2_000_001)
    assert found.controller.bound
    np.testing.assert_allclose(found.metric("cost"), [[0.3, 0.5]])
    assert earlier_bound(earlier, row, [replace(paper, values=paper.values * 1.001)]) is None
    assert earlier_bound(earlier, row, [replace(paper, controller=replace(paper.controller, name="other"))]) is None
    assert earlier_bound(earlier, find_row("hard"), [paper]) is None
    other = make_config("randomized", parameters=make_config().parameters._replace(k_l=62.1))
    moved = Sample.of(paper.controller, [rollout(registry.CompensatedPID(), other, paper.seeds)])
    assert earlier_bound(earlier, row, [moved]) is None


def test_an_earlier_bound_needs_its_episodes_from_the_first_on(earlier: Path, paper: Sample) -> None:
    row, table = find_row("randomized"), earlier / "episodes.csv"
    whole = table.read_text()
    for broken in (whole.replace(",2000000,", ",2000001,"), whole.replace("cost", "price"), "", whole[:-9] + "nan\n"):
        table.write_text(broken)
        assert earlier_bound(earlier, row, [paper]) is None
    table.unlink()
    assert earlier_bound(earlier, row, [paper]) is None


def test_the_committed_bounds_can_be_used(paper: Sample) -> None:
    found = earlier_bound(benchmark.BOUNDS, find_row("randomized"), [paper])
    assert found is not None
    assert len(found.seeds) == 50


def test_the_table_of_training_seeds_names_those_that_lost_crystals() -> None:
    sample = made("ppo", [0.1, 0.2, 0.3], training_seeds=(4, 7, 9))
    values = np.repeat(sample.values, 3, axis=0)
    values[1, :, metric_names().index("failure_rate")] = [0.0, 1.0, 1.0]
    values[1, :, 0] = 5.0
    report = markdown(benchmark_of(replace(sample, values=values)), ())
    assert "| ppo | 3 | 0.200 | 0.200 | 5.000 | 7 | 2 by seed 7 | 3 |" in report
    values[1, :, metric_names().index("failure_rate")] = 0.0
    report = markdown(benchmark_of(replace(sample, values=values)), ())
    assert "| 7 | none | 3 |" in report
