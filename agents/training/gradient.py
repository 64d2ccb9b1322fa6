"""Learning from the gradient of the cost: through policy, memory and plant, window by window of the crystal.

The plant's derivatives are the exact ones of :class:`cz_gym.differentiable.DifferentiableBatch`. The network's
estimates beside its means (noise, swings, ripple) and its schedule have no gradient. No critic, no teacher.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.logger import Logger
from torch import nn
from torch.autograd import backward, grad
from torch.nn.utils.parametrize import register_parametrization

from cz_gym.config import Config
from cz_gym.cost import WEIGHTS, Cost, cost_slopes, cost_terms, saturated, saturated_slope
from cz_gym.differentiable import STATES, Step
from cz_gym.evaluation.protocol import TRAINING_SEEDS
from cz_gym.observation import MEASURED, scales
from cz_gym.task import drives_of

from .crystals import CostNormaliser, Crystals
from .demonstrations import widened
from .expectation import Expectation
from .filter_bank import MEANS, N_DETACHED, STATE, FilterBank, read_bank
from .learner import Parts, Watch
from .networks import whitening
from .recipes import Gradient

WARM_UP = 0.05
"""Share of the updates in which features are still standardised anew."""
MOST_STD, LEAST_STD = 10.0, 1e-4
"""Bounds of a feature's standard deviation [-]."""
LEAST_VARIANCE = 1e-4
"""Added to the variances that whitening divides by [-]."""
MOST_GRADIENT = 2.0
"""Gradient-norm clip, in multiples of the running median norm [-]: the gradient of a crystal that is nearly lost is
thousands of times as large, and has no useful direction."""
LAST_GRADIENTS = 100
"""Window of that median [updates]."""
AT_ONCE = 12
"""Steps whose actions are differentiated in one call: their arrays fit into a processor's cache."""
_V_P = [channel.name for channel in MEASURED].index("v_p")
_RADIUS, _PULL_STEP = (Cost._fields.index(name) for name in ("radius", "pull_step"))


class Window(NamedTuple):
    """Some steps of all crystals, with all that a gradient needs."""

    features: torch.Tensor
    """The network's features, shape (steps, n, width)."""
    costs: Any
    """Terms of the cost, shape (steps, n, 4)."""
    beyond: Any
    """Gradient of moves that a limit cuts off (:meth:`GradientLearner._beyond`), shape (steps, n)."""
    jacobians: list[Any]
    """Each step's jacobian (:class:`cz_gym.differentiable.Step`)."""
    measured: Any
    """The last readings, shape (n, 11)."""
    memory: torch.Tensor
    """The network's state after them, shape (n, :data:`.filter_bank.STATE`)."""


class _OfWhitened(nn.Module):
    """Parametrisation of a layer's weights by weights of its whitened inputs."""

    scaling: torch.Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("scaling", torch.eye(width))

    def forward(self, learned: torch.Tensor) -> torch.Tensor:
        return learned.matmul(self.scaling)

    def right_inverse(self, weight: torch.Tensor) -> Any:
        return torch.linalg.solve(self.scaling, weight, left=False)


