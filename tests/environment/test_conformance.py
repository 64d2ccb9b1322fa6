"""Cz-v0 under the checkers of Gymnasium and stable-baselines3, and its batch under ours."""

import warnings

import gymnasium as gym
import pytest
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_checker import check_env as check_with_sb3

from cz_gym import SCENARIOS, CzEnv, CzVectorEnv
from cz_gym.spaces import OBSERVATIONS
from tests.vector_checker import check_vector_env

SHORT = {"control_interval": 60.0, "horizon": 1200.0}


def conforming(settings, **options):
    """What a check of these settings counts; it raises where batch and scalars differ."""
    return check_vector_env(
        lambda n, mode: CzVectorEnv(n, autoreset_mode=mode, **settings), lambda: CzEnv(**settings), **options
    )


@pytest.mark.parametrize("observation", ["measured", "history", "state"])
def test_the_checkers_of_gymnasium_and_stable_baselines3_on_every_scenario(observation):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scenario in SCENARIOS:
            env = gym.make("Cz-v0", scenario=scenario, observation=observation, **SHORT)
            check_with_gymnasium(env.unwrapped)
            check_with_sb3(env)


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize(
    "settings",
    [
        {"scenario": "puller", "observation": "history"},
        {"scenario": "hard", "observation": "state", "model": 0.2},
        {"scenario": "sensor-fault", "observation": "measured"},
        {"scenario": "all", "observation": "history", "action": "smooth", "horizon": 1800.0},
        {"scenario": {"randomized": 1.0, "puller": 1.0}, "info": "lean"},
    ],
    ids=["puller", "hard", "sensor-fault", "all", "lean"],
)
def test_the_native_batch_is_a_vector_of_scalars(settings, mode):
    settings = {"info": "all", **SHORT, **settings}
    checked = conforming(settings, steps=60, mode=mode)
    assert checked.episodes > checked.failures > 2
    assert checked.held > (2000 if settings["info"] == "all" else 700)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_a_batch_of_images_is_a_vector_of_scalars(mode):
    settings = {"scenario": "sensor-fault", "observation": "camera", **SHORT, "horizon": 180.0, "info": "all"}
    checked = conforming(settings, mode=mode, num_envs=2, steps=5, random_start=False)
    assert checked.episodes > 1
    assert checked.held > 90


ALIKE = {("only-sensor", "state"), ("sensor-fault", "camera")}
"""Two first images of "sensor-fault" may both be black, so images do not tell its episodes apart."""


@pytest.mark.slow
@pytest.mark.parametrize("observation", [*OBSERVATIONS, "camera"])
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_scenario_and_observation_conforms(scenario, observation):
    """Long steps and short episodes, so that many end; images, which are slow, for fewer steps."""
    images = observation == "camera"
    settings = {"scenario": scenario, "observation": observation, **SHORT, "horizon": 180.0 if images else 1200.0}
    at_random = scenario in {"randomized", "hard", "sensor-fault", "puller", "only-sensor"}
    random_start = at_random and (scenario, observation) not in ALIKE
    for mode in AutoresetMode:
        conforming(settings, mode=mode, steps=4 if images else 50, random_start=random_start)
