"""A step of the batch as a function that torch differentiates, for networks of any shape, and the cost of a step."""

from typing import Any

import torch

from cz_gym.action import drives_of
from cz_gym.body.cost import Cost, cost_terms, saturated
from cz_gym.config import Config
from cz_gym.differentiable import STATES, DifferentiableBatch

R_C, V_P, Q_H, V_P_MEAN = (STATES.index(name) for name in ("r_c", "v_p", "Q_H", "v_p_mean"))


def advance(state: torch.Tensor, action: torch.Tensor, batch: DifferentiableBatch) -> Any:
    """State (n, 10) and "measured" (n, 12) after an action (n, 2), whether each crystal grew, and its target.

    ``state`` is the batch's present one; gradients go back through it to the step before. The target (n,) is the radius
    at which sensors would show no error [m]: the reference less the bright ring's offset, which no sensor shows.
    """
    return _PlantStep.apply(state, action, batch)  # type: ignore[no-untyped-call]


class _PlantStep(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, state: torch.Tensor, action: torch.Tensor, batch: DifferentiableBatch) -> Any:
        step = batch.step(action.numpy())
        ctx.jacobian, ctx.measured_by_state = step.jacobian[:, : len(STATES)], batch.measured_by_state
        grows, target = torch.from_numpy(step.grows), torch.from_numpy(step.state[:, R_C] - step.error - step.offset)
        ctx.mark_non_differentiable(grows, target)
        return torch.from_numpy(step.state), torch.from_numpy(step.measured), grows, target

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> Any:
        by_state, by_measured, *_ = gradients
        rows = by_state + by_measured.double() @ torch.from_numpy(ctx.measured_by_state)
        back = torch.einsum("ni,nij->nj", rows, torch.from_numpy(ctx.jacobian))
        return back[:, : len(STATES)], back[:, len(STATES) :].float(), None


class StepCost:
    """The cost of a step that APG follows: the reward's, but for moves that a limit of the drive cuts off.

    The pull step is the one that the action asks for: the one that is taken no longer depends on the action there, and
    a policy that asks for more than the drive does would never learn to ask for less.
    """

    def __init__(self, config: Config) -> None:
        self.weights = config.weights
        self.drives, self.v_0 = drives_of(config.action, config.control_interval), config.parameters.v_0

    def __call__(
        self, before: torch.Tensor, action: torch.Tensor, after: torch.Tensor, grows: torch.Tensor, target: torch.Tensor
    ) -> torch.Tensor:
        """The saturated sum of the four terms, shape (n,), from the states before and after; 0 if it does not grow."""
        asked = (self.drives.keep - 1.0) * (before[:, V_P] - self.v_0) + self.drives.pull * self.v_0 * action[:, 0]
        error, heater_step = after[:, R_C] - target, after[:, Q_H] - before[:, Q_H]
        terms = cost_terms(Cost(error, after[:, V_P_MEAN] / self.v_0 - 1.0, asked, heater_step), self.weights)
        return torch.where(grows, saturated(sum(terms)), 0.0)
