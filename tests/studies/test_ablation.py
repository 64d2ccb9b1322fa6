"""The ablation: rows change what they say, finished runs are kept and read back, the table's figures are right."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cz_gym.agents.training import recipes as settings
from cz_gym.agents.training import run
from cz_gym.agents.training.export import actor_of
from cz_gym.agents.training.learners import clone, make_training, training_scenario
from cz_gym.agents.training.validation import JUDGING, PICKING
from cz_gym.baselines.registry import find_controller
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import TEST_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.statistics import Resamples
from studies.ablation import __main__ as ablation
from studies.ablation import figure as ablation_figure
from studies.ablation import rows as ablation_rows
from studies.ablation import table as ablation_table
from studies.ablation.rows import BASE, ROWS, Row, find_rows
from studies.comparison import lqg_family as rivals
from studies.comparison import runs as ablation_run
from studies.comparison.runs import FIGURES, Finished, Plan, read_finished

CHANGES = {
    "told": {"recipe.clone"},
    "some-wide": {"recipe.clone"},
    "more-shown": {"recipe.clone"},
    "scratch": {"recipe", "critic_steps", "n_steps", "batch_size", "n_epochs", "actor_pace", "frozen", "paired"}
    | {"gamma", "gae_lambda", "noise"},
    "absolute": {"recipe.head"},
    "blind-critic": {"recipe.privileged_critic"},
    "unpaired": {"paired"},
    "heater-free": {"frozen"},
    "layers-free": {"frozen"},
    "all-free": {"frozen"},
    "actor-pace-1": {"actor_pace"},
    "no-critic-first": {"critic_steps"},
    "residual-lqg": {"recipe.clone", "recipe.residual", "recipe.head"},
    "residual-paper": {"recipe.clone", "recipe.residual", "recipe.head"},
    "memory-none": {"recipe.memory"},
    "memory-4min": {"recipe.memory"},
    "weights-0.5": {"recipe.weights"},
    "weights-1": {"recipe.weights"},
    "pullers-nominal": {"recipe.width"},
    "pullers-half": {"recipe.width"},
    "pullers-wider": {"recipe.width"},
    "teacher-lqg": {"recipe.clone"},
    "shown-1": {"recipe.clone"},
    "shown-1.5": {"recipe.clone"},
    "teacher-lqg-quiet": {"recipe.clone"},
    "on-hard": {"recipe.scenario"},
    BASE: set(),
    "fifth": set(),
}


LQGS = rivals.Rivals(
    {name: dict.fromkeys(FIGURES, error) | {rivals.ACTIVITY: 0.01 / error} for name, error in (("a", 1.0), ("b", 2.0))}
)


def differing(one: dict[str, Any], other: dict[str, Any], inside: str = "") -> set[str]:
    return {inside + name for name in one if one[name] != other[name]}


def changed(choice: settings.PPO) -> set[str]:
    base, mine = asdict(settings.PPO()), asdict(choice)
    whole = differing(base, mine) - {"name", "steps"}
    if "recipe" not in whole or whole - {"recipe"}:
        return whole
    return differing(base["recipe"], mine["recipe"], "recipe.")


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_row_changes_what_it_says_and_nothing_else(row: Row) -> None:
    assert changed(row.of(1000)) == CHANGES[row.name]
    assert row.of(1000).steps == 1000 * row.share
    training_scenario(row.choice.recipe)
    if row.choice.recipe.clone:
        assert find_controller(row.choice.recipe.clone.teacher).privileged == (row.name in ("told", "some-wide"))
    assert row.choice.recipe.residual == row.name.startswith("residual")


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_row_can_be_learned(row: Row, tmp_path: Path) -> None:
    choice, recipe = row.of(32), row.choice.recipe
    few = replace(recipe.clone, rounds=1, episodes=1, epochs=1) if recipe.clone else None
    choice = replace(choice, recipe=replace(recipe, num_envs=4, clone=few), n_steps=8, batch_size=32, critic_steps=0)
    config = replace(make_config(recipe.scenario, observation="history"), horizon=100.0)
    teacher = find_controller(few.teacher).make(make_config(recipe.scenario)) if few else None
    training = make_training(choice, 0, None, 0, teacher)
    clone(training, teacher, config, 0, lambda _: None, tmp_path)
    before = actor_of(training.learner)
    training.learner.learn(32, callback=training.callbacks)
    after = actor_of(training.learner)
    assert not np.array_equal(before.layers[-1][0][0], after.layers[-1][0][0])
    assert np.isfinite(after.layers[-1][0]).all()
    training.learner.env.close()


def test_rows_have_names_of_their_own() -> None:
    assert len({row.name for row in ROWS}) == len(ROWS) == len(CHANGES)
    assert len({repr((row.choice, row.share)) for row in ROWS}) == len(ROWS)
    assert [row.name for row in find_rows(["absolute", BASE])] == [BASE, "absolute"]


def test_what_judges_neither_selects_nor_tests() -> None:
    judged = set(JUDGING)
    assert judged <= set(VALIDATION_SEEDS)
    assert not judged & set(PICKING)
    assert not judged & set(TEST_SEEDS)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rows of a recipe that is done in a moment."""
    monkeypatch.setattr(run, "PICKING", VALIDATION_SEEDS[:2])
    monkeypatch.setattr(ablation_run, "JUDGING", VALIDATION_SEEDS[2:4])
    recipe = replace(
        settings.Recipe(), num_envs=16, hidden=(8, 8), clone=settings.Clone("lqg", rounds=1, episodes=2, epochs=1)
    )
    quick = settings.PPO("ppo-base", recipe, n_steps=16, batch_size=256, n_epochs=1, critic_steps=0)
    beside = replace(recipe, residual=True, head=settings.ActionHead(skip=0.0))
    rows = (
        Row(BASE, BASE, "as it is", quick),
        Row("beside", "action", "residual", replace(quick, name="ppo-beside", recipe=beside)),
    )
    monkeypatch.setattr(ablation_rows, "ROWS", rows)
    monkeypatch.setattr(rivals, "rivals", lambda plan: LQGS)


