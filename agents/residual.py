"""A learned residual: an agent whose actions are added, within limits, to those of a given controller.

The network reads the controller's output and its own share in force before the channels of "history". Its two outputs
are shares of the limits in [-1, 1], smoothed as those of ``action="smooth"``; the sum is a "direct" action. With limits
of zero it is the controller. Training (:class:`cz_gym.sb3.AddToController`) and the finished agent
(:class:`cz_gym.agents.contract.OnnxPolicy`) both run :class:`Residual`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.process import Channel
from cz_gym.spaces import HISTORY, drives_of, to_measured
from cz_gym.support.errors import CzError
from cz_gym.support.units import KILO

ADDED = (
    Channel("v_0", 1.0, "pull speed that the controller asks for, above nominal", "asked_v_p"),
    Channel("10 kW", 1.0, "heater power that the controller asks for, above nominal", "asked_Q_H"),
    Channel("limit", 1.0, "share of the largest addition to the pull speed that is in force", "share_v_p"),
    Channel("limit", 1.0, "share of the largest addition to the heater power that is in force", "share_Q_H"),
)
"""Channels that the network reads before those of "history"."""
ALONE = "none"
"""Label in the contract of an agent that adds to no controller."""


class Base(NamedTuple):
    """The controller that an agent adds to; it pickles, which the user's own controllers do not."""

    label: str
    """Name of the controller, and hash of its settings or of the user's file."""
    make: Callable[[Config], Any]
    """Builds it; it must pickle."""
    config: Config
    """Environment that it is designed for."""


class ResidualMemory(NamedTuple):
    """Memory of the loop; arrays have shape (n, 2)."""

    own: Any
    """The controller's own memory."""
    asked: npt.NDArray[Any]
    """Last actions of the controller."""
    share: npt.NDArray[np.float32]
    """Shares of the limits that are in force [-]."""
    network: Any = None
    """The network's own memory, if it has one."""


@dataclass(frozen=True)
class Residual:
    """Run a controller and add shares of the limits to its actions."""

    width: ClassVar[int] = len(ADDED)
    """Number of channels that the network reads before those of its observation."""

    base: Base = field(repr=False)
    pull_limit: float
    """Largest addition to the pull speed, as a share of v_0 [-]."""
    heater_limit: float
    """Largest addition to the heater power [kW]."""

    def __post_init__(self) -> None:
        if not (0.0 <= self.pull_limit <= 1.0 and 0.0 <= self.limits[1] <= 1.0):
            most = self.base.config.heater_range / KILO
            given = f"{self.pull_limit:g} and {self.heater_limit:g} kW"
            raise CzError(f"limits must be a share of v_0 from 0 to 1 and from 0 to {most:g} kW, not {given}")

    @property
    def facts(self) -> dict[str, Any]:
        """Fields of a contract that say what the agent adds to."""
        return {"controller": self.base.label, "pull_limit": self.pull_limit, "heater_limit": self.heater_limit}

    @cached_property
    def controller(self) -> Any:
        """The controller itself."""
        return self.base.make(self.base.config)

    @cached_property
    def reads_history(self) -> bool:
        """True if the controller reads "history" as it is; others get their "measured" channels from it."""
        return "history" in (getattr(self.controller, "observation", ""), *getattr(self.controller, "observations", ()))

    @cached_property
    def limits(self) -> npt.NDArray[np.float32]:
        """Largest additions [action units], shape (2,)."""
        return np.array([self.pull_limit, KILO * self.heater_limit / self.base.config.heater_range], np.float32)

    @cached_property
    def keep(self) -> np.float32:
        """Part of a share that is still in force after a control interval [-]."""
        return np.float32(drives_of("smooth", self.base.config.control_interval).keep)

    def read(self, observation: Any, memory: ResidualMemory | None, begins: Any) -> tuple[Any, ResidualMemory]:
        """Channels of :data:`ADDED`, shape (n, 4), and the memory, at observations whose first channels are "history";
        ``begins`` marks the crystals that are new.
        """
        history = observation[:, : len(HISTORY)]
        seen = history if self.reads_history else to_measured(history, *self.base.config.ranges)
        own = None if memory is None else memory.own
        action, own = self.controller.predict(seen, state=own, episode_start=begins, deterministic=True)
        share = np.zeros((len(history), 2), np.float32) if memory is None else memory.share
        share = share if begins is None else np.where(np.asarray(begins)[..., None], np.float32(0.0), share)
        asked = np.asarray(action)
        network = None if memory is None else memory.network
        return np.concatenate([asked, share], axis=1, dtype=np.float32), ResidualMemory(own, asked, share, network)

    def act(self, wanted: Any, memory: ResidualMemory) -> tuple[npt.NDArray[Any], ResidualMemory]:
        """Actions of the environment, shape (n, 2), where the network wants these shares, and the memory."""
        share = self.keep * memory.share + (1 - self.keep) * np.clip(np.asarray(wanted, np.float32), -1.0, 1.0)
        return memory.asked + self.limits * share, memory._replace(share=share)
