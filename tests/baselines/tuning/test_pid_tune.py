"""The tuning command: a known optimum, a search that goes on where it stopped, and no test seed ever."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from cz_gym.baselines.pid.filtered_pid import FilteredPID
from cz_gym.baselines.pid.tuned import settings
from cz_gym.baselines.tuning import pid as tune
from cz_gym.baselines.tuning.pid import Score, build, first_values, read_history, search
from cz_gym.baselines.tuning.pid_spaces import SPACES, Knob, Space, reading, space_of, turned, unruled
from cz_gym.config import make_config

BOWL = Space("bowl", FilteredPID(), (Knob("T_f", 1.0, 100.0), Knob("K_ff", -1.0, 1.0, log=False)), np.inf, unruled)


def bowl(space, values, episodes):
    """Least at T_f = 10, K_ff = 0.5, where it is 0."""
    T_f, K_ff = values
    cost = np.log10(T_f / 10.0) ** 2 + (K_ff - 0.5) ** 2
    return Score(float(cost), 1.0, 0.0, 0.0, 0.0)


@pytest.fixture
def cheap(monkeypatch):
    pytest.importorskip("optuna")
    monkeypatch.setattr(tune, "score", bowl)


def test_search_comes_near_a_known_optimum(cheap, tmp_path):
    done = search(BOWL, None, 80, tmp_path / "history.csv")
    best = min(done, key=lambda trial: trial.score.objective)
    assert done[0].values == first_values(BOWL)
    assert best.score.objective < 0.02
    assert best.score.objective < 0.2 * done[0].score.objective
    for T_f, K_ff in (trial.values for trial in done):
        assert 1.0 <= T_f <= 100.0
        assert -1.0 <= K_ff <= 1.0


def test_search_goes_on_where_it_stopped(cheap, tmp_path):
    path = tmp_path / "history.csv"
    first = search(BOWL, None, 6, path)
    assert read_history(path, BOWL) == [t._replace(score=Score(*(float(f"{x:.6g}") for x in t.score))) for t in first]
    more = search(BOWL, None, 9, path)
    assert [t.values for t in more[:6]] == [t.values for t in first]
    assert len(read_history(path, BOWL)) == 9
    assert len(search(BOWL, None, 5, path)) == 9
    assert not [p for p in tmp_path.iterdir() if p != path]


def test_history_of_another_search_is_refused(cheap, tmp_path):
    path = tmp_path / "history.csv"
    search(BOWL, None, 2, path)
    with pytest.raises(ValueError, match="another search than industrial's"):
        read_history(path, space_of("industrial", "randomized"))


@pytest.mark.parametrize("scenario", ["randomized", "puller"])
@pytest.mark.parametrize("name", [space.name for space in SPACES])
def test_every_knob_turns_what_it_names(name, scenario):
    space = space_of(name, scenario)
    values = [0.5 * (knob.low + knob.high) for knob in space.knobs]
    policy = build(space, values)
    assert [reading(policy, knob.path) for knob in space.knobs] == values
    assert len({knob.path for knob in space.knobs}) == len(space.knobs)
    for knob in space.knobs:
        assert knob.low < knob.high
    with pytest.raises(AttributeError):
        turned(policy, "no.such", 1.0)


def test_score_prices_what_it_counts():
    config = make_config("randomized", horizon=300.0)
    space = space_of("paper-tuned", "randomized")._replace(rule=unruled)
    free = tune.score(space, first_values(space), tune.Episodes(config, range(3), range(2)))
    assert free.objective == pytest.approx(free.rmse_mm + tune.STEP_PRICE * free.pull_step_rms_mm_per_min, rel=1e-9)
    strict = space._replace(allowed_step=0.0, rule=lambda policy: 0.5)
    priced = tune.score(strict, first_values(space), tune.Episodes(config, range(3), range(2)))
    step = free.pull_step_rms_mm_per_min
    assert priced.objective - free.objective == pytest.approx(
        tune.EXCESS_PRICE * step + 0.5 * tune.RULE_PRICE, rel=1e-9
    )


def test_command_chooses_on_validation_and_never_sees_test(monkeypatch, tmp_path, capsys):
    pytest.importorskip("optuna")
    asked = []

    def told(space, values, episodes):
        asked.append((episodes.config.scenario.name, list(episodes.seeds), list(episodes.survive)))
        cost = values[0] if episodes.seeds[0] < 1_000_000 else -values[0]
        return Score(cost, 0.1, 0.0, 0.0, 0.0)

    monkeypatch.setattr(tune, "score", told)
    arguments = ["--controller", "paper-filtered", "--trials", "12", "--episodes", "4", "--survive", "2"]
    assert tune.main([*arguments, "--finalists", "3", "--validation", "5", "--out", str(tmp_path)]) == 0
    folder = tmp_path / "paper-filtered" / "randomized"
    chosen = json.loads((folder / "chosen.json").read_text())
    with (folder / "history.csv").open() as file:
        tried = sorted(float(row["T_f"]) for row in csv.DictReader(file))
    assert len(tried) == chosen["trials"] == 12
    assert chosen["chosen"]["T_f"] == sorted(set(tried))[2]
    assert len(chosen["finalists_on_validation"]) == 3
    assert asked[:12] == [("randomized", [0, 1, 2, 3], [0, 1])] * 12
    assert asked[12:] == [("randomized", list(range(1_000_000, 1_000_005)), list(range(1_000_000, 1_000_005)))] * 3
    assert "FilteredPID(" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (["--controller", "nobody"], "nobody"),
        (["--controller", "industrial", "--trials", "0"], "--trials"),
        (["--controller", "industrial", "--validation", "501"], "--validation"),
        (["--controller", "industrial", "--scenario", "moon"], "moon"),
    ],
)
def test_command_refuses(wrong, named, tmp_path, capsys):
    assert tune.main([*wrong, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", [space.name for space in SPACES])
def test_a_search_elsewhere_begins_with_the_settings_of_randomized(name):
    """But for a jump without end, which the knob holds inside its range."""
    space = space_of(name, "sensor-fault")
    first, frozen = build(space, first_values(space)), settings(name, "randomized")
    highest = max((knob.high for knob in space.knobs if knob.path == "jump"), default=None)
    assert first == (frozen if highest is None else replace(frozen, jump=highest))
