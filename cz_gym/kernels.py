"""The compiled loops: drives, plant, sensors, observation and reward, for one slot or ten thousand.

The equations are the functions of :mod:`cz_gym.plant`, :mod:`cz_gym.schedule` and :mod:`cz_gym.task`, compiled
in; this module says in which order a slot goes through them. Nothing here draws a random number or allocates.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ._compile import hashed, kernel, physics
from .episode import FREEZES, GRID
from .meniscus import HURLE, MeniscusModel
from .observation import CLIP, INTEGRAL_SCALE, LAGGED, MEASURED, PREVIEWS, STATE, Measured
from .plant import Disturbance, Inputs, State, derive_puller, growth, rk4
from .schedule import bias_offset, disturbance, pyrometer_drift, recipe, reference, ripple
from .slots import INFO
from .task import HEATER_RANGE, HEIGHT_MAX_IN_A, HEIGHT_MIN, Cost, cost_terms, failure_penalty, reward, within_limits

_AHEAD_1, _AHEAD_2 = PREVIEWS[1:]
_M, _S, _L = len(MEASURED), len(STATE), len(LAGGED)
_RING_SCALE = MEASURED[0].scale
_EPS = 1e-9
_CLIPPED = INFO.index("action_clipped")
_JUMP = HEIGHT_MIN


@physics
def _clip(value: Any, limit: Any) -> Any:
    return np.minimum(np.maximum(value, -limit), limit)


@physics
def _drive(slot: Any, pull: Any, heat: Any, interval: Any) -> None:
    """Move the drives towards an action within window and slew, the heater in whole steps."""
    p, e = slot.puller, slot.episode
    wanted = p.v_0 + _clip(p.v_0 * _clip(pull, 1.0), e.pull_window)
    slot.v_p = slot.v_p + _clip(wanted - slot.v_p, e.pull_slew * interval)
    power = p.Q_H_0 + HEATER_RANGE * _clip(heat, 1.0)
    slot.Q_H_slewed = slot.Q_H_slewed + _clip(power - slot.Q_H_slewed, e.heater_slew * interval)
    slot.Q_H = slot.Q_H_slewed
    if e.heater_step > 0.0:
        slot.Q_H = p.Q_H_0 + e.heater_step * np.rint((slot.Q_H_slewed - p.Q_H_0) / e.heater_step)


@physics
def _height_inside(h_c: Any, p: Any) -> Any:
    """Meniscus height held inside its limits, so that a failed state is still measured."""
    return np.minimum(np.maximum(h_c, HEIGHT_MIN), HEIGHT_MAX_IN_A * p.a)


@physics
def _substep(x: Any, u: Any, d: Any, p: Any, dt: Any, r_ref: Any, slope: Any) -> Any:
    """One RK4 substep and whether the crystal still grows; a jump no crystal makes keeps the state before."""
    new = rk4(x, u, d, p, dt, slope)
    grows = within_limits(new.r_c, new.h_c, r_ref, p.a)
    if not grows and not (np.abs(new.r_c - x.r_c) < _JUMP and np.abs(new.h_c - x.h_c) < _JUMP):
        new = State(x.r_c, x.h_c, x.T_1, x.T_2, x.T_b)
    return new, grows


@physics
def _photograph(slot: Any, frames: Any, t: Any, ring_offset: Any) -> None:
    """Keep the ring, less the operator's bias, as a frame taken at t."""
    p, x = slot.puller, slot.x
    at = slot.frames % frames.shape[0]
    frames[at, 0] = t
    frames[at, 1] = x.r_c + ring_offset(x.r_c, _height_inside(x.h_c, p), p) - p.ring_bias
    slot.frames = slot.frames + 1


@physics
def _delivered(slot: Any, frames: Any, t: Any) -> Any:
    """Index of the newest frame as old as the latency, or of the oldest there is."""
    depth = frames.shape[0]
    index = slot.frames - 1
    oldest = max(slot.frames - depth, 0)
    while index > oldest and frames[index % depth, 0] > t - slot.episode.latency + _EPS:
        index -= 1
    return index % depth


