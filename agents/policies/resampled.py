"""An agent at another control interval than the one it was trained at.

The channels of "history" are defined in time, so an agent can read them at any interval, means over at least one
sample. What it asks for is a move of the drives within its own interval; so within a shorter one it makes that share
of it: action = applied + (interval / trained) (asked - applied). Whole moves would drive so much too fast. Within a
longer one it makes the move half way between the one asked for and one in proportion: a fast loop that waits longer
between two looks has little margin for larger moves. This is an override: the contract's interval stays what the agent
was trained and picked at.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.observation import DRIVE_CHANNELS

from .onnx import OnnxPolicy


@dataclass(frozen=True)
class Resampled:
    """An agent whose moves are shortened or stretched to another control interval."""

    policy: OnnxPolicy
    share: float
    """Of the move asked for that is made [-]; more than 1 at a longer interval."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Actions as :meth:`.onnx.OnnxPolicy.predict`, each move the share of the one asked for, within the box."""
        asked, state = self.policy.predict(observation, state, episode_start, deterministic)
        applied = np.asarray(observation, np.float32)[..., list(DRIVE_CHANNELS)]
        moved = applied + np.float32(self.share) * (asked - applied)
        return np.clip(moved, -1.0, 1.0), state


def at_interval(policy: OnnxPolicy, control_interval: float) -> OnnxPolicy | Resampled:
    """The agent itself at its own control interval [s], its moves shortened or stretched at another one.

    ValueError for an agent that remembers: what a sample does to its memory belongs to its interval.
    """
    share = control_interval / policy.contract.control_interval
    if policy.remembers and share != 1.0:
        raise ValueError(f"an agent with a memory runs at its own {policy.contract.control_interval:g} s alone")
    return policy if share == 1.0 else Resampled(policy, min(share, (1.0 + share) / 2.0))
