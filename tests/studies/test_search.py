"""The search: begins with the recipe, goes on from its journal, gives up the hopeless, confirms the best."""

from __future__ import annotations

import csv
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from cz_gym.agents.training import run
from cz_gym.agents.training.recipes import PPO
from cz_gym.agents.training.validation import PICKING, Validation
from cz_gym.evaluation.protocol import TEST_SEEDS, VALIDATION_SEEDS
from studies.comparison import training
from studies.search import __main__ as search
from studies.search.space import SPACE, params_of, recipe_of

RECIPE = params_of(PPO())


def test_the_space_turns_what_it_says() -> None:
    again = recipe_of(RECIPE, PPO().steps, "ppo")
    assert again.gamma == pytest.approx(PPO().gamma)
    assert asdict(again) | {"gamma": PPO().gamma} == asdict(PPO())
    assert set(RECIPE) == set(SPACE)
    for name, distribution in SPACE.items():
        assert distribution._contains(distribution.to_internal_repr(RECIPE[name]))
        least: Any = distribution.to_external_repr(0) if hasattr(distribution, "choices") else distribution.low
        other = recipe_of({**RECIPE, name: least}, PPO().steps, "ppo")
        assert params_of(other)[name] == pytest.approx(least)
        assert len({key for key, value in asdict(other).items() if value != asdict(again)[key]}) == 1


def test_crystals_that_pick_judge_and_confirm_are_others() -> None:
    groups = [set(PICKING), *map(set, search.crystals())]
    assert set.union(*groups) <= set(VALIDATION_SEEDS)
    assert sum(map(len, groups)) == len(set.union(*groups))
    assert not set.union(*groups) & set(TEST_SEEDS)


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Trials that take no time: their cost is least at a small rate and many epochs."""
    made: list[dict[str, Any]] = []

    def bowl(params: dict[str, Any], seed: int, given: Any, report: Any) -> float:
        assert seed == 0
        made.append(params)
        cost = params["learning_rate"] / 1e-3 + 1.0 / params["n_epochs"]
        for look in range(1, 4):
            report(look, Validation(cost, 0.1, 0.01, 0.0))
        return float(cost)

    monkeypatch.setattr(search, "objective", bowl)
    return made


def command(folder: Path, trials: int, finalists: int = 0) -> list[str]:
    folders = ["--out", str(folder / "out"), "--work", str(folder / "work")]
    return ["--trials", str(trials), "--finalists", str(finalists), *folders]


def history(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "out" / "history.csv").read_text().splitlines()))


def test_a_search_begins_with_the_recipe_and_goes_on(tried: list[dict[str, Any]], tmp_path: Path) -> None:
    assert search.main(command(tmp_path, 12)) == 0
    first = history(tmp_path)
    assert tried[0] == RECIPE
    assert float(first[0]["learning_rate"]) == pytest.approx(RECIPE["learning_rate"])
    assert search.main(command(tmp_path, 24)) == 0
    every = history(tmp_path)
    assert every[:12] == first
    assert len(every) == len(tried) == 24
    assert {row["state"] for row in every} == {"complete", "pruned"}
    assert min(float(row["cost"]) for row in every if row["state"] == "complete") < 0.8 * float(first[0]["cost"])
    assert search.main(command(tmp_path, 24)) == 0
    assert len(tried) == 24
    assert search.main([*command(tmp_path, 2), "--steps", "7"]) == 0
    assert len(tried) == 26, "trials of other steps are another search"


def test_an_interrupted_trial_comes_again(
    tried: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert search.main(command(tmp_path, 4)) == 0
    stopped: list[dict[str, Any]] = []

    def stop(params: dict[str, Any], *others: Any) -> float:
        stopped.append(params)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(search, "objective", stop)
        assert search.main(command(tmp_path, 6)) == 130
    assert "goes on from the trials" in capsys.readouterr().err
    assert len(history(tmp_path)) == 4
    assert search.main(command(tmp_path, 6)) == 0
    assert tried[4] == stopped[0]
    assert len(history(tmp_path)) == 6


def test_the_best_are_confirmed_with_other_seeds(
    tried: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    met: list[Any] = []
    monkeypatch.setattr(search, "compare", lambda *given: met.append(given))
    assert search.main([*command(tmp_path, 10, finalists=2), "--seeds", "2"]) == 0
    ((study, plan, variants, seeds, _),) = met
    assert [variant.base for variant in variants] == ["", "ppo", "ppo"]
    assert list(plan.crystals) == list(search.crystals()[1])
    assert list(seeds) == [1, 2]
    done = sorted((row for row in history(tmp_path)[1:] if row["state"] == "complete"), key=lambda r: float(r["cost"]))
    assert [variant.name for variant in study.variants[1:]] == [f"ppo-trial-{row['trial']}" for row in done[:2]]
    assert variants[1].recipe.learning_rate == pytest.approx(float(done[0]["learning_rate"]), rel=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trials", "0"], "--trials: must be between 1 and 10000, not 0"),
        (["--finalists", "-1"], "--finalists: must be between 0"),
        (["--seeds", "0"], "--seeds: must be between 1"),
    ],
)
def test_mistakes_give_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = search.main(arguments)
    except SystemExit as left:
        code = left.code
    assert code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_the_objective_trains_once_and_can_be_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "PICKING", VALIDATION_SEEDS[:2])
    monkeypatch.setattr(search, "crystals", lambda: (VALIDATION_SEEDS[2:4], VALIDATION_SEEDS[4:6]))
    given: Any = search.parser().parse_args([*command(tmp_path, 1), "--steps", "24576"])
    looks: list[int] = []
    cost = search.objective(RECIPE, 0, given, lambda steps, found: looks.append(steps))
    assert cost > 0.0
    assert len(looks) >= search.VALIDATIONS
    monkeypatch.setattr(training, "Run", None)
    assert search.objective(RECIPE, 0, given) == cost, "the result is cached"
    monkeypatch.undo()

    class GivenUp(Exception):
        pass

    def give_up(steps: int, found: Validation) -> None:
        raise GivenUp

    monkeypatch.setattr(run, "PICKING", VALIDATION_SEEDS[:2])
    with pytest.raises(GivenUp):
        search.objective({**RECIPE, "n_epochs": 1}, 0, given, give_up)
