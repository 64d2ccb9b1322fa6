"""Comparisons of algorithms: agents are evaluated on crystals that did not choose them, and differences are paired."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("matplotlib")

from cz_gym.agents.training import validation
from cz_gym.agents.training.run import Job
from cz_gym.evaluation.protocol import TEST_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.statistics import Resamples
from studies import algorithms
from studies.algorithms import COLUMNS, Result, tabulate, to_markdown
from tests.small_learners import REFERENCES, SMALL, SMALL_APG, train_small_seed


def test_evaluation_crystals_neither_select_nor_test() -> None:
    judged = set(validation.JUDGING)
    assert judged <= set(VALIDATION_SEEDS)
    assert not judged & (set(validation.PICKING) | set(TEST_SEEDS))


@pytest.mark.usefixtures("few_crystals")
def test_finished_runs_are_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Any) -> None:
    monkeypatch.setattr(algorithms, "in_processes", lambda function, tasks: enumerate(map(function, tasks)))
    assert "no finished run" in refused(algorithms.main, [str(tmp_path)])
    for recipe in (SMALL, SMALL_APG):
        train_small_seed(Job(tmp_path / recipe.name / "seed0", recipe, 0, REFERENCES))
    assert algorithms.main([str(tmp_path), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    table = (tmp_path / "table.md").read_text()
    assert "on 2 validation crystals" in table
    assert "**gradient** | 1" in table
    assert "less ppo |" in table


def results_of(seeds: range, shift: float) -> dict[int, Result]:
    random = np.random.default_rng(len(seeds))
    crystals = 1.0 + shift + np.random.default_rng(1).normal(size=(40, 1))
    progress = [{"steps": 128.0, "seconds": 60.0}]
    return {
        seed: Result("ppo", seed, crystals + 0.01 * random.normal(size=(40, len(COLUMNS))), progress) for seed in seeds
    }


def test_differences_are_paired_by_crystal_and_training_seed() -> None:
    found = {"ppo": results_of(range(3), 0.0), "sac": results_of(range(2), 0.1)}
    base, other = tabulate(found)
    assert base.differences == ()
    values, reference = (np.array([found[name][seed].figures[:, 0] for seed in range(2)]) for name in ("sac", "ppo"))
    difference, mean = other.differences[0], other.means[0]
    assert mean.mean == pytest.approx(values.mean())
    assert difference.mean == pytest.approx((values - reference).mean())
    draws = Resamples.draw(40)
    by_hand = [
        sum(seeds[i] * (crystals @ (values - reference)[i]) for i in range(2))
        for seeds, crystals in zip(draws.training_seeds(2), draws.episodes, strict=True)
    ]
    np.testing.assert_allclose(difference.ci95, np.quantile(by_hand, [0.025, 0.975]))
    # The spread of the crystals themselves, fifty times that of the difference, cancels.
    assert difference.ci95[1] - difference.ci95[0] < 0.02 < mean.ci95[1] - mean.ci95[0]
    assert to_markdown([base, other]).count("less ppo") == 1
