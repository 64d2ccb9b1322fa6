"""The tuning command on a made-up plant whose optimum is known, and what ships against its history."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from cz_gym.baselines.lqg import settings as lqg_settings
from cz_gym.baselines.lqg.controller import LQGSettings
from cz_gym.baselines.tuning import lqg as lqg_tune
from cz_gym.baselines.tuning import lqg_goal
from cz_gym.baselines.tuning.lqg import History
from cz_gym.baselines.tuning.lqg_goal import KNOBS, Figures, Goal
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS

GOAL = Goal(0.07, 0.02, True, LQGSettings())
RESULTS = Path(__file__).parents[3] / "results" / "tuning"


def made_up(settings, scenario="randomized", seeds=()):
    """Best return where every knob is twice its default; the radius error is within its limit below the default."""
    away = lqg_goal.knobs(settings) - lqg_goal.knobs(LQGSettings()) - np.log(2.0)
    rmse = 0.07 * np.exp(0.1 * (lqg_goal.knobs(settings)[0] - lqg_goal.knobs(LQGSettings())[0]))
    return Figures(float(rmse), 0.01, 0.02, 2000.0 - 20.0 * float(away @ away), 0.0, 2160)


def test_knobs_and_settings_are_inverse():
    values = lqg_goal.knobs(LQGSettings()) + np.linspace(-1.0, 1.0, len(KNOBS))
    found = lqg_goal.knobs(lqg_goal.with_knobs(LQGSettings(), values))
    np.testing.assert_allclose(found, values, atol=1e-3)


def test_the_search_finds_the_optimum_inside_the_limits(monkeypatch):
    monkeypatch.setattr(lqg_tune, "measure", made_up)
    history = lqg_tune.search(GOAL, 250, 1, 0)
    best = lqg_goal.settings_from(history.best(1)[0]["settings"])
    away = lqg_goal.knobs(best) - lqg_goal.knobs(LQGSettings())
    assert away[0] == pytest.approx(0.0, abs=0.02)
    np.testing.assert_allclose(away[1:], np.log(2.0), atol=0.15)


def test_a_candidate_that_loses_crystals_is_never_best(monkeypatch):
    def fragile(settings, scenario="randomized", seeds=()):
        found = made_up(settings)
        lost = scenario != "randomized" and lqg_goal.knobs(settings)[1] > lqg_goal.knobs(LQGSettings())[1]
        return replace(found, failure_rate=float(lost))

    monkeypatch.setattr(lqg_tune, "measure", fragile)
    history = lqg_tune.search(GOAL, 60, 1, 5)
    assert any(sum(entry["lost"]) for entry in history.entries)
    best = history.best(1)[0]
    assert best["lost"]
    assert sum(best["lost"]) == 0.0


def test_validation_seeds_choose(monkeypatch):
    candidates = [LQGSettings(lam=lam) for lam in (0.1, 0.2, 0.3)]
    history = History([{"score": float(i), "settings": asdict(c)} for i, c in enumerate(candidates)])
    met = []

    def by_lam(settings, scenario, seeds):
        met.extend(seeds if scenario == "randomized" else [])
        return Figures(0.06, 0.01, 0.02, 1000.0 * settings.lam, 0.0, 2160)

    monkeypatch.setattr(lqg_tune, "measure", by_lam)
    chosen = lqg_tune.choose(GOAL, history, 7, 5)
    assert chosen["settings"]["lam"] == 0.3
    assert chosen["hash"] == candidates[2].hash
    assert sum(chosen["lost"].values()) == 0.0
    assert set(met) == set(VALIDATION_SEEDS[:7])


def test_the_calmer_version_wins_where_the_other_loses_crystals(monkeypatch):
    def restless(settings, scenario, seeds):
        lost = scenario == "puller" and settings.weights.heater_step < 2.0 * LQGSettings().weights.heater_step
        return Figures(0.06, 0.01, 0.02, 1900.0 - settings.weights.heater_step, float(lost), 2160)

    monkeypatch.setattr(lqg_tune, "measure", restless)
    chosen = lqg_tune.choose(GOAL, History([{"score": 0.0, "settings": asdict(LQGSettings())}]), 1, 1)
    assert chosen["settings"]["weights"]["heater_step"] == pytest.approx(3.0 * LQGSettings().weights.heater_step)


def test_a_kept_history_can_be_chosen_from_again(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(lqg_tune, "measure", made_up)
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    assert lqg_tune.main(["--budget", "20", "--output", str(first)]) == 0
    assert lqg_tune.main(["--history", str(first), "--output", str(second)]) == 0
    assert json.loads(first.read_text()) == json.loads(second.read_text())
    (tmp_path / "other.json").write_text("{}")
    assert lqg_tune.main(["--history", str(tmp_path / "other.json"), "--output", str(second)]) == 2
    assert "no tuning history" in capsys.readouterr().err


def test_missing_a_limit_and_losing_a_crystal_cost_more_than_any_return():
    inside, outside = Figures(0.069, 0.01, 0.0, 1800.0, 0.0, 2160), Figures(0.08, 0.01, 0.0, 2000.0, 0.0, 2160)
    lost = replace(inside, mean_return=2000.0, failure_rate=0.01)
    assert GOAL.score(inside) < GOAL.score(outside)
    assert GOAL.score(inside) < GOAL.score(lost)


def test_the_command_writes_its_history(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(lqg_tune, "measure", made_up)
    output = tmp_path / "new" / "lqg.json"
    assert lqg_tune.main(["--budget", "20", "--survive", "0", "--output", str(output)]) == 0
    written = json.loads(output.read_text())
    assert len(written["history"]) >= 20
    assert lqg_goal.settings_from(written["chosen"]["settings"]).hash == written["chosen"]["hash"]
    assert [file.name for file in output.parent.iterdir()] == ["lqg.json"]


@pytest.mark.parametrize(
    "arguments", [["--budget", "0"], ["--survive", "-1"], ["--validation", "501"], ["--controller", "pid"]]
)
def test_bad_arguments_are_refused_in_a_line(arguments, capsys):
    try:
        code = lqg_tune.main(arguments)
    except SystemExit as left:
        code = left.code
    assert code == 2
    error = capsys.readouterr().err
    assert arguments[0] in error
    assert error.count("\n") == 1


def test_a_place_that_cannot_be_written_is_refused_before_the_search(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(lqg_tune, "measure", None)
    (tmp_path / "file").write_text("")
    assert lqg_tune.main(["--output", str(tmp_path / "file" / "lqg.json")]) == 2
    assert "is not a folder" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "scenario"), sorted(lqg_settings.SHIPPED))
def test_what_ships_is_what_the_command_chose(name, scenario):
    chosen = json.loads((RESULTS / lqg_tune.file_name(name, scenario)).read_text())["chosen"]
    shipped = lqg_settings.SHIPPED[name, scenario]
    assert shipped.hash == chosen["hash"]
    assert shipped == lqg_goal.settings_from(chosen["settings"])
    assert not chosen["validation"]["failure_rate"]


@pytest.mark.parametrize("scenario", ["randomized", "hard", "nominal", "paper-ramp", "reference-a", "only-sensor"])
def test_everywhere_else_the_settings_of_randomized_serve(scenario):
    assert lqg_settings.lqg(make_config(scenario)).settings.hash == "769324959cc3ed6e"
    assert lqg_settings.lqg_quiet(make_config(scenario)).settings.hash == "f4a3e50fb1dcf8af"


def test_another_scenario_is_tuned_on_its_own_training_seeds(monkeypatch):
    met = {}

    def watched(settings, scenario, seeds):
        met.setdefault(scenario, set()).update(seeds)
        return made_up(settings)

    monkeypatch.setattr(lqg_tune, "measure", watched)
    goal = replace(lqg_goal.GOALS["lqg", "puller"], start=LQGSettings())
    lqg_tune.search(goal, 15, 4, 3)
    assert met == {"puller": {*range(4), *range(100_000, 100_003)}}
    lqg_tune.choose(goal, History([{"score": 0.0, "settings": asdict(LQGSettings())}]), 5, 2)
    assert set(met) == {"puller"}
    assert met["puller"] <= set(TRAINING_SEEDS) | set(VALIDATION_SEEDS)


def test_a_kept_history_is_chosen_from_with_the_camera_that_is_known_now(monkeypatch):
    monkeypatch.setattr(lqg_tune, "measure", made_up)
    goal = lqg_goal.GOALS["lqg", "puller"]
    other = replace(goal.start, ring=replace(lqg_settings.PULLER_RING, lowest=0.004))
    chosen = lqg_tune.choose(goal, History([{"score": 0.0, "settings": asdict(other)}]), 1, 1, count=1)
    assert lqg_goal.settings_from(chosen["settings"]).ring == lqg_settings.PULLER_RING


def test_settings_with_a_ring_are_read_back_as_written():
    settings = lqg_goal.GOALS["lqg", "puller"].start
    assert settings.ring == lqg_settings.PULLER_RING
    assert lqg_goal.settings_from(json.loads(json.dumps(asdict(settings)))) == settings
