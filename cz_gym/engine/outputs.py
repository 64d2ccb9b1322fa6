"""Output of a slot's signals: scaled channels, the memory of "history", the rows of ``info``."""

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.jit.compile import jittable, scratch
from cz_gym.process import Channel, Process

from .arithmetic import clip

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


@jittable
def write_channels(values: Any, per_scale: Any, out: Any) -> None:
    """Write signals scaled and clipped, as "measured" or "state" channels."""
    for channel in range(len(values)):
        out[channel] = clip(values[channel] * per_scale[channel], CLIP)


@jittable
def remember(slot: Any, history: Any, interval: Any, out: Any, process: Any) -> None:
    """Add the sample's scaled channels to the running sums, and the first of them, the error, to its integral."""
    depth, error = history.shape[0], process.remembered[0]
    if slot.k == 0:
        for back in range(depth):
            history[depth - 1 - back, 0] = -out[error] * back
            for channel in range(1, len(process.remembered)):
                history[depth - 1 - back, channel] = 0.0
    else:
        step = out[error] * (process.integrated_scale / INTEGRAL_SCALE) * interval
        slot.integral = clip(slot.integral + step, CLIP)
    at = slot.k % depth
    before = at - 1 if at > 0 else depth - 1
    for channel in range(len(process.remembered)):
        history[at, channel] = history[before, channel] + out[process.remembered[channel]]


@jittable
def recall(slot: Any, measured: Any, history: Any, scales: Any, out: Any, process: Any) -> None:
    """Turn "measured" channels into "history": integral, differences of successive spans' means, relative channels."""
    depth, first, signals = history.shape[0], len(measured), process.lagged
    later, at = scratch(1, process.lagged), slot.k % depth
    out[first] = slot.integral
    for channel in range(signals):
        later[0, channel] = history[at, channel] - history[at - 1 if at > 0 else depth - 1, channel]
    for lag in range(scales.newest.size):
        newest, before = at - scales.newest[lag], at - scales.before[lag]
        newest, before = newest if newest >= 0 else newest + depth, before if before >= 0 else before + depth
        for channel in range(signals):
            mean = (history[newest, channel] - history[before, channel]) * scales.share[lag]
            change = process.past_change[channel]
            out[first + 1 + lag * signals + channel] = clip((mean - later[0, channel]) * change, CLIP)
            later[0, channel] = mean
    for row in range(len(process.relative_at)):
        place, to = process.relative_at[row], process.relative_to[row]
        difference = measured[place] - measured[to]
        out[place] = clip(difference * (scales.measured[place] * process.relative_change[row]), CLIP)


@jittable
def write_info(values: Any, info: Any) -> None:
    """Write the rows of ``info``."""
    for row in range(len(values)):
        info[row] = values[row]