def test_a_sweep_keeps_what_is_finished_and_goes_on(
    small: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["--seeds", "1", "--steps", "256", "--jobs", "1", "--out", str(tmp_path / "out")]
    command += ["--work", str(tmp_path / "work")]
    trained: list[str] = []
    learn = run.Run.learn

    def counted(self: run.Run, bar: Any) -> None:
        trained.append(f"{self.choice.name}-{self.seed}")
        if len(trained) == 2:
            learn(self, bar)
            raise KeyboardInterrupt
        learn(self, bar)

    monkeypatch.setattr(run.Run, "learn", counted)
    assert ablation.main(command) == 130
    runs = tmp_path / "out" / "runs"
    assert [path.name for path in runs.iterdir()] == ["base-seed0.json"]
    before = (runs / "base-seed0.json").read_bytes()
    assert ablation.main(command) == 0
    assert trained == ["ppo-base-0", "ppo-beside-0", "ppo-beside-0"]
    assert (runs / "base-seed0.json").read_bytes() == before
    told = json.loads((runs / "beside-seed0.json").read_text())
    assert told["settings"]["name"] == "ppo-beside"
    assert {"command", "git_commit", "packages"} <= set(told["provenance"])
    assert set(told["stages"]) == {"best", "last", "start"}
    names = {"table.csv", "table.md", "forest.png", "runs"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    assert {path.name for path in (tmp_path / "work").iterdir()} == {"imitations"}
    capsys.readouterr()
    assert ablation.main([*command, "--list"]) == 0
    assert capsys.readouterr().out.count("1/1") == 2
    assert ablation.main([*command[:2], "--steps", "512", *command[4:]]) == 2
    assert "made with other settings" in capsys.readouterr().err
    assert len(trained) == 3


def test_a_run_that_cannot_go_on_begins_again(small: None, tmp_path: Path) -> None:
    plan = Plan(256, tmp_path / "out", tmp_path / "work", settings.CostWeights())
    row = ablation_rows.ROWS[0]
    folder = tmp_path / "work" / "base-seed0"
    folder.mkdir(parents=True)
    (folder / "settings.json").write_text("{}")
    opened = ablation_run._open(folder, row.of(256), 0, tmp_path / "work" / "imitations")
    assert opened.training.learner.num_timesteps == 0
    assert not ablation_run.path_of(plan, row, 0).exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rows", "base,abslute"], "unknown row 'abslute'; choose from base, fifth"),
        (["--seeds", "0"], "--seeds must be between 1 and 100, not 0"),
        (["--steps", "-5"], "--steps must be between 1"),
        (["--jobs", "0"], "--jobs must be between 1 and 64, not 0"),
    ],
)
def test_mistakes_give_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert ablation.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("content", ["{", "[]", '{"row": "base", "seed": 0, "settings": {}, "stages": {"best": {}}}'])
def test_a_damaged_result_is_named(content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "base-seed0.json").write_text(content)
    assert ablation.main(["--out", str(tmp_path), "--work", str(tmp_path / "work"), "--list"]) == 2
    error = capsys.readouterr().err
    assert "base-seed0.json" in error
    assert error.count("\n") == 1


def test_a_run_kept_before_a_setting_existed_is_of_other_settings(tmp_path: Path) -> None:
    """A new setting's default may change what the recipe does; what was kept before it must not pass for today's."""
    plan, row = Plan(7, tmp_path, tmp_path, settings.CostWeights()), ROWS[0]
    path = ablation_run.path_of(plan, row, 0)
    path.parent.mkdir()
    stages = {stage: dict.fromkeys(FIGURES, [0.0] * len(ablation_run.JUDGING)) for stage in ("best", "last")}
    told = {
        "row": row.name,
        "seed": 0,
        "settings": asdict(row.of(7)),
        "judged": ablation_run.judged_on(),
        "stages": stages,
    }
    path.write_text(json.dumps(told))
    assert read_finished(plan, row, 0) is not None
    del told["settings"]["recipe"]["clone"]["wide_share"]
    path.write_text(json.dumps(told))
    assert read_finished(plan, row, 0) is not None, "a later setting whose earlier value is written down"
    del told["settings"]["recipe"]["clone"]["width"]
    path.write_text(json.dumps(told))
    with pytest.raises(ValueError, match="made with other settings"):
        read_finished(plan, row, 0)


