"""What is exported acts as the network that was trained."""

from typing import Any

import numpy as np
import pytest
import torch

from cz_gym.agents import OnnxPolicy
from cz_gym.agents.agent_file.contract import make_contract
from cz_gym.observation import HISTORY, STATE
from tests.contracts import facts
from tests.small_learners import SMALL_SAC, trained


def observations(n: int, channels: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-3.0, 3.0, (n, channels)).astype(np.float32)


def agent_of(learner: Any) -> OnnxPolicy:
    content = learner.exported()
    return OnnxPolicy.of(make_contract(content, **facts()), content)


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_what_is_exported_acts_like_the_network_it_came_from(algorithm: str, ppo: Any) -> None:
    learner = ppo if algorithm == "ppo" else trained(SMALL_SAC)
    seen = observations(64, learner.algorithm.observation_space.shape[0])
    expected, _ = learner.algorithm.predict(seen, deterministic=True)
    action, _ = agent_of(learner).predict(seen[:, : len(HISTORY)])
    np.testing.assert_allclose(action, expected, atol=2e-6)
    assert action.dtype == np.float32


def test_actor_is_blind_to_the_true_state(ppo: Any) -> None:
    seen = observations(8, len(HISTORY) + len(STATE))
    blind = seen.copy()
    blind[:, len(HISTORY) :] = 0.0
    policy = ppo.algorithm.policy
    np.testing.assert_array_equal(*(policy.predict(array, deterministic=True)[0] for array in (seen, blind)))
    values = [policy.predict_values(torch.as_tensor(array)) for array in (seen, blind)]
    assert not torch.allclose(*values)


def test_normalisation_is_the_data_s_mean_and_spread(ppo: Any) -> None:
    buffer, normalise = ppo.algorithm.rollout_buffer, ppo.algorithm.policy.features_extractor
    seen = buffer.observations.reshape(-1, len(HISTORY) + len(STATE))
    np.testing.assert_allclose(normalise.mean, seen.mean(axis=0), atol=1e-5)
    spread = np.maximum(seen.std(axis=0), 0.02)
    np.testing.assert_allclose(normalise.scaling, np.diag(1.0 / spread), rtol=1e-4)
    assert not torch.allclose(normalise.scaling, torch.eye(len(spread)))
