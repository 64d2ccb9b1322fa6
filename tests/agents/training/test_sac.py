"""Soft actor-critic: it begins gently, and its observations are normalised with what it does since."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from cz_gym.agents.training.callbacks import Statistics

from cz_gym.agents.training import callbacks
from cz_gym.agents.training.algorithms import make_algorithm
from tests.small_learners import SMALL_SAC, learned


def test_its_first_actions_are_those_of_a_gentle_policy():
    algorithm: Any = make_algorithm(replace(SMALL_SAC, noise=0.2), 0)
    algorithm._setup_learn(64)
    drawn = [algorithm._sample_action(10**6, None, 4)[0] for _ in range(200)]
    assert np.std(drawn, axis=(0, 1)) == pytest.approx([0.2, 0.2], rel=0.2)
    assert np.abs(np.mean(drawn, axis=(0, 1))).max() < 0.3


def test_observations_are_normalised_anew_until_a_quarter_of_the_training(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(callbacks, "RECENT", 8)
    taken, update = [], Statistics._update

    def noted(self: Statistics, observations: Any) -> None:
        taken.append((self.num_timesteps, len(observations)))
        update(self, observations)

    monkeypatch.setattr(Statistics, "_update", noted)
    recipe = replace(SMALL_SAC, steps=320)
    learned(make_algorithm(recipe, 0), recipe)
    assert taken == [(28, 6), (44, 8), (60, 8), (76, 8)]
