"""Back-propagation through time over a window of steps, written out: the gradient of the mean cost by the weights.

Forward, :class:`Window` runs the policy without autograd and keeps what the way back needs; backward, one loop takes
the derivative of the cost from the last step to the first, through plant, means and gated recurrent unit. Autograd
gives the same numbers at a higher price: a step is a hundred small operations, each of which it records. Arrays of the
policy are (features, crystals), so that gates are blocks of memory.
"""

from typing import Any

import torch
from torch import Tensor

from cz_gym.engine.tangents import DifferentiableBatch, Step, smooth


class Window:
    """Policy, plant and cost of ``steps`` steps of n crystals."""

    def __init__(self, policy: Any, cost: Any, batch: DifferentiableBatch, steps: int) -> None:
        n = batch.num_envs
        self.policy, self.cost, self.batch, self.steps, self.k = policy, cost, batch, steps, 0
        self.channels, self.width = len(batch.config.process.measured), policy.differences.shape[1]
        self.units, hidden = policy.gru.hidden_size, policy.layer.out_features
        units, new, self.radius = self.units, torch.empty, smooth(batch.config.process).index("r_c")
        self.shown = new(self.channels + policy.means, n)
        """Readings and means of the present step."""
        self.y = new(steps + 1, self.width + units, n)
        """Standardised features of each step above the hidden state after it; the last row is the step before."""
        self.gates, self.hidden_gates = new(steps, 3 * units, n), new(steps, 3 * units, n)
        """Reset gate, update gate, candidate; and what the hidden state adds to each before it is bent."""
        self.tanh, self.action = new(steps, hidden, n), new(steps, 2, n)
        self.states = torch.empty(steps + 1, n, len(smooth(batch.config.process)), dtype=torch.float64)
        self.target, self.grows = torch.empty(steps, n, dtype=torch.float64), torch.empty(steps, n, dtype=torch.bool)
        self.jacobian: list[Tensor] = []
        self.measured_by_state: list[Tensor] = []

    def begin(self, state: Tensor, memory: Tensor) -> None:
        """Begin a window at a state and a memory, shape (n, means + units); weights are those of now."""
        policy, self.k = self.policy, 0
        std = policy.usable_std
        self.by_shown, self.zero = (policy.differences / std).T.contiguous(), (policy.mean / std)[:, None]
        self.keep, self.gain, self.gains = policy.keep[:, None], policy.gain.T.contiguous(), policy.gains[:, None]
        self.shown[self.channels :] = memory[:, : policy.means].T
        self.y[-1, self.width :] = memory[:, policy.means :].T
        self.states[0] = state
        self.jacobian.clear()
        self.measured_by_state.clear()

    @torch.no_grad()
    def act(self, measured: Tensor) -> Tensor:
        """Action, shape (n, 2), unclipped, after a reading, shape (n, channels)."""
        policy, gru, k, units = self.policy, self.policy.gru, self.k, self.units
        readings, means = self.shown[: self.channels], self.shown[self.channels :]
        readings.copy_(measured.T)
        means.mul_(self.keep).addmm_(self.gain, readings)
        y, h = self.y[k], self.y[k - 1, self.width :]
        x, after = y[: self.width], y[self.width :]
        torch.mm(self.by_shown, self.shown, out=x).sub_(self.zero).clamp_(-policy.feature_limit, policy.feature_limit)
        gates = torch.mm(gru.weight_ih, x, out=self.gates[k]).add_(gru.bias_ih[:, None])
        by_hidden = torch.mm(gru.weight_hh, h, out=self.hidden_gates[k]).add_(gru.bias_hh[:, None])
        gates[: 2 * units].add_(by_hidden[: 2 * units]).sigmoid_()
        candidate = gates[2 * units :].addcmul_(gates[:units], by_hidden[2 * units :]).tanh_()
        torch.lerp(candidate, h, gates[units : 2 * units], out=after)
        tanh = torch.mm(policy.layer.weight, y, out=self.tanh[k]).add_(policy.layer.bias[:, None]).tanh_()
        action = torch.mm(policy.linear.weight, y, out=self.action[k]).add_(policy.linear.bias[:, None])
        moves: Tensor = action.addmm_(policy.output.weight, tanh).mul_(self.gains).T
        return moves

    def record(self, step: Step) -> None:
        """Keep a step of the plant that followed the last action."""
        k, states = self.k, self.states.shape[2]
        self.states[k + 1] = torch.from_numpy(step.state)
        self.target[k] = torch.from_numpy(step.state[:, self.radius] - step.error - step.offset)
        self.grows[k] = torch.from_numpy(step.grows)
        self.jacobian.append(torch.from_numpy(step.jacobian[:, :states]))
        self.measured_by_state.append(torch.from_numpy(self.batch.measured_by_state))
        self.k += 1

    @property
    def features(self) -> Tensor:
        """Features of the present step, shape (n, features), as they are before they are standardised."""
        return torch.mm(self.shown.T, self.policy.differences)

    @property
    def memory(self) -> Tensor:
        """Memory after the last step, shape (n, means + units)."""
        return torch.cat([self.shown[self.channels :], self.y[self.k - 1, self.width :]]).T.contiguous()

    def backward(self) -> float:
        """Return the window's mean cost, and write its derivatives into the parameters' ``grad``."""
        action = self.action.transpose(1, 2).contiguous()
        leaves = [part.detach().requires_grad_() for part in (self.states[:-1], action, self.states[1:], self.target)]
        before, action, after, target = (part.flatten(0, 1) for part in leaves)
        loss = self.cost(before, action, after, self.grows.flatten(), target).mean()
        by_before, by_action, by_after, by_target = torch.autograd.grad(loss, leaves)
        with torch.no_grad():
            self._back(by_before, by_action.float().transpose(1, 2).contiguous(), by_after, by_target)
        return float(loss.detach())

    def _back(self, by_before: Tensor, by_action: Tensor, by_after: Tensor, by_target: Tensor) -> None:
        """Take the derivatives of the cost by each step's own numbers back to the weights."""
        policy, gru, process, units = self.policy, self.policy.gru, self.batch.config.process, self.units
        reference = process.Measured._fields.index("r_ref")
        scale, states, n = process.measured[reference].scale, self.states.shape[2], self.shown.shape[1]
        new, limit, width = torch.empty, policy.feature_limit, self.width
        d_gates, d_recalled, d_layer = new(3 * units, n), new(units, n), new(self.tanh.shape[1], n)
        d_y, slope, d_both = new(self.y.shape[1], n), new(units, n), new(self.shown.shape)
        d_state, d_now, d_means = torch.zeros(n, states, dtype=torch.float64), torch.zeros(units, n), torch.zeros(())
        d_shown, through = torch.zeros(n, self.channels, dtype=torch.float64), new(n, states, states + 2).double()
        one, parameters = torch.ones(()), [*policy.parameters()]
        for parameter in parameters:
            parameter.grad = torch.zeros_like(parameter)
        by = {name: parameter.grad for name, parameter in policy.named_parameters()}
        W_i, W_h, W_layer, W_linear, W_output = (
            weight.T.contiguous()
            for weight in (
                gru.weight_ih, gru.weight_hh, policy.layer.weight, policy.linear.weight, policy.output.weight,
            )
        )  # fmt: skip
        for k in reversed(range(self.steps)):
            d_shown[:, reference] += scale * by_target[k]
            by_state = self.measured_by_state[k]
            d_state += by_after[k]
            d_state += d_shown @ by_state if by_state.ndim == 2 else (d_shown[:, None] @ by_state)[:, 0]
            back = torch.mul(self.jacobian[k], d_state[:, :, None], out=through).sum(dim=1)
            torch.add(back[:, :states], by_before[k], out=d_state)
            d_out = back[:, states:].T.float().add_(by_action[k]).mul_(self.gains)
            tanh, gates, y, h = self.tanh[k], self.gates[k], self.y[k], self.y[k - 1, width:]
            reset, update, candidate = gates[:units], gates[units : 2 * units], gates[2 * units :]
            torch.mm(W_output, d_out, out=d_layer).mul_(torch.addcmul(one, tanh, tanh, value=-1.0))
            torch.mm(W_layer, d_layer, out=d_y).addmm_(W_linear, d_out)
            d_now += d_y[width:]
            d_reset, d_update, d_candidate = d_gates[:units], d_gates[units : 2 * units], d_gates[2 * units :]
            torch.addcmul(d_now, d_now, update, value=-1.0, out=d_candidate)
            d_candidate.mul_(torch.addcmul(one, candidate, candidate, value=-1.0, out=slope))
            torch.sub(h, candidate, out=d_update).mul_(d_now).mul_(torch.addcmul(update, update, update, value=-1.0))
            torch.mul(d_candidate, reset, out=d_recalled)
            torch.mul(d_recalled, self.hidden_gates[k, 2 * units :], out=d_reset).mul_(torch.sub(one, reset, out=slope))
            x = y[:width]
            by["gru.weight_ih"].addmm_(d_gates, x.T)
            by["gru.weight_hh"][: 2 * units].addmm_(d_gates[: 2 * units], h.T)
            by["gru.weight_hh"][2 * units :].addmm_(d_recalled, h.T)
            by["gru.bias_ih"].add_(d_gates.sum(1))
            by["gru.bias_hh"][2 * units :].add_(d_recalled.sum(1))
            by["layer.weight"].addmm_(d_layer, y.T)
            by["layer.bias"].add_(d_layer.sum(1))
            by["linear.weight"].addmm_(d_out, y.T)
            by["linear.bias"].add_(d_out.sum(1))
            by["output.weight"].addmm_(d_out, tanh.T)
            d_now.mul_(update).addmm_(W_h[:, : 2 * units], d_gates[: 2 * units]).addmm_(W_h[:, 2 * units :], d_recalled)
            d_x = d_y[:width].addmm_(W_i, d_gates).mul_(x.abs() < limit)
            torch.mm(self.by_shown.T, d_x, out=d_both)
            d_means = d_both[self.channels :] + d_means
            d_shown.copy_(d_both[: self.channels].addmm_(self.gain.T, d_means).T)
            d_means *= self.keep
        by["gru.bias_hh"][: 2 * units] = by["gru.bias_ih"][: 2 * units]
