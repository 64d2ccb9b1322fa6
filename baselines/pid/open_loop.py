"""No control: nominal pull speed and heater power."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import batched, to_action


@dataclass(frozen=True)
class OpenLoop:
    """The nominal inputs at every sample: the plant without feedback."""

    made_for: ClassVar[None] = None

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Zero action of the batch's shape."""
        array, single = batched(observation)
        zero = np.zeros(len(array))
        return to_action(zero, zero, single), state
