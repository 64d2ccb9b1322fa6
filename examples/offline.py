"""Offline learning from recorded crystals, no crystal pulled: ``python -m cz_gym.examples.offline`` (data, agents).

Behaviour cloning and TD3+BC (Fujimoto and Gu, 2021) on each dataset, three training seeds each. Scores: Minari's, 0 is
open loop, 100 the best classical controller of README's table, both on the same validation crystals.
"""

import argparse
import copy
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import minari
import numpy as np
import torch
from torch import Tensor, nn

from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.spaces import DRIVE_CHANNELS, drives_of
from cz_gym.support.command_line import between
from cz_gym.support.files import write_files
from cz_gym.tools.datasets import main as write_datasets
from cz_gym.tools.report.tables import markdown

SETS = ("lqg", "mixed", "operator", "paper")
SEEDS = 3
CRYSTALS = VALIDATION_SEEDS[:100]
BATCH, WIDTH, UPDATES = 256, 128, 20_000
GAMMA, TAU, ALPHA, DELAY = 0.99, 0.005, 2.5, 2
"""TD3+BC: discount of a step, rate of the target networks, weight of the value, critic updates for one of the actor."""
NOISE, NOISE_LIMIT = 0.2, 0.5
"""Noise of the targets' actions, and its limit, in standard deviations of the recorded actions."""
LARGEST = 4.0
"""Largest action of an actor, in standard deviations of the recorded ones."""


class Steps(NamedTuple):
    """Recorded steps: observations standardised, "smooth" actions in units of their standard deviation."""

    seen: Tensor
    action: Tensor
    reward: Tensor
    next_seen: Tensor
    goes_on: Tensor

    def sample(self) -> "Steps":
        """Draw a batch of steps."""
        rows = torch.randint(len(self.seen), (BATCH,))
        return Steps(*(each[rows] for each in self))


class Actor(nn.Module):
    """Policy on "history" observations, with the scales of its data."""

    settings = {"observation": "history", "action": "smooth"}  # noqa: RUF012  # read by rollout

    def __init__(self, mean: Tensor, spread: Tensor, unit: Tensor) -> None:
        super().__init__()
        self.mean, self.spread, self.unit = mean, spread, unit
        self.net = nn.Sequential(*layers(len(mean), 2), nn.Tanh())

    def forward(self, seen: Tensor) -> Tensor:
        """Actions for standardised observations."""
        action: Tensor = LARGEST * self.net(seen)
        return action

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        """Return actions for observations, as every policy does."""
        with torch.no_grad():
            action = self.unit * self((torch.as_tensor(observation) - self.mean) / self.spread)
        return action.clamp(-1.0, 1.0).numpy(), state


def layers(inputs: int, outputs: int) -> list[nn.Module]:
    """Two hidden layers."""
    return [nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, outputs)]


def load(name: str) -> tuple[Any, Steps, Callable[[], Actor]]:
    """Load a dataset; return it, its steps, and a function that makes an actor for them."""
    dataset = minari.load_dataset(f"cz/randomized/{name}-v0")
    drives, episodes = drives_of("smooth", control_interval=5.0), list(dataset.iterate_episodes())
    smooth = [drives.asked(each.actions, each.observations[:-1, list(DRIVE_CHANNELS)]) for each in episodes]
    parts = (
        [each.observations[:-1] for each in episodes],
        smooth,
        [each.rewards for each in episodes],
        [each.observations[1:] for each in episodes],
        [~each.terminations for each in episodes],
    )
    seen, action, reward, next_seen, goes_on = (torch.tensor(np.concatenate(part).astype(np.float32)) for part in parts)
    mean, spread, unit = seen.mean(0), seen.std(0) + 1e-3, action.std(0)
    action = (action / unit).clamp(-LARGEST, LARGEST)
    steps = Steps((seen - mean) / spread, action, reward / 100.0, (next_seen - mean) / spread, goes_on)
    return dataset, steps, partial(Actor, mean, spread, unit)


