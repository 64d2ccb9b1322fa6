"""Imitation learning: a network is fitted to a teacher's demonstrations (DAgger; Ross, Gordon, Bagnell 2011).

In the first round the teacher controls crystals, with noise on its actions, so that it also demonstrates corrections.
In later rounds the imitation controls them, and the teacher labels what it would have done. The linear path is a ridge
regression on the whitened observations of the first round; then the whole actor is fitted by gradient, round by round.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3.common.logger import Logger

from cz_gym.config import Config
from cz_gym.errors import CzError
from cz_gym.evaluation.protocol import TRAINING_SEEDS
from cz_gym.observation import CLIP, DRIVE_CHANNELS, HISTORY

from .demonstrations import Demonstrations, Floats, demonstrate, widened
from .export import actor_onnx
from .learner import Parts, Watch
from .networks import Actor, Normalise, SkipConcat, tanh_layers, whitening
from .recipes import Imitation

RIDGE = 1e-6
"""Regularisation of the regression, in units of the whitened observation's variance."""
SPREAD_FLOOR = 1e-6
"""Least spread of the demonstrated actions that a loss is divided by [-]."""
BATCH = 4096


class Imitator:
    """A learner that imitates the teacher which its recipe names.

    ``config`` is the recipe's environment. An imitation that is interrupted begins again, because a checkpoint does not
    hold its demonstrations.
    """

    def __init__(self, recipe: Imitation, seed: int, teacher: Any, config: Config, logger: Logger, done: int) -> None:
        if recipe.rounds < 1:
            raise CzError(f"an imitation needs at least one round, not {recipe.rounds}")
        torch.set_num_threads(recipe.threads)
        self.recipe, self.seed, self.teacher, self.config, self.logger = recipe, seed, teacher, config, logger
        self.total = recipe.rounds * recipe.episodes * config.steps
        self.steps = self.total if done else 0
        self.network = make_network(recipe, seed)

    def learn(self, watch: Watch) -> None:
        """Imitate, unless that is done."""
        if self.steps:
            return
        recipe, self.network = self.recipe, make_network(self.recipe, self.seed)
        torch.manual_seed(self.seed)
        demonstrations: Demonstrations | None = None
        for turn in range(recipe.rounds):
            new = self._round(turn, watch)
            if demonstrations is None:
                demonstrations = new
                fit_linear_path(self.network, new)
            else:
                demonstrations = Demonstrations.concatenated([demonstrations, new])
            taken = (turn + 1) * recipe.episodes * self.config.steps
            watch(taken, f"round {turn + 1} of {recipe.rounds}: fits {len(demonstrations.action):,} samples")
            self.logger.record("imitation/loss", fit(self.network, demonstrations, recipe))
            self.logger.dump(taken)
        self.steps = self.total
        watch(self.total, "")

    def _round(self, turn: int, watch: Watch) -> Demonstrations:
        """One round of demonstrations, on crystals that no other round and no other training seed meets."""
        recipe = self.recipe
        first = (self.seed * 20_011 + 500_000) % (len(TRAINING_SEEDS) - recipe.rounds * recipe.episodes)
        seeds = range(first + turn * recipe.episodes, first + (turn + 1) * recipe.episodes)
        wide_episodes, taken = round(recipe.wide_share * recipe.episodes), turn * recipe.episodes * self.config.steps
        wide = self.config.with_scenario(widened(self.config.scenario, recipe.width))

        def progress(steps: int) -> None:
            nonlocal taken
            taken += steps
            watch(taken, f"round {turn + 1} of {recipe.rounds}: {recipe.teacher} demonstrates")

        driver = mean_action(self.network) if turn else None
        return Demonstrations.concatenated(
            demonstrate(self.teacher, config, some, recipe.noise, driver, progress)
            for config, some in ((wide, seeds[:wide_episodes]), (self.config, seeds[wide_episodes:]))
            if some
        )

    def parts(self) -> Parts:
        """The network."""
        return Parts({"network": self.network})

    def exported(self) -> bytes:
        """The network's actor."""
        return actor_onnx(self.network.actor)