class GradientLearner:
    """A :class:`.filter_bank.FilterBank` that follows the gradient of the recipe's cost, window by window."""

    def __init__(self, recipe: Gradient, seed: int, config: Config, logger: Logger, done: int) -> None:
        torch.set_num_threads(recipe.threads)
        torch.manual_seed(seed)
        self.recipe, self.config, self.logger = recipe, config, logger
        self.per_update = recipe.num_envs * recipe.window
        self.total = math.ceil(recipe.steps / self.per_update) * self.per_update
        self.steps = done
        if recipe.start and not done:
            self.network = read_bank(recipe.start, seed, config, recipe.hidden)
        else:
            self.network = FilterBank(config.control_interval, recipe.hidden)
        width = len(self.network.mean)
        self.whitened: list[tuple[nn.Linear, _OfWhitened]] = []
        for layer in (self.network.linear, *self.network.layers):
            if recipe.whitened and isinstance(layer, nn.Linear) and layer.in_features == width:
                self.whitened.append((layer, _OfWhitened(width)))
                register_parametrization(layer, "weight", self.whitened[-1][1])
        self.expectation = Expectation() if recipe.imputes_failed_readings else None
        self.normaliser: CostNormaliser | None = None
        self.products, self.seen = (torch.zeros(size, dtype=torch.float64) for size in ((width, width), (1,)))
        weights = self.network.parameters()
        self.optimiser = torch.optim.Adam(weights, recipe.learning_rate, betas=(0.9, recipe.beta2))
        self.norms = torch.zeros(LAST_GRADIENTS)
        self.random = np.random.default_rng([seed, done])
        self.drives = drives_of(config.action, config.control_interval)
        self.v_p_scale = float(scales(MEASURED, config.parameters.v_0)[_V_P])
        self.weights = np.array(recipe.weights) / np.array(WEIGHTS)

    def learn(self, watch: Watch) -> None:
        """Make the updates that are left."""
        recipe, n = self.recipe, self.recipe.num_envs
        batch = self._crystals()
        measured = batch.reset(self._seeds(n))
        memory = torch.zeros(n, STATE)
        windows = self.config.steps // recipe.window
        left = self.random.integers(1, windows, n, endpoint=True)
        if recipe.normalise_cost:
            self.normaliser = CostNormaliser(batch, windows)
        while self.steps < self.total:
            progress = self.steps / self.total
            self.optimiser.param_groups[0]["lr"] = recipe.learning_rate * (1.0 - progress)
            window = self._drive(batch, measured, memory)
            self._follow(window, batch.measured_by_state)
            features = window.features.detach().flatten(0, 1)
            if progress < WARM_UP and not recipe.start:
                self._standardise(features)
            if recipe.whitened:
                self._whiten(features, progress)
            if self.expectation and progress >= WARM_UP:
                self.expectation.teach(self.network)
            measured, memory = window.measured, window.memory
            left -= 1
            over = np.flatnonzero(~batch.grows | (left == 0)).tolist()
            if over:
                measured = batch.reset(self._seeds(len(over)), over)
                memory[over] = 0.0
                left[over] = windows
                if self.normaliser:
                    self.normaliser.begin(over)
            self.steps += self.per_update
            watch(self.steps, "")
        batch.close()

    def _crystals(self) -> Crystals:
        """The training crystals: the recipe's scenario, and its mixture."""
        slots = self.recipe.num_envs
        others = []
        for name, width, share in self.recipe.mixture:
            scenario = widened(self.config.with_scenario(name or self.recipe.scenario).scenario, width)
            others.append((self.config.with_scenario(scenario), round(share * slots)))
        return Crystals([(self.config, slots - sum(many for _, many in others)), *others])

    def _drive(self, batch: Crystals, measured: Any, memory: torch.Tensor) -> Window:
        """Drive each crystal through a window."""
        features, costs, beyond, jacobians = [], [], [], []
        warm = self.steps >= WARM_UP * self.total
        expectation = None if warm and self.expectation and not self.expectation.seen else self.expectation
        with torch.no_grad():
            for _ in range(self.recipe.window):
                readings = torch.from_numpy(measured)
                if expectation:
                    expectation.see(memory, readings)
                seen, memory = self.network.remember(readings, memory)
                action = self.network.act(seen).numpy()
                step = self._weighed(batch.step(action))
                beyond.append(self._beyond(measured, action, step))
                features.append(seen)
                costs.append(step.cost)
                jacobians.append(step.jacobian)
                measured = step.measured
        return Window(torch.stack(features), np.stack(costs), np.stack(beyond), jacobians, measured, memory)

    def _weighed(self, step: Step) -> Step:
        """The step with the radius error's cost as the recipe counts it."""
        if not self.recipe.observable:
            return step
        error = np.where(step.grows, step.error + step.offset, 0.0)
        step.cost[:, _RADIUS] = cost_terms(error, 0.0, 0.0, 0.0).radius
        slope = cost_slopes(error, 0.0, 0.0, 0.0).radius
        step.jacobian[:, len(STATES) + _RADIUS] = slope[:, None] * step.jacobian[:, STATES.index("r_c")]
        return step

    def _beyond(self, measured: Any, action: Any, step: Step) -> Any:
        """The gradient of each action where a limit of the pull speed cuts its move off, shape (n,).

        The cost does not depend on the action there, so a policy that asks for more than the drive does would never
        learn to ask for less. The move that was asked for is charged instead.
        """
        deviation = measured[:, _V_P] * self.v_p_scale
        asked = (self.drives.keep - 1.0) * deviation + self.drives.pull * self.config.parameters.v_0 * action[:, 0]
        charged = cost_terms(0.0, 0.0, asked, 0.0).pull_step
        gain = cost_slopes(0.0, 0.0, asked, 0.0).pull_step * self.drives.pull * self.config.parameters.v_0
        return np.where(step.grows & (charged > 1.001 * step.cost[:, _PULL_STEP] + 1e-9), gain, 0.0)

    def _follow(self, window: Window, measured_by_state: Any) -> None:
        """Update the weights by the gradient of the window's cost, back through plant and memory step by step.

        The derivatives of actions by features are computed for AT_ONCE steps at a time.
        """
        cost = window.costs @ self.weights
        capped = saturated(cost)
        by_cost = saturated_slope(cost) / cost.size
        if self.normaliser:
            by_cost *= self.normaliser.weights(capped.mean(axis=0))
        steps, n = cost.shape
        rows, by_memory = np.zeros((n, len(STATES) + len(self.weights))), np.zeros((n, MEANS), np.float32)
        weights = list(self.network.parameters())
        self.optimiser.zero_grad()
        for first in reversed(range(0, steps, AT_ONCE)):
            features = window.features[first : first + AT_ONCE].requires_grad_()
            actions = self.network.act(features)
            pull, heater = (grad(actions[..., drive].sum(), features, retain_graph=True)[0].numpy() for drive in (0, 1))
            by_action = np.empty(actions.shape, np.float32)
            for k in reversed(range(len(actions))):
                rows[:, len(STATES) :] = by_cost[first + k, :, None] * self.weights
                back = np.einsum("ni,nij->nj", rows, window.jacobians[first + k])
                by_action[k] = back[:, len(STATES) :]
                by_action[k, :, 0] += by_cost[first + k] * self.weights[_PULL_STEP] * window.beyond[first + k]
                by_features = by_action[k, :, :1] * pull[k] + by_action[k, :, 1:] * heater[k]
                by_measured, by_memory = self.network.back(by_features, by_memory)
                rows[:, : len(STATES)] = back[:, : len(STATES)] + by_measured @ measured_by_state
            backward(actions, torch.from_numpy(by_action), inputs=weights)
        known = self.norms[self.norms > 0.0].numpy()
        limit = MOST_GRADIENT * float(np.median(known)) if known.size else math.inf
        norm = torch.nn.utils.clip_grad_norm_(weights, limit)
        if not norm.isfinite():
            return
        self.norms[1:], self.norms[0] = self.norms[:-1].clone(), norm
        self.optimiser.step()
        self.logger.record("gradient/cost", float(capped.mean()))
        self.logger.record("gradient/norm", float(norm))

    def _standardise(self, seen: torch.Tensor) -> None:
        """Update the running mean and standard deviation of the features; the first update sets them."""
        network = self.network
        share = 0.1 if bool(network.mean.any()) else 1.0
        network.mean += share * (seen.mean(dim=0) - network.mean)
        variance = network.per_std**-2.0
        variance += share * (seen.var(dim=0) - variance)
        network.per_std.copy_(1.0 / torch.clamp(variance.sqrt(), LEAST_STD, MOST_STD))

    def _whiten(self, features: torch.Tensor, progress: float) -> None:
        """Estimate the features' covariance; after the warm-up, change to weights of whitened features.

        The means' differences are strongly correlated, so that a step in one weight alone changes the action little.
        Features without gradient are not whitened. The policy stays the same, and the optimiser begins anew.
        """
        if progress < WARM_UP:
            x = self.network.normalised(features).double()
            self.products += x.T @ x
            self.seen += len(x)
        elif self.seen.any():
            covariance = (self.products / self.seen).numpy()[:-N_DETACHED, :-N_DETACHED]
            scaling = torch.eye(len(self.products))
            scaling[:-N_DETACHED, :-N_DETACHED] = torch.from_numpy(
                whitening(covariance + LEAST_VARIANCE * np.eye(len(covariance)))
            )
            for layer, inputs in self.whitened:
                weight = layer.weight.detach().clone()
                inputs.scaling.copy_(scaling)
                layer.weight = weight
            self.optimiser.state.clear()
            self.norms.zero_()
            self.products.zero_()
            self.seen.zero_()

    def _seeds(self, count: int) -> list[int]:
        return [int(seed) for seed in self.random.choice(len(TRAINING_SEEDS), count)]

    def parts(self) -> Parts:
        """Network, optimiser, the last gradients' norms, and the sums of the warm-up."""
        variables = {"norms": self.norms, "products": self.products, "seen": self.seen}
        if self.expectation:
            variables |= {"expectation": self.expectation.products, "expectation_ring": self.expectation.with_ring}
        return Parts({"network": self.network}, {"optimiser": self.optimiser}, variables)

    def exported(self) -> bytes:
        """The network with its memory."""
        return self.network.onnx()
