"""An exported policy acts as the algorithm's own."""

import numpy as np
import pytest
import torch

from cz_gym.agents import AgentFileError, OnnxPolicy
from cz_gym.agents.agent_file.contract import make_contract
from cz_gym.agents.export import to_onnx
from cz_gym.agents.training.recipes import Recipe
from cz_gym.observation import HISTORY, OBSERVATIONS, STATE
from tests.contracts import facts
from tests.small_learners import SMALL, SMALL_APG, SMALL_SAC, trained


@pytest.mark.parametrize("recipe", [SMALL, SMALL_SAC, SMALL_APG], ids=lambda recipe: recipe.name)
def test_an_exported_policy_acts_as_the_algorithm(recipe: Recipe) -> None:
    """Over several steps, with an episode that begins among them."""
    algorithm, channels = trained(recipe), len(OBSERVATIONS[recipe.observation])
    content = to_onnx(algorithm.policy, channels)
    agent = OnnxPolicy.of(make_contract(content, **facts(recipe.observation)), content)
    random, state, memory = np.random.default_rng(0), None, None
    for step in range(20):
        starts = np.array([step == 0, step == 0, step == 9])
        seen = random.uniform(-3.0, 3.0, (3, *algorithm.observation_space.shape)).astype(np.float32)
        wanted, state = algorithm.predict(seen, state, starts, deterministic=True)
        action, memory = agent.predict(seen[:, :channels], memory, starts)
        np.testing.assert_allclose(action, wanted, atol=2e-6)
        assert action.dtype == np.float32


def test_a_policy_without_an_actor_is_refused() -> None:
    from stable_baselines3 import DQN

    model = DQN("MlpPolicy", "CartPole-v1", buffer_size=10)
    with pytest.raises(AgentFileError, match="DQNPolicy has no actor that gives two continuous actions"):
        to_onnx(model.policy, 4)


def test_actor_is_blind_to_the_true_state(ppo) -> None:
    seen = np.random.default_rng(0).uniform(-3.0, 3.0, (8, len(HISTORY) + len(STATE))).astype(np.float32)
    blind = seen.copy()
    blind[:, len(HISTORY) :] = 0.0
    np.testing.assert_array_equal(*(ppo.policy.predict(array, deterministic=True)[0] for array in (seen, blind)))
    values = [ppo.policy.predict_values(torch.as_tensor(array)) for array in (seen, blind)]
    assert not torch.allclose(*values)


def test_normalisation_is_the_data_s_mean_and_spread(ppo) -> None:
    buffer, normalise = ppo.rollout_buffer, ppo.policy.features_extractor
    seen = buffer.observations.reshape(-1, len(HISTORY) + len(STATE))
    np.testing.assert_allclose(normalise.mean, seen.mean(axis=0), atol=1e-5)
    spread = np.maximum(seen.std(axis=0), 0.02)
    np.testing.assert_allclose(normalise.std, spread, rtol=1e-4)
    assert not torch.allclose(normalise.std, torch.ones(len(spread)))
