"""The table of episodes and its estimates: committed results, pairs on common episodes, gaps, an earlier bound."""

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
from cz_gym.evaluation.metrics import SPEED
from cz_gym.evaluation.protocol import TEST_SEEDS, find_case
from cz_gym.evaluation.rollout import rollout
from cz_gym.evaluation.statistics import Resamples, optimality_gap
from cz_gym.support.files import write_files
from cz_gym.tools import benchmark
from cz_gym.tools.episodes import by_key, estimates, read_episodes, to_csv
from cz_gym.tools.registry import find_controller
from cz_gym.tools.report.markdown import markdown
from cz_gym.tools.run import earlier_bound
from tests.observed import PLAIN
from tests.samples import contender, made, made_rows, rolled_out

RANDOMIZED = find_case("randomized")


def sample(name, errors, costs=None, **facts):
    """A contender with these RMSEs [mm] and costs."""
    return contender(name, **facts), {"rmse_mm": errors, "cost": errors if costs is None else costs}


def test_the_committed_estimates_come_out_of_the_committed_episodes():
    """To the digits of the table, which has five."""
    saved = json.loads(Path("results/bounds/benchmark.json").read_text())
    table = read_episodes(Path("results/bounds/episodes.csv")).assign(**{SPEED: 1.0})
    parts = {"mean": "results", "difference": "paired", "cvar": "cvar5"}
    found = estimates(table)
    assert set(found["kind"]) == {*parts, "quantile", "improvement", "gap"}
    compared = 0
    for row in found[found["metric"] != SPEED].itertuples():
        if row.kind in parts:
            wanted = saved[parts[row.kind]][row.scenario][row.controller][row.metric]
        elif row.kind == "gap":
            part = "optimality_gap" if row.metric == "cost" else "optimality_gap_radius"
            wanted = saved[part][row.scenario][row.controller]
        elif row.kind == "improvement":
            wanted = saved["paired"][row.scenario][row.controller]["rmse_mm"]["probability_of_improvement"]
        else:
            continue
        size = saved["results"][row.scenario]["paper"][row.metric]["mean"]
        given = (row.mean, row.low, row.high), (wanted["mean"], *(wanted["ci95"] or (np.nan, np.nan)))
        np.testing.assert_allclose(*np.array(given, float), rtol=1e-4, atol=1e-4 * abs(size))
        assert row.n == wanted["n"]
        compared += 1
    assert compared > 400


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
    found = made(
        RANDOMIZED,
        sample("paper", [1.0, 2.0, 30.0], [8.0, 4.0, 99.0]),
        sample("lqg", [0.5, 0.4, 9.0], [3.0, 1.0, 99.0]),
        sample("clairvoyant", [0.0, 0.1], [1.0, 1.0], privileged=True),
        sample("mpc", [0.6, 0.5], [4.0, 3.0]),
        sample("ppo", [0.4, 0.3, 9.0], training_seeds=(0,)),
        sample("seer", [0.0] * 3, training_seeds=(0,), observation="state"),
    )
    known = {key[1:]: (each.mean, each.n) for key, each in by_key(found.estimates).items()}
    assert len(found.seeds(RANDOMIZED)) == 3
    assert known["mpc", "rmse_mm", "difference"] == pytest.approx((0.55 - 1.5, 2))
    assert known["lqg", "rmse_mm", "difference"] == pytest.approx((9.9 / 3 - 11.0, 3))
    assert known["mpc", "rmse_mm", "improvement"] == (1.0, 2)
    assert known["lqg", "cost", "gap"][0] == pytest.approx((2.0 - 1.0) / (6.0 - 1.0))
    assert known["lqg", "rmse_mm", "gap"][0] == pytest.approx(((0.25 + 0.16) / 2 - 0.005) / (2.5 - 0.005))
    assert {each[1] for key, each in known.items() if key[2] == "gap"} == {2}
    # On the two episodes of all, lqg is the better rival; on its own three it would seem worse than mpc.
    assert found.rival(RANDOMIZED) == "lqg"
    assert known["ppo", "rmse_mm", "verdict"] == pytest.approx((-0.2 / 3, 3))
    assert known["ppo", "cost", "verdict"] == pytest.approx((9.7 / 3 - 103.0 / 3, 3))
    assert list(found.verdicts(RANDOMIZED)) == ["ppo"], (
        "an agent that reads the true state is a bound, and wins nothing"
    )


def test_a_table_is_read_back_as_it_was_and_gives_the_same_file(tmp_path, rng):
    errors = rng.normal(1.0, 0.1, (2, 5)), rng.normal(1.0, 0.1, 5)
    first = made(RANDOMIZED, sample("ppo", errors[0], training_seeds=(3, 8)), sample("paper", errors[1]))
    (tmp_path / "episodes.csv").write_bytes(to_csv(first.episodes))
    again = type(first).of(first.cases, first.contenders, read_episodes(tmp_path / "episodes.csv"), {})
    assert again.estimates.equals(first.estimates)
    assert to_csv(again.episodes) == to_csv(first.episodes)


