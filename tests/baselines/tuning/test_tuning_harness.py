"""What all searches share: history, resume, choice on validation seeds; and what ships against the kept histories."""

import json
from pathlib import Path

import numpy as np
import pytest

from cz_gym.baselines.lqg import settings as lqg_settings
from cz_gym.baselines.pid import settings as pid_settings
from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.tuning.harness import Parameter, Search, file_name
from cz_gym.baselines.tuning.lqg import LQGSearch
from cz_gym.baselines.tuning.lqg_goals import SCENARIOS
from cz_gym.baselines.tuning.pid import PIDSearch
from cz_gym.baselines.tuning.pid_spaces import space_of
from cz_gym.config import make_config

RESULTS = Path(__file__).parents[3] / "results" / "tuning"
PARAMETERS = (Parameter("T_f", 1.0, 100.0), Parameter("pid.K_p", 1e-3, 1.0))


class Walk(Search):
    """Tries T_f = 1, 2, 3, ...; the last is best on training episodes, T_f = 2 on validation episodes."""

    def __init__(self, tries=4, episodes=3, parameters=PARAMETERS):
        budget = {"tries": tries, "episodes": episodes, "survive": 0, "finalists": 3}
        super().__init__("walk", "randomized", FilteredPID(), parameters, budget)
        self.measured = 0

    def training_score(self, settings):
        self.measured += 1
        return -settings.T_f, {"facts": settings.T_f}

    def validation_score(self, settings):
        return abs(settings.T_f - 2.0), {"hash": "h"}

    def run(self):
        for number in range(len(self.trials), self.budget["tries"]):
            self.add((number + 1.00001, 0.01))


def test_validation_chooses_among_the_best_of_training(tmp_path):
    path = tmp_path / "new" / "walk.json"
    search = Walk()
    chosen = search.tune(path)
    assert search.settings(chosen.values) == FilteredPID(T_f=2.0)
    written = json.loads(path.read_text())
    assert written["chosen"] == {"score": 0.0, "values": {"T_f": 2.0, "pid.K_p": 0.01}, "hash": "h"}
    assert [entry["values"]["T_f"] for entry in written["finalists"]] == [2.0, 3.0, 4.0]
    assert written["parameters"] == ["T_f", "pid.K_p"]
    assert [score for _, score, _ in written["history"]] == [-1.0, -2.0, -3.0, -4.0]
    assert [file.name for file in path.parent.iterdir()] == ["walk.json"]


def test_a_search_goes_on_where_it_stopped(tmp_path):
    path = tmp_path / "walk.json"
    Walk(2).tune(path)
    more = Walk(5)
    more.tune(path)
    assert (more.measured, len(more.trials)) == (3, 5)
    again = Walk(5)
    again.tune(path)
    assert (again.measured, again.trials) == (0, more.trials)


def test_every_trial_is_kept_at_once(tmp_path):
    search = Walk()
    search.path = tmp_path / "walk.json"
    for number in (1.0, 2.0):
        search.add((number, 0.01))
        assert len(json.loads(search.path.read_text())["history"]) == number


def test_a_kept_history_can_be_chosen_from_without_a_search(tmp_path):
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    Walk().tune(first)
    again = Walk(tries=9, episodes=5)
    again.tune(second, history=first)
    assert again.measured == 0
    assert json.loads(second.read_text())["chosen"] == json.loads(first.read_text())["chosen"]
    assert json.loads(second.read_text())["budget"]["episodes"] == 3


def test_another_file_is_refused(tmp_path):
    path = tmp_path / "walk.json"
    Walk().tune(path)
    for other, message in ((Walk(episodes=4), "was begun with"), (Walk(parameters=PARAMETERS[:1]), "parameters")):
        with pytest.raises(ValueError, match=message):
            other.tune(path)
    for content in ("{}", "[]", "", '{"budget": {"episodes": 3, "survive": 0}, "history": [1]}'):
        path.write_text(content)
        with pytest.raises(ValueError, match="no history of this search"):
            Walk().tune(path)
    with pytest.raises(FileNotFoundError):
        Walk().tune(path, history=tmp_path / "none.json")
    with pytest.raises(NotADirectoryError, match="is not a folder"):
        Walk().tune(path / "walk.json")


def kept(controller, scenario):
    return json.loads((RESULTS / file_name(controller, scenario)).read_text())


@pytest.mark.parametrize(("controller", "scenario"), sorted(pid_settings.SHIPPED))
def test_shipped_pids_are_those_the_search_chose(controller, scenario):
    found = kept(controller, scenario)
    search = PIDSearch(space_of(controller, scenario), scenario, found["budget"])
    values = found["chosen"]["values"]
    assert list(values) == [parameter.path for parameter in search.parameters]
    assert search.settings(values.values()) == pid_settings.SHIPPED[controller, scenario]
    assert list(values.values()) in [tried for tried, *_ in found["history"]]
    assert len(found["history"]) == found["budget"]["trials"]
    assert found["scenario_hash"] == make_config(scenario).scenario.hash


LQGS = [(controller, scenario) for controller, shipped in lqg_settings.SHIPPED.items() for scenario in shipped]


@pytest.mark.parametrize(("controller", "scenario"), LQGS)
def test_shipped_lqgs_are_those_the_search_chose(controller, scenario):
    found = kept(controller, scenario)
    search = LQGSearch(controller, scenario, found["budget"])
    values = list(found["chosen"]["values"].values())
    chosen = search.settings(values)
    assert chosen == lqg_settings.settings_of(controller, scenario)
    assert chosen.hash == found["chosen"]["hash"]
    assert not found["chosen"]["figures"]["failure_rate"]
    heater_step = lqg_settings.SEARCHED.index("weights.heater_step")  # finalists are also tried with heavier ones
    assert np.delete(values, heater_step).tolist() in [
        np.delete(tried, heater_step).tolist() for tried, *_ in found["history"]
    ]


@pytest.mark.parametrize("scenario", ["randomized", "hard", "nominal", "paper-ramp", "reference-a", "only-sensor"])
def test_everywhere_else_the_settings_of_randomized_serve(scenario):
    assert lqg_settings.lqg("lqg", make_config(scenario)).settings.hash == "769324959cc3ed6e"
    assert lqg_settings.lqg("lqg-quiet", make_config(scenario)).settings.hash == "f4a3e50fb1dcf8af"
    assert pid_settings.settings_of("paper-tuned", scenario) == pid_settings.SHIPPED["paper-tuned", "randomized"]


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_family_has_less_error_the_more_it_may_move(scenario):
    """But for puller's most active member: there the drive limits the steps."""
    names = map(lqg_settings.family_name, lqg_settings.ACTIVITIES)
    found = [kept(name, scenario)["chosen"]["figures"] for name in names]
    errors = [one["rmse_mm"] for one in found]
    assert errors[:-1] == sorted(errors[:-1], reverse=True)
    assert errors[-1] < errors[-2] or scenario == "puller"
    for activity, one in zip(lqg_settings.ACTIVITIES, found, strict=True):
        assert one["pull_step"] < 1.05 * activity
