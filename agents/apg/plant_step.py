"""A step of the batch as a function that torch differentiates, for networks of any shape, and the cost of a step."""

from typing import Any

import torch

from cz_gym.action import drives_of
from cz_gym.body.cost import Cost, cost_terms, saturated
from cz_gym.config import Config
from cz_gym.differentiable import DifferentiableBatch
from cz_gym.engine.tangents import smooth


def advance(state: torch.Tensor, action: torch.Tensor, batch: DifferentiableBatch) -> Any:
    """State and "measured", as of Cz-v0 of shapes (n, 10) and (n, 12), after an action (n, 2), whether each crystal
    grew, and its target.

    ``state`` is the batch's present one; gradients go back through it to the step before. The target (n,) is the radius
    at which sensors would show no error [m]: the reference less the bright ring's offset, which no sensor shows; it
    depends on the state where the reference runs with the length.
    """
    return _PlantStep.apply(state, action, batch)  # type: ignore[no-untyped-call]


class _PlantStep(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, state: torch.Tensor, action: torch.Tensor, batch: DifferentiableBatch) -> Any:
        step, process = batch.step(action.numpy()), batch.config.process
        ctx.jacobian, ctx.measured_by_state = step.jacobian[:, : step.state.shape[1]], batch.measured_by_state
        ctx.reference = process.Measured._fields.index("r_ref")
        ctx.scale = process.measured[ctx.reference].scale
        radius = step.state[:, smooth(process).index("r_c")]
        grows, target = torch.from_numpy(step.grows), torch.from_numpy(radius - step.error - step.offset)
        ctx.mark_non_differentiable(grows)
        return torch.from_numpy(step.state), torch.from_numpy(step.measured), grows, target

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> Any:
        by_state, by_measured, _, by_target = gradients
        by_shown = by_measured.double()
        by_shown[:, ctx.reference] += ctx.scale * by_target
        rows = by_state + (by_shown[:, None] @ torch.from_numpy(ctx.measured_by_state))[:, 0]
        back, states = torch.einsum("ni,nij->nj", rows, torch.from_numpy(ctx.jacobian)), rows.shape[1]
        return back[:, :states], back[:, states:].float(), None


class StepCost:
    """The cost of a step that APG follows: the reward's, but for moves that a limit of the drive cuts off.

    The pull step is the one that the action asks for, against the recipe's: the one that is taken no longer depends on
    the action there, and a policy that asks for more than the drive does would never learn to ask for less.
    """

    def __init__(self, config: Config) -> None:
        self.weights, names = config.weights, smooth(config.process)
        self.drives, self.v_0 = drives_of(config.action, config.control_interval), config.parameters.v_0
        self.r_c, self.v_p, self.Q_H, self.mean = (names.index(each) for each in ("r_c", "v_p", "Q_H", "v_p_mean"))
        self.nominal = names.index("v_p_nominal") if config.process.nominal_moves else None

    def __call__(
        self, before: torch.Tensor, action: torch.Tensor, after: torch.Tensor, grows: torch.Tensor, target: torch.Tensor
    ) -> torch.Tensor:
        """The saturated sum of the four terms, shape (n,), from the states before and after; 0 if it does not grow."""
        # Where the nominal speed moves, the mean is of deviations from it.
        nominal, rest = (self.v_0, 1.0) if self.nominal is None else (before[:, self.nominal], 0.0)
        asked = (self.drives.keep - 1.0) * (before[:, self.v_p] - nominal) + self.drives.pull * self.v_0 * action[:, 0]
        error, heater_step = after[:, self.r_c] - target, after[:, self.Q_H] - before[:, self.Q_H]
        terms = cost_terms(Cost(error, after[:, self.mean] / self.v_0 - rest, asked, heater_step), self.weights)
        return torch.where(grows, saturated(sum(terms)), 0.0)
