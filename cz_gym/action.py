"""Actions that know which environment they were made for, so that another one refuses them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.error import InvalidAction


class MadeFor(NamedTuple):
    """The environment that a controller or an agent was made for."""

    action: str
    """Mode of its actions: "direct", "smooth" or "rate" (:func:`cz_gym.body.task.drives_of`)."""
    control_interval: float
    """Time between its actions [s]."""
    plant: str
    """Hash of the plant (:attr:`cz_gym.config.Config.plant_hash`)."""
    puller: str = "default"
    """Name and hash of the puller file (:attr:`cz_gym.machine.puller.PullerFile.label`)."""

    def __str__(self) -> str:
        puller = "" if self.puller == "default" else f", puller {self.puller}"
        return f"action={self.action!r}, control_interval={self.control_interval:g}, plant {self.plant}{puller}"


class MarkedAction(np.ndarray[Any, np.dtype[Any]]):
    """An action, or one a row, that carries what it was made for; whatever is computed from it is a plain array."""

    made_for: MadeFor | None

    def __array_finalize__(self, other: Any) -> None:
        self.made_for = getattr(other, "made_for", None)

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return np.asarray(array)[()]


def mark(action: npt.NDArray[Any], made_for: MadeFor | None) -> npt.NDArray[Any]:
    """The same action, refused by every environment but the one it was made for; with None, taken by every one."""
    if made_for is None:
        return action
    marked = action.view(MarkedAction)
    marked.made_for = made_for
    return marked


def check_marked(action: MarkedAction, own: MadeFor) -> None:
    """Raise InvalidAction for an action that was made for another environment than ``own``."""
    if message := mismatch(action.made_for, own):
        raise InvalidAction(f"{message} (np.asarray(action) is taken all the same)")


def mismatch(made_for: MadeFor | None, own: MadeFor) -> str:
    """Differences between an environment and the one that a controller was made for; empty if there are none."""
    if made_for is None or made_for == own:
        return ""
    return (
        f"this controller or agent was made for {made_for}; the environment has {own}: "
        'gym.make("Cz-v0", **controller.settings) makes the one that it was made for'
    )
