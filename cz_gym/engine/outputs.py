"""What a slot says after a step: the measured channels, the memory of "history", the true state and the info rows."""

from __future__ import annotations

from typing import Any

import numpy as np

from cz_gym.episodes.schedule import bias_offset, recipe, reference
from cz_gym.jit.compile import jittable, scratch
from cz_gym.observation import CLIP, INTEGRAL_SCALE, LAGGED, MEASURED, PREVIEWS, STATE, Measured

_AHEAD_1, _AHEAD_2 = PREVIEWS[1:]
_M, _S, _L = len(MEASURED), len(STATE), len(LAGGED)
_REMEMBERED = tuple(Measured._fields.index(name) for name in LAGGED)
_RING = _REMEMBERED[0]
_RING_SCALE = MEASURED[_RING].scale


@jittable
def clip(value: Any, limit: Any) -> Any:
    """The value held within +-limit, a complex one by its real part; NaN passes."""
    if value.real < -limit:
        return -limit
    return limit if value.real > limit else value


@jittable
def measure(slot: Any, t: Any) -> Any:
    """The "measured" channels in SI units."""
    p, e = slot.puller, slot.episode
    r_ref = reference(t, e)
    return Measured(
        slot.ring - p.r_0 - r_ref,
        slot.valid,
        r_ref,
        reference(t + _AHEAD_1, e),
        reference(t + _AHEAD_2, e),
        recipe(t, e),
        recipe(t + _AHEAD_1, e),
        recipe(t + _AHEAD_2, e),
        slot.T_1 - p.T_1_0,
        slot.v_p - p.v_0,
        slot.Q_H - p.Q_H_0,
    )


@jittable
def write_measured(measured: Any, per_scale: Any, out: Any) -> None:
    """Write the "measured" channels, scaled and clipped."""
    for channel in range(_M):
        out[channel] = clip(measured[channel] * per_scale[channel], CLIP)


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
def recall(slot: Any, measured: Any, history: Any, reading: Any, out: Any) -> None:
    """Turn "measured" channels into "history": integral, differences of successive spans' means, relative channels."""
    depth, later = history.shape[0], scratch(1, _L)
    at = slot.k % depth
    out[_M] = slot.integral
    for channel in range(_L):
        later[0, channel] = history[at, channel] - history[at - 1 if at > 0 else depth - 1, channel]
    for lag in range(reading.upto.size):
        upto, before = at - reading.upto[lag], at - reading.before[lag]
        upto, before = upto if upto >= 0 else upto + depth, before if before >= 0 else before + depth
        for channel in range(_L):
            mean = (history[upto, channel] - history[before, channel]) * reading.share[lag]
            out[_M + 1 + lag * _L + channel] = clip((mean - later[0, channel]) * reading.span[channel], CLIP)
            later[0, channel] = mean
    place, to, change = reading.relative
    for row in range(place.size):
        difference = measured[place[row]] - measured[to[row]]
        out[place[row]] = clip(difference * (reading.measured[place[row]] * change[row]), CLIP)


@jittable
def write_state(slot: Any, measured: Any, t: Any, per_scale: Any, out: Any) -> None:
    """Write the "state" channels."""
    p, x = slot.puller, slot.x
    truth = (
        x.r_c - p.r_0 - measured.r_ref, x.h_c - p.h_0, x.T_1 - p.T_1_0, x.T_2 - p.T_2_0, x.T_b - p.T_b_0,
        measured.r_ref, measured.r_ref_1min, measured.r_ref_5min,
        measured.T_1_ref, measured.T_1_ref_1min, measured.T_1_ref_5min,
        measured.v_p, measured.Q_H, slot.dT_i, slot.Q_d, bias_offset(t, slot.episode), p.lam,
    )  # fmt: skip
    for channel in range(_S):
        out[channel] = clip(truth[channel] * per_scale[channel], CLIP)


@jittable
def write_info(slot: Any, measured: Any, cost: Any, t: Any, ring: Any, at_interface: Any, info: Any) -> None:
    """Write the info rows, all but the last; ``h_c`` is the height held inside its limits, ``ring`` the ring there."""
    p, x = slot.puller, slot.x
    values = (
        x.r_c, ring, p.r_0 + measured.r_ref, x.h_c,
        np.arctan(at_interface.tan_alpha), at_interface.v_g,
        slot.v_p, slot.Q_H, x.T_1, p.T_1_0 + measured.T_1_ref, x.T_b,
        slot.ring + p.ring_bias, bias_offset(t, slot.episode),
        cost.radius, cost.pull, cost.pull_step, cost.heater_step,
    )  # fmt: skip
    for row in range(len(values)):
        info[row] = values[row]
