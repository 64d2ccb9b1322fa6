"""An exported controller in the simulator: the recorded program, or its compiled form, as a policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.action import MadeFor, mark
from cz_gym.config import Config
from cz_gym.observation import decode
from cz_gym.physics.plant import make_puller
from cz_gym.units import KILO, MM_PER_MIN

from .program import Floats, Program
from .shell import in_plant_units

Run = Callable[[Mapping[str, Any], Any], tuple[dict[str, Floats], Any]]
"""Outputs and next memory for inputs and memory, as :meth:`cz_gym.export.program.Program.run`."""


class BlockState(NamedTuple):
    """What a block's policy remembers."""

    samples: npt.NDArray[np.int64]
    """Number of samples since the episode began, shape (n,)."""
    memory: Any
    outputs: Mapping[str, Floats]
    """Setpoints and alarm bits of the last sample, each of shape (n,)."""


@dataclass(frozen=True)
class BlockPolicy:
    """A controller in its shell, acting in the environment that it was exported for.

    The environment's readings are deviations from each crystal's own nominal values; the block gets them added to its
    nominal ones, so that every puller looks as if it had been calibrated.
    """

    observation: ClassVar[str] = "measured"
    action: ClassVar[str] = "direct"

    program: Program
    config: Config
    settings_changed: Mapping[str, float] = field(default_factory=dict)
    """Settings that differ from the program's defaults."""
    run: Run | None = None
    """What runs the block instead of the program's interpreter."""
    begin: Callable[[int], Any] | None = None
    """Makes the memory of n blocks for ``run``."""

    @property
    def made_for(self) -> MadeFor:
        """The environment that takes its actions."""
        return self.config.made_for._replace(action=self.action)

    @property
    def settings(self) -> dict[str, Any]:
        """Arguments of ``gym.make("Cz-v0", ...)``."""
        return {"observation": "measured", "action": "direct", "control_interval": self.config.control_interval}

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Actions and the next state; arguments as of every policy."""
        rows = np.atleast_2d(np.asarray(observation, np.float64))
        n = len(rows)
        begins = (
            np.ones(n, np.bool_)
            if state is None
            else np.broadcast_to(np.asarray(False if episode_start is None else episode_start), (n,))
        )
        if state is None or begins.any():
            state = self._begun(state, begins)
        inputs = self.inputs(rows, state.samples) | dict(self.settings_changed)
        outputs, memory = (self.run or self.program.run)(inputs, state.memory)
        action = self.action_of(outputs)
        marked = mark(action[0] if np.ndim(observation) == 1 else action, self.made_for)
        return marked, BlockState(state.samples + 1, memory, outputs)

    def _begun(self, state: Any, begins: npt.NDArray[np.bool_]) -> BlockState:
        n = len(begins)
        fresh = self.begin(n) if self.begin is not None else np.tile(self.program.start, (n, 1))
        if state is None:
            return BlockState(np.zeros(n, np.int64), fresh, {})
        memory = state.memory.copy()
        memory[begins] = fresh[begins]
        return BlockState(np.where(begins, 0, state.samples), memory, state.outputs)

    def inputs(self, rows: Any, samples: Any) -> dict[str, Any]:
        """The block's inputs for observations of shape (n, channels) at those samples of their episodes."""
        puller = make_puller(self.config.parameters, 0.5, self.config.meniscus)
        time = samples * self.config.control_interval
        readings = in_plant_units(decode(rows, *self.config.ranges), puller)
        return readings | {"time_s": time, "ring_time_s": time, "automatic": np.ones(len(rows))}

    def shares_of(self, outputs: Mapping[str, Any]) -> npt.NDArray[np.float64]:
        """The setpoints above nominal in shares of the drives' ranges, shape (n, 2)."""
        puller = make_puller(self.config.parameters, 0.5, self.config.meniscus)
        pull = outputs["pull_speed_setpoint_mm_per_min"] * MM_PER_MIN / puller.v_0 - 1.0
        heat = (outputs["heater_power_setpoint_kW"] * KILO - puller.Q_H_0) / self.config.heater_range
        return np.stack([pull, heat], axis=-1)

    def action_of(self, outputs: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        """The environment's action for the setpoints, shape (n, 2)."""
        action: npt.NDArray[np.float32] = np.clip(self.shares_of(outputs), -1.0, 1.0).astype(np.float32)
        return action
