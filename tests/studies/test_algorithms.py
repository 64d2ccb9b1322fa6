"""Algorithms side by side: every one trains, is judged, kept, and not run again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("matplotlib")

from cz_gym.agents.training import recipes as settings
from cz_gym.agents.training import run
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from studies.algorithms import __main__ as algorithms
from studies.comparison import lqg_family as rivals
from studies.comparison import runs as ablation_run

SMALL = settings.Recipe(num_envs=4, privileged_critic=False, hidden=(4,))
CHOICES: tuple[Any, ...] = (
    replace(settings.RecurrentPPO(), recipe=SMALL, units=4, n_steps=16, batch_size=64),
    replace(settings.SAC(), recipe=SMALL, learning_starts=16, buffer_size=64, batch_size=8),
)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [replace(row, choice=choice) for row, choice in zip(algorithms.ROWS[1:3], CHOICES, strict=True)]
    monkeypatch.setattr(algorithms, "ROWS", tuple(rows))
    monkeypatch.setattr(ablation_run, "JUDGING", VALIDATION_SEEDS[:2])
    monkeypatch.setattr(run, "PICKING", VALIDATION_SEEDS[:1])
    means = {name: dict.fromkeys(ablation_run.FIGURES, error) for name, error in (("lively", 1.0), ("quiet", 2.0))}
    means["lively"] |= {rivals.ACTIVITY: 3.0}
    monkeypatch.setattr(rivals, "rivals", lambda plan: rivals.Rivals(means))


def test_rows_are_the_recipes_by_name() -> None:
    for row in algorithms.ROWS:
        shipped = settings.RECIPES[row.name]
        if shipped.recipe.clone and row.choice.recipe.clone:
            told = f"{row.choice.recipe.clone.teacher}-told"
            assert shipped.recipe.clone.teacher == told
            mine = row.choice.recipe
            shipped = replace(shipped, recipe=replace(shipped.recipe, clone=mine.clone, weights=mine.weights))
        assert row.choice == shipped
        assert row.choice.recipe.observation == "history"


@pytest.mark.usefixtures("small")
def test_each_is_run_once_and_tabulated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--seeds", "1", "--steps", "128", "--jobs", "1"]
    arguments += ["--out", str(tmp_path / "out"), "--work", str(tmp_path / "work")]
    assert algorithms.main(arguments) == 0
    assert capsys.readouterr().out.count(": done") == 2
    table = (tmp_path / "out" / "table.md").read_text()
    assert "| ppo-recurrent | from nothing | 1 | " in table
    assert "| sac | from nothing | 1 | " in table
    assert (tmp_path / "out" / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert algorithms.main(arguments) == 0
    assert ": done" not in capsys.readouterr().out
    assert algorithms.main([*arguments, "--steps", "64"]) == 2
    assert "made with other settings" in capsys.readouterr().err


def test_what_cannot_be_meant_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert algorithms.main(["--seeds", "0"]) == 2
    assert capsys.readouterr().err == "python -m studies.algorithms: --seeds must be between 1 and 100, not 0\n"
