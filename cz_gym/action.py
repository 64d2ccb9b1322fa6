"""An agent's action knows which environment it is for, so that another one does not take it in silence."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.error import InvalidAction

from .config import Config


class AgentAction(np.ndarray[Any, np.dtype[np.float32]]):
    """An action, or a row of some, as an agent gave it; what is computed from it is a plain array."""

    made_for: tuple[str, float] | None
    """What it means ("direct", "smooth" or "rate") and the time between actions [s]."""

    def __array_finalize__(self, other: Any) -> None:
        self.made_for = getattr(other, "made_for", None)

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return np.asarray(array)[()]


def made_for(action: npt.NDArray[np.float32], kind: str, control_interval: float) -> AgentAction:
    """The same action for environments of that kind of actions and that control interval [s] only."""
    marked = action.view(AgentAction)
    marked.made_for = kind, control_interval
    return marked


def check_made_for(action: AgentAction, config: Config) -> None:
    """InvalidAction for an agent's action that is meant for another environment than one of these settings."""
    made = action.made_for
    if made is not None and made != (config.action, config.control_interval):
        raise InvalidAction(
            f"this agent is made for action={made[0]!r}, control_interval={made[1]:g}; the environment has "
            f'{config.action!r}, {config.control_interval:g}: gym.make("Cz-v0", **agent.settings) makes the agent\'s '
            "(np.asarray(action) passes nevertheless)"
        )
