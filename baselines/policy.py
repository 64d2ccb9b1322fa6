"""The interface that controllers and agents share: stable-baselines3's ``predict``, for a batch of crystals at once."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
import numpy.typing as npt

from cz_gym.body.process import BODY
from cz_gym.body.signals import Measured
from cz_gym.config import Config, positive
from cz_gym.jit import labelled
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import make_puller
from cz_gym.process import Process
from cz_gym.puller.file import DEFAULT, PullerFile
from cz_gym.spaces import TargetEnv, decode, readable, tag
from cz_gym.support.errors import CzError, select

Floats = npt.NDArray[np.float64]


@runtime_checkable
class Policy(Protocol):
    """Anything that acts on observations.

    Settings are immutable; what a policy remembers travels in ``state``. ``observation`` has shape (n, channels) or
    (channels,), the action shape (n, 2) or (2,), float32. ``episode_start`` (bool, shape (n,)) marks slots that begin
    an episode and whose memory starts anew; None marks none of them, unless ``state`` is None.
    """

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Return the action and the next state."""
        ...


READING_SCALE, READING_OFFSET = 0.03, 0.02
"""Errors that the reading of an applied drive may have: share of the reading, share of the drive's full range [-]."""
DIFFERENCE_TIME = 60.0
"""Time constant of the average of reading minus setpoint [s]."""


class DriveLimits(NamedTuple):
    """Limits of the drives of a puller, beyond the ranges of the actions."""

    pull_window: float = math.inf
    """Largest |v_p - v_0| [m/s]."""
    pull_slew: float = math.inf
    """Largest rate of the pull speed [m/s2]."""
    heater_slew: float = math.inf
    """Largest rate of the heater power [W/s]."""
    heater_step: float = 0.0
    """Whole steps in which the heater moves [W]; 0: none."""

    def moved(self, applied: Floats, wanted: Floats, dt: float) -> Floats:
        """Setpoints within the limits dt [s] after they were ``applied``, deviations [m/s, W], shape (n, 2)."""
        wanted = np.stack([np.clip(wanted[:, 0], -self.pull_window, self.pull_window), wanted[:, 1]], axis=-1)
        most = dt * np.array([self.pull_slew, self.heater_slew])
        return applied + np.clip(wanted - applied, -most, most)

    def whole(self, setpoints: Floats) -> Floats:
        """Setpoints with the power in whole steps, shape (n, 2)."""
        if not self.heater_step:
            return setpoints
        return np.stack([setpoints[:, 0], self.heater_step * np.rint(setpoints[:, 1] / self.heater_step)], axis=-1)


class ControllerState(NamedTuple):
    """The memory of a :class:`MeasuredController`."""

    readings: Measured
    """Last number that was read from each channel, SI units, each of shape (n,)."""
    asked: Floats
    """Last setpoints within the drives' limits, deviations from nominal [m/s, W], shape (n, 2)."""
    difference: Floats
    """Readings of the drives minus the setpoints, averaged over :data:`DIFFERENCE_TIME`, shape (n, 2)."""
    memory: Any
    """The controller's own memory."""


