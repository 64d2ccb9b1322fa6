"""Common behaviour of the controllers on "measured" observations: batches, memories, shapes, control intervals."""

import math
from dataclasses import replace
from functools import reduce
from operator import or_

import numpy as np
import pytest

from cz_gym import SCENARIOS, CzVectorEnv, Parameters
from cz_gym.baselines import CompensatedPID, Compensator, SeriesPID
from cz_gym.baselines.lqg_filter import NoiseModel, RingModel
from cz_gym.baselines.pid import FilteredPID, TemperatureLoop
from cz_gym.config import make_config
from cz_gym.episodes.scenario import DriveReadings
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.errors import CzError
from cz_gym.support.units import KILO, MM_PER_MIN
from cz_gym.tools.registry import make_controller
from tests.observed import PLAIN, actions_of, measured

TUNED = ("pid-conventional", "paper-filtered", "paper-tuned", "lqg")


@pytest.mark.parametrize("name", TUNED)
def test_every_control_interval_holds_the_radius_alike(name):
    configs = [make_config("randomized", control_interval=dt, horizon=5400.0, **PLAIN) for dt in (5.0, 2.0, 10.0)]
    found = [metrics(rollout(make_controller(name, config), config, range(8))) for config in configs]
    assert not np.any([m.failure_rate for m in found])
    usual, *others = (m.rmse_mm.mean() for m in found)
    assert others == pytest.approx([usual, usual], rel=0.25)


@pytest.mark.parametrize("name", TUNED)
def test_a_controller_without_disturbances_stays_where_it_is(name):
    config = make_config("nominal", control_interval=2.0, horizon=3600.0, **PLAIN)
    assert metrics(rollout(make_controller(name, config), config, [0])).max_error_mm[0] < 1e-3


# What a controller was made for

OTHER = {"parameters": Parameters(r_0=0.1), "control_interval": 2.0}


@pytest.mark.parametrize("option", OTHER)
def test_a_controller_can_be_made_for_another_environment_or_for_any(option):
    env = CzVectorEnv(1, scenario="nominal", **{**PLAIN, option: OTHER[option]})
    observation, _ = env.reset(seed=0)
    own = CompensatedPID().for_config(env.config)
    assert own.settings[option] == OTHER[option]
    anywhere = CompensatedPID(any_environment=True)
    assert anywhere.made_for is None
    for accepted in (own, anywhere):
        env.step(accepted.predict(observation)[0])


# Readings that are no numbers, and settings that are none


@pytest.mark.parametrize("name", ["paper", "paper-tuned", "lqg"])
@pytest.mark.parametrize("garbage", [math.nan, 0.0, 9.0])
def test_a_ring_that_is_not_valid_is_not_read(name, garbage):
    """It counts as the last valid ring, also while the reference moves."""
    rows = np.stack([measured(ring_error=3e-5 - r_ref, r_ref=r_ref) for r_ref in np.linspace(0.0, 1e-4, 6)])
    held = rows.copy()
    held[2:4, :, 1] = rows[2:4, :, 1] = 0.0
    rows[2:4, :, 0] = garbage
    policy = make_controller(name, make_config(**PLAIN))
    np.testing.assert_allclose(actions_of(policy, rows), actions_of(policy, held), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        (SeriesPID, {"K_p": -0.01}),
        (SeriesPID, {"T_i": 0.0}),
        (SeriesPID, {"N": math.nan}),
        (Compensator, {"fast": -1e-3}),
        (CompensatedPID, {"control_interval": 0.0}),
        (FilteredPID, {"T_f": -1.0}),
        (TemperatureLoop, {"T_i": 0.0}),
        (NoiseModel, {"slow_tau": 0.0}),
        (RingModel, {"latency": -5.0}),
    ],
)
def test_impossible_settings_are_refused_at_once(kind, wrong):
    (name,) = wrong
    with pytest.raises(CzError, match=f"{name} must be"):
        kind(**wrong)


# Readings of the drives that err

ERRING = {
    "scales": {"pull_scale": (1.03, 1.03), "heater_scale": (0.97, 0.97)},
    "offsets": {"pull_offset": (0.048 * MM_PER_MIN,) * 2, "heater_offset": (-0.4 * KILO,) * 2},
    "coarse and late": {"pull_resolution": 0.02 * MM_PER_MIN, "heater_resolution": 0.2 * KILO, "delay": 10.0},
}
ERRING["all"] = reduce(or_, ERRING.values())


@pytest.mark.parametrize("errors", ERRING)
@pytest.mark.parametrize("name", ["lqg", "lqg-at-0.02", "paper-tuned"])
def test_erring_readings_of_the_drives_lose_no_crystal(name, errors):
    """A power that read half a percent wrong lost every crystal of the LQGs when moves began at readings."""
    exact, erring = (
        make_config(replace(SCENARIOS["puller"], readings=DriveReadings(**values)), horizon=3600.0, **PLAIN)
        for values in ({}, ERRING[errors])
    )
    policy = make_controller(name, exact)
    usual, found = (metrics(rollout(policy, config, range(6))) for config in (exact, erring))
    assert not found.failure_rate.any()
    assert found.rmse_observable_mm.mean() <= 1.2 * usual.rmse_observable_mm.mean()


def test_a_lasting_difference_between_setpoint_and_reading_is_shown_and_not_integrated():
    policy, state = make_controller("lqg", make_config("nominal", **PLAIN)), None
    for k in range(60):
        _, state = policy.predict(measured(Q_H=0.0 if k == 0 else state.asked[:, 1] + 1.0 * KILO), state)
    assert state.difference[0] == pytest.approx([0.0, 1.0 * KILO], rel=0.02, abs=1e-9)
    np.testing.assert_allclose(state.asked[0], 0.0, atol=1e-3)


def test_a_drive_that_does_not_follow_is_where_its_reading_says():
    policy, state = make_controller("lqg", make_config("nominal", **PLAIN)), None
    for k in range(120):
        _, state = policy.predict(measured(Q_H=0.0 if k == 0 else -8.0 * KILO), state)
    assert state.readings.Q_H[0] == pytest.approx(-8.0 * KILO)
    applied, _ = policy.applied(state.readings, state.asked, state.difference)
    assert applied[0, 1] < -8.0 * KILO + 1.1 * policy.tolerance[1]
