"""An exported controller in the simulator: a block, in Python or in another language, as a policy."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from cz_gym.action import MadeFor, mark
from cz_gym.observation import decode
from cz_gym.support.nested import select

from .ports import in_plant_units, in_shares, nominal_puller
from .shell import Block
from .trace import Floats


class Runner(Protocol):
    """What runs n blocks: :class:`Block`, or its compiled form."""

    def start(self, n: int) -> Any:
        """The memory of n blocks before their first sample."""

    def run(self, inputs: Mapping[str, Any], memory: Any) -> tuple[dict[str, Floats], Any]:
        """The outputs, each of shape (n,), and the next memory."""


class BlockState(NamedTuple):
    """What a block's policy remembers."""

    samples: npt.NDArray[np.int64]
    """Number of samples since the episode began, shape (n,)."""
    memory: Any
    outputs: Mapping[str, Floats]
    """Setpoints and alarm bits of the last sample, each of shape (n,)."""


@dataclass(frozen=True)
class BlockPolicy:
    """A block that acts in the environment that it was exported for.

    The environment's readings are deviations from each crystal's own nominal values; the block gets them added to its
    nominal ones, so that every puller looks as if it had been calibrated.
    """

    observation: ClassVar[str] = "measured"
    action: ClassVar[str] = "direct"

    block: Block
    runner: Runner | None = None
    """What runs it in place of Python."""
    interval: float | None = None
    """Control interval of the environment, if it is another one than the block's [s]."""

    @property
    def made_for(self) -> MadeFor:
        """The environment that takes its actions."""
        made_for = self.block.config.made_for
        return made_for._replace(action=self.action, control_interval=self.interval or made_for.control_interval)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Actions and the next state; arguments as of every policy."""
        rows = np.atleast_2d(np.asarray(observation, np.float64))
        n, runner = len(rows), self.runner or self.block
        if state is None:
            state = BlockState(np.zeros(n, np.int64), runner.start(n), {})
        elif episode_start is not None and np.any(episode_start):
            samples, memory = select(np.asarray(episode_start), (0 * state.samples, runner.start(n)), state[:2])
            state = BlockState(samples, memory, state.outputs)
        outputs, memory = runner.run(self.inputs(rows, state.samples), state.memory)
        action = self.action_of(outputs)
        marked = mark(action[0] if np.ndim(observation) == 1 else action, self.made_for)
        return marked, BlockState(state.samples + 1, memory, outputs)

    def inputs(self, rows: Any, samples: Any) -> dict[str, Any]:
        """The block's inputs for observations of shape (n, channels) at those samples of their episodes."""
        config = self.block.config
        time = samples * (self.interval or config.control_interval)
        readings = in_plant_units(decode(rows, *config.ranges), nominal_puller(config))
        return readings | {"time_s": time, "ring_time_s": time, "automatic": 1.0}

    def action_of(self, outputs: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        """The environment's action for the setpoints, shape (n, 2)."""
        action: npt.NDArray[np.float32] = np.clip(in_shares(outputs, self.block.config), -1.0, 1.0).astype(np.float32)
        return action
