"""Settings follow what a scenario contains, whatever its name is."""

from dataclasses import replace

import pytest

from cz_gym.baselines.lqg.designs import SHIPPED, design_of, ring_of
from cz_gym.baselines.lqg.ring_model import RingModel
from cz_gym.baselines.pid.settings import settings_of
from cz_gym.baselines.registry import make_controller
from cz_gym.baselines.tuned_for import TUNED, shipped
from cz_gym.baselines.tuning.search import value_at
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Sensor
from cz_gym.episodes.scenarios import HARD, PULLER, RANDOMIZED, SCENARIOS, SENSOR_FAULT
from cz_gym.support.units import MINUTE, MM
from tests.observed import PLAIN

NAMES = [scenario.name for scenario in TUNED]


@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS)
def test_named_scenarios_have_their_own_settings_or_those_of_randomized(scenario):
    for name in (*SHIPPED[:-1], "paper-tuned", "industrial"):
        values = shipped(name).get(scenario.name, shipped(name)["randomized"])
        made = design_of(name, scenario) if name in SHIPPED else settings_of(name, scenario)
        assert {path: value_at(made, path) for path in values} == values


@pytest.mark.parametrize("scenario", [RANDOMIZED, HARD, SENSOR_FAULT, PULLER], ids=NAMES)
def test_another_name_changes_nothing(scenario):
    other = replace(scenario, name="mine", drift=replace(scenario.drift, amount=(-1.0, 1.0)))
    for name in ("lqg", "lqg-at-0.02", "paper-tuned", "industrial"):
        made, expected = (make_controller(name, make_config(each, **PLAIN)) for each in (other, scenario))
        assert made == expected


def test_the_model_of_the_camera_follows_the_scenario():
    assert ring_of(RANDOMIZED.sensor) is None
    assert ring_of(PULLER.sensor) == RingModel(5.0, 0.08 * MM, rotation=(8.0 / MINUTE, 15.0 / MINUTE))
    slow = replace(PULLER, name="slow", sensor=replace(PULLER.sensor, latency=2.0, ripple=(0.0, 0.1 * MM)))
    assert design_of("lqg", slow).ring == RingModel(2.0, 0.04 * MM, rotation=(8.0 / MINUTE, 15.0 / MINUTE))
    assert ring_of(Sensor(latency=3.0)) == RingModel(3.0, 0.0, rotation=Sensor().rotation)


def test_a_warning_names_what_no_settings_were_tuned_for():
    scenario = replace(PULLER, name="both", faults=SENSOR_FAULT.faults)
    for name in ("lqg", "paper-tuned"):
        with pytest.warns(UserWarning, match=rf"{name} was not tuned for faults\.flagged, .* of scenario 'both'"):
            made = make_controller(name, make_config(scenario, **PLAIN))
        assert made == make_controller(name, make_config("puller", **PLAIN))
    late = replace(PULLER, name="late", sensor=replace(PULLER.sensor, latency=20.0))
    with pytest.warns(UserWarning, match=r"tuned for sensor\.latency of scenario 'late': it has .* for 'puller'"):
        assert design_of("lqg", late).ring.latency == 20.0