def clone(steps: Steps, make: Callable[[], Actor]) -> Actor:
    """Behaviour cloning: the actor's action is the recorded one, in the mean of squares."""
    actor = make()
    optimiser = torch.optim.Adam(actor.parameters(), 1e-3)
    for _ in range(UPDATES // 4):
        batch = steps.sample()
        descend(optimiser, (actor(batch.seen) - batch.action).square().mean())
    return actor


def td3_bc(steps: Steps, make: Callable[[], Actor]) -> Actor:
    """TD3 whose actor also stays near the recorded actions."""
    actor, critics = make(), [nn.Sequential(*layers(steps.seen.shape[1] + 2, 1)) for _ in range(2)]
    target, target_critics = copy.deepcopy(actor), copy.deepcopy(critics)
    optimiser = torch.optim.Adam(actor.parameters(), 3e-4)
    critic_optimiser = torch.optim.Adam([weight for each in critics for weight in each.parameters()], 3e-4)
    for update in range(UPDATES):
        batch = steps.sample()
        with torch.no_grad():
            noise = (NOISE * torch.randn_like(batch.action)).clamp(-NOISE_LIMIT, NOISE_LIMIT)
            following = torch.cat([batch.next_seen, (target(batch.next_seen) + noise).clamp(-LARGEST, LARGEST)], 1)
            least = torch.minimum(*(each(following)[:, 0] for each in target_critics))
            value = batch.reward + GAMMA * batch.goes_on * least
        at = torch.cat([batch.seen, batch.action], 1)
        descend(critic_optimiser, sum((each(at)[:, 0] - value).square().mean() for each in critics))
        if update % DELAY == 0:
            action = actor(batch.seen)
            worth = critics[0](torch.cat([batch.seen, action], 1))
            pull = ALPHA / worth.abs().mean().detach()
            descend(optimiser, (action - batch.action).square().mean() - pull * worth.mean())
            for ours, slow in zip([actor, *critics], [target, *target_critics], strict=True):
                follow(ours, slow)
    return actor


def descend(optimiser: torch.optim.Optimizer, loss: Any) -> None:
    """Take one step of an optimiser."""
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()


def follow(ours: nn.Module, slow: nn.Module) -> None:
    """Move a target network towards its network."""
    with torch.no_grad():
        for weight, slow_weight in zip(ours.parameters(), slow.parameters(), strict=True):
            slow_weight.lerp_(weight, TAU)


LEARNERS = {"behaviour cloning": clone, "TD3+BC": td3_bc}


def score(policy: Any, dataset: Any) -> tuple[float, float]:
    """Normalised score, and share of crystals lost [%]."""
    figures = metrics(rollout(policy, make_config("randomized"), CRYSTALS))
    normalised = float(minari.get_normalized_score(dataset, figures.return_).mean())
    return 100.0 * normalised, 100.0 * figures.failure_rate.mean()


def compare(name: str, seeds: int) -> list[tuple[str, ...]]:
    """Rows of the table for a dataset."""
    dataset, steps, make = load(name)
    recorded = np.array([each.rewards.sum() for each in dataset.iterate_episodes()])
    rows: list[tuple[str, ...]] = []
    rows += [(name, "its recorded returns", f"{100.0 * minari.get_normalized_score(dataset, recorded).mean():.1f}", "")]
    for learner, learn in LEARNERS.items():
        scored = []
        for seed in range(seeds):
            torch.manual_seed(seed)
            scored.append(score(learn(steps, make), dataset))
        scores, lost = np.array(scored).T
        rows.append(
            (name, learner, f"{scores.mean():.1f} [{scores.min():.1f}, {scores.max():.1f}]", f"{lost.mean():.1f}")
        )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser("python -m cz_gym.examples.offline", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--sets", default=",".join(SETS), help="datasets (default: %(default)s)")
    parser.add_argument("--seeds", type=between(1, 100), default=SEEDS, help="training seeds (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("runs/offline.md"), help="table (default: %(default)s)")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)  # small networks are quicker so
    names = given.sets.split(",")
    have = minari.list_local_datasets()
    missing = [name for name in names if f"cz/randomized/{name}-v0" not in have]
    if missing and (code := write_datasets(["--policies", ",".join(missing)])):
        sys.exit(code)
    rows = [row for name in names for row in compare(name, given.seeds)]
    text = markdown(("dataset", "learner", "score, mean and range over seeds", "crystals lost [%]"), rows)
    print(text)
    write_files({given.out: f"{text}\n".encode()})


if __name__ == "__main__":
    main(sys.argv[1:])
