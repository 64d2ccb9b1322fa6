"""Output of a slot's signals: scaled channels, the memory of "history", the rows of ``info``."""

from __future__ import annotations

from typing import Any

from cz_gym.body.signals import MEASURED, Measured
from cz_gym.jit.compile import jittable, scratch
from cz_gym.observation import CLIP, INTEGRAL_SCALE, LAGGED, PAST_SCALES, RELATIVE

_M, _L = len(MEASURED), len(LAGGED)
_REMEMBERED = tuple(Measured._fields.index(name) for name in LAGGED)
_PAST_CHANGE = tuple(MEASURED[at].scale / PAST_SCALES[name] for at, name in zip(_REMEMBERED, LAGGED, strict=True))
"""Ratio of each remembered signal's scale to the scale of its past differences [-]."""
_PLACE = tuple(Measured._fields.index(name) for name in RELATIVE)
_TO = tuple(Measured._fields.index(relative.to) for relative in RELATIVE.values())
_CHANGE = tuple(MEASURED[at].scale / relative.scale for at, relative in zip(_PLACE, RELATIVE.values(), strict=True))
"""Signals shown relative to another one: their index, the index of the other, and the ratio of the two scales."""
_RING = _REMEMBERED[0]
_RING_SCALE = MEASURED[_RING].scale


@jittable
def clip(value: Any, limit: Any) -> Any:
    """The value limited to +-limit, a complex one by its real part; NaN stays NaN."""
    if value.real < -limit:
        return -limit
    return limit if value.real > limit else value


@jittable
def write_channels(values: Any, per_scale: Any, out: Any) -> None:
    """Write signals scaled and clipped, as "measured" or "state" channels."""
    for channel in range(len(values)):
        out[channel] = clip(values[channel] * per_scale[channel], CLIP)


@jittable
def remember(slot: Any, history: Any, interval: Any, out: Any) -> None:
    """Add the sample's scaled channels to the running sums, and the ring error to its integral."""
    depth = history.shape[0]
    if slot.k == 0:
        for back in range(depth):
            history[depth - 1 - back, 0] = -out[_RING] * back
            for channel in range(1, _L):
                history[depth - 1 - back, channel] = 0.0
    else:
        step = out[_RING] * (_RING_SCALE / INTEGRAL_SCALE) * interval
        slot.integral = clip(slot.integral + step, CLIP)
    at = slot.k % depth
    before = at - 1 if at > 0 else depth - 1
    for channel in range(_L):
        history[at, channel] = history[before, channel] + out[_REMEMBERED[channel]]


@jittable
def recall(slot: Any, measured: Any, history: Any, scales: Any, out: Any) -> None:
    """Turn "measured" channels into "history": integral, differences of successive spans' means, relative channels."""
    depth, later = history.shape[0], scratch(1, _L)
    at = slot.k % depth
    out[_M] = slot.integral
    for channel in range(_L):
        later[0, channel] = history[at, channel] - history[at - 1 if at > 0 else depth - 1, channel]
    for lag in range(scales.newest.size):
        newest, before = at - scales.newest[lag], at - scales.before[lag]
        newest, before = newest if newest >= 0 else newest + depth, before if before >= 0 else before + depth
        for channel in range(_L):
            mean = (history[newest, channel] - history[before, channel]) * scales.share[lag]
            out[_M + 1 + lag * _L + channel] = clip((mean - later[0, channel]) * _PAST_CHANGE[channel], CLIP)
            later[0, channel] = mean
    for row in range(len(_PLACE)):
        difference = measured[_PLACE[row]] - measured[_TO[row]]
        out[_PLACE[row]] = clip(difference * (scales.measured[_PLACE[row]] * _CHANGE[row]), CLIP)


@jittable
def write_info(values: Any, info: Any) -> None:
    """Write the rows of ``info``."""
    for row in range(len(values)):
        info[row] = values[row]
