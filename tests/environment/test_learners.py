"""Cz-v0 as learners meet it: under stable-baselines3's checker and Gymnasium's counting wrapper."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env

from cz_gym import SCENARIOS


@pytest.mark.parametrize("observation", ["measured", "history", "state"])
def test_stable_baselines3s_checker_on_every_scenario(observation: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scenario in SCENARIOS:
            check_env(gym.make("Cz-v0", scenario=scenario, observation=observation, horizon=600.0), warn=True)


@pytest.mark.parametrize("form", ["vector_entry_point", "sync"])
def test_gymnasiums_wrapper_counts_the_episodes_of_both_forms(form: str) -> None:
    """As single-file training loops make them; CleanRL's own is in ``tests/examples``."""
    envs: Any = gym.make_vec("Cz-v0", num_envs=4, vectorization_mode=form, control_interval=20.0, horizon=400.0)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    envs.reset(seed=1)
    random, earned, ends = np.random.default_rng(0), np.zeros(4), 0
    for _ in range(96):
        _, reward, terminated, truncated, infos = envs.step(random.uniform(-0.3, 0.3, (4, 2)).astype(np.float32))
        earned += reward
        for i in np.flatnonzero(terminated | truncated):
            assert infos["episode"]["r"][i] == pytest.approx(earned[i], rel=1e-5)
            earned[i], ends = 0.0, ends + 1
    envs.close()
    assert ends >= 16
