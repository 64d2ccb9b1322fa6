"""Searches on made-up plants whose optimum is known, and shipped settings against the kept histories."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from cz_gym.baselines import tuned_controllers as records
from cz_gym.baselines.lqg import LQGDesign
from cz_gym.baselines.margins import MarginLimits, worst_margins
from cz_gym.baselines.pid import FilteredPID
from cz_gym.baselines.search import Search
from cz_gym.baselines.tuned import TUNED, Objective, Parameter, Scores, by_scenario, file_name, measure, value_at
from cz_gym.baselines.tuned_controllers import ACTIVITIES, BEST_RETURN, CRYSTALS, LQG_PARAMETERS, LQGS, PIDS, price
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import RANDOMIZED, find_scenario
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.puller.file import FOLDER
from cz_gym.support.errors import CzError
from cz_gym.tools import tune
from tests.observed import PLAIN

SCORES = Scores(0.06, 0.01, 0.02, 0.0, 1900.0, 0.0, 2160)
CONFIG = make_config("randomized", **PLAIN)
TWO = Parameter("T_f", 1.0, 100.0), Parameter("K_ff", -1.0, 1.0, log=False)


def name(part):
    return getattr(part, "name", None)


def kept(controller, scenario):
    return json.loads((FOLDER / "default" / file_name(controller, scenario)).read_text())


def bowl(trials=40, episodes=4, parameters=TWO):
    """Least error on training episodes at T_f = 10 and K_ff = 0.5, on validation episodes the longer T_f the better."""
    met = []

    def figures(policy, config, seeds):
        met.append(policy)
        error = np.log10(policy.T_f / 10.0) ** 2 + (policy.K_ff - 0.5) ** 2
        return SCORES._replace(rmse_mm=float(error) if seeds[0] < 1_000_000 else 1.0 / policy.T_f, pull_step=0.0)

    return Search(
        "bowl",
        Objective(price, (), 5.0, 2.0, start=FilteredPID(), parameters=parameters),
        CONFIG,
        trials,
        episodes,
        figures,
    ), met


def test_validation_chooses_among_the_best_of_training(tmp_path):
    path = tmp_path / "new" / "bowl.json"
    (search, _), done = bowl(), []
    search.progress = done.append
    chosen = search.tune(path)
    assert done == [*range(1, len(search.trials) + 4)]
    assert search.trials[0].values == (FilteredPID().T_f, FilteredPID().K_ff)
    assert search.best(1)[0].score < 1e-3
    assert chosen.values[0] == max(trial.values[0] for trial in search.best(3))
    written = json.loads(path.read_text())
    assert tuple(written["chosen"]["values"].values()) == chosen.values
    assert len(written["finalists"]) == 3
    assert written["parameters"] == list(written["chosen"]["values"]) == ["T_f", "K_ff"]
    assert [tuple(values) for values, *_ in written["history"]] == [trial.values for trial in search.trials]
    assert [file.name for file in path.parent.iterdir()] == ["bowl.json"]


def test_every_trial_is_kept_at_once_and_a_search_continues_where_it_stopped(tmp_path):
    path = tmp_path / "bowl.json"
    (whole, _), (begun, _), (resumed, met) = bowl(20), bowl(8), bowl(20)
    whole.explore()
    begun.path = path
    begun.explore()
    assert len(json.loads(path.read_text())["history"]) == len(begun.trials) < len(whole.trials)
    resumed.tune(path)
    assert resumed.trials == whole.trials
    assert len(met) == len(whole.trials) - len(begun.trials) + 3


@pytest.mark.parametrize("trials", [1, 2, 3, 9])
def test_no_more_candidates_are_tried_than_asked_for(trials, recwarn):
    """SciPy raises COBYLA's number of evaluations to that of the parameters plus two, with a warning."""
    search, met = bowl(trials)
    search.explore()
    assert len(search.trials) == len(met) == trials
    assert not recwarn.list


