"""Searches on made-up plants whose optimum is known, and shipped settings against the kept histories."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cz_gym.baselines.lqg import designs
from cz_gym.baselines.lqg.controller import LQGDesign
from cz_gym.baselines.pid import settings as pid_settings
from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.tuning import __main__ as command
from cz_gym.baselines.tuning.goals import FAMILY_SCENARIOS, LQG_PARAMETERS, PIDS, LQGGoal, PIDGoal, goal_of
from cz_gym.baselines.tuning.optimisers import first
from cz_gym.baselines.tuning.search import Figures, Parameter, Search, file_name, measure, value_at
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import RANDOMIZED, find_scenario
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

RESULTS = Path(__file__).parents[3] / "results" / "tuning"
BUDGET = {"trials": 60, "episodes": 1, "survive": 0, "finalists": 3, "validation": 7, "finals": 0, "seed": 0}
FIGURES = Figures(0.06, 0.01, 0.02, 1900.0, 0.0, 2160)
CONFIG = make_config("randomized")


def kept(controller, scenario):
    return json.loads((RESULTS / file_name(controller, scenario)).read_text())


# A search of any controller


class Walk(PIDGoal):
    """Tries T_f = 1, 2, 3, ..."""

    def propose(self, search):
        for number in range(len(search.trials), search.budget["trials"]):
            search.add((number + 1.00001, 0.01))


PARAMETERS = Parameter("T_f", 1.0, 100.0), Parameter("pid.K_p", 1e-3, 1.0)


def walk(trials=4, episodes=3, parameters=PARAMETERS):
    """The last candidate is best on training episodes, T_f = 2 on validation episodes."""
    met = []

    def figures(policy, config, seeds):
        met.append(policy)
        return FIGURES._replace(rmse_mm=-policy.T_f if seeds[0] < 1_000_000 else abs(policy.T_f - 2.0))

    search = Search("walk", Walk(FilteredPID(), parameters, ()), CONFIG, BUDGET, figures)
    search.budget |= {"trials": trials, "episodes": episodes}
    return search, met


def test_validation_chooses_among_the_best_of_training(tmp_path):
    path = tmp_path / "new" / "walk.json"
    search, _ = walk()
    assert search.settings(search.tune(path).values) == FilteredPID(T_f=2.0)
    written = json.loads(path.read_text())
    assert written["chosen"]["values"] == {"T_f": 2.0, "pid.K_p": 0.01}
    assert [entry["values"]["T_f"] for entry in written["finalists"]] == [2.0, 3.0, 4.0]
    assert written["parameters"] == ["T_f", "pid.K_p"]
    assert [facts["figures"]["rmse_mm"] for *_, facts in written["history"]] == [-1.0, -2.0, -3.0, -4.0]
    assert [file.name for file in path.parent.iterdir()] == ["walk.json"]


def test_a_search_continues_where_it_stopped(tmp_path):
    path = tmp_path / "walk.json"
    walk(2)[0].tune(path)
    (more, met), (again, met_again) = walk(5), walk(5)
    more.tune(path)
    assert (len(met), len(more.trials)) == (3 + 3, 5)
    again.tune(path)
    assert (len(met_again), again.trials) == (3, more.trials)


def test_every_trial_is_kept_at_once(tmp_path):
    search, _ = walk()
    search.path = tmp_path / "walk.json"
    for number in (1.0, 2.0):
        search.add((number, 0.01))
        assert len(json.loads(search.path.read_text())["history"]) == number


def test_another_file_is_refused(tmp_path):
    path = tmp_path / "walk.json"
    walk()[0].tune(path)
    others = walk(episodes=4)[0], walk(parameters=PARAMETERS[:1])[0]
    for other, message in zip(others, ("was begun with", "parameters"), strict=True):
        with pytest.raises(ValueError, match=message):
            other.tune(path)
    for content in ("{}", "[]", "", '{"budget": {"episodes": 3, "survive": 0}, "history": [1]}'):
        path.write_text(content)
        with pytest.raises(ValueError, match="no history of this search"):
            walk()[0].tune(path)


def test_steps_are_judged_by_time_not_by_sample():
    """At 2 s a ramp of the drives has two fifths of the steps that it has at 5 s: the figure is the same."""

    class Ramp:
        def __init__(self, dt):
            self.rise = np.float32(1e-5 * dt)

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            state = np.zeros((len(observation), 2), np.float32) if state is None else state
            return state + self.rise, state + self.rise

    found = []
    for dt in (2.0, 5.0, 10.0):
        config = make_config("nominal", control_interval=dt, horizon=600.0)
        found.append(measure(Ramp(dt), config, [0]))
    assert [one.pull_step for one in found] == pytest.approx([5e-5 * 1.2] * 3, rel=1e-3)
    assert [one.heater_step for one in found] == pytest.approx([5e-5 * 10.0] * 3, rel=1e-3)


@pytest.mark.parametrize("dt", [2.0, 5.0])
def test_a_search_keeps_the_control_interval_and_puller_of_its_environment(dt):
    parameters = CONFIG.parameters._replace(r_0=0.1)
    config = make_config("randomized", control_interval=dt, parameters=parameters)
    for name in ("paper-filtered", "lqg"):
        met = []

        def figures(policy, config, seeds, met=met):
            met.append((policy.made_for, config.made_for))
            return FIGURES

        search = Search(name, goal_of(name, RANDOMIZED), config, BUDGET | {"survive": 2}, figures)
        search.add(first(search))
        assert len(met) == 1 + len(search.goal.survive)
        assert set(met) == {(config.made_for, config.made_for)}


# PIDs


def bowl(trials):
    """A search of the least cost, 0 at T_f = 10 and K_ff = 0.5."""
    pytest.importorskip("optuna")
    parameters = Parameter("T_f", 1.0, 100.0), Parameter("K_ff", -1.0, 1.0, log=False)

    def figures(policy, config, seeds):
        return FIGURES._replace(
            rmse_mm=float(np.log10(policy.T_f / 10.0) ** 2 + (policy.K_ff - 0.5) ** 2), pull_step=0.0
        )

    return Search("bowl", PIDGoal(FilteredPID(), parameters, ()), CONFIG, BUDGET | {"trials": trials}, figures)


def test_exploring_and_refining_comes_near_a_known_optimum():
    search = bowl(80)
    search.goal.propose(search)
    assert search.trials[0].values == (FilteredPID().T_f, FilteredPID().K_ff)
    assert search.best_score < 0.02
    assert search.best_score < 0.2 * search.trials[0].score
    for T_f, K_ff in (trial.values for trial in search.trials):
        assert 1.0 <= T_f <= 100.0
        assert -1.0 <= K_ff <= 1.0


def test_the_same_seed_tries_the_same_and_a_kept_history_continues(tmp_path):
    path = tmp_path / "bowl.json"
    first_run, again, more = bowl(20), bowl(20), bowl(26)
    first_run.tune(path)
    again.goal.propose(again)
    assert again.trials == first_run.trials
    more.tune(path)
    assert more.trials[:20] == first_run.trials
    assert len(more.trials) == 26


@pytest.mark.parametrize("scenario", ["randomized", "puller"])
@pytest.mark.parametrize("name", PIDS)
def test_every_parameter_sets_what_it_names(name, scenario):
    search = Search(name, goal_of(name, find_scenario(scenario)), make_config(scenario), BUDGET)
    values = [0.5 * (each.low + each.high) for each in search.parameters]
    assert [value_at(search.settings(values), each.path) for each in search.parameters] == values
    assert len({each.path for each in search.parameters}) == len(search.parameters)
    assert all(each.low < each.high for each in search.parameters)


@pytest.mark.parametrize("scenario", ["randomized", "sensor-fault"])
@pytest.mark.parametrize("name", PIDS)
def test_a_search_begins_with_the_settings_of_randomized(name, scenario):
    """But for an infinite jump, which is clipped to the range of its parameter."""
    search = Search(name, goal_of(name, find_scenario(scenario)), make_config(scenario), BUDGET)
    highest = max((each.high for each in search.parameters if each.path == "jump"), default=None)
    frozen = pid_settings.SHIPPED[name, "randomized"]
    assert search.settings(first(search)) == (frozen if highest is None else replace(frozen, jump=highest))


def test_the_cost_of_a_pid_is_its_priced_sum():
    goal = PIDGoal(FilteredPID(), (), (), allowed_step=0.004, rules=(lambda policy: 0.5, lambda policy: 0.25))
    found = FIGURES._replace(failure_rate=0.1)
    assert goal.cost(found, None) == pytest.approx(0.06 + 0.2 * 0.01 + 20.0 * 0.006 + 5.0 * 0.1 + 2.0 * 0.75)


@pytest.mark.parametrize(("controller", "scenario"), sorted(pid_settings.SHIPPED))
def test_shipped_pids_are_those_the_search_chose(controller, scenario):
    found = kept(controller, scenario)
    search = Search(controller, goal_of(controller, find_scenario(scenario)), make_config(scenario), found["budget"])
    values = found["chosen"]["values"]
    assert list(values) == [parameter.path for parameter in search.parameters]
    assert search.settings(values.values()) == pid_settings.SHIPPED[controller, scenario]
    assert list(values.values()) in [tried for tried, *_ in found["history"]]
    assert len(found["history"]) == found["budget"]["trials"]
    assert found["scenario_hash"] == make_config(scenario).scenario.hash


# LQGs

START = LQGDesign()
GOAL = LQGGoal(START, LQG_PARAMETERS, ("hard", "puller"), 0.07, 0.02, True)
HEATER_STEP = START.weights.heater_step


def logarithms(design):
    return np.log([value_at(design, parameter.path) for parameter in LQG_PARAMETERS])


def made_up(policy, config=CONFIG, seeds=()):
    """Best return where every parameter is twice its default, radius error within its limit below the default."""
    away = logarithms(policy.design) - logarithms(START) - np.log(2.0)
    rmse = 0.07 * np.exp(0.1 * (away[0] + np.log(2.0)))
    return FIGURES._replace(rmse_mm=float(rmse), mean_return=2000.0 - 20.0 * float(away @ away))


def lqg_search(figures=made_up, goal=GOAL, config=CONFIG, **budget):
    return Search("lqg", goal, config, BUDGET | budget, figures)


def test_cobyla_comes_near_the_optimum_inside_the_limits():
    search = lqg_search(trials=250)
    search.goal.propose(search)
    away = logarithms(search.settings(search.best(1)[0].values)) - logarithms(START)
    assert away[0] == pytest.approx(0.0, abs=0.02)
    np.testing.assert_allclose(away[1:], np.log(2.0), atol=0.15)


def test_an_interrupted_search_meets_the_same_candidates_and_measures_none_again():
    whole, begun, resumed = lqg_search(trials=40), lqg_search(trials=20), lqg_search(trials=40)
    whole.goal.propose(whole)
    begun.goal.propose(begun)
    resumed.trials = list(begun.trials)
    resumed.goal.propose(resumed)
    assert len(begun.trials) < len(whole.trials)
    assert resumed.trials == whole.trials


def test_a_candidate_that_loses_crystals_is_never_best():
    def fragile(policy, config, seeds):
        lost = config.scenario.name != "randomized" and logarithms(policy.design)[1] > logarithms(START)[1]
        return made_up(policy)._replace(failure_rate=float(lost))

    search = lqg_search(fragile, survive=5)
    search.goal.propose(search)
    assert any(sum(trial.facts["lost"].values()) for trial in search.trials)
    lost = search.best(1)[0].facts["lost"]
    assert lost
    assert not sum(lost.values())


def test_the_version_with_calm_heater_wins_where_the_other_loses_crystals(tmp_path):
    def restless(policy, config, seeds):
        weight = policy.design.weights.heater_step
        lost = config.scenario.name == "puller" and weight < 2.0 * HEATER_STEP
        return FIGURES._replace(mean_return=1900.0 - weight, failure_rate=float(lost))

    class Once(LQGGoal):
        def propose(self, search):
            search.add(first(search))

    goal = Once(START, LQG_PARAMETERS, ("hard", "puller"), 0.07, 0.02, True)
    search = lqg_search(restless, goal, finalists=1, finals=5)
    chosen = search.settings(search.tune(tmp_path / "lqg.json").values)
    assert chosen.weights.heater_step == pytest.approx(3.0 * HEATER_STEP)


def test_missing_a_limit_and_losing_a_crystal_cost_more_than_any_return():
    inside, outside = Figures(0.069, 0.01, 0.0, 1800.0, 0.0, 2160), Figures(0.08, 0.01, 0.0, 2000.0, 0.0, 2160)
    lost = inside._replace(mean_return=2000.0, failure_rate=0.01)
    assert GOAL.cost(inside, None) < GOAL.cost(outside, None)
    assert GOAL.cost(inside, None) < GOAL.cost(lost, None)


def test_a_search_uses_training_and_validation_seeds_only(tmp_path):
    met = {}

    def watched(policy, config, seeds):
        met.setdefault(config.scenario.name, set()).update(seeds)
        return made_up(policy)

    config = make_config("puller")
    goal = replace(goal_of("lqg", config.scenario), start=START)
    lqg_search(watched, goal, config, trials=15, episodes=4, survive=3, finals=2).tune(tmp_path / "lqg.json")
    assert met == {"puller": {*range(4), *range(100_000, 100_003), *VALIDATION_SEEDS[:7]}}


@pytest.mark.parametrize(
    ("controller", "scenario"), [(name, where) for name, shipped in designs.SHIPPED.items() for where in shipped]
)
def test_shipped_lqgs_are_those_the_search_chose(controller, scenario):
    found, config = kept(controller, scenario), make_config(scenario)
    search = Search(controller, goal_of(controller, config.scenario), config, found["budget"])
    values = list(found["chosen"]["values"].values())
    chosen = search.settings(values)
    assert chosen == designs.design_of(controller, config.scenario)
    assert chosen.hash == found["chosen"]["hash"]
    assert not found["chosen"]["figures"]["failure_rate"]
    heater_step = designs.SEARCHED.index("weights.heater_step")  # finalists are also tried with heavier ones
    assert np.delete(values, heater_step).tolist() in [
        np.delete(tried, heater_step).tolist() for tried, *_ in found["history"]
    ]


@pytest.mark.parametrize("scenario", FAMILY_SCENARIOS)
def test_the_family_has_less_error_the_more_it_may_move(scenario):
    """But for the most active member on puller, where the drive limits the steps."""
    found = [kept(designs.family_name(each), scenario)["chosen"]["figures"] for each in designs.ACTIVITIES]
    errors = [one["rmse_mm"] for one in found]
    assert errors[:-1] == sorted(errors[:-1], reverse=True)
    assert errors[-1] < errors[-2] or scenario == "puller"
    for activity, one in zip(designs.ACTIVITIES, found, strict=True):
        assert one["pull_step"] < 1.05 * activity


# The command


def test_the_command_writes_what_the_search_chose(monkeypatch, tmp_path, capsys):
    pytest.importorskip("optuna")
    monkeypatch.setattr(command, "measure", lambda policy, config, seeds: FIGURES)
    arguments = ["--controller", "paper-filtered", "--trials", "3", "--control-interval", "2", "--out", str(tmp_path)]
    assert command.main(arguments) == 0
    assert len(json.loads((tmp_path / "paper-filtered.json").read_text())["history"]) == 3
    assert "FilteredPID(" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--controller", "nobody"], "unknown controller to tune 'nobody'"),
        (["--controller", "industrial", "--scenario", "moon"], "moon"),
        (["--controller", "lqg", "--scenario", "hard"], "lqg has no goal on 'hard', but on randomized"),
    ],
)
def test_the_command_refuses_in_one_line(given, said, tmp_path, refused):
    assert said in refused(command.main, [*given, "--out", str(tmp_path)])
    assert not list(tmp_path.iterdir())
