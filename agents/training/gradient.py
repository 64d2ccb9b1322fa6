"""Learning from the exact gradient of the cost: through policy, memory and plant, window by window of the crystal.

The plant's derivatives are those of :class:`cz_gym.differentiable.DifferentiableBatch`. No critic, no teacher.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.logger import Logger

from cz_gym.config import Config
from cz_gym.differentiable import STATES, DifferentiableBatch
from cz_gym.evaluation.protocol import TRAINING_SEEDS
from cz_gym.task import COST_CAP

from .filter_bank import STATE, FilterBank
from .learner import Parts, Watch
from .recipes import Gradient

WARM_UP = 0.05
"""Share of the updates in which features are still standardised anew."""
MOST_STD, LEAST_STD = 10.0, 1e-4
"""Bounds of a feature's standard deviation [-]."""
MOST_GRADIENT = 1.0
"""Norm that a gradient is cut to."""


class PlantStep(torch.autograd.Function):
    """A step of the batch as a function that torch differentiates: state, measured and cost from state and action.

    The batch goes on by a step; the state passed in says only what gradients belong to.
    """

    @staticmethod
    def forward(ctx: Any, state: torch.Tensor, action: torch.Tensor, batch: DifferentiableBatch) -> Any:
        """State (n, 9), measured (n, 11) and the cost's terms (n, 4) after the action, shape (n, 2)."""
        step = batch.step(action.numpy())
        ctx.jacobian, ctx.measured_by_state = step.jacobian, batch.measured_by_state
        return torch.from_numpy(step.state), torch.from_numpy(step.measured), torch.from_numpy(step.cost).float()

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> Any:
        """Gradients with respect to state and action."""
        by_state, by_measured, by_cost = gradients
        whole = by_state.numpy() + by_measured.double().numpy() @ ctx.measured_by_state
        rows = np.concatenate([whole, by_cost.double().numpy()], axis=1)
        back = torch.from_numpy(np.matmul(rows[:, None, :], ctx.jacobian)[:, 0])
        return back[:, : len(STATES)], back[:, len(STATES) :].float(), None


class GradientLearner:
    """A :class:`.filter_bank.FilterBank` that follows the gradient of the reward's own cost."""

    def __init__(self, recipe: Gradient, seed: int, config: Config, logger: Logger, done: int) -> None:
        torch.set_num_threads(recipe.threads)
        torch.manual_seed(seed)
        self.recipe, self.config, self.logger = recipe, config, logger
        self.per_update = recipe.num_envs * recipe.window
        self.total = math.ceil(recipe.steps / self.per_update) * self.per_update
        self.steps = done
        self.network = FilterBank(config.control_interval, recipe.hidden)
        self.optimiser = torch.optim.Adam(self.network.parameters(), recipe.learning_rate)
        self.random = np.random.default_rng([seed, done])
        self.weights = torch.tensor([1.0, recipe.weights.pull, recipe.weights.pull_step, recipe.weights.heater_step])

    def learn(self, watch: Watch) -> None:
        """Take the updates that are left."""
        recipe, n = self.recipe, self.recipe.num_envs
        batch = DifferentiableBatch(self.config, n)
        state, measured = (torch.from_numpy(each) for each in batch.reset(self._seeds(n)))
        memory = torch.zeros(n, STATE)
        windows = self.config.steps // recipe.window
        left = self.random.integers(1, windows, n, endpoint=True)
        while self.steps < self.total:
            progress = self.steps / self.total
            self.optimiser.param_groups[0]["lr"] = recipe.learning_rate * (1.0 - progress)
            state, measured, memory, lost = self._update(batch, state.detach(), measured, memory.detach(), progress)
            left -= 1
            over = np.flatnonzero(lost | (left == 0)).tolist()
            if over:
                state, measured = (torch.from_numpy(each) for each in batch.reset(self._seeds(len(over)), over))
                memory[over] = 0.0
                left[over] = windows
            self.steps += self.per_update
            watch(self.steps, "")
        batch.close()

    def _update(
        self, batch: DifferentiableBatch, state: Any, measured: Any, memory: Any, progress: float
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, Any]:
        """Drive each crystal through a window and follow the cost's gradient; where that left them, and who is lost."""
        step: Any = PlantStep.apply
        costs, seen = [], []
        for _ in range(self.recipe.window):
            features, memory = self.network.remember(measured, memory)
            seen.append(features.detach())
            state, measured, terms = step(state, self.network.act(features), batch)
            costs.append(terms @ self.weights)
        whole = torch.stack(costs)
        loss: Any = (COST_CAP * whole / (COST_CAP + whole)).mean()
        self.optimiser.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), MOST_GRADIENT)
        self.optimiser.step()
        if progress < WARM_UP:
            self._standardise(torch.cat(seen))
        self.logger.record("gradient/cost", float(loss.detach()))
        self.logger.record("gradient/norm", float(norm))
        return state, measured.detach(), memory.detach(), ~batch.grows

    def _standardise(self, seen: torch.Tensor) -> None:
        """Move the features' mean and standard deviation towards what is seen; the first time wholly."""
        network = self.network
        share = 0.1 if bool(network.mean.any()) else 1.0
        network.mean += share * (seen.mean(dim=0) - network.mean)
        variance = network.per_std**-2.0
        variance += share * (seen.var(dim=0) - variance)
        network.per_std.copy_(1.0 / torch.clamp(variance.sqrt(), LEAST_STD, MOST_STD))

    def _seeds(self, count: int) -> list[int]:
        return [int(seed) for seed in self.random.choice(len(TRAINING_SEEDS), count)]

    def parts(self) -> Parts:
        """Network and optimiser."""
        return Parts({"network": self.network}, {"optimiser": self.optimiser})

    def exported(self) -> bytes:
        """The network with its memory."""
        return self.network.onnx()
