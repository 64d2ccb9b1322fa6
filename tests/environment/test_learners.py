"""Cz-v0 as learners meet it: under stable-baselines3's checker, and in a single-file loop as CleanRL writes them."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.env_checker import check_env

from cz_gym import SCENARIOS


@pytest.mark.parametrize("observation", ["measured", "history", "state"])
def test_stable_baselines3s_checker_on_every_scenario(observation: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scenario in SCENARIOS:
            check_env(gym.make("Cz-v0", scenario=scenario, observation=observation, horizon=600.0), warn=True)


class Agent(torch.nn.Module):
    """CleanRL's continuous actor and critic, smaller."""

    def __init__(self, envs: Any) -> None:
        super().__init__()
        seen, acted = np.prod(envs.single_observation_space.shape), np.prod(envs.single_action_space.shape)
        self.critic = torch.nn.Sequential(torch.nn.Linear(int(seen), 32), torch.nn.Tanh(), torch.nn.Linear(32, 1))
        self.actor = torch.nn.Sequential(
            torch.nn.Linear(int(seen), 32), torch.nn.Tanh(), torch.nn.Linear(32, int(acted))
        )
        self.actor_logstd = torch.nn.Parameter(-torch.ones(1, int(acted)))

    def act(self, x: torch.Tensor, action: torch.Tensor | None = None) -> tuple[torch.Tensor, ...]:
        normal = torch.distributions.Normal(self.actor(x), self.actor_logstd.exp())
        action = normal.sample() if action is None else action
        return action, normal.log_prob(action).sum(1), self.critic(x).flatten()


@pytest.mark.parametrize("form", ["vector_entry_point", "sync"])
def test_a_cleanrl_style_loop_runs_it_unmodified(form: str) -> None:
    """PPO in one function: torch tensors over what the environment returns, episodes counted by Gymnasium's wrapper."""
    torch.manual_seed(0)
    envs: Any = gym.make_vec("Cz-v0", num_envs=4, vectorization_mode=form, control_interval=20.0, horizon=400.0)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(envs)
    agent = Agent(envs)
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3)
    obs, _ = envs.reset(seed=1)
    obs, returns, before = torch.Tensor(obs), [], agent.actor[0].weight.detach().clone()
    for _ in range(3):
        rows = []
        for _ in range(32):
            with torch.no_grad():
                action, logprob, value = agent.act(obs)
            seen, reward, terminated, _, infos = envs.step(action.cpu().numpy())
            rows.append((obs, action, logprob, torch.Tensor(reward) / 10 + 0.99 * value * ~torch.tensor(terminated)))
            obs = torch.Tensor(seen)
            if "episode" in infos:
                returns += infos["episode"]["r"][infos["_episode"]].tolist()
        x, action, old, target = (torch.cat(parts) for parts in zip(*rows, strict=True))
        _, new, value = agent.act(x, action)
        advantage = (target - value).detach()
        loss = -(torch.exp(new - old).clamp(0.8, 1.2) * advantage).mean() + (target - value).pow(2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    envs.close()
    assert len(returns) >= 16
    assert np.isfinite(returns).all()
    assert not torch.equal(before, agent.actor[0].weight)
