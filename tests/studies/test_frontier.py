"""The LQG's frontier: interpolation between what was measured, and how its settings are chosen."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from cz_gym.baselines.lqg import settings as lqg_settings
from cz_gym.baselines.lqg.settings import ACTIVITIES, family_name, frontier_settings
from cz_gym.baselines.registry import find_controller
from cz_gym.baselines.tuning import lqg_frontier
from cz_gym.baselines.tuning.lqg_goal import Figures
from cz_gym.config import make_config
from cz_gym.evaluation.statistics import Resamples
from studies.frontier import __main__ as frontier
from studies.frontier.__main__ import at_equal_activity, frontier_of

RESULTS = Path(__file__).parents[2] / "results" / "tuning"
PAIRS = st.lists(st.tuples(st.floats(1e-4, 1.0), st.floats(1e-3, 10.0)), min_size=2, max_size=12)


def entry(activity, rmse):
    return {"pull_step_rms_mm_per_min": {"mean": activity}, "rmse_mm": {"mean": rmse}}


def test_a_power_law_is_met_exactly():
    curve = frontier.frontier([(a, 0.01 * a**-0.5) for a in (0.003, 0.006, 0.02, 0.03)])
    for activity in (0.003, 0.004, 0.011, 0.03):
        assert curve.at(activity) == pytest.approx(0.01 * activity**-0.5, rel=1e-12)


@given(PAIRS)
@example([(1e-4, 1.0), (0.00010000000000000002, 0.5), (1.0, 0.1)])
def test_it_goes_through_its_points_and_never_rises(pairs):
    try:
        curve = frontier.frontier(pairs)
    except ValueError:
        return
    for activity, rmse in zip(*curve, strict=True):
        assert curve.at(activity) == pytest.approx(rmse, rel=1e-9)
    between = np.geomspace(curve.activity[0], curve.activity[-1], 50)[1:-1]
    values = [curve.at(activity) for activity in between]
    assert np.all(np.diff(values) <= 1e-12)
    assert all(rmse >= curve.at(activity) * (1.0 - 1e-9) for activity, rmse in pairs if activity >= curve.activity[0])


def test_a_setting_beaten_in_both_is_left_out_and_the_liveliest_need_not_move():
    curve = frontier.frontier([(0.01, 0.07), (0.02, 0.05), (0.03, 0.06)])
    np.testing.assert_array_equal(curve.activity, [0.01, 0.02])
    assert curve.at(5.0) == 0.05


@pytest.mark.parametrize("activity", [0.009, 0.0, -1.0, float("nan")])
def test_below_the_quietest_nothing_is_made_up(activity):
    with pytest.raises(ValueError, match=r"below the frontier's 0\.01"):
        frontier.frontier([(0.01, 0.07), (0.02, 0.05)]).at(activity)


@pytest.mark.parametrize("pairs", [[(0.01, 0.07)], [(0.01, 0.05), (0.02, 0.06)], [(0.0, 0.1), (0.1, 0.1)]])
def test_a_frontier_needs_two_settings_and_positive_numbers(pairs):
    with pytest.raises(ValueError, match=r"frontier needs two|must be positive"):
        frontier.frontier(pairs)


def test_a_benchmark_is_compared_at_equal_activity(tmp_path, capsys):
    scenario = {name: entry(a, 0.01 * a**-0.5) for name, a in ((family_name(0.005), 0.005), ("lqg", 0.02))}
    scenario |= {"ppo": entry(0.01, 0.2), "industrial": entry(0.001, 0.4)}
    assert at_equal_activity(scenario, "ppo") == pytest.approx(2.0)
    assert len(frontier_of(scenario).activity) == 2
    file = tmp_path / "benchmark.json"
    file.write_text(json.dumps({"results": {"randomized": scenario, "nominal": {"ppo": entry(0.01, 0.2)}}}))
    assert frontier.main([str(file)]) == 0
    told = capsys.readouterr().out
    assert "ppo 0.2000 mm at 0.0100 mm/min; lqg there: 0.1000 mm, ratio 2.00" in told
    assert "industrial 0.4000 mm at 0.0010 mm/min; lqg there: quieter than any" in told
    assert "nominal: a frontier needs two settings" in told


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"results": {"randomized": {"lqg": 1}}}'])
def test_another_file_is_refused_in_a_line(content, tmp_path, capsys):
    (tmp_path / "x.json").write_text(content)
    assert frontier.main([str(tmp_path / "x.json")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert frontier.main([str(tmp_path / "none.json")]) == 2


# How the settings are chosen


def test_the_weight_for_an_activity_is_read_off_between(monkeypatch, tmp_path):
    def made_up(settings, scenario, seeds):
        """Pull steps fall with the square root of their weight; the quiet base holds the radius better."""
        step = 0.01 * settings.weights.pull_step**-0.5
        return Figures(0.05 + 0.01 * (settings.noise == lqg_settings.REWARD.noise), step, 0.0, 0.0, 0.0, 2160)

    monkeypatch.setattr(lqg_frontier, "measure", made_up)
    output = tmp_path / "frontier.json"
    assert lqg_frontier.main(["--output", str(output)]) == 0
    found = json.loads(output.read_text())
    assert [chosen["activity"] for chosen in found["chosen"]] == list(ACTIVITIES)
    assert {chosen["base"] for chosen in found["chosen"]} == {"lqg-quiet"}
    for chosen in found["chosen"]:
        assert chosen["validation"]["pull_step"] == pytest.approx(chosen["activity"], rel=1e-2)


@pytest.mark.parametrize("option", [["--episodes", "0"], ["--validation", "501"]])
def test_a_budget_out_of_range_is_refused_in_a_line(option, tmp_path, capsys):
    assert lqg_frontier.main([*option, "--output", str(tmp_path / "x.json")]) == 2
    assert "must be" in capsys.readouterr().err


@pytest.mark.parametrize("scenario", sorted(lqg_settings.FRONTIER))
def test_what_ships_is_what_the_command_chose(scenario):
    chosen = json.loads((RESULTS / f"lqg-frontier-{scenario}.json").read_text())["chosen"]
    for activity, one in zip(ACTIVITIES, chosen, strict=True):
        assert one["activity"] == activity
        assert frontier_settings(activity, scenario).hash == one["hash"]
        policy = find_controller(family_name(activity)).make(make_config(scenario))
        assert policy.settings.hash == one["hash"]
        assert not one["validation"]["failure_rate"]
    steps = [one["validation"]["pull_step"] for one in chosen]
    assert steps == sorted(steps)


def test_an_lqg_as_lively_as_ppo_stands_in_the_default_table():
    """And no other of the frontier: they run when named."""
    shown = {name: find_controller(name).default for name in map(family_name, ACTIVITIES)}
    assert [name for name, default in shown.items() if default] == ["lqg-at-0.02"]


def drawn(activity, rmse, seeds=1, spread=0.1):
    random = np.random.default_rng(int(1e6 * activity))
    return np.array([activity, rmse]) * np.exp(spread * random.normal(size=(seeds, 60, 2)))


def test_a_ratios_interval_holds_it_and_shrinks_with_the_spread():
    family = {
        name: drawn(a, 0.01 * a**-0.5) for name, a in zip(frontier.FAMILY, np.geomspace(0.003, 0.03, 8), strict=True)
    }
    widths = []
    for spread in (0.2, 0.02):
        scenario = {**family, "agent": drawn(0.01, 0.12, seeds=3, spread=spread)}
        found = frontier.intervals(scenario, Resamples.draw(60, 200))
        means = {name: values.mean(axis=(0, 1)) for name, values in scenario.items()}
        curve = frontier.frontier([tuple(means[name]) for name in frontier.FAMILY])
        low, high = found["agent"]
        assert low < means["agent"][1] / curve.at(means["agent"][0]) < high
        assert found["lqg-at-0.005"] == pytest.approx((1.0, 1.0))
        widths.append(high - low)
    assert widths[1] < widths[0]


def test_an_agent_quieter_than_the_family_has_no_interval():
    family = {
        name: drawn(a, 0.01 * a**-0.5) for name, a in zip(frontier.FAMILY, np.geomspace(0.003, 0.03, 8), strict=True)
    }
    assert "agent" not in frontier.intervals({**family, "agent": drawn(0.001, 0.5)}, Resamples.draw(60, 50))


def test_episodes_beside_a_benchmark_give_intervals_unless_they_are_of_another_run(tmp_path, capsys):
    values = {"lqg": (0.02, 0.05), "lqg-quiet": (0.01, 0.07), "agent": (0.015, 0.06)}
    lines = ["scenario,controller,training_seed,seed,pull_step_rms_mm_per_min,rmse_mm"]
    lines += [f"randomized,{name},,{seed},{a},{e}" for name, (a, e) in values.items() for seed in (1, 2)]
    (tmp_path / "episodes.csv").write_text("\n".join(lines))
    path = tmp_path / "benchmark.json"
    path.write_text(json.dumps({"results": {"randomized": {name: entry(*pair) for name, pair in values.items()}}}))
    assert frontier.main([str(path)]) == 0
    assert "ratio 1.044 [1.044, 1.044]" in capsys.readouterr().out
    (tmp_path / "episodes.csv").write_text("\n".join([*lines[:-1], lines[-1].replace("0.06", "nan")]))
    assert frontier.main([str(path)]) == 2
    assert "no episodes of a benchmark, or damaged" in capsys.readouterr().err
    (tmp_path / "episodes.csv").write_text("\n".join(lines))
    path.write_text(path.read_text().replace("0.06", "0.0601"))
    assert frontier.main([str(path)]) == 2
    assert "episodes.csv is of another run: agent on randomized" in capsys.readouterr().err
