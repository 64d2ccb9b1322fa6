"""The bound that nothing can beat: true state, parameters and every future disturbance are known.

Before an episode the whole trajectory is optimised for the reward's own cost
(:mod:`cz_gym.baselines.bounds.trajectory`). During it the optimal inputs are played. The optimum's own feedback on the
true state corrects what the plan cannot know: a heater that moves in steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats, batched, fresh, to_action
from cz_gym.config import Config
from cz_gym.errors import CzError
from cz_gym.observation import HEATER_SCALE, STATE, scales

from .future import future_of
from .trajectory import INPUTS, Trajectory, limits_of, optimise, predicted_cost

_CHANNELS = tuple(channel.name for channel in STATE)
_X = ("r_c_error", "h_c", "T_1", "T_2", "T_b")


class Plan(NamedTuple):
    """What the clairvoyant knows of its slots."""

    best: Trajectory
    state_0: Floats
    """Each puller's operating point, shape (n, 5)."""
    inputs_0: Floats
    """Its inputs, shape (n, 2)."""
    cost: Floats
    """The objective at the optimum, summed over the episode, shape (n,)."""


class Memory(NamedTuple):
    """What it remembers."""

    step: Floats
    """Steps taken, shape (n,)."""
    correction: Floats
    """Last inputs less the planned ones [m/s, W], shape (n, 2)."""


@dataclass(frozen=True)
class Clairvoyant:
    """Plays the optimum of each slot's episode, on "state" observations; :meth:`for_episodes` makes the plan."""

    plan: Plan | None = field(default=None, compare=False, repr=False)

    @property
    def hash(self) -> str:
        """Hash of its settings: it has none, and its constants are part of the code."""
        return ""

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> Clairvoyant:
        """The same for those episodes, one a slot."""
        return Clairvoyant(make_plan(config, seeds))

    def predict(
        self, observation: Any, state: Memory | None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Memory]:
        """The action and what to remember."""
        if self.plan is None:
            raise RuntimeError("clairvoyant has no plan: call for_episodes(config, seeds) first, as a rollout does")
        array, single = batched(observation)
        n, best, inputs_0 = len(array), self.plan.best, self.plan.inputs_0
        if n != len(inputs_0):
            raise CzError(f"clairvoyant has a plan for {len(inputs_0)} episodes, not {n}")
        memory = fresh(state, Memory(np.zeros(n), np.zeros((n, INPUTS))), episode_start)
        k, slot = np.minimum(memory.step.astype(int), len(best.u) - 1), np.arange(n)
        seen = array * scales(STATE, float(inputs_0[0, 0]))
        x = seen[:, [_CHANNELS.index(name) for name in _X]] + self.plan.state_0
        x[:, 0] += seen[:, _CHANNELS.index("r_ref")]
        deviation = np.concatenate([x - best.x[k, slot], memory.correction], axis=-1)
        correction = memory.correction + (best.feedback[k, slot] @ deviation[:, :, None])[:, :, 0]
        inputs = best.u[k, slot] + correction - inputs_0
        action = to_action(inputs[:, 0] / inputs_0[:, 0], inputs[:, 1] / HEATER_SCALE, single)
        return action, Memory(memory.step + 1.0, correction)


def make_plan(config: Config, seeds: Sequence[int]) -> Plan:
    """Optimise the first episodes that those seeds draw."""
    future = future_of(config, seeds)
    limits = limits_of(config.scenario.actuators, config.parameters.v_0, config.control_interval)
    best = optimise(future, limits)
    state_0, inputs_0 = (
        np.stack(np.broadcast_arrays(*values), axis=-1) for values in (future.puller.state_0, future.puller.inputs_0)
    )
    return Plan(best, state_0, inputs_0, predicted_cost(future, best))
