"""A step of the batch as a function that torch differentiates, for networks of any shape."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from cz_gym.differentiable import STATES, DifferentiableBatch


class PlantStep(torch.autograd.Function):
    """State, measured and cost from state and action: ``PlantStep.apply(state, action, batch)``.

    The batch advances by a step; the state passed in only says which state the gradients belong to.
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
