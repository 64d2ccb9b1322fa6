"""The LQG's bounds: what they are told is what the environment brings, and is worth something."""

from dataclasses import replace

import numpy as np
import pytest

from cz_gym import CzVectorEnv, make_puller
from cz_gym.baselines.bounds import lqg as lqg_bounds
from cz_gym.baselines.lqg.controller import LQG, LQGSettings
from cz_gym.baselines.lqg.model import plant_model
from cz_gym.baselines.registry import find_controller
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.plant import hidden_load
from tests.observed import observations

PULLER = make_puller(lam=0.5)


def test_the_bounds_know_the_pullers_the_environment_draws():
    config = make_config("randomized", horizon=600.0)
    env = CzVectorEnv(3, horizon=600.0)
    env.reset(seed=[5, 9, 2_000_000])
    drawn = env._batch.memory.slots["puller"]
    for slot, puller in enumerate(lqg_bounds.pullers_of(config, (5, 9, 2_000_000))):
        np.testing.assert_allclose([drawn[slot][name] for name in puller._fields], puller, rtol=1e-12)


def test_the_bounds_know_how_rough_the_environment_s_melts_are():
    config = make_config("randomized", horizon=600.0)
    env = CzVectorEnv(3, horizon=600.0)
    env.reset(seed=[5, 9, 2_000_000])
    drawn = env._batch.memory.slots["episode"]
    told = lqg_bounds.roughness_of(config, (5, 9, 2_000_000))
    np.testing.assert_array_equal(told, np.stack([drawn["sd_fast"], drawn["sd_slow"]], axis=1))
    assert len(np.unique(told)) == 6


def test_each_filter_has_the_noise_of_its_own_melt():
    config = make_config("only-interface", horizon=900.0)
    told = lqg_bounds.ToldLQG(LQGSettings(lam=1.0), roughness=True).for_episodes(config, [0, 1, 2]).gains.eye.model.Q
    for slot, (fast, slow) in enumerate(lqg_bounds.roughness_of(config, [0, 1, 2])):
        noise = replace(LQGSettings().noise, fast_sd=fast, slow_sd=slow)
        puller = lqg_bounds.pullers_of(config, [slot])[0]
        np.testing.assert_allclose(told[slot], plant_model(puller, noise, config.control_interval).Q, rtol=1e-12)


@pytest.mark.parametrize("name", ["lqg-quiet", "lqg-at-0.02"])
def test_knowing_the_roughness_buys_something(name):
    config = make_config("randomized")
    plain, told = (
        metrics(rollout(find_controller(each).make(config), config, range(30))) for each in (name, f"{name}-told")
    )
    assert told.rmse_mm.mean() < plain.rmse_mm.mean()
    assert told.pull_step_rms_mm_per_min.mean() < plain.pull_step_rms_mm_per_min.mean()


def test_a_told_nominal_puller_is_the_lqg():
    settings = LQGSettings(lam=1.0)
    config = make_config("only-interface", horizon=900.0)
    told = rollout(lqg_bounds.ToldLQG(settings), config, [0, 1, 2])
    plain = rollout(LQG(settings), config, [0, 1, 2])
    np.testing.assert_allclose(told.signals.v_p, plain.signals.v_p, rtol=1e-5)


def test_a_bound_nobody_told_is_the_controller_it_bounds():
    for observation in observations(steps=3):
        expected = LQG().predict(observation)[0]
        np.testing.assert_array_equal(lqg_bounds.ToldLQG().predict(observation)[0], expected)


def test_a_bound_told_other_slots_refuses():
    told = lqg_bounds.ToldLQG().for_episodes(make_config("randomized"), [1, 2])
    with pytest.raises(ValueError, match="told 2 pullers, got 3 slots"):
        told.predict(next(observations()))


def test_the_drift_is_read_off_its_load():
    drift = np.linspace(-7.5, 7.5, 7)
    np.testing.assert_allclose(lqg_bounds._drift(hidden_load(drift, PULLER), PULLER), drift, atol=1e-6)


def test_full_information_beats_the_filter_on_the_same_episodes():
    measured_config = make_config("randomized", horizon=3600.0)
    state_config = replace(measured_config, observation="state")
    seeds = range(12)
    full = metrics(rollout(lqg_bounds.FullInformation(), state_config, seeds))
    filtered = metrics(rollout(LQG(), measured_config, seeds))
    assert full.rmse_mm.mean() < filtered.rmse_mm.mean()
