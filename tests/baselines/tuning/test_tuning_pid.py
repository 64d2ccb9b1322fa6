"""The PIDs' searches: a known optimum, what is priced, and no test seed ever."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.pid.settings import settings_of
from cz_gym.baselines.tuning import pid as pid_tuning
from cz_gym.baselines.tuning.harness import Parameter, value_at
from cz_gym.baselines.tuning.pid import PIDSearch
from cz_gym.baselines.tuning.pid_spaces import SPACES, Space, space_of

BOWL = Space("bowl", FilteredPID(), (Parameter("T_f", 1.0, 100.0), Parameter("K_ff", -1.0, 1.0, log=False)), np.inf)
BUDGET = {"trials": 80, "episodes": 3, "survive": 2, "finalists": 2, "validation": 3}
NAMES = [space.name for space in SPACES]


class Bowl(PIDSearch):
    """Least at T_f = 10, K_ff = 0.5, where it is 0."""

    def objective(self, policy, seeds, survive):
        return float(np.log10(policy.T_f / 10.0) ** 2 + (policy.K_ff - 0.5) ** 2), {}


def bowl(trials):
    pytest.importorskip("optuna")
    return Bowl(BOWL, "randomized", BUDGET | {"trials": trials})


def test_the_search_comes_near_a_known_optimum():
    search = bowl(80)
    search.run()
    assert search.trials[0].values == (FilteredPID().T_f, FilteredPID().K_ff)
    assert search.best_score < 0.02
    assert search.best_score < 0.2 * search.trials[0].score
    for T_f, K_ff in (trial.values for trial in search.trials):
        assert 1.0 <= T_f <= 100.0
        assert -1.0 <= K_ff <= 1.0


def test_the_same_seed_finds_the_same_and_a_kept_history_goes_on(tmp_path):
    path = tmp_path / "bowl.json"
    first, again = bowl(20), bowl(20)
    first.tune(path)
    again.run()
    assert again.trials == first.trials
    more = bowl(26)
    more.tune(path)
    assert more.trials[:20] == first.trials
    assert len(more.trials) == 26


@pytest.mark.parametrize("scenario", ["randomized", "puller"])
@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_sets_what_it_names(name, scenario):
    search = PIDSearch(space_of(name, scenario), scenario, BUDGET)
    values = [0.5 * (each.low + each.high) for each in search.parameters]
    assert [value_at(search.settings(values), each.path) for each in search.parameters] == values
    assert len({each.path for each in search.parameters}) == len(search.parameters)
    assert all(each.low < each.high for each in search.parameters)


@pytest.mark.parametrize("name", NAMES)
def test_a_search_elsewhere_begins_with_the_settings_of_randomized(name):
    """But for a jump without end, which the parameter holds inside its range."""
    search = PIDSearch(space_of(name, "sensor-fault"), "sensor-fault", BUDGET)
    first = search.settings(search._inside(value_at(search.base, each.path) for each in search.parameters))
    highest = max((each.high for each in search.parameters if each.path == "jump"), default=None)
    frozen = settings_of(name, "randomized")
    assert first == (frozen if highest is None else replace(frozen, jump=highest))


def test_the_objective_prices_what_it_counts():
    def objective(space):
        search = PIDSearch(space, "randomized", BUDGET)
        search.config = replace(search.config, horizon=300.0)
        return search.objective(space.base, range(3), range(2))

    space = space_of("paper-tuned", "randomized")._replace(rule=BOWL.rule)
    free, facts = objective(space)
    step = facts["pull_step_rms_mm_per_min"]
    assert free == pytest.approx(facts["rmse_mm"] + pid_tuning.STEP_PRICE * step, rel=1e-9)
    priced, _ = objective(space._replace(allowed_step=0.0, rule=lambda policy: 0.5))
    assert priced - free == pytest.approx(pid_tuning.EXCESS_PRICE * step + 0.5 * pid_tuning.RULE_PRICE, rel=1e-9)


def test_the_command_chooses_on_validation_and_never_sees_test(monkeypatch, tmp_path, capsys):
    pytest.importorskip("optuna")
    asked = []

    def falling(search, policy, seeds, survive):
        """On training episodes a small T_f is best, on validation episodes a large one."""
        asked.append((search.config.scenario.name, list(seeds), list(survive)))
        return policy.T_f if seeds[0] < 1_000_000 else -policy.T_f, {}

    monkeypatch.setattr(PIDSearch, "objective", falling)
    arguments = ["--controller", "paper-filtered", "--trials", "12", "--episodes", "4", "--survive", "2"]
    assert pid_tuning.main([*arguments, "--finalists", "3", "--validation", "5", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "paper-filtered.json").read_text())
    tried = sorted({values[found["parameters"].index("T_f")] for values, *_ in found["history"]})
    assert len(found["history"]) == 12
    assert found["chosen"]["values"]["T_f"] == tried[2]
    validation = list(range(1_000_000, 1_000_005))
    assert asked == [("randomized", [0, 1, 2, 3], [0, 1])] * 12 + [("randomized", validation, validation)] * 3
    assert "FilteredPID(" in capsys.readouterr().out


@pytest.mark.parametrize("wrong", [["--controller", "nobody"], ["--controller", "industrial", "--scenario", "moon"]])
def test_the_command_refuses(wrong, tmp_path, refused):
    assert wrong[-1] in refused(pid_tuning.main, [*wrong, "--out", str(tmp_path)])
    assert not list(tmp_path.iterdir())
