"""The LQG's searches on a made-up plant whose optimum is known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cz_gym.baselines.lqg.controller import LQGSettings
from cz_gym.baselines.tuning import lqg as lqg_tuning
from cz_gym.baselines.tuning.harness import Figures, value_at
from cz_gym.baselines.tuning.lqg import LQGSearch
from cz_gym.baselines.tuning.lqg_goals import GOALS, PARAMETERS, Goal
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

START = LQGSettings()
GOAL = Goal(0.07, 0.02, True, START)
BUDGET = {"budget": 60, "episodes": 1, "survive": 0, "finalists": 3, "validation": 7, "finals": 5}
HEATER_STEP = START.weights.heater_step


def logarithms(settings):
    return np.log([value_at(settings, parameter.path) for parameter in PARAMETERS])


def made_up(settings, scenario="randomized", seeds=()):
    """Best return where every parameter is twice its default, radius error within its limit below the default."""
    away = logarithms(settings) - logarithms(START) - np.log(2.0)
    rmse = 0.07 * np.exp(0.1 * (away[0] + np.log(2.0)))
    return Figures(float(rmse), 0.01, 0.02, 2000.0 - 20.0 * float(away @ away), 0.0, 2160)


@pytest.fixture
def search(monkeypatch):
    """A search towards GOAL on the made-up plant; another plant and budget can be given."""

    def make(figures=made_up, goal=GOAL, **budget):
        monkeypatch.setattr(lqg_tuning, "figures", figures)
        monkeypatch.setitem(GOALS, ("lqg", goal.scenario), goal)
        return LQGSearch("lqg", goal.scenario, BUDGET | budget)

    return make


def test_the_search_finds_the_optimum_inside_the_limits(search):
    found = search(budget=250)
    found.run()
    away = logarithms(found.settings(found.best(1)[0].values)) - logarithms(START)
    assert away[0] == pytest.approx(0.0, abs=0.02)
    np.testing.assert_allclose(away[1:], np.log(2.0), atol=0.15)


def test_an_interrupted_search_meets_the_same_candidates_and_measures_none_again(search):
    whole, begun = search(budget=40), search(budget=20)
    whole.run()
    begun.run()
    resumed = search(budget=40)
    resumed.trials = list(begun.trials)
    resumed.run()
    assert len(begun.trials) < len(whole.trials)
    assert resumed.trials == whole.trials


def test_a_candidate_that_loses_crystals_is_never_best(search):
    def fragile(settings, scenario, seeds):
        lost = scenario != "randomized" and logarithms(settings)[1] > logarithms(START)[1]
        return made_up(settings)._replace(failure_rate=float(lost))

    found = search(fragile, survive=5)
    found.run()
    assert any(sum(trial.facts["lost"].values()) for trial in found.trials)
    lost = found.best(1)[0].facts["lost"]
    assert lost
    assert not sum(lost.values())


def test_the_version_with_calm_heater_wins_where_the_other_loses_crystals(search, tmp_path):
    def restless(settings, scenario, seeds):
        weight = settings.weights.heater_step
        lost = scenario == "puller" and weight < 2.0 * HEATER_STEP
        return Figures(0.06, 0.01, 0.02, 1900.0 - weight, float(lost), 2160)

    found = search(restless, finalists=1)
    found.run = lambda: found.add(np.exp(logarithms(START)))
    chosen = found.settings(found.tune(tmp_path / "lqg.json").values)
    assert chosen.weights.heater_step == pytest.approx(3.0 * HEATER_STEP)


def test_missing_a_limit_and_losing_a_crystal_cost_more_than_any_return():
    inside, outside = Figures(0.069, 0.01, 0.0, 1800.0, 0.0, 2160), Figures(0.08, 0.01, 0.0, 2000.0, 0.0, 2160)
    lost = inside._replace(mean_return=2000.0, failure_rate=0.01)
    assert GOAL.score(inside) < GOAL.score(outside)
    assert GOAL.score(inside) < GOAL.score(lost)


def test_another_scenario_is_tuned_on_its_own_training_seeds(search, tmp_path):
    met = {}

    def watched(settings, scenario, seeds):
        met.setdefault(scenario, set()).update(seeds)
        return made_up(settings)

    goal = replace(GOALS["lqg", "puller"], start=START)
    search(watched, goal, budget=15, episodes=4, survive=3, finals=2).tune(tmp_path / "lqg.json")
    assert met == {"puller": {*range(4), *range(100_000, 100_003), *VALIDATION_SEEDS[:7]}}


def test_a_controller_without_a_goal_on_a_scenario_is_refused_in_a_line(tmp_path, refused):
    arguments = ["--controller", "lqg", "--scenario", "hard", "--output", str(tmp_path / "lqg.json")]
    assert "lqg has no goal on 'hard', but on randomized" in refused(lqg_tuning.main, arguments)


def test_the_command_writes_what_the_search_chose(search, tmp_path, capsys):
    search()
    output = tmp_path / "lqg.json"
    assert lqg_tuning.main(["--budget", "20", "--survive", "0", "--output", str(output)]) == 0
    written = json.loads(output.read_text())
    assert len(written["history"]) >= 20
    assert f"pull_step={written['chosen']['values']['weights.pull_step']}" in capsys.readouterr().out
