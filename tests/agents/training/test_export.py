"""An exported policy acts as the algorithm's own."""

import numpy as np
import pytest

from cz_gym.agents import AgentFileError, OnnxPolicy
from cz_gym.agents.agent_file.contract import make_contract
from cz_gym.agents.export import to_onnx
from cz_gym.agents.training.recipes import Recipe
from cz_gym.observation import OBSERVATIONS
from tests.contracts import facts
from tests.small_learners import SMALL, SMALL_APG, SMALL_SAC, trained


@pytest.mark.parametrize("recipe", [SMALL, SMALL_SAC, SMALL_APG], ids=lambda recipe: recipe.name)
def test_an_exported_policy_acts_as_the_algorithm(recipe: Recipe) -> None:
    """Over several steps, with an episode that begins among them; what normalises the observations is in the file."""
    algorithm, channels = trained(recipe), len(OBSERVATIONS[recipe.observation])
    normalisation = algorithm.get_vec_normalize_env()
    content = to_onnx(algorithm.policy, channels, normalisation)
    agent = OnnxPolicy.of(make_contract(content, **facts(recipe.observation)), content)
    random, state, memory = np.random.default_rng(0), None, None
    for step in range(20):
        starts = np.array([step == 0, step == 0, step == 9])
        observation = random.uniform(-3.0, 3.0, (3, channels)).astype(np.float32)
        seen = observation if normalisation is None else normalisation.normalize_obs(observation)
        wanted, state = algorithm.predict(seen, state, starts, deterministic=True)
        action, memory = agent.predict(observation, memory, starts)
        np.testing.assert_allclose(action, wanted, atol=2e-6)
        assert action.dtype == np.float32


def test_a_policy_without_an_actor_is_refused() -> None:
    from stable_baselines3 import DQN

    model = DQN("MlpPolicy", "CartPole-v1", buffer_size=10)
    with pytest.raises(AgentFileError, match="DQNPolicy has no actor that gives two continuous actions"):
        to_onnx(model.policy, 4)
