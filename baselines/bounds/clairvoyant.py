"""The lowest bound: the optimal trajectory for known parameters, state and future disturbances.

The trajectory is optimised before the episode, for the reward's own cost (:mod:`cz_gym.baselines.bounds.trajectory`).
During the episode its inputs are applied. The optimum's own feedback on the true state corrects what the plan does not
contain: a heater that moves in steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.action import MadeFor, mark
from cz_gym.baselines.policy import Floats, batched, fresh, to_action
from cz_gym.config import Config
from cz_gym.errors import CzError
from cz_gym.observation import STATE, scales

from .future import future_of
from .trajectory import INPUTS, MOST_STEPS, TOLERANCE, Trajectory, limits_of, optimise

_CHANNELS = tuple(channel.name for channel in STATE)
_X = ("r_c_error", "h_c", "T_1", "T_2", "T_b")


class Plan(NamedTuple):
    """The optima of the slots."""

    best: Trajectory
    state_0: Floats
    """Each puller's operating point, shape (n, 5)."""
    inputs_0: Floats
    """Inputs at the operating point, shape (n, 2)."""
    ranges: tuple[float, float]
    """What an action of 1 moves pull speed [m/s] and heater power [W] by."""
    made_for: MadeFor


class Memory(NamedTuple):
    """The memory of the clairvoyant."""

    step: Floats
    """Number of steps taken, shape (n,)."""
    correction: Floats
    """Last inputs minus the planned ones [m/s, W], shape (n, 2)."""


@dataclass(frozen=True)
class Clairvoyant:
    """The optimal inputs of each slot's episode, on "state" observations; :meth:`for_episodes` makes the plan."""

    plan: Plan | None = field(default=None, compare=False, repr=False)

    @property
    def hash(self) -> str:
        """Hash of its settings, of which there are none."""
        return ""

    @property
    def made_for(self) -> MadeFor | None:
        """The environment of the plan; None without a plan."""
        return self.plan and self.plan.made_for

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> Clairvoyant:
        """The clairvoyant of those episodes, one a slot; CzError if the optimum of one was not reached."""
        return Clairvoyant(make_plan(config, seeds))

    def predict(
        self, observation: Any, state: Memory | None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Memory]:
        """Return the action and the next memory; arguments as of :class:`cz_gym.baselines.policy.Policy`."""
        if self.plan is None:
            raise RuntimeError("clairvoyant has no plan: call for_episodes(config, seeds) first, as a rollout does")
        array, single = batched(observation)
        n, best, inputs_0 = len(array), self.plan.best, self.plan.inputs_0
        if n != len(inputs_0):
            raise CzError(f"clairvoyant has a plan for {len(inputs_0)} episodes, not {n}")
        memory = fresh(state, Memory(np.zeros(n), np.zeros((n, INPUTS))), episode_start)
        k, slot = np.minimum(memory.step.astype(int), len(best.u) - 1), np.arange(n)
        seen = array * scales(STATE, *self.plan.ranges)
        x = seen[:, [_CHANNELS.index(name) for name in _X]] + self.plan.state_0
        x[:, 0] += seen[:, _CHANNELS.index("r_ref")]
        deviation = np.concatenate([x - best.x[k, slot], memory.correction], axis=-1)
        correction = memory.correction + (best.feedback[k, slot] @ deviation[:, :, None])[:, :, 0]
        inputs = best.u[k, slot] + correction - inputs_0
        pull, power = (inputs / np.array(self.plan.ranges)).T
        action = to_action(pull, power, single)
        return mark(action, self.made_for), Memory(memory.step + 1.0, correction)


def make_plan(config: Config, seeds: Sequence[int]) -> Plan:
    """Optimise the first episode of each seed; CzError names those whose optimum was not reached."""
    future = future_of(config, seeds)
    limits = limits_of(config.sole_scenario.actuators, config.ranges, config.control_interval)
    best = optimise(future, limits)
    if not best.converged.all():
        lost = ", ".join(str(seed) for seed, reached in zip(seeds, best.converged, strict=True) if not reached)
        raise CzError(
            f"clairvoyant is no bound on {config.scenario.name!r}: after {MOST_STEPS} Newton steps the optimum of seed "
            f"{lost} was not reached (last move {best.last_move.max():.1g}, at most {TOLERANCE:g} is allowed)"
        )
    state_0, inputs_0 = (
        np.stack(np.broadcast_arrays(*values), axis=-1) for values in (future.puller.state_0, future.puller.inputs_0)
    )
    return Plan(best, state_0, inputs_0, config.ranges, config.made_for)
