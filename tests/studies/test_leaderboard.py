"""The leaderboard runs submitted agents again, on crystals of its own."""

import json
import shutil
from types import SimpleNamespace
from typing import Any, cast

import pytest

from cz_gym import agents
from cz_gym.evaluation.protocol import CASES, TRAINING_SEEDS
from cz_gym.tools.report.task_records import contract_hash
from studies import leaderboard

MEAN = {"mean": 0.0125, "ci95": None}


@pytest.fixture
def submissions(tmp_path, monkeypatch):
    """A folder with one submission, the shipped PPO under another name, with a claim that is too good."""
    monkeypatch.setattr(leaderboard, "CASES", CASES[:1])
    monkeypatch.setattr(leaderboard, "CONTROLLERS", leaderboard.CONTROLLERS[:2])
    folder = tmp_path / "submissions" / "mine"
    folder.mkdir(parents=True)
    for file in agents.MODELS.glob("ppo-seed0.*"):
        shutil.copy(file, folder)
    results, contract = {"randomized": {"mine": {"rmse_mm": MEAN}}}, contract_hash(CASES[:1])
    claim = {"results": results, "provenance": {"contract": contract}}
    (folder / "benchmark.json").write_text(json.dumps(claim))
    return folder.parent


def test_a_claim_stands_beside_what_fresh_crystals_show(submissions, tmp_path):
    command = [str(submissions), "--episodes", "2", "--first-seed", "3000007", "--out", str(tmp_path)]
    assert leaderboard.main(command) == 0
    page = (tmp_path / "leaderboard.md").read_text()
    (line,) = (line for line in page.splitlines() if line.startswith("| open |"))
    _, budget, place, name, told, seeds, claimed, here, _, contract, _ = (cell.strip() for cell in line.split("|"))
    assert (budget, place, name, told, seeds, claimed) == ("open", "1", "mine", "state, in training", "1", "0.013")
    assert contract == "the same"
    assert 0.02 < float(here.split()[0]) < 0.3
    assert "seeds 3000007 to 3000008" in page
    assert "| paper |" in page
    found = json.loads((tmp_path / "leaderboard.json").read_text())
    assert found["provenance"]["scenarios"]["randomized"]["first_seed"] == 3_000_007


@pytest.mark.parametrize(
    ("steps", "name"), [(1_048_576, "1 M"), (1_100_000, "5 M"), (5_242_880, "5 M"), (20_447_232, "20 M"), (6e7, "open")]
)
def test_an_agent_has_the_smallest_budget_that_its_longest_training_keeps(steps, name):
    """The recipe ppo, asked for 1, 5 and 20 million steps, ends with its update: after 2,048 x 64 x 4 steps each."""
    trained = [SimpleNamespace(contract=SimpleNamespace(training_steps=each)) for each in (9, steps)]
    assert leaderboard.budget(cast("Any", SimpleNamespace(trained=trained))) == name


def test_fresh_seeds_are_nobody_else_s():
    taken = {seed for row in CASES for seed in row.seeds(500)} | {TRAINING_SEEDS.stop}
    assert max(taken) < leaderboard.FRESH.start


def test_what_is_no_submission_is_named(submissions, tmp_path, refused):
    assert "no such" in refused(leaderboard.main, [str(tmp_path / "nowhere")]).lower()
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "no submissions" in refused(leaderboard.main, [str(empty)])
    for broken in ("", "[]", '{"results": {"randomized": {"mine": {"rmse_mm": {"mean": "x"}}}}}', '{"results": 1}'):
        (submissions / "mine" / "benchmark.json").write_text(broken)
        assert "is no benchmark.json" in refused(leaderboard.main, [str(submissions), "--out", str(tmp_path)])
    (submissions / "mine" / "benchmark.json").write_text('{"results": {"randomized": {}}}')
    assert "no results of 'mine'" in refused(leaderboard.main, [str(submissions), "--out", str(tmp_path)])
