"""Settings follow what a scenario contains, whatever its name is."""

from dataclasses import replace

import pytest

from cz_gym.baselines.lqg_filter import RingModel
from cz_gym.baselines.tuned import TUNED, by_scenario, value_at
from cz_gym.baselines.tuned_lqg import BEST_RETURN, LQGS, ring_of
from cz_gym.baselines.tuned_pid import PIDS
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Sensor
from cz_gym.episodes.scenarios import PULLER, RANDOMIZED, SCENARIOS, SENSOR_FAULT
from cz_gym.support.units import MINUTE, MM
from cz_gym.tools.registry import make_controller
from tests.observed import PLAIN


@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS)
def test_named_scenarios_have_their_own_settings_or_those_of_randomized(scenario):
    for tuned in (*LQGS, *PIDS):
        values = by_scenario(tuned.name).get(scenario.name, by_scenario(tuned.name)["randomized"])
        settings = tuned.design(scenario) if tuned in LQGS else tuned.settings(scenario)
        assert {path: value_at(settings, path) for path in values} == values


@pytest.mark.parametrize("scenario", TUNED, ids=[each.name for each in TUNED])
def test_another_name_changes_nothing(scenario):
    other = replace(scenario, name="mine", drift=replace(scenario.drift, amount=(-1.0, 1.0)))
    for name in ("lqg", "lqg-at-0.02", "paper-tuned"):
        ours, theirs = (make_controller(name, make_config(each, **PLAIN)) for each in (other, scenario))
        assert ours == theirs


def test_the_model_of_the_camera_follows_the_scenario():
    rotation = 8.0 / MINUTE, 15.0 / MINUTE
    slow = replace(PULLER, name="slow", sensor=replace(PULLER.sensor, latency=2.0, ripple=(0.0, 0.1 * MM)))
    assert BEST_RETURN.design(slow).ring == RingModel(2.0, 0.04 * MM, rotation=rotation)
    for sensor, ring in (
        (RANDOMIZED.sensor, None),
        (PULLER.sensor, RingModel(5.0, 0.08 * MM, rotation=rotation)),
        (Sensor(latency=3.0), RingModel(3.0, 0.0, rotation=Sensor().rotation)),
    ):
        assert ring_of(sensor) == ring


def test_a_warning_names_what_no_settings_were_tuned_for():
    scenario = replace(PULLER, name="both", faults=SENSOR_FAULT.faults)
    for name in ("lqg", "paper-tuned"):
        with pytest.warns(UserWarning, match=rf"{name} was not tuned for faults\.flagged, .* of scenario 'both'"):
            controller = make_controller(name, make_config(scenario, **PLAIN))
        assert controller == make_controller(name, make_config("puller", **PLAIN))
    late = replace(PULLER, name="late", sensor=replace(PULLER.sensor, latency=20.0))
    with pytest.warns(UserWarning, match=r"tuned for sensor\.latency of scenario 'late': it has .* for 'puller'"):
        assert BEST_RETURN.design(late).ring.latency == 20.0
