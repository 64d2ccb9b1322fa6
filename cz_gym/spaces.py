"""Actions and observations: spaces, the effect of actions on the drives, channels and their decoding.

A tagged action is refused by every environment but the one it was made for. An observed value is ``quantity / scale``
clipped to +-10, float32; :mod:`cz_gym.body.signals` has quantities and scales. "history" adds the past as differences
of the means of neighbouring time spans. These differ by micrometres, readings by millimetres, so the differences have
scales of their own.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.error import InvalidAction
from gymnasium.spaces import Box

from cz_gym.body.process import BODY
from cz_gym.body.signals import PREVIEWS as PREVIEWS
from cz_gym.body.signals import Measured as Measured
from cz_gym.camera.view import IMAGE
from cz_gym.support.errors import CzError

from .process import HEATER_SCALE, PULL_SCALE, Process
from .process import Channel as Channel
from .process import scales as scales

HEATER_RANGE = HEATER_SCALE
"""Range of the default puller's heater drive [W]: Q_H = Q_H0 +- HEATER_RANGE."""
HEATER_SLACK = 0.6
"""Difference between commanded and applied power that is due to the heater's resolution, in units of it [-]."""
SMOOTH_TIME = 50.0
"""Time constant with which ``action="smooth"`` moves both drives [s]."""
SMOOTH_PULL, SMOOTH_HEATER = 1.0, 0.5
"""Drive deviations that a held smooth action of 1 settles at, in shares of v_0 and of the heater's range [-]."""


class Drives(NamedTuple):
    """Effect of an action on the drives, in shares of v_0 and of the heater's range: keep * applied + gain * action."""

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


def action_space() -> Any:
    """Pull speed and heater power, each in [-1, 1]: v_p = v_0 (1 + a_0), Q_H = Q_H0 + 10 kW a_1."""
    return Box(-1.0, 1.0, (2,), np.float32)


def check_action(action: Any) -> Any:
    """Return the action as float64, shape (2,); raise InvalidAction for anything else."""
    try:
        array = np.asarray(action, np.float64)
    except (TypeError, ValueError):
        raise InvalidAction(f"an action must be two numbers in [-1, 1], not {action!r}") from None
    if array.shape != (2,):
        raise InvalidAction(f"an action must have shape (2,), not {array.shape}")
    pull, heat = array.tolist()
    if pull != pull or heat != heat:
        raise InvalidAction(f"an action must not be NaN: {action!r}")
    return array


