"""Results of a benchmark's samples: pairs on common episodes, the optimality gap, and an earlier run's bound."""

import csv
import itertools
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cz_gym.baselines import CompensatedPID
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.protocol import TEST_SEEDS, find_case
from cz_gym.evaluation.results import Sample, summarise
from cz_gym.evaluation.rollout import rollout
from cz_gym.evaluation.statistics import Resamples, optimality_gap
from cz_gym.support.files import write_files
from cz_gym.tools import benchmark
from cz_gym.tools.files import to_csv
from cz_gym.tools.registry import find_controller
from cz_gym.tools.report.markdown import markdown
from cz_gym.tools.run import earlier_bound
from tests.observed import PLAIN
from tests.samples import contender


def made(name, errors, costs=None, **facts):
    """A sample with these RMSEs [mm] and costs."""
    values = np.zeros((1, len(errors), len(metric_names())))
    values[0, :, 0] = errors
    values[0, :, metric_names().index("cost")] = errors if costs is None else costs
    return Sample(contender(name, **facts), tuple(range(len(errors))), values, 1.0)


def results_of(*samples):
    return [summarise(find_case("randomized"), samples)]


def test_the_gap_is_zero_at_the_bound_and_one_at_the_reference():
    bound, reference = np.array([[0.0, 1.0]]), np.array([[4.0, 9.0]])
    resamples = Resamples.draw(2)
    assert optimality_gap(bound, reference, bound, resamples) == (0.0, (0.0, 0.0), 2)
    assert optimality_gap(reference, reference, bound, resamples) == (1.0, (1.0, 1.0), 2)
    found = optimality_gap(np.array([[2.0, 5.0]]), reference, bound, resamples)
    assert found is not None
    assert found.mean == pytest.approx((3.5 - 0.5) / (6.5 - 0.5))
    assert found.ci95 == pytest.approx((0.5, 0.5))
    assert optimality_gap(bound, bound, bound, resamples) is None


def test_different_numbers_of_episodes_meet_on_those_of_both():
    samples = [
        made("paper", [1.0, 2.0, 30.0], [8.0, 4.0, 99.0]),
        made("lqg", [0.5, 0.4, 9.0], [3.0, 1.0, 99.0]),
        made("clairvoyant", [0.0, 0.1], [1.0, 1.0], privileged=True),
        made("mpc", [0.6, 0.5]),
        made("ppo", [0.4, 0.3, 9.0], training_seeds=(0,)),
        made("seer", [0.0] * 3, training_seeds=(0,), observation="state"),
    ]
    result = summarise(find_case("randomized"), samples)
    assert len(result.seeds) == 3
    assert result.paired["mpc"]["rmse_mm"][::2] == pytest.approx((0.55 - 1.5, 2))
    assert result.paired["lqg"]["rmse_mm"][::2] == pytest.approx((9.9 / 3 - 11.0, 3))
    assert result.improvement["mpc"]["rmse_mm"][::2] == (1.0, 2)
    assert result.gaps["lqg"]["cost"].mean == pytest.approx((2.0 - 1.0) / (6.0 - 1.0))
    assert result.gaps["lqg"]["rmse_mm"].mean == pytest.approx(((0.25 + 0.16) / 2 - 0.005) / (2.5 - 0.005))
    assert {name: gaps["cost"].n for name, gaps in result.gaps.items()} == dict.fromkeys(result.means, 2)
    # On the two episodes of all, lqg is the better rival; on its own three it would seem worse than mpc.
    assert result.rival == "lqg"
    assert result.verdicts["ppo"][::2] == pytest.approx((-0.2 / 3, 3))
    assert list(result.verdicts) == ["ppo"], "an agent that reads the true state is a bound, and wins nothing"


@pytest.fixture(scope="module")
def paper():
    """The paper's controller on two crystals."""
    run = rollout(CompensatedPID(), find_case("randomized").config(), TEST_SEEDS[:2])
    return Sample.of(contender("paper"), [run])