def finished(random: np.random.Generator, row: str, seeds: range, shift: float) -> list[Finished]:
    crystals = np.random.default_rng(1).normal(size=(40, 1))
    made = []
    for seed in seeds:
        stages = {
            stage: 1.0 + crystals + shift + 0.01 * random.normal(size=(40, len(FIGURES))) for stage in ("best", "last")
        }
        made.append(Finished(row, seed, {}, stages))
    return made


def test_differences_are_paired_by_crystal_and_training_seed() -> None:
    random = np.random.default_rng(0)
    rows = find_rows([BASE, "absolute"])
    runs = {BASE: finished(random, BASE, range(3), 0.0), "absolute": finished(random, "absolute", range(2), 0.1)}
    base, other = ablation_table.tabulate(rows, runs)
    assert base.cells["best", "cost"].difference.mean == 0.0
    cell = other.cells["best", "rmse_mm"]
    values = np.array([each.stages["best"][:, 0] for each in runs["absolute"]])
    reference = np.array([each.stages["best"][:, 0] for each in runs[BASE][:2]])
    assert cell.mean.mean == pytest.approx(values.mean())
    assert cell.difference.mean == pytest.approx((values - reference).mean())
    draws = Resamples.draw(40)
    by_hand = [
        sum(seeds[i] * (crystals @ (values - reference)[i]) for i in range(2))
        for seeds, crystals in zip(draws.training_seeds(2), draws.episodes, strict=True)
    ]
    np.testing.assert_allclose(cell.difference.ci95, np.quantile(by_hand, [0.025, 0.975]))
    # The crystals' own spread, fifty times the difference's, has gone.
    assert cell.difference.ci95[1] - cell.difference.ci95[0] < 0.02 < cell.mean.ci95[1] - cell.mean.ci95[0]


def test_the_table_is_written_for_people_and_machines() -> None:
    random = np.random.default_rng(0)
    runs = {name: finished(random, name, range(2), shift) for name, shift in ((BASE, 0.0), ("scratch", 0.5))}
    lines = ablation_table.tabulate(ROWS, runs)
    text = ablation_table.to_markdown(lines, 3_000_000, LQGS)
    assert [line.split(" |")[0] for line in text.splitlines() if line.startswith("| ba")] == ["| base", "| base"]
    assert "3,000,000 environment steps" in text
    table = ablation_table.to_csv(lines).splitlines()
    assert len(table) == 1 + 2 * 2 * len(FIGURES)
    assert len({line.count(",") for line in table}) == 1
    assert ablation_figure.forest(lines).startswith(b"\x89PNG")
    assert ablation_table.tabulate(ROWS, {}) == []


def test_the_lqgs_are_judged_once_and_stand_at_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def judge(law: Any, weights: settings.CostWeights) -> np.ndarray:
        asked.append(law.settings.hash)
        moves = 1.0 / law.settings.weights.pull_step
        return np.tile([2.0 + 1.0 / moves, 0.0, 0.0, moves, 0.0, 0.0, 0.0], (3, 1))

    monkeypatch.setattr(ablation_run, "judge", judge)
    plan = Plan(1, tmp_path, tmp_path, settings.CostWeights())
    found = rivals.rivals(plan)
    assert len(found.means) == len(asked) == len(set(asked)) == 8
    assert rivals.rivals(plan) == found
    assert len(asked) == 8
    for each in found.means.values():
        assert found.ratio(each["rmse_mm"], each[rivals.ACTIVITY]) == pytest.approx(1.0)
    quietest = min(each[rivals.ACTIVITY] for each in found.means.values())
    assert found.ratio(1.0, 0.5 * quietest) is None
    rivals.rivals(plan._replace(weights=settings.CostWeights(0.5)))
    assert len(asked) == 16
    (tmp_path / rivals.KEPT).write_text('{"of": 1}')
    assert rivals.rivals(plan) == found
    assert len(rivals.rivals_table(found)) == 2 + 8


@pytest.mark.parametrize(("lost", "said"), [(0.0, "1.00"), (0.02, "-")])
def test_where_crystals_are_lost_nothing_is_compared_at_equal_activity(lost: float, said: str) -> None:
    values = np.tile([1.0 if name == "rmse_mm" else 0.01 for name in FIGURES], (50, 1))
    values[:, FIGURES.index("failure_rate")] = np.arange(50) < lost * 50
    (line,) = ablation_table.tabulate(find_rows([BASE]), {BASE: [Finished(BASE, 0, {}, {"best": values})]})
    assert ablation_table.at_equal_activity(line, LQGS) == said