def test_another_file_is_refused(tmp_path):
    path = tmp_path / "bowl.json"
    bowl()[0].tune(path)
    for other, message in ((bowl(episodes=5), "was begun with 4 episodes"), (bowl(parameters=TWO[:1]), "param")):
        with pytest.raises(ValueError, match=message):
            other[0].tune(path)
    for content in ("{}", "[]", "", '{"budget": {"episodes": 4}, "history": [1]}'):
        path.write_text(content)
        with pytest.raises(ValueError, match="no history of this search"):
            bowl()[0].tune(path)


def test_steps_are_judged_by_time_not_by_sample():
    """At 2 s a ramp of the drives has two fifths of the steps that it has at 5 s: the figure is the same."""

    class Ramp:
        def __init__(self, dt):
            self.rise = np.float32(1e-5 * dt)

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            state = np.zeros((len(observation), 2), np.float32) if state is None else state
            return state + self.rise, state + self.rise

    for dt in (2.0, 5.0, 10.0):
        found = measure(Ramp(dt), make_config("nominal", control_interval=dt, horizon=600.0, **PLAIN), [0])
        assert (found.pull_step, found.heater_step) == pytest.approx((5e-5 * 1.2, 5e-5 * 10.0), rel=1e-3)


@pytest.mark.parametrize("dt", [2.0, 5.0])
@pytest.mark.parametrize("tuned", [PIDS[0], BEST_RETURN], ids=name)
def test_a_search_keeps_the_control_interval_and_puller_of_its_environment(tuned, dt):
    slim, met = CONFIG.parameters._replace(r_0=0.1), []
    config = make_config("randomized", control_interval=dt, parameters=slim, **PLAIN)

    def figures(policy, config, seeds):
        met.append((policy.made_for, config.made_for))
        return SCORES

    search = Search(tuned.name, tuned.objective(RANDOMIZED), config, 1, 10, figures)
    search.add(search.first)
    assert len(met) == 1 + len(search.objective.survive)
    assert set(met) == {(config.made_for, config.made_for)}


def test_a_search_is_not_continued_on_other_crystals_or_at_another_interval(tmp_path, monkeypatch):
    goal, path = PIDS[0].objective(RANDOMIZED), tmp_path / "search.json"

    def search(scenario, dt):
        config = make_config(scenario, control_interval=dt, **PLAIN)
        return Search(PIDS[0].name, goal, config, 2, 10, lambda *_: SCORES)

    search("randomized", 2.0).tune(path)
    tried = path.read_bytes()
    search("randomized", 2.0).tune(path)
    for scenario, dt in (("randomized", 5.0), ("hard", 2.0)):
        with pytest.raises(CzError, match="begun on other crystals or at another control interval"):
            search(scenario, dt).tune(path)
    assert path.read_bytes() == tried


# Margins


def within(margins, trials, losing=False):
    """A search for the least filter time, which has the least margins, on episodes that are lost or not."""

    def figures(policy, config, seeds):
        return SCORES._replace(rmse_mm=policy.T_f / 1000.0, pull_step=0.0, failure_rate=float(losing))

    parameters = (Parameter("T_f", 2.0, 400.0), Parameter("pid.K_p", 1e-3, 1e-2))
    start = replace(PIDS[1].settings(RANDOMIZED), T_f=20.0)
    objective = Objective(price, (), 5.0, 2.0, start=start, parameters=parameters)
    return Search("within", objective, CONFIG, trials, 5, figures, margins=margins)


def test_a_search_within_margins_ends_within_them_and_says_so(tmp_path):
    path, limits = tmp_path / "within.json", MarginLimits(1.8, 22.5, 2.6)
    search = within(limits, 40)
    chosen = search.tune(path)
    found = worst_margins(search.settings(chosen.values), CONFIG)
    assert min(limits.slacks(found)) > -2e-3
    assert min(limits.slacks(worst_margins(search.settings(search.first), CONFIG))) < -0.05
    written = json.loads(path.read_text())
    assert written["margins"] == list(limits)
    assert written["chosen"]["margins"]["ring"]["phase"] == pytest.approx(found.ring.phase, rel=1e-3)
    for other, was in ((MarginLimits(), "1.8,22.5,2.6, not 2,30,2"), (None, "1.8,22.5,2.6, not off")):
        with pytest.raises(CzError, match=f"begun with --margins {was}"):
            within(other, 3).tune(path)


