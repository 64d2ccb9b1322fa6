"""The search: begins with the recipe, goes on from its journal, gives up the hopeless, confirms the best."""

import csv
import time
from dataclasses import asdict
from pathlib import Path
from threading import Thread
from typing import Any

import optuna
import pytest

pytest.importorskip("ray.tune", exc_type=ImportError)

from cz_gym.agents.training.recipes import PPO
from cz_gym.agents.training.validation import PICKING
from cz_gym.evaluation.protocol import TEST_SEEDS, VALIDATION_SEEDS
from studies.comparison import training
from studies.comparison.results import Plan
from studies.search import __main__ as search
from studies.search import trials
from studies.search.trials import SPACE, params_of, recipe_of
from tests.studies.bowl import attempt_bowl

pytestmark = pytest.mark.filterwarnings("ignore")
RECIPE = params_of(PPO())
slow = pytest.mark.slow


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
    groups = [set(PICKING), set(trials.JUDGED), set(trials.CONFIRMING)]
    assert set.union(*groups) <= set(VALIDATION_SEEDS)
    assert sum(map(len, groups)) == len(set.union(*groups))
    assert not set.union(*groups) & set(TEST_SEEDS)


def command(folder: Path, trials: int, finalists: int = 0) -> list[str]:
    folders = ["--out", str(folder / "out"), "--work", str(folder / "work")]
    return ["--trials", str(trials), "--finalists", str(finalists), *folders]


def history(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "out" / "history.csv").read_text().splitlines()))


def begun(folder: Path) -> int:
    return len(list((folder / "work" / "begun").glob("*")))


@slow
def test_a_search_begins_with_the_recipe_goes_on_and_confirms_the_best(
    nodes: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    met: list[Any] = []
    monkeypatch.setattr(trials, "compare", lambda *given: met.append(given))
    monkeypatch.setattr(trials, "attempt", attempt_bowl)
    monkeypatch.setattr(trials, "OTHERS", 2)
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "go").touch()
    assert search.main(command(tmp_path, 3)) == 0
    first = history(tmp_path)
    assert float(first[0]["learning_rate"]) == pytest.approx(RECIPE["learning_rate"])
    assert search.main([*command(tmp_path, 8, finalists=2), "--seeds", "2"]) == 0
    every = history(tmp_path)
    assert every[:3] == first
    assert len(every) == begun(tmp_path) == 8
    assert {row["state"] for row in every} == {"complete", "pruned"}
    ((study, plan, variants, seeds, _),) = met
    assert [variant.base for variant in variants] == ["", "ppo", "ppo"]
    assert list(plan.crystals) == list(trials.CONFIRMING)
    assert list(seeds) == [1, 2]
    done = sorted((row for row in every[1:] if row["state"] == "complete"), key=lambda row: float(row["cost"]))
    assert [variant.name for variant in study.variants[1:]] == [f"ppo-trial-{row['trial']}" for row in done[:2]]
    assert variants[1].recipe.learning_rate == pytest.approx(float(done[0]["learning_rate"]), rel=1e-4)
    assert search.main(command(tmp_path, 8)) == 0
    assert begun(tmp_path) == 8
    assert search.main([*command(tmp_path, 1), "--steps", "7"]) == 0
    assert begun(tmp_path) == 9, "trials of other steps are another search"


@slow
def test_a_lost_node_loses_nothing(nodes: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, second = nodes
    monkeypatch.setattr(trials, "attempt", attempt_bowl)

    def lose() -> None:
        while begun(tmp_path) < 2:
            time.sleep(0.1)
        made.remove_node(second, allow_graceful=False)
        (tmp_path / "work" / "go").touch()

    losing = Thread(target=lose, daemon=True)
    losing.start()
    assert search.main(command(tmp_path, 4)) == 0
    losing.join()
    assert len({row["trial"] for row in history(tmp_path)}) == len(history(tmp_path)) == 4
    assert begun(tmp_path) == 5, "one trial was begun again"


def test_interrupted_trials_come_again_and_once(tmp_path: Path) -> None:
    study = optuna.create_study()
    trials.enqueue(study)
    study.tell(study.ask(SPACE), 1.0)
    lost, failed = study.ask(SPACE), study.ask(SPACE)
    study.tell(failed, state=optuna.trial.TrialState.FAIL)
    for _ in range(2):
        trials.enqueue(study)
    again = [study.ask(SPACE) for _ in range(2)]
    assert [trial.params for trial in again] == [lost.params, failed.params]
    study.tell(again[0], 2.0)
    trials.enqueue(study)
    assert study.ask(SPACE).params == failed.params
    assert [trial.params for trial in trials.finished(study)] == [RECIPE, lost.params]
    assert study.ask(SPACE).params not in (RECIPE, lost.params, failed.params)


def test_a_number_beyond_its_limits_is_one_line(refused: Any) -> None:
    assert "--trials: must be between 1 and 10000, not 0" in refused(search.main, ["--trials", "0"])


@pytest.mark.usefixtures("few_crystals")
def test_an_attempt_goes_on_and_tells_all_its_validations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[float] = []

    def report(row: dict[str, float]) -> None:
        told.append(row["cost"])
        if len(told) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(trials.tune, "report", report)
    plan = Plan(tmp_path / "out", tmp_path / "work", VALIDATION_SEEDS[4:6])
    asked = trials.Search(plan, 24576, 1, 0)
    with pytest.raises(KeyboardInterrupt):
        trials.attempt(RECIPE, asked)
    trials.attempt(RECIPE, asked)
    assert told[:2] == told[2:4]
    assert len(told) > 2 + trials.VALIDATIONS
    monkeypatch.setattr(training, "Run", None)
    told_once = told[2:]
    trials.attempt(RECIPE, asked)
    assert told[2 + len(told_once) :] == pytest.approx(told_once, rel=1e-4), "the result is cached"
