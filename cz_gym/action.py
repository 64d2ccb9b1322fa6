"""Actions: how they move the drives, and marked ones that every environment but their own refuses."""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.error import InvalidAction

from cz_gym.process import HEATER_SCALE, PULL_SCALE

HEATER_RANGE = HEATER_SCALE
"""Range of the default puller's heater drive [W]: Q_H = Q_H0 +- HEATER_RANGE."""
HEATER_SLACK = 0.6
"""Difference between commanded and applied power that is due to the heater's resolution, in units of it [-]."""
SMOOTH_TIME = 50.0
"""Time constant with which ``action="smooth"`` moves both drives [s]."""
SMOOTH_PULL, SMOOTH_HEATER = 1.0, 0.5
"""Drive deviations that a held smooth action of 1 settles at, in shares of v_0 and of the heater's range [-]."""


class Drives(NamedTuple):
    """How an action moves the drives, in shares of v_0 and of the heater's range: keep * applied + gain * action."""

    keep: float
    """Share of the present deviation that is left after one step [-]."""
    pull: float
    """Gain from the action to the pull speed [-]."""
    heater: float
    """Gain from the action to the heater power [-]."""
    speed: float = PULL_SCALE
    """Range of the pull's drive [m/s]."""
    power: float = HEATER_RANGE
    """Range of the heater's drive [W]."""

    def asked(self, wanted: Any, applied: Any) -> Any:
        """The action that moves the drives from ``applied`` to ``wanted``, shape (..., 2), in shares of their ranges.

        It may lie outside the box of actions.
        """
        return (wanted - self.keep * applied) / np.array([self.pull, self.heater])


DIRECT = Drives(0.0, 1.0, 1.0)
"""The drives of ``action="direct"``: the action is their deviation from nominal."""
ACTIONS = ("direct", "smooth", "rate")
"""The action modes."""


def drives_of(
    action: str, control_interval: float, heater_range: float = HEATER_RANGE, speed: float = PULL_SCALE
) -> Drives:
    """The effect of actions in this mode on the drives, at this control interval [s], with ranges [W] and [m/s].

    "smooth": first-order lags. A held action a brings the pull speed to v_0 (1 + a) and the heater to
    Q_H0 + 5 kW a with a time constant of 50 s; left alone they return to nominal. So noise on the action is bounded,
    coloured noise of the drives, whatever the control interval. "rate": the same without the return to nominal; a held
    action of 1 moves the drives by v_0 and 5 kW every 50 s.
    """
    if action == "direct":
        return DIRECT._replace(speed=speed, power=heater_range)
    share = control_interval / SMOOTH_TIME
    keep, share = (1.0, share) if action == "rate" else (math.exp(-share), 1.0 - math.exp(-share))
    return Drives(keep, SMOOTH_PULL * share, SMOOTH_HEATER * share, speed, heater_range)


class MadeFor(NamedTuple):
    """The environment that a controller or an agent was made for."""

    action: str
    """Mode of its actions: "direct", "smooth" or "rate" (:func:`drives_of`)."""
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
        "gym.make(..., **controller.settings) makes the one that it was made for"
    )