def test_within_margins_a_lost_crystal_is_a_missed_limit():
    wide = MarginLimits(1.0, 0.1, 1e3)
    searches = within(None, 1), within(wide, 1), within(wide, 1, losing=True)
    scores = [search.add(search.first).score for search in searches]
    assert scores[0] == scores[1]
    assert scores[2] == pytest.approx(scores[0] + 5.0 + 2.0)


# PIDs


@pytest.mark.parametrize("scenario", ["randomized", "sensor-fault", "puller"])
@pytest.mark.parametrize("tuned", PIDS, ids=name)
def test_every_parameter_sets_what_it_names_and_a_search_begins_with_the_settings_of_randomized(tuned, scenario):
    """But for an infinite jump, which is clipped to the range of its parameter."""
    search = Search(tuned.name, tuned.objective(find_scenario(scenario)), make_config(scenario, **PLAIN), 1, 5)
    parameters = search.objective.parameters
    values = [0.5 * (each.low + each.high) for each in parameters]
    assert [value_at(search.settings(values), each.path) for each in parameters] == values
    highest = max((each.high for each in parameters if each.path == "jump"), default=None)
    frozen = tuned.settings(RANDOMIZED)
    assert search.settings(search.first) == (frozen if highest is None else replace(frozen, jump=highest))


# LQGs

START = LQGDesign()
GOAL = replace(records.lqg_objective(0.07, 0.02, True, ("hard", "puller")), start=START, parameters=LQG_PARAMETERS)


def logarithms(design):
    return np.log([value_at(design, parameter.path) for parameter in LQG_PARAMETERS])


def made_up(policy, config=CONFIG, seeds=()):
    """Best return where every parameter is twice its default, radius error within its limit below the default."""
    away = logarithms(policy.design) - logarithms(START) - np.log(2.0)
    rmse = 0.07 * np.exp(0.1 * (away[0] + np.log(2.0)))
    return SCORES._replace(rmse_mm=float(rmse), mean_return=2000.0 - 20.0 * float(away @ away))


def test_cobyla_comes_near_the_optimum_inside_the_limits():
    search = Search("lqg", GOAL, CONFIG, 250, 4, made_up)
    search.explore()
    away = logarithms(search.settings(search.best(1)[0].values)) - logarithms(START)
    assert away[0] == pytest.approx(0.0, abs=0.02)
    np.testing.assert_allclose(away[1:], np.log(2.0), atol=0.15)


def test_a_candidate_that_loses_crystals_is_never_best():
    def fragile(policy, config, seeds):
        lost = config.scenario.name != "randomized" and logarithms(policy.design)[1] > logarithms(START)[1]
        return made_up(policy)._replace(failure_rate=float(lost))

    search = Search("lqg", GOAL, CONFIG, 60, 5, fragile)
    search.explore()
    assert any(sum(trial.facts["lost"].values()) for trial in search.trials)
    lost = search.best(1)[0].facts["lost"]
    assert lost
    assert not sum(lost.values())


def test_a_search_uses_training_and_validation_seeds_only(tmp_path):
    met = {}

    def watched(policy, config, seeds):
        met.setdefault(config.scenario.name, set()).update(seeds)
        return made_up(policy)

    config = make_config("puller", **PLAIN)
    goal = replace(BEST_RETURN.objective(config.scenario), start=START)
    Search("lqg", goal, config, 15, 10, watched).tune(tmp_path / "lqg.json")
    survived = {*range(100_000, 100_020)}
    assert met == {"puller": {*range(10), *survived, *VALIDATION_SEEDS[:20]}}


# Shipped settings

HEATER_STEP = [*by_scenario("lqg")["randomized"]].index("weights.heater_step")
SEARCHES = [(each, find_scenario(kept)) for each in (*PIDS, *LQGS, *CRYSTALS) for kept in by_scenario(each.name)]


