"""Comparisons of algorithms: agents are evaluated on crystals that did not choose them."""

import pytest

from cz_gym.agents.training import validation
from cz_gym.agents.training.run import Job
from cz_gym.evaluation.protocol import CASES, TEST_SEEDS, VALIDATION_SEEDS
from studies import algorithms, leaderboard
from tests.small_learners import REFERENCES, SMALL, SMALL_APG, train_small_seed


def test_evaluation_crystals_neither_select_nor_test():
    judged = set(validation.JUDGING)
    assert judged <= set(VALIDATION_SEEDS)
    assert not judged & (set(validation.PICKING) | set(TEST_SEEDS))


@pytest.mark.usefixtures("few_crystals")
def test_finished_runs_are_compared(tmp_path, monkeypatch, refused):
    monkeypatch.setattr(leaderboard, "CASES", CASES[:2])
    assert "no finished run" in refused(algorithms.main, [str(tmp_path)])
    for recipe in (SMALL, SMALL_APG):
        train_small_seed(Job(tmp_path / recipe.name / "seed0", recipe, 0, REFERENCES))
    assert algorithms.main([str(tmp_path), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    table = (tmp_path / "table.md").read_text()
    assert "on 2 validation crystals" in table
    assert "| a training | million steps | minutes | training seeds |" in table
    for recipe in (SMALL, SMALL_APG):
        assert table.count(f"| {recipe.name} |") == 2
