"""Observations of ``Cz-v0``: scaled and clipped signals, and their decoding.

An observed value is ``quantity / scale`` clipped to +-10, float32; :mod:`cz_gym.body.signals` has quantities and
scales. "history" adds the past as differences of the means of neighbouring time spans. These differ by micrometres,
readings by millimetres, so the differences have scales of their own.
"""

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.body.process import BODY
from cz_gym.body.signals import PREVIEWS as PREVIEWS
from cz_gym.body.signals import Measured as Measured
from cz_gym.errors import CzError
from cz_gym.process import HEATER_SCALE as HEATER_SCALE
from cz_gym.process import PULL_SCALE as PULL_SCALE
from cz_gym.process import Channel as Channel
from cz_gym.process import Process
from cz_gym.process import scales as scales

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
"""Where "measured" and "history" hold the applied drives, in units of the action."""
LAGGED = tuple(each.name for each in BODY.past)
"""Signals whose past "history" shows."""
OBSERVATIONS = observations(BODY)
"""Channels of every observation but the camera's."""
MEASURED, HISTORY, STATE = (OBSERVATIONS[name] for name in ("measured", "history", "state"))
CAMERA = "camera"
"""The observation that is an image instead of channels (:mod:`cz_gym.camera`)."""


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