@pytest.mark.parametrize(("tuned", "scenario"), SEARCHES, ids=name)
def test_shipped_settings_are_those_a_search_chose(tuned, scenario):
    """Finalists of the searches that chose the LQGs were also tried with heavier weights on heater steps."""
    found, config = kept(tuned.name, scenario.name), tuned.search_config(scenario)
    search, values = Search(tuned.name, tuned.objective(scenario), config, 1, 5), found["chosen"]["values"]
    assert list(values) == [parameter.path for parameter in search.objective.parameters]
    chosen, shipped = search.settings(values.values()), tuned.settings(scenario)
    if tuned in LQGS:  # a search expects the errors of all its crystals, a shipped LQG those of its scenario
        told = {each: getattr(shipped.noise, each) for each in ("told_power_sd", "told_temperature_sd")}
        chosen = replace(chosen, noise=replace(chosen.noise, **told))
    assert chosen == shipped
    varied = [HEATER_STEP] if tuned in LQGS else []
    history = [np.delete(tried, varied).tolist() for tried, *_ in found["history"]]
    assert np.delete([*values.values()], varied).tolist() in history
    assert found["scenario_hash"] == config.scenario.hash
    if tuned in LQGS:
        assert not found["chosen"]["figures"]["failure_rate"]
    if tuned in CRYSTALS:
        assert found["history"][0][0] == list(search.first)
        score = search.objective.score(records.CrystalScores(**found["chosen"]["figures"]), None)
        assert found["chosen"]["score"] == pytest.approx(score)


@pytest.mark.parametrize("scenario", [each.name for each in TUNED])
def test_the_family_has_less_error_the_more_it_may_move(scenario):
    """But for the most active member on puller, where the drive limits the steps."""
    found = [kept(each, scenario)["chosen"]["figures"] for each in records.FAMILY[1:]]
    errors = [one["rmse_mm"] for one in found]
    assert errors[:-1] == sorted(errors[:-1], reverse=True)
    assert errors[-1] < errors[-2] or scenario == "puller"
    for activity, one in zip(ACTIVITIES, found, strict=True):
        assert one["pull_step"] < 1.05 * activity


# The command


@pytest.mark.parametrize(
    ("name", "said", "trials", "scenario"),
    [
        ("paper-filtered", "T_f = ", 3, "randomized"),
        ("lqg-at-0.02", "weights.pull = ", 13, "0.5 hot-zone + 0.5 randomized"),
    ],
)
def test_the_command_writes_what_the_search_chose(name, said, trials, scenario, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tune, "Search", partial(Search, measure=lambda policy, config, seeds: SCORES))
    arguments = ["--controller", name, "--trials", f"{trials}", "--control-interval", "2", "--out", str(tmp_path)]
    assert tune.main(arguments) == 0
    written = json.loads((tmp_path / f"{name}.json").read_text())
    assert len(written["history"]) == trials
    assert written["scenario"] == scenario
    out = capsys.readouterr().out
    assert said in out
    assert f"wrote {tmp_path / name}.json" in out


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--controller", "nobody"], "unknown controller to tune 'nobody'"),
        (["--controller", "pid-conventional", "--scenario", "moon"], "moon"),
        (["--controller", "lqg-along", "--scenario", "hard"], "lqg-along has one search: leave --scenario hard out"),
        (["--controller", "lqg-along", "--margins", "2,30,2"], "lqg-along has no linear loop along a whole crystal"),
        (["--controller", "lqg", "--margins", "two"], "--margins two: write GAIN,PHASE,PEAK, such as 2,30,2, or off"),
        (["--controller", "lqg", "--scenario", "hard"], "lqg has no goal on 'hard', but on randomized"),
    ],
)
def test_the_command_refuses_in_one_line(given, said, tmp_path, refused):
    assert said in refused(tune.main, [*given, "--out", str(tmp_path)])
    assert not list(tmp_path.iterdir())
