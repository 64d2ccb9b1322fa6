"""Output of a slot's signals: scaled channels, the memory of "history", the rows of ``info``."""

from typing import Any

from cz_gym.jit.compile import jittable, scratch
from cz_gym.observation import CLIP, INTEGRAL_SCALE
from cz_gym.physics.arithmetic import clip


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