def check_actions(actions: Any, array: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Copy a batch's actions into ``array``, shape (n, 2), and return it; raise InvalidAction for anything else."""
    try:
        shape = np.shape(actions)
        if shape == array.shape:
            array[:] = actions
    except (TypeError, ValueError):
        raise InvalidAction(f"actions must be numbers of shape {array.shape}, not {actions!r}") from None
    if shape != array.shape:
        raise InvalidAction(f"actions must have shape {array.shape}, not {shape}")
    if math.isnan(array.min()):
        slots = np.flatnonzero(np.isnan(array).any(axis=1))[:10].tolist()
        raise InvalidAction(f"actions must not be NaN; those of slots {slots} are")
    return array


class TargetEnv(NamedTuple):
    """The environment that a controller or an agent was made for."""

    action: str
    """Mode of its actions: "direct", "smooth" or "rate" (:func:`drives_of`)."""
    control_interval: float
    """Time between its actions [s]."""
    plant: str
    """Hash of the plant (:attr:`cz_gym.config.Config.plant_hash`)."""
    puller: str = "default"
    """Name and hash of the puller file (:attr:`cz_gym.puller.file.PullerFile.label`)."""

    def __str__(self) -> str:
        puller = "" if self.puller == "default" else f", puller {self.puller}"
        return f"action={self.action!r}, control_interval={self.control_interval:g}, plant {self.plant}{puller}"


class TaggedAction(np.ndarray[Any, np.dtype[Any]]):
    """An action, or one a row, that names the environment it was made for; arrays computed from it are plain ones."""

    made_for: TargetEnv | None

    def __array_finalize__(self, other: Any) -> None:
        self.made_for = getattr(other, "made_for", None)

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return np.asarray(array)[()]


def tag(action: npt.NDArray[Any], made_for: TargetEnv | None) -> npt.NDArray[Any]:
    """Tag an action: every environment but the one it was made for refuses it; with None, every one takes it."""
    if made_for is None:
        return action
    tagged = action.view(TaggedAction)
    tagged.made_for = made_for
    return tagged


def check_tagged(action: TaggedAction, own: TargetEnv) -> None:
    """Raise InvalidAction for an action that was made for another environment than ``own``."""
    if message := mismatch(action.made_for, own):
        raise InvalidAction(f"{message} (np.asarray(action) is taken all the same)")


def mismatch(made_for: TargetEnv | None, own: TargetEnv) -> str:
    """Differences between an environment and the one that a controller was made for; empty if there are none."""
    if made_for is None or made_for == own:
        return ""
    return (
        f"this controller or agent was made for {made_for}; the environment has {own}: "
        "gym.make(..., **controller.settings) makes the one that it was made for"
    )


CLIP = 10.0
"""Largest observed value after scaling [-]."""
INTEGRAL_SCALE = 1.0
"""Scale of the error's integral, one metre second: 1 mm held for 1000 s [m s]."""
LAGS = (5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 240.0, 360.0, 480.0, 720.0, 960.0, 1200.0)
"""Ages [s] at which the time spans of "history" end; each span starts at the age before."""


@cache
def observations(process: Process) -> dict[str, tuple[Channel, ...]]:
    """Channels of every observation but the camera's."""
    return {"measured": process.measured, "history": _history(process), "state": process.state}


def _history(process: Process) -> tuple[Channel, ...]:
    """The measured channels, relative ones as such, the integral of the error, and differences of past means."""
    relative = {each.name: each for each in process.relative}
    present = [
        c._replace(scale=relative[c.name].scale, meaning=relative[c.name].meaning) if c.name in relative else c
        for c in process.measured
    ]
    error, units = process.past[0].name, {channel.name: channel.unit for channel in process.measured}
    meaning = f"integral of {error} since the start, held within +-10"
    later = ("the value now", *(f"that over the span up to {age:g} s" for age in LAGS))
    past = [
        Channel(
            units[name],
            scale,
            f"{name}: mean over the span up to {age:g} s ago, minus {subtracted}",
            f"{name}_{age:g}s",
        )
        for age, subtracted in zip(LAGS, later, strict=False)
        for name, scale in process.past
    ]
    return (*present, Channel("m s", INTEGRAL_SCALE, meaning, "integral"), *past)


def lags(control_interval: float) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Ages, in samples, of the newest and the oldest sample of each span, at that control interval [s].

    Each span holds at least one sample.
    """
    oldest = np.maximum(np.rint(np.array(LAGS) / control_interval).astype(np.int64), 1)
    before = np.concatenate([[0], oldest[:-1]])
    return np.minimum(before + 1, oldest), oldest


DRIVE_CHANNELS = tuple(Measured._fields.index(name) for name in ("v_p", "Q_H"))
"""Places in "measured" and "history" of the applied drives, which have units of the action."""
LAGGED = tuple(each.name for each in BODY.past)
"""Signals whose past "history" shows."""
OBSERVATIONS = observations(BODY)
"""Channels of every observation but the camera's."""
MEASURED, HISTORY, STATE = (OBSERVATIONS[name] for name in ("measured", "history", "state"))
CAMERA = "camera"
"""The observation that is an image instead of channels (:mod:`cz_gym.camera`)."""


def observation_space(observation: str, process: Process = BODY) -> Any:
    """The observation's channels, scaled and clipped to +-10, or the camera's grey values."""
    if observation == CAMERA:
        return Box(0, 255, IMAGE, np.uint8)
    return Box(-CLIP, CLIP, (len(observations(process)[observation]),), np.float32)


def decode(
    observation: npt.ArrayLike,
    v_0: float = PULL_SCALE,
    heater_range: float = HEATER_SCALE,
    process: Process = BODY,
) -> Any:
    """Read a "measured" or "history" observation, shape (..., channels), back into SI units: a ``process.Measured``.

    ``v_0`` [m/s] and ``heater_range`` [W] are the puller's (:attr:`cz_gym.config.Config.ranges`).

    Raises ValueError if the last axis is neither.
    """
    array = np.asarray(observation, dtype=np.float64)
    measured, history = (observations(process)[name] for name in ("measured", "history"))
    if array.ndim == 0 or array.shape[-1] not in (len(measured), len(history)):
        raise CzError(
            f"expected an observation of {len(measured)} (measured) or {len(history)} (history) channels, "
            f"got shape {array.shape}"
        )
    present = (history if array.shape[-1] == len(history) else measured)[: len(measured)]
    values = process.Measured(*np.moveaxis(array[..., : len(measured)] * scales(present, v_0, heater_range), -1, 0))
    if array.shape[-1] == len(measured):
        return values
    sums = {each.name: getattr(values, each.name) + getattr(values, each.to) for each in process.relative}
    return values._replace(**sums)


def readable(seen: Any, last: Any) -> Any:
    """A sample with the ``last`` reading wherever a channel is not finite or the ring is not valid."""
    finite = type(seen)(*map(np.isfinite, seen))
    valid = (seen.valid > 0.5) & finite.ring_error
    kept = type(seen)(*map(np.where, finite, seen, last))
    ring_error = np.where(valid, seen.ring_error, last.ring_error + last.r_ref - kept.r_ref)
    return kept._replace(ring_error=ring_error, valid=valid.astype(np.float64))


def to_measured(
    history: npt.ArrayLike, v_0: float = PULL_SCALE, heater_range: float = HEATER_SCALE
) -> npt.NDArray[np.float32]:
    """Convert "history" observations, shape (..., channels), to "measured" ones, exact to the rounding of float32."""
    measured = np.stack(decode(history, v_0, heater_range), axis=-1) / scales(MEASURED, v_0, heater_range)
    return np.clip(measured, -CLIP, CLIP).astype(np.float32)
