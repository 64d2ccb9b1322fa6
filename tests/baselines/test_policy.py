"""Common behaviour of the controllers on "measured" observations: batches, memories, shapes, control intervals."""

import math

import numpy as np
import pytest

from cz_gym import CzVectorEnv, Parameters
from cz_gym.baselines import CompensatedPID, Compensator, SeriesPID
from cz_gym.baselines.lqg_filter import NoiseModel, RingModel
from cz_gym.baselines.pid import FilteredPID, TemperatureLoop
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.errors import CzError
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
