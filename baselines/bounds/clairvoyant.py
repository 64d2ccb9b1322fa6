"""The lowest bound: the optimal trajectory for known parameters, state and future disturbances.

Its inputs are applied; the optimum's own feedback on the true state corrects what the plan does not contain: a heater
that moves in steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
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


class Memory(NamedTuple):
    """The memory of the clairvoyant."""

    step: Floats
    """Number of steps taken, shape (n,)."""
    correction: Floats
    """Last inputs minus the planned ones [m/s, W], shape (n, 2)."""


class Clairvoyant:
    """The bound before it knows any episode; :meth:`for_episodes` finds their optimal inputs."""

    hash = ""
    """Hash of its settings, of which there are none."""

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> "OptimalInputs":
        """The optimal inputs of each seed's first episode, one a slot; CzError names the seeds that have none."""
        future = future_of(config, seeds)
        limits = limits_of(config.sole_scenario.actuators, config.ranges, config.control_interval)
        best = optimise(future, limits)
        if not best.converged.all():
            lost = ", ".join(str(seed) for seed, reached in zip(seeds, best.converged, strict=True) if not reached)
            raise CzError(
                f"clairvoyant is no bound on {config.scenario.name!r}: after {MOST_STEPS} Newton steps the optimum of "
                f"seed {lost} was not reached (last move {best.last_move.max():.1g}, at most {TOLERANCE:g} is allowed)"
            )
        p = future.puller
        state_0, inputs_0 = (np.stack(np.broadcast_arrays(*values), axis=-1) for values in (p.state_0, p.inputs_0))
        return OptimalInputs(best, state_0, inputs_0, np.array(config.ranges), config.made_for)


@dataclass(frozen=True)
class OptimalInputs:
    """The policy that applies the optimal inputs of known episodes, one a slot, on "state" observations."""

    best: Trajectory
    state_0: Floats
    """Each puller's operating point, shape (n, 5)."""
    inputs_0: Floats
    """Inputs at the operating point, shape (n, 2)."""
    ranges: Floats
    """What an action of 1 moves pull speed [m/s] and heater power [W] by."""
    made_for: MadeFor

    def predict(
        self, observation: Any, state: Memory | None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Memory]:
        """Return the action and the next memory; arguments as of :class:`cz_gym.baselines.policy.Policy`."""
        array, single = batched(observation)
        n, best = len(array), self.best
        if n != len(self.inputs_0):
            raise CzError(f"clairvoyant has a plan for {len(self.inputs_0)} episodes, not {n}")
        memory = fresh(state, Memory(np.zeros(n), np.zeros((n, INPUTS))), episode_start)
        k, slot = np.minimum(memory.step.astype(int), len(best.u) - 1), np.arange(n)
        seen = array * scales(STATE, *self.ranges)
        x = seen[:, [_CHANNELS.index(name) for name in _X]] + self.state_0
        x[:, 0] += seen[:, _CHANNELS.index("r_ref")]
        deviation = np.concatenate([x - best.x[k, slot], memory.correction], axis=-1)
        correction = memory.correction + (best.feedback[k, slot] @ deviation[:, :, None])[:, :, 0]
        pull, power = ((best.u[k, slot] + correction - self.inputs_0) / self.ranges).T
        return mark(to_action(pull, power, single), self.made_for), Memory(memory.step + 1.0, correction)