@pytest.fixture
def earlier(tmp_path, paper):
    """A folder with the results of an earlier run with a bound, on two crystals."""
    samples = (paper, made("clairvoyant", [0.1, 0.2], [0.3, 0.5], privileged=True, slow=True))
    results = results_of(*(replace(sample, seeds=TEST_SEEDS[:2]) for sample in samples))
    folder = tmp_path / "earlier"
    write_files({folder / "episodes.csv": to_csv(results).encode()})
    return folder


def test_gaps_are_measured_from_an_earlier_bound(earlier, tmp_path, monkeypatch):
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
    assert data["provenance"]["gap_from_cached_episodes"] == {"randomized": 2}
    report = (tmp_path / "new" / "report.md").read_text()
    assert "`clairvoyant` of an earlier run (results/bounds), on the first 2 crystals" in report
    command = "python benchmark.py --slow --controllers paper,clairvoyant --scenarios hard --out runs/bound"
    assert f"`{command}` runs it" in report


def test_a_bound_is_used_only_beside_the_same_figures_of_the_same_controller(earlier, paper):
    """A plant, a scenario or code that moves the paper's figures moves the bound's too."""
    row = find_case("randomized")
    found = earlier_bound(earlier, row, [paper])
    assert found is not None
    assert found.seeds == (2_000_000, 2_000_001)
    assert found.contender.bound
    np.testing.assert_allclose(found.metric("cost"), [[0.3, 0.5]])
    assert earlier_bound(earlier, row, [replace(paper, values=paper.values * 1.001)]) is None
    assert earlier_bound(earlier, row, [replace(paper, contender=contender("other"))]) is None
    assert earlier_bound(earlier, find_case("hard"), [paper]) is None
    other = make_config("randomized", parameters=make_config(**PLAIN).parameters._replace(k_l=62.1), **PLAIN)
    moved = Sample.of(paper.contender, [rollout(find_controller("paper").make(other), other, paper.seeds)])
    assert earlier_bound(earlier, row, [moved]) is None


def test_an_earlier_bound_needs_its_episodes_from_the_first_on(earlier, paper):
    row, table = find_case("randomized"), earlier / "episodes.csv"
    whole = table.read_text()
    for broken in (whole.replace(",2000000,", ",2000001,"), whole.replace("cost", "price"), "", whole[:-9] + "nan\n"):
        table.write_text(broken)
        assert earlier_bound(earlier, row, [paper]) is None
    table.unlink()
    assert earlier_bound(earlier, row, [paper]) is None


def test_the_committed_bounds_can_be_used(paper):
    found = earlier_bound(Path("results/bounds"), find_case("randomized"), [paper])
    assert found is not None
    assert len(found.seeds) == 50


def test_the_table_of_training_seeds_names_those_that_lost_crystals():
    sample = made("ppo", [0.1, 0.2, 0.3], training_seeds=(4, 7, 9))
    values = np.repeat(sample.values, 3, axis=0)
    values[1, :, metric_names().index("failure_rate")] = [0.0, 1.0, 1.0]
    values[1, :, 0] = 5.0
    report = markdown(results_of(replace(sample, values=values)), "", ())
    assert "| ppo | 3 | 0.200 | 0.200 | 5.000 | 7 | 2 by seed 7 | 3 |" in report
    values[1, :, metric_names().index("failure_rate")] = 0.0
    report = markdown(results_of(replace(sample, values=values)), "", ())
    assert "| 7 | none | 3 |" in report


def test_a_name_with_a_bar_breaks_no_table():
    """Agents may be called anything."""
    sample = made("a|b", [0.1, 0.2], training_seeds=(1, 2))
    two = replace(sample, values=np.repeat(sample.values, 2, axis=0))
    lines = [line for line in markdown(results_of(made("paper", [1.0, 2.0]), two), "", ()).splitlines() if "|" in line]
    rows = [re.split(r"(?<!\\)\|", line) for line in lines]
    assert sum(r" a\|b " in row for row in rows) == 6
    for one, other in itertools.pairwise(rows):
        assert len(one) == len(other) or other[1] in (" controller ", " agent ")