@physics
def _advance(slot: Any, interface: Any, frames: Any, clock: Any, slope: Any, ring_offset: Any) -> Any:
    """Integrate over one control interval, split at the 5 s grid; returns whether the crystal still grows."""
    p, e = slot.puller, slot.episode
    u = Inputs(slot.v_p, slot.Q_H)
    x = State(slot.x.r_c, slot.x.h_c, slot.x.T_1, slot.x.T_2, slot.x.T_b)
    t, end = slot.k * clock.interval, (slot.k + 1) * clock.interval
    grows = True
    while grows and t < end - _EPS:
        j = int(t / GRID + _EPS)
        upto = min((j + 1) * GRID, end)
        d = disturbance(j * GRID, interface[j], e, p)
        x, grows = _substep(x, u, d, p, upto - t, p.r_0 + reference(upto, e), slope)
        slot.dT_i = d.dT_i
        slot.Q_d = d.Q_d
        slot.x.r_c = x.r_c
        slot.x.h_c = x.h_c
        slot.x.T_1 = x.T_1
        slot.x.T_2 = x.T_2
        slot.x.T_b = x.T_b
        t = upto
        if e.latency > 0.0 and t < end - _EPS:
            _photograph(slot, frames, t, ring_offset)
    return grows


@physics
def _sense(slot: Any, noise: Any, frames: Any, t: Any) -> None:
    """Read pyrometer and camera at sample k; a frozen or dropped sample shows the last ring again."""
    e = slot.episode
    slot.T_1 = slot.x.T_1 + pyrometer_drift(t, e) + noise[slot.k, 1]
    camera = noise[slot.k, 0]
    invalid = np.isnan(camera)
    stuck = invalid
    for which in range(FREEZES):
        if slot.freezes[which, 0] <= t < slot.freezes[which, 1]:
            stuck = True
            invalid = invalid or which < FREEZES - 1
    slot.valid = 0.0 if invalid else 1.0
    if not stuck or slot.k == 0:
        at = _delivered(slot, frames, t)
        slot.ring = frames[at, 1] + bias_offset(t, e)
        if e.ripple_amplitude > 0.0:
            slot.ring = slot.ring + ripple(frames[at, 0], e)
        if not np.isnan(camera):
            slot.ring = slot.ring + camera


@physics
def _measure(slot: Any, t: Any) -> Any:
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


@physics
def _remember(slot: Any, out: Any, history: Any, interval: Any) -> None:
    """Add the sample's scaled channels to the running sums, and the ring error to its integral."""
    depth = history.shape[0]
    values = (out[0], out[9], out[8], out[10])
    if slot.k == 0:
        for back in range(depth):
            history[depth - 1 - back, 0] = -values[0] * back
            for channel in range(1, _L):
                history[depth - 1 - back, channel] = 0.0
    else:
        step = values[0] * (_RING_SCALE / INTEGRAL_SCALE) * interval
        slot.integral = _clip(slot.integral + step, CLIP)
    at = slot.k % depth
    before = at - 1 if at > 0 else depth - 1
    for channel in range(_L):
        history[at, channel] = history[before, channel] + values[channel]


@physics
def _recall(slot: Any, history: Any, newest: Any, oldest: Any, out: Any) -> None:
    """Write the integral and the means of the remembered samples."""
    depth = history.shape[0]
    at = slot.k % depth
    out[_M] = slot.integral
    for lag in range(newest.size):
        upto, before = at - newest[lag], at - oldest[lag] - 1
        upto = upto + depth if upto < 0 else upto
        before = before + depth if before < 0 else before
        count = oldest[lag] - newest[lag] + 1
        for channel in range(_L):
            mean = (history[upto, channel] - history[before, channel]) / count
            out[_M + 1 + lag * _L + channel] = _clip(mean, CLIP)


@physics
def _write_state(slot: Any, measured: Any, t: Any, scales: Any, out: Any) -> None:
    """Write the "state" channels."""
    p, x = slot.puller, slot.x
    truth = (
        x.r_c - p.r_0 - measured.r_ref, x.h_c - p.h_0, x.T_1 - p.T_1_0, x.T_2 - p.T_2_0, x.T_b - p.T_b_0,
        measured.r_ref, measured.r_ref_1min, measured.r_ref_5min,
        measured.T_1_ref, measured.T_1_ref_1min, measured.T_1_ref_5min,
        measured.v_p, measured.Q_H, slot.dT_i, slot.Q_d, bias_offset(t, slot.episode), p.lam,
    )  # fmt: skip
    for channel in range(_S):
        out[channel] = _clip(truth[channel] / scales[channel], CLIP)


@physics
def _write_info(slot: Any, measured: Any, cost: Any, t: Any, slope: Any, ring_offset: Any, info: Any) -> None:
    """Write the info rows, all but the last."""
    p, x = slot.puller, slot.x
    h_c = _height_inside(x.h_c, p)
    d = Disturbance(slot.Q_d, slot.dT_i, 1.0)
    at_interface = growth(State(x.r_c, h_c, x.T_1, x.T_2, x.T_b), d, p, slope)
    values = (
        x.r_c, x.r_c + ring_offset(x.r_c, h_c, p), p.r_0 + measured.r_ref, x.h_c,
        np.arctan2(at_interface.sin_alpha, at_interface.cos_alpha), at_interface.v_g,
        slot.v_p, slot.Q_H, x.T_1, p.T_1_0 + measured.T_1_ref, x.T_b,
        slot.ring + p.ring_bias, bias_offset(t, slot.episode),
        cost.radius, cost.pull, cost.pull_step, cost.heater_step,
    )  # fmt: skip
    for row in range(len(values)):
        info[row] = values[row]


