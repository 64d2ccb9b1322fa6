"""Learn from recorded episodes alone: TD3+BC in one file, ``python -m examples.offline_td3_bc``, 2 minutes.

Record the data first with ``python -m cz_gym.datasets``; the extras ``data`` and ``agents`` are needed. The agent is
judged on 100 validation crystals twice: after behaviour cloning, the first third of the updates, and at the end.
"""

from __future__ import annotations

import argparse
import copy
import sys
from typing import Any

try:
    import minari
    import numpy as np
    import torch
    from torch import nn
except ModuleNotFoundError as error:
    sys.exit(f'{error.name} is missing: make venv, then .venv/bin/python, or pip install ".[agents,data]"')

from cz_gym.agents.training.validation import Validation, validate
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.observation import DRIVE_CHANNELS
from cz_gym.task import drives_of

CONFIG = make_config("randomized")
GAMMA, ALPHA = 0.98, 5.0
"""Discount, and weight of the critic's gradient beside that of the cloning."""
BATCH, RATE, TARGET_RATE, TARGET_NOISE = 512, 1e-3, 0.05, 0.2


def network(inputs: int, outputs: int, activation: type[nn.Module]) -> nn.Module:
    """Two hidden layers of 128 units."""
    first, second, last = nn.Linear(inputs, 128), nn.Linear(128, 128), nn.Linear(128, outputs)
    return nn.Sequential(first, activation(), second, activation(), last)


class Policy:
    """The actor, as rollouts and the benchmark call it."""

    def __init__(self, actor: nn.Module, *scales: torch.Tensor) -> None:
        self.actor, (self.mean, self.spread, self.unit) = actor, scales

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        """Observations (n, 72) -> actions (n, 2), and no state."""
        with torch.no_grad():
            action = self.unit * self.actor((torch.as_tensor(observation) - self.mean) / self.spread)
            return action.clamp(-1.0, 1.0).numpy(), state


def read(names: list[str]) -> list[Any]:
    """Scaled observations, scaled true states, "smooth" actions, rewards, and whether a step lost its crystal."""
    drives, parts = drives_of("smooth", CONFIG.control_interval), []
    for episode in (each for name in names for each in minari.load_dataset(name).iterate_episodes()):
        seen, state = episode.observations, episode.infos["state"]
        action = drives.asked(episode.actions, seen[:-1, list(DRIVE_CHANNELS)])
        reward = (1.0 - GAMMA) * episode.rewards
        parts.append((seen[:-1], seen[1:], state[:-1], state[1:], action, reward, episode.terminations))
    columns = [torch.as_tensor(np.concatenate(each).astype(np.float32)) for each in zip(*parts, strict=True)]
    return [scaled(*columns[:2]), scaled(*columns[2:4]), *columns[4:]]


def scaled(now: torch.Tensor, following: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Both with mean 0 and standard deviation 1, then that mean and standard deviation."""
    mean, spread = now.mean(0), now.std(0) + 1e-3
    return (now - mean) / spread, (following - mean) / spread, mean, spread


def descend(optimiser: torch.optim.Optimizer, loss: Any) -> None:
    """One step down the gradient of the loss."""
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()


def main(names: list[str], seed: int = 0, updates: int = 9000) -> Validation:
    """Learn, and judge the agent on 100 validation crystals."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    (seen, next_seen, mean, spread), (state, next_state, *_), action, reward, lost = read(names)
    unit = action.std(0)  # what actor and critics take and give is in units of the recorded actions' spread
    actor = network(seen.shape[1], 2, nn.Tanh)
    # The critics see the true state, which a policy cannot: they are of use in training only.
    critics = nn.ModuleList([network(state.shape[1] + 2, 1, nn.ReLU) for _ in range(2)])
    slow_actor, slow_critics = copy.deepcopy(actor), copy.deepcopy(critics)
    optimisers = [torch.optim.Adam(part.parameters(), RATE) for part in (actor, critics)]
    policy = Policy(actor, mean, spread, unit)
    for update in range(updates):
        for optimiser in optimisers:
            optimiser.param_groups[0]["lr"] = RATE * (1.0 - update / updates)
        rows = torch.randint(len(seen), (BATCH,))
        with torch.no_grad():
            following = slow_actor(next_seen[rows]) + TARGET_NOISE * torch.randn(BATCH, 2).clamp(-2.5, 2.5)
            there = torch.cat([next_state[rows], following], 1)
            value = (slow_critics[0](there) + slow_critics[1](there)).squeeze(1) / 2.0
            wanted = reward[rows] + GAMMA * (1.0 - lost[rows]) * value
        here, taken = state[rows], action[rows] / unit
        errors = [critic(torch.cat([here, taken], 1))[:, 0] - wanted for critic in critics]
        descend(optimisers[1], sum(error.square().mean() for error in errors))
        given = actor(seen[rows])
        loss = (given - taken).square().mean()
        if update > updates // 3:
            worth = critics[0](torch.cat([here, given], 1))
            loss = loss - ALPHA * worth.mean() / (worth - worth.mean()).abs().mean().detach()
        descend(optimisers[0], loss)
        with torch.no_grad():
            for slow, fast in ((slow_actor, actor), (slow_critics, critics)):
                for old, new in zip(slow.parameters(), fast.parameters(), strict=True):
                    old.lerp_(new, TARGET_RATE)
        if update in (updates // 3, updates - 1):
            found = validate(policy, CONFIG, VALIDATION_SEEDS[:100])
            said = f"radius error {found.rmse_mm:.3f} mm, {100.0 * found.failure_rate:.0f} % of crystals lost"
            print(f"{update + 1:>6,} updates: {said}, cost {found.cost:.3f}", flush=True)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", nargs="+", default=["cz/randomized/paper-tuned-v0"], metavar="NAME")
    for name, value in {"seed": 0, "updates": 9000}.items():
        parser.add_argument(f"--{name}", type=int, default=value)
    options = parser.parse_args()
    try:
        main(options.data, options.seed, options.updates)
    except FileNotFoundError as error:
        sys.exit(f"{error.args[0]} `python -m cz_gym.datasets` writes it.")