class ImitationNetwork(torch.nn.Module):
    """Normalised observation -> tanh layers, concatenated with the observation itself -> linear -> action.

    The linear path carries the linear part of the controller, the layers the nonlinear part.
    """

    def __init__(self, hidden: tuple[int, ...], memory: float) -> None:
        super().__init__()
        channels = len(HISTORY)
        self.normalise = Normalise(Box(-CLIP, CLIP, (channels,), np.float32), memory)
        self.layers = SkipConcat(tanh_layers([channels, *hidden]))
        self.last = torch.nn.Linear((channels, *hidden)[-1] + channels, len(DRIVE_CHANNELS))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Shape (n, channels) to (n, 2)."""
        action: torch.Tensor = self.last(self.layers(self.normalise(observation)))
        return action

    @property
    def actor(self) -> Actor:
        """The actor to export."""
        return Actor(self.normalise, None, [self.layers, self.last])


def make_network(recipe: Imitation, seed: int) -> ImitationNetwork:
    """The network with the initial weights of a training seed."""
    torch.manual_seed(seed)
    return ImitationNetwork(recipe.hidden, recipe.memory)


def mean_action(network: ImitationNetwork) -> Callable[[Floats], Floats]:
    """The network's clipped action as a function of "history" observations."""

    def act(observation: Floats) -> Floats:
        with torch.no_grad():
            action: Floats = network(torch.as_tensor(observation)).clamp(-1.0, 1.0).numpy()
        return action

    return act


def fit_linear_path(network: ImitationNetwork, demonstrations: Demonstrations) -> None:
    """Set normalisation and linear path by regression; the hidden layers add nothing yet."""
    normalise, last = network.normalise, network.last
    seen = demonstrations.observation.astype(np.float64) * normalise.visible.numpy()
    mean = seen.mean(axis=0)
    normalise.set(mean, whitening(np.cov(seen.T)))
    whitened = _features(network, demonstrations.observation).numpy().astype(np.float64)
    x = np.column_stack([whitened, np.ones(len(whitened))])
    squares = x.T @ x + RIDGE * len(x) * np.eye(x.shape[1])
    weights = np.linalg.solve(squares, x.T @ demonstrations.action)
    with torch.no_grad():
        last.weight.zero_()
        last.weight[:, -len(mean) :] = torch.as_tensor(weights[:-1].T)
        last.bias.copy_(torch.as_tensor(weights[-1]))


def fit(network: ImitationNetwork, demonstrations: Demonstrations, recipe: Imitation) -> float:
    """Fit the actor by gradient, with Huber's loss of scaled outputs and a one-cycle learning rate; the last loss."""
    wanted = demonstrations.action
    spread = torch.as_tensor(np.maximum(np.quantile(np.abs(wanted), 0.68, axis=0), SPREAD_FLOOR).astype(np.float32))
    features = _features(network, demonstrations.observation)
    targets = torch.as_tensor(wanted / spread.numpy())
    shares = torch.tensor(recipe.loss_weights)
    actor = torch.nn.Sequential(network.layers, network.last)
    optimiser = torch.optim.Adam(actor.parameters(), recipe.learning_rate)
    steps = recipe.epochs * max(len(wanted) // BATCH, 1)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimiser, recipe.learning_rate, total_steps=steps)
    loss = torch.zeros(())
    for _ in range(steps):
        rows = torch.randint(len(wanted), (min(BATCH, len(wanted)),))
        errors = torch.nn.functional.huber_loss(actor(features[rows]) / spread, targets[rows], reduction="none")
        loss = (shares * errors).mean()
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        cycle.step()
    return float(loss.detach())


def _features(network: ImitationNetwork, observation: Floats) -> torch.Tensor:
    """The normalised observation, shape (samples, channels)."""
    with torch.no_grad():
        features: torch.Tensor = network.normalise(torch.as_tensor(observation))
    return features