@dataclass(frozen=True)
class MeasuredController(ABC):
    """A controller that reads "measured" (or "history") observations; base class of the package's own.

    A subclass works in SI units on a batch of n crystals and defines its memory at the start of an episode
    (:meth:`at_rest`) and its answer to a sample (:meth:`step`). Its memory is a NamedTuple of arrays with a leading
    axis n, or of such tuples. Readings that are not valid or not finite never reach it (:func:`readable`). Its actions
    are refused by other environments than the one it was made for.
    """

    process: ClassVar[Process] = BODY
    """Process that the controller acts on."""
    observation: ClassVar[str] = "measured"
    """Observation that it reads."""
    action: ClassVar[str] = "direct"
    """Meaning of its actions."""
    accepts_missing_temperature: ClassVar[bool] = False
    """Receives missing pyrometer readings as NaN, and not as the last reading."""
    observes: ClassVar[bool] = False
    """Memory follows the crystal also while another controller sets the drives, as a filter's does."""

    control_interval: float = 5.0
    """Time between actions [s]."""
    parameters: Parameters = field(default=Parameters(), kw_only=True)
    """Parameters of the nominal puller."""
    meniscus: MeniscusModel = field(default=HURLE, kw_only=True)
    """Meniscus of the nominal puller."""
    puller: PullerFile = field(default=DEFAULT, kw_only=True)
    """Puller file of the machine."""
    limits: DriveLimits = field(default=DriveLimits(), kw_only=True)
    """Limits of the puller's drives."""
    any_environment: bool = field(default=False, kw_only=True)
    """Lets every environment take the actions (``made_for`` is None)."""

    def __post_init__(self) -> None:
        positive("control_interval", self.control_interval)

    @property
    def v_0(self) -> float:
        """Nominal pull speed [m/s]."""
        return self.parameters.v_0

    @property
    def heater_range(self) -> float:
        """Heater power that an action of 1 stands for [W]."""
        return self.puller.power_range

    @property
    def exportable(self) -> bool:
        """True if `step` can be traced for export: no branch or loop on data."""
        return True

    @cached_property
    def made_for(self) -> TargetEnv | None:
        """The environment that takes its actions; None: every one does."""
        if self.any_environment:
            return None
        plant: dict[str, Any] = {"parameters": self.parameters, "meniscus": self.meniscus, "puller": self.puller}
        return Config(
            action=self.action, control_interval=self.control_interval, process=self.process, **plant
        ).made_for

    @property
    def observations(self) -> tuple[str, ...]:
        """Observations that it reads: who reads "measured" reads it in "history" too."""
        return ("measured", "history") if self.observation == "measured" else (self.observation,)

    @property
    def settings(self) -> dict[str, Any]:
        """Arguments of ``gym.make("Cz-v0", ...)`` for the environment that it was made for."""
        given = {"observation": self.observation, "action": self.action, "control_interval": self.control_interval}
        plant: dict[str, Any] = {"meniscus": (self.meniscus, HURLE), "puller": (self.puller, DEFAULT)}
        if self.puller == DEFAULT and self.process == BODY:
            plant["parameters"] = self.parameters, Parameters()
        return given | {name: own for name, (own, default) in plant.items() if own != default}

    def for_config(self, config: Config) -> Self:
        """Return the controller for the control interval and the puller of an environment."""
        names = "control_interval", "parameters", "meniscus", "puller"
        drives = [each.actuators for each in config.scenario.scenarios]
        limits = DriveLimits._make(max(getattr(each, name) for each in drives) for name in DriveLimits._fields)
        return replace(self, limits=limits, **{name: getattr(config, name) for name in names})

    @cached_property
    def tolerance(self) -> Floats:
        """Largest lasting errors of the drives' readings that are expected [m/s, W], shape (2,)."""
        puller = make_puller(labelled(Parameters, self.parameters), meniscus=self.meniscus)
        ranges = np.array([self.v_0, self.heater_range])
        largest = np.array([puller.v_0, puller.Q_H_0]) + ranges
        tolerance: Floats = READING_SCALE * largest + 2.0 * READING_OFFSET * ranges
        return tolerance

    def applied(self, seen: Measured, asked: Floats, difference: Floats) -> tuple[Floats, Floats]:
        """The applied drives, deviations [m/s, W], and the averaged difference of their readings, each of shape (n, 2).

        Drives are taken to follow their setpoints; the first one is what is read. A move that began at an erring
        reading would add its error at every sample. Only a difference that lasts and is larger than readings err
        (:attr:`tolerance`) counts as a drive that does not follow.
        """
        share = -math.expm1(-self.control_interval / DIFFERENCE_TIME)
        difference = difference + share * (drives_of(seen) - asked - difference)
        return asked + difference - np.clip(difference, -self.tolerance, self.tolerance), difference

    @abstractmethod
    def at_rest(self, seen: Measured) -> Any:
        """The memory before the first sample, which is ``seen``."""

    @abstractmethod
    def step(self, seen: Measured, memory: Any) -> tuple[Floats, Floats, Any]:
        """Pull speed v_p - v_0 [m/s] and heater power Q_H - Q_H0 [W], each of shape (n,), and the new memory."""

    def read(self, array: Floats) -> Measured:
        """The channels of observations, shape (n, channels), in SI units."""
        seen: Measured = decode(array, self.v_0, self.heater_range, self.process)
        return seen

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Return the action and the next memory; arguments as of :class:`Policy`."""
        array, single = batched(observation)
        seen = self.read(array)
        if state is None or (episode_start is not None and np.any(episode_start)):
            first = type(seen)(*(np.where(np.isfinite(channel), channel, 0.0) for channel in seen))
            asked, difference = drives_of(first), np.zeros((len(array), 2))
            state = reset_rows(state, ControllerState(first, asked, difference, self.at_rest(first)), episode_start)
        good = np.isfinite(array).all() and (seen.valid > 0.5).all()
        read = seen if good else readable(seen, state.readings)
        applied, difference = self.applied(read, state.asked, state.difference)
        pull, power = self.limits.whole(applied).T
        given = read._replace(v_p=pull, Q_H=power)
        given = given._replace(T_1=seen.T_1) if self.accepts_missing_temperature else given
        pull, power, memory = self.step(given, state.memory)
        action = to_action(pull / self.v_0, power / self.heater_range, single)
        wanted = np.atleast_2d(action) * np.array([self.v_0, self.heater_range])
        asked = self.limits.moved(applied, wanted, self.control_interval)
        return tag(action, self.made_for), ControllerState(read, asked, difference, memory)


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


def drives_of(seen: Measured) -> Floats:
    """Readings of pull speed and power, deviations [m/s, W], shape (n, 2)."""
    return np.stack([seen.v_p, seen.Q_H], axis=-1)


def batched(observation: Any) -> tuple[Floats, bool]:
    """The observation with a batch axis, and whether it had none."""
    array = np.asarray(observation, np.float64)
    return np.atleast_2d(array), array.ndim == 1


def to_action(pull: Floats, heat: Floats, single: bool) -> npt.NDArray[np.float32]:
    """Actions from the two normalised inputs, each of shape (n,), clipped to the box."""
    action = np.clip(np.stack([pull, heat], axis=-1), -1.0, 1.0).astype(np.float32)
    return action[0] if single else action


def reset_rows(state: Any, zeros: Any, episode_start: Any) -> Any:
    """The state, with ``zeros``, the state at rest, where an episode begins; both are nested tuples of arrays."""
    if state is None:
        return zeros
    if episode_start is None:
        return state
    begins = np.atleast_1d(np.asarray(episode_start, np.bool_))
    return select(begins, zeros, state) if begins.any() else state


def check_numbers(owner: Any, positive: Sequence[str] = (), not_negative: Sequence[str] = ()) -> None:
    """Raise CzError for a field of ``owner`` that is not positive, or negative, or no number."""
    for names, least, what in ((positive, False, "positive"), (not_negative, True, "zero or positive")):
        for name in names:
            value = getattr(owner, name)
            if not (value > 0.0 or (least and value == 0.0)):
                raise CzError(f"{type(owner).__name__}.{name} must be {what}, not {value!r}")