# The bound of an earlier run.


@pytest.fixture(scope="module")
def paper():
    """The paper's controller on two crystals."""
    return contender("paper"), rollout(CompensatedPID(), RANDOMIZED.config(), TEST_SEEDS[:2])


@pytest.fixture
def earlier(tmp_path, paper):
    """A folder with the results of an earlier run with a bound, on two crystals."""
    bound = made_rows(RANDOMIZED, *sample("clairvoyant", [0.1, 0.2], [0.3, 0.5]), TEST_SEEDS[:2])
    rows = rolled_out(RANDOMIZED, [paper]).episodes
    write_files({tmp_path / "earlier" / "episodes.csv": to_csv(rows) + to_csv(bound[rows.columns]).split(b"\n", 1)[1]})
    return tmp_path / "earlier"


def bound_of(folder, case, *samples):
    now = rolled_out(case, samples)
    return earlier_bound(folder, now.episodes, [case], now.contenders)


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
        assert found["mean"] == pytest.approx((ours - best) / (theirs - best), rel=1e-9)
        assert found["n"] == 2
    assert data["provenance"]["gap_from_cached_episodes"] == {"randomized": 2}
    report = (tmp_path / "new" / "report.md").read_text()
    assert "`clairvoyant` of an earlier run (results/bounds), on the first 2 crystals" in report
    command = "python benchmark.py --slow --controllers paper,clairvoyant --scenario hard --out runs/bound"
    assert f"`{command}` runs it" in report


def test_a_bound_is_used_only_beside_the_same_figures_of_the_same_controller(earlier, paper):
    """A plant, a scenario or code that moves the paper's figures moves the bound's too."""
    who, run = paper
    found = bound_of(earlier, RANDOMIZED, paper)
    assert found["seed"].tolist() == [2_000_000, 2_000_001]
    assert found["cost"].tolist() == [0.3, 0.5]
    assert (
        bound_of(earlier, RANDOMIZED, (who, replace(run, signals=run.signals._replace(r_c=run.signals.r_ref)))) is None
    )
    assert bound_of(earlier, RANDOMIZED, (contender("other"), run)) is None
    assert bound_of(earlier, find_case("hard"), paper) is None
    other = make_config("randomized", parameters=make_config(**PLAIN).parameters._replace(k_l=62.1), **PLAIN)
    moved = rollout(find_controller("paper").make(other), other, run.seeds)
    assert bound_of(earlier, RANDOMIZED, (who, moved)) is None


def test_an_earlier_bound_needs_its_episodes_from_the_first_on(earlier, paper):
    table = earlier / "episodes.csv"
    whole = table.read_text()
    broken = (
        whole.replace(",2000000,", ",2000001,"),
        whole.replace("cost", "price"),
        "",
        whole.replace(",0.3,", ",nan,"),
    )
    for text in (*broken, whole.replace(",0.3,", ",x,")):
        table.write_text(text)
        assert bound_of(earlier, RANDOMIZED, paper) is None
    table.unlink()
    assert bound_of(earlier, RANDOMIZED, paper) is None


def test_the_committed_bounds_can_be_used(paper):
    assert len(bound_of(Path("results/bounds"), RANDOMIZED, paper)) == 50


# Parts of the report.


def test_the_table_of_training_seeds_names_those_that_lost_crystals():
    errors, lost = np.tile([0.1, 0.2, 0.3], (3, 1)), np.zeros((3, 3))
    errors[1], lost[1] = 5.0, [0.0, 1.0, 1.0]
    agent = contender("ppo", training_seeds=(4, 7, 9))
    report = markdown(made(RANDOMIZED, (agent, {"rmse_mm": errors, "failure_rate": lost})), "", ())
    assert "| ppo | 3 | 0.200 | 0.200 | 5.000 | 7 | 2 by seed 7 | 3 |" in report
    report = markdown(made(RANDOMIZED, (agent, {"rmse_mm": errors})), "", ())
    assert "| 7 | none | 3 |" in report


def test_a_name_with_a_bar_breaks_no_table():
    """Agents may be called anything."""
    found = made(RANDOMIZED, sample("paper", [1.0, 2.0]), sample("a|b", [0.1, 0.2], training_seeds=(1, 2)))
    lines = [line for line in markdown(found, "", ()).splitlines() if "|" in line]
    rows = [re.split(r"(?<!\\)\|", line) for line in lines]
    assert sum(r" a\|b " in row for row in rows) == 6
    for one, other in itertools.pairwise(rows):
        assert len(one) == len(other) or other[1] in (" controller ", " agent ")
