"""Comparisons of algorithms: runs are trained once and evaluated anew, and differences are paired."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("matplotlib")

from cz_gym.agents.training import run, validation
from cz_gym.agents.training.recipes import APG, PPO, SAC
from cz_gym.evaluation.protocol import TEST_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.statistics import Resamples
from studies.algorithms import __main__ as command
from studies.algorithms import report
from studies.algorithms.report import COLUMNS, Result, tabulate, to_markdown

SMALL: dict[str, Any] = {"num_envs": 4, "hidden": (4,), "steps": 128}
SOME = (
    PPO(**SMALL, n_steps=16, batch_size=64, n_epochs=1),
    SAC(**SMALL, learning_starts=16, buffer_size=64, batch_size=8),
    APG(name="few", num_envs=4, window=16, steps=128),
)


def in_turn(function: Any, tasks: Any) -> Iterator[tuple[int, Any]]:
    return enumerate(map(function, tasks))


def test_evaluation_crystals_neither_select_nor_test() -> None:
    judged = set(validation.JUDGING)
    assert judged <= set(VALIDATION_SEEDS)
    assert not judged & (set(validation.PICKING) | set(TEST_SEEDS))


def test_finished_runs_are_kept_and_evaluated_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stopped comparison goes on; a changed metric shows although no run is trained again."""
    monkeypatch.setattr(validation, "PICKING", VALIDATION_SEEDS[:2])
    monkeypatch.setattr(validation, "JUDGING", VALIDATION_SEEDS[2:4])
    learn, trained = run.Run.learn, []

    def counted(self: run.Run, *arguments: Any) -> None:
        trained.append(self.recipe.name)
        learn(self, *arguments)
        if len(trained) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(run.Run, "learn", counted)
    jobs = command.make_jobs(SOME, 1, tmp_path / "work")
    with pytest.raises(KeyboardInterrupt):
        command.compare(jobs, tmp_path, in_turn)
    command.compare(jobs, tmp_path, in_turn)
    assert trained == ["ppo", "sac", "sac", "few"]
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    before = (tmp_path / "table.md").read_text()
    for text in ("**few** | 1", "less ppo |"):
        assert text in before
    measured = report.metrics
    monkeypatch.setattr(report, "metrics", lambda found: (m := measured(found))._replace(rmse_mm=m.rmse_mm + 100.0))
    command.compare(jobs, tmp_path, in_turn)
    assert len(trained) == 4
    assert (tmp_path / "table.md").read_text() != before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rows", "ppo,sacc"], "unknown row 'sacc': did you mean 'sac'? Choose from ppo, sac, gradient"),
        (["--seeds", "0"], "--seeds: must be between 1 and 100, not 0"),
        (["--steps", "-5"], "--steps: must be between 1"),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(arguments: list[str], message: str, refused: Any) -> None:
    assert message in refused(command.main, arguments)


def results_of(seeds: range, shift: float) -> dict[int, Result]:
    random = np.random.default_rng(len(seeds))
    crystals = 1.0 + shift + np.random.default_rng(1).normal(size=(40, 1))
    progress = [{"steps": 128.0, "seconds": 60.0}]
    return {seed: Result(crystals + 0.01 * random.normal(size=(40, len(COLUMNS))), progress) for seed in seeds}


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
