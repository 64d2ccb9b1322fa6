"""PPO in one file, in the manner of CleanRL, on the native batch: ``python -m examples.cleanrl_ppo``, 4 minutes.

It needs nothing but torch: copy it and change what you like. While it learns from the reward, it prints the mean radius
error on validation crystals.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict, dataclass
from typing import Any

try:
    import numpy as np
    import torch
    from gymnasium.wrappers.utils import RunningMeanStd
    from torch import nn
except ModuleNotFoundError as error:
    sys.exit(f'{error.name} is missing: make venv, then .venv/bin/python, or pip install ".[agents]"')

from cz_gym import CzVectorEnv
from cz_gym.agents.training.validation import Validation, validate
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

CONFIG = make_config("randomized")


@dataclass
class Args:
    """Settings, as options of the command line."""

    seed: int = 0
    steps: int = 10_000_000
    num_envs: int = 512
    num_steps: int = 64
    epochs: int = 5
    minibatch: int = 4096
    learning_rate: float = 1e-3
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    log_std: float = -0.7


class Agent(nn.Module):
    """Actor and critic, and the running mean and variance of their observations."""

    def __init__(self, channels: int, actions: int, log_std: float) -> None:
        super().__init__()
        self.actor = network(channels, actions, 0.01)
        self.critic = network(channels, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((actions,), log_std))
        self.seen = RunningMeanStd(shape=(channels,))

    def normalise(self, observation: np.ndarray, learn: bool = False) -> torch.Tensor:
        """Observations with mean 0 and variance 1; ``learn`` updates the statistics."""
        if learn:
            self.seen.update(observation)
        x = (observation - self.seen.mean) / np.sqrt(self.seen.var + 1e-8)
        return torch.as_tensor(x.clip(-10.0, 10.0), dtype=torch.float32)

    def distribution(self, x: torch.Tensor) -> torch.distributions.Normal:
        """The distribution of the actions."""
        return torch.distributions.Normal(self.actor(x), self.log_std.exp())

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        """The mean action, as rollouts and the benchmark call it."""
        with torch.no_grad():
            return self.actor(self.normalise(observation)).clamp(-1.0, 1.0).numpy(), state


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Two hidden layers with orthogonal weights; ``gain`` scales those of the last layer."""
    layers: list[nn.Module] = []
    for wide, narrow, spread in ((inputs, 64, 2.0**0.5), (64, 64, 2.0**0.5), (64, outputs, gain)):
        layer = nn.Linear(wide, narrow)
        nn.init.orthogonal_(layer.weight, spread)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def main(args: Args) -> Validation:
    """Learn, and judge the agent on 100 validation crystals."""
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    envs = CzVectorEnv.from_config(CONFIG, args.num_envs, autoreset_mode="SameStep")
    observation, _ = envs.reset(seed=args.seed * args.num_envs)
    channels, actions = observation.shape[1], 2
    agent = Agent(channels, actions, args.log_std)
    optimiser = torch.optim.Adam(agent.parameters(), args.learning_rate, eps=1e-5)
    shape = (args.num_steps, args.num_envs)
    seen, done_after = torch.zeros(*shape, channels), torch.zeros(shape)
    acted, (logps, values, rewards) = torch.zeros(*shape, actions), torch.zeros(3, *shape)
    updates = max(args.steps // (args.num_steps * args.num_envs), 1)
    for update in range(updates):
        optimiser.param_groups[0]["lr"] = args.learning_rate * (1.0 - update / updates)
        for t in range(args.num_steps):
            with torch.no_grad():
                seen[t] = agent.normalise(observation, learn=True)
                drawn = agent.distribution(seen[t])
                acted[t] = drawn.sample()
                logps[t], values[t] = drawn.log_prob(acted[t]).sum(-1), agent.critic(seen[t]).squeeze(-1)
            observation, reward, ended, cut, info = envs.step(acted[t].clamp(-1.0, 1.0).numpy())
            rewards[t] = torch.as_tensor((1.0 - args.gamma) * reward)
            done_after[t] = torch.as_tensor(ended | cut)
            if cut.any():  # an episode that ran out of time would have gone on
                last = agent.normalise(np.stack(info["final_obs"][cut]))
                with torch.no_grad():
                    rewards[t, torch.as_tensor(cut)] += args.gamma * agent.critic(last).squeeze(-1)
        with torch.no_grad():
            following, gained = agent.critic(agent.normalise(observation)).squeeze(-1), torch.zeros(args.num_envs)
            advantages = torch.zeros(shape)
            for t in reversed(range(args.num_steps)):
                on = 1.0 - done_after[t]
                surprise = rewards[t] + args.gamma * on * following - values[t]
                advantages[t] = gained = surprise + args.gamma * args.gae_lambda * on * gained
                following = values[t]
        flat = [x.flatten(0, 1) for x in (seen, acted, logps, advantages, advantages + values)]
        for _ in range(args.epochs):
            for rows in torch.randperm(len(flat[0])).split(args.minibatch):
                x, a, before, advantage, target = (part[rows] for part in flat)
                drawn = agent.distribution(x)
                ratio = (drawn.log_prob(a).sum(-1) - before).exp()
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                gain = torch.minimum(advantage * ratio, advantage * ratio.clamp(1.0 - args.clip, 1.0 + args.clip))
                loss = -gain.mean() + 0.5 * (agent.critic(x).squeeze(-1) - target).square().mean()
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimiser.step()
        if (update + 1) % max(updates // 8, 1) == 0:
            found = validate(agent, CONFIG, VALIDATION_SEEDS[:100])
            steps = (update + 1) * args.num_steps * args.num_envs
            lost = 100.0 * found.failure_rate
            print(f"{steps:>9,} steps: radius error {found.rmse_mm:.3f} mm, {lost:.0f} % of crystals lost", flush=True)
    envs.close()
    return validate(agent, CONFIG, VALIDATION_SEEDS[:100])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    for name, value in asdict(Args()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    main(Args(**vars(parser.parse_args())))