class Kernels(NamedTuple):
    """The compiled loops for one meniscus model."""

    step: Any
    """``step(memory, actions, active, clock, reading, out, start, stop)``: one control interval of the active slots."""
    observe: Any
    """``observe(memory, which, clock, reading, out)``: first sample of the freshly drawn slots ``which``."""
    plant: Any
    """``plant(memory, actions, clock, rings, start, stop)``: drives, plant and ring alone, to measure speed against."""
    derive: Any
    """``derive(parameters, lam)``: the puller at its operating point."""


def build_kernels(meniscus: MeniscusModel = HURLE) -> Kernels:
    """Compile the loops for a meniscus model; those of this package's models are kept on disk."""
    slope, ring_offset, height = meniscus.slope, meniscus.ring_offset, meniscus.height

    @physics
    def sample(memory: Any, i: Any, cost: Any, clock: Any, reading: Any, out: Any) -> None:
        slot, frames = memory.slots[i], memory.frames[i]
        t = slot.k * clock.interval
        _photograph(slot, frames, t, ring_offset)
        _sense(slot, memory.noise[i], frames, t)
        measured = _measure(slot, t)
        row = out.observation[i]
        for channel in range(_M):
            row[channel] = _clip(measured[channel] / reading.measured[channel], CLIP)
        if memory.history.shape[1] > 0:
            _remember(slot, row, memory.history[i], clock.interval)
            _recall(slot, memory.history[i], reading.newest, reading.oldest, row)
        if out.state.shape[1] > 0:
            _write_state(slot, measured, t, reading.state, out.state[i])
        _write_info(slot, measured, cost, t, slope, ring_offset, out.info[:, i])

    def step(memory: Any, actions: Any, active: Any, clock: Any, reading: Any, out: Any, start: int, stop: int) -> None:
        for i in range(start, stop):
            if not active[i]:
                continue
            slot = memory.slots[i]
            v_p, Q_H = slot.v_p, slot.Q_H
            pull, heat = actions[i, 0], actions[i, 1]
            _drive(slot, pull, heat, clock.interval)
            grows = _advance(slot, memory.interface[i], memory.frames[i], clock, slope, ring_offset)
            slot.k = slot.k + 1
            p = slot.puller
            radius_error = slot.x.r_c - p.r_0 - reference(slot.k * clock.interval, slot.episode)
            cost = cost_terms(radius_error, slot.v_p - p.v_0, slot.v_p - v_p, slot.Q_H - Q_H)
            out.reward[i] = reward(cost) + (0.0 if grows else failure_penalty(slot.k, clock.steps))
            out.terminated[i] = not grows
            out.truncated[i] = grows and slot.k >= clock.steps
            slot.over = 1 if (not grows or slot.k >= clock.steps) else 0
            sample(memory, i, cost, clock, reading, out)
            out.info[_CLIPPED, i] = 1.0 if (np.abs(pull) > 1.0 or np.abs(heat) > 1.0) else 0.0

    def observe(memory: Any, which: Any, clock: Any, reading: Any, out: Any) -> None:
        for i in which:
            slot = memory.slots[i]
            sample(memory, i, Cost(0.0, 0.0, 0.0, 0.0), clock, reading, out)
            out.info[_CLIPPED, i] = 0.0
            out.reward[i] = 0.0
            out.terminated[i] = False
            out.truncated[i] = False
            slot.over = 0

    def plant(memory: Any, actions: Any, clock: Any, rings: Any, start: int, stop: int) -> None:
        for i in range(start, stop):
            slot = memory.slots[i]
            _drive(slot, actions[i, 0], actions[i, 1], clock.interval)
            _advance(slot, memory.interface[i], memory.frames[i], clock, slope, ring_offset)
            slot.k = slot.k + 1
            x, p = slot.x, slot.puller
            rings[i] = x.r_c + ring_offset(x.r_c, _height_inside(x.h_c, p), p)

    def derive(parameters: Any, lam: float) -> Any:
        return derive_puller(parameters, lam, height, ring_offset)

    keep = hashed(*meniscus[1:])
    return Kernels(*(kernel(loop, keep) for loop in (step, observe, plant, derive)))


KERNELS = build_kernels()
"""The loops on Hurle's meniscus."""
