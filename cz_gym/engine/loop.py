"""One control interval of a slot: drives moved by an action, camera and pyrometer, the plant of eight in lockstep."""

from typing import Any

import numpy as np

from cz_gym.episodes.draw import FREEZES, fluctuation, next_fluctuation
from cz_gym.episodes.scenario import GRID
from cz_gym.jit import column, force_inlined, inlined, jittable, labelled, scratch, set_column, set_labelled
from cz_gym.physics.plant import bias_offset, drift, pyrometer_drift, ripple
from cz_gym.process import GROWS, Inputs, clip, rk4

_EPS, _POWER, _DRIVES = 1e-9, 3, 4


@jittable
def next_speed(v_p: Any, pull: Any, drives: Any, nominal: Any, before: Any, e: Any, interval: Any) -> Any:
    """The pull speed [m/s] after an action, within its window and slew rate; ``before``: nominal for the last one."""
    speed = drives.keep * ((v_p - before) / drives.speed) + drives.pull * clip(pull, 1.0)
    wanted = nominal + clip(drives.speed * clip(speed, 1.0), e.pull_window)
    return v_p + clip(wanted - v_p, e.pull_slew * interval)


@jittable
def next_power(Q_H: Any, heat: Any, drives: Any, nominal: Any, before: Any, e: Any, interval: Any) -> Any:
    """The heater power [W] after an action, within its slew rate, before it is rounded to whole steps."""
    share = drives.keep * ((Q_H - before) / drives.power) + drives.heater * clip(heat, 1.0)
    power = nominal + drives.power * clip(share, 1.0)
    power = power if power.real > 0.0 else 0.0
    return Q_H + clip(power - Q_H, e.heater_slew * interval)


@jittable
def next_inputs(x: Any, u: Any, action: Any, before: Any, drives: Any, slot: Any, interval: Any, process: Any) -> Any:
    """The inputs after an action, before the heater is rounded to whole steps, from those before and the state;
    ``before`` are the inputs from which the last action was counted."""
    e, nominal = slot.episode, process.nominal(x, slot, interval)
    return Inputs(
        next_speed(u.v_p, action.v_p, drives, nominal.v_p, before.v_p, e, interval),
        next_power(u.Q_H, action.Q_H, drives, nominal.Q_H, before.Q_H, e, interval),
    )


@jittable
def drive(slot: Any, pull: Any, heat: Any, drives: Any, interval: Any, process: Any) -> None:
    """Move the drives by an action, the heater in whole steps, and the process's ``StepMemory`` with them."""
    e, x = slot.episode, labelled(process.State, slot.x)
    slot.v_p_before, slot.Q_H_before = slot.v_p, slot.Q_H
    slot.clipped = 1.0 if (np.abs(pull) > 1.0 or np.abs(heat) > 1.0) else 0.0
    nominal, before = process.nominal(x, slot, interval), Inputs(slot.v_p_nominal, slot.Q_H_nominal)
    u = next_inputs(x, Inputs(slot.v_p, slot.Q_H_slewed), Inputs(pull, heat), before, drives, slot, interval, process)
    slot.v_p, slot.Q_H_slewed, slot.Q_H = u.v_p, u.Q_H, u.Q_H
    slot.v_p_nominal, slot.Q_H_nominal = nominal.v_p, nominal.Q_H
    if e.heater_step > 0.0:
        whole = nominal.Q_H + e.heater_step * np.rint((slot.Q_H_slewed - nominal.Q_H) / e.heater_step)
        slot.Q_H = np.maximum(whole, 0.0)
    step_memory = process.update_memory(labelled(process.StepMemory, slot), labelled(Inputs, slot), nominal, interval)
    set_labelled(process.StepMemory, step_memory, slot)


@force_inlined
def is_slow(e: Any) -> Any:
    """True if the heater has a lag or dead time."""
    return e.heater_lag + e.heater_dead_time > 0.0


@jittable
def mean_power(slot: Any, frames: Any, start: Any, stop: Any, interval: Any) -> Any:
    """Mean power [W] that heats from ``start`` to ``stop`` [s]: the one set, after the dead time and through the lag.

    The power set is constant in each control interval, so that both are exact, and the mean gives the plant the energy.
    ``frames`` holds those of the last intervals, this one's is added; the lag's output stays in the slot.
    """
    depth, lag, dead_time = frames.shape[0], slot.episode.heater_lag, slot.episode.heater_dead_time
    frames[slot.k % depth, _POWER] = slot.Q_H
    t, energy = start, 0.0
    while t < stop - _EPS:
        step = int(np.floor((t - dead_time) / interval + _EPS))
        end = min((step + 1) * interval + dead_time, stop)
        power, done = frames[step % depth, _POWER], -np.expm1(-(end - t) / lag) if lag > 0.0 else 1.0
        behind = slot.Q_heats - power
        energy += power * (end - t) + behind * lag * done
        slot.Q_heats = power + behind * (1.0 - done)
        t = end
    return energy / (stop - start)


@jittable
def _whole(value: Any, step: Any) -> Any:
    """The value in whole steps; as it is where the step is zero."""
    return step * np.rint(value / step) if step > 0.0 else value


@jittable
def sample_drives(slot: Any, frames: Any, interval: Any) -> None:
    """Keep what resolution and delay change in the readings of the drives; scale and offset follow from the episode."""
    e = slot.episode
    if e.delay + e.pull_resolution + e.heater_resolution > 0.0:
        depth, back = frames.shape[0], int(np.rint(e.delay / interval))
        frames[slot.k % depth, _DRIVES], frames[slot.k % depth, _DRIVES + 1] = slot.v_p, slot.Q_H
        then = (slot.k - back) % depth
        pull = e.pull_scale * frames[then, _DRIVES] + e.pull_offset
        power = e.heater_scale * frames[then, _DRIVES + 1] + e.heater_offset
        slot.v_p_misread = _whole(pull, e.pull_resolution) - (e.pull_scale * slot.v_p + e.pull_offset)
        slot.Q_H_misread = _whole(power, e.heater_resolution) - (e.heater_scale * slot.Q_H + e.heater_offset)


# Camera and pyrometer of a slot: frames, latency, noise, drop-outs and freezes.


@jittable
def store_camera_frame(slot: Any, frames: Any, t: Any, ring: Any, h_c: Any) -> None:
    """Store ring [m] and meniscus height [m] as the camera frame taken at t [s]."""
    at = slot.frames % frames.shape[0]
    frames[at, 0] = t
    frames[at, 1] = ring
    frames[at, 2] = h_c
    slot.frames = slot.frames + 1


@jittable
def _delivered(slot: Any, frames: Any, t: Any) -> Any:
    """Index of the newest frame that is at least as old as the latency, or else of the oldest frame."""
    depth = frames.shape[0]
    index = slot.frames - 1
    oldest = max(slot.frames - depth, 0)
    while index > oldest and frames[index % depth, 0] > t - slot.episode.latency + _EPS:
        index -= 1
    return index % depth


@jittable
def _freezes(slot: Any, t: Any) -> Any:
    """Whether the camera is frozen at t [s], and whether it is flagged as such."""
    frozen, flagged = False, False
    for which in range(FREEZES):
        if slot.freezes[which, 0] <= t < slot.freezes[which, 1]:
            frozen = True
            flagged = flagged or which < FREEZES - 1
    return frozen, flagged


@jittable
def _filtered(slot: Any, T_1: Any, t: Any) -> Any:
    """The true temperature [K] through the pyrometer's filter: exact for one that moves straight between samples."""
    tau = slot.episode.pyrometer_filter
    if slot.k == 0:
        slot.T_filtered = T_1
    else:
        interval = t / slot.k
        lead = (T_1 - slot.T_1_before) * (tau / interval)
        slot.T_filtered = T_1 - lead + (slot.T_filtered - slot.T_1_before + lead) * np.exp(-interval / tau)
    slot.T_1_before = T_1
    return slot.T_filtered


@jittable
def sample_sensors(slot: Any, camera: Any, pyrometer: Any, frames: Any, t: Any, seen: Any) -> None:
    """Read pyrometer and camera at t; ``seen`` are the readings of noise-free sensors without latency
    (:class:`cz_gym.process.PerfectReadings`).

    ``camera`` [m] (NaN: the sample drops out) and ``pyrometer`` [K] are the sample's noise. A frozen or dropped sample
    shows the last reading again.
    """
    e = slot.episode
    T_1 = _filtered(slot, seen.T_1, t) if e.pyrometer_filter > 0.0 else seen.T_1
    slot.T_1 = T_1 + pyrometer_drift(t, e) + pyrometer
    lost = np.isnan(camera)
    frozen, flagged = _freezes(slot, t)
    slot.valid = 0.0 if lost or flagged else 1.0
    taken, ring, h_c = t, seen.reading, seen.h_c
    if e.latency > 0.0:
        store_camera_frame(slot, frames, t, ring, h_c)
        at = _delivered(slot, frames, t)
        taken, ring, h_c = frames[at, 0], frames[at, 1], frames[at, 2]
    if slot.k == 0 or not (lost or frozen):
        slot.ring = ring + bias_offset(t, e)
        slot.h_seen, slot.k_seen = h_c, slot.k
        if e.ripple_amplitude > 0.0:
            slot.ring = slot.ring + ripple(taken, e)
        if not lost:
            slot.ring = slot.ring + camera


# The plant of eight slots in lockstep, so that the processor works on eight independent equations at once.
#
# Each slot has a lane, a column of a small array on the stack. Its substeps are prepared and judged one slot after the
# other; the integration between runs over all lanes at once, with the processor's vector instructions. Those do the
# same arithmetic, so that a slot's trajectory does not depend, in any bit, on the slots beside it.

LANES = 8
"""Slots in lockstep; the rows of a lane are those of :class:`cz_gym.engine.kernels.Model`."""


@jittable
def _disturb(slot: Any, j: Any, series: Any, process: Any) -> Any:
    """The disturbance at grid point j, this one or the next; the hidden load is solved only while the drift moves."""
    p, e = slot.puller, slot.episode
    if j != slot.point:
        slot.point = j
        slot.fast, slot.slow = next_fluctuation(e, slot.streams, slot.fast, slot.slow)
        slot.dT_i = fluctuation(e, slot.fast, slot.slow)
    shift = drift(j * GRID, e)
    if shift != slot.drift:
        slot.drift, slot.Q_d = shift, process.hidden_load(shift, p)
    if series.shape[1] > 0 and not np.isnan(series[slot.scenario, 0, 0]):
        at = min(j, series.shape[1] - 1)
        slot.Q_d, slot.dT_i = series[slot.scenario, at, 0], series[slot.scenario, at, 1]
    return process.disturb(slot.Q_d, slot.dT_i, j * GRID, e)


@jittable
def _begin(slot: Any, numbers: Any, lanes: Any, lane: Any, interval: Any, model: Any) -> None:
    """Copy a slot into its lane at the start of a control interval."""
    for constant in range(model.constants):
        lanes[constant, lane] = numbers[constant]
    set_column(model.process.State, slot.x, lanes, model.constants, lane)
    set_column(Inputs, slot, lanes, model.u_at, lane)
    lanes[model.dt_at + 1, lane] = slot.k * interval


@jittable
def _prepare(slot: Any, lanes: Any, lane: Any, interval: Any, series: Any, model: Any) -> None:
    """Prepare the next substep, to the next point of the 5 s grid or to the end of the interval."""
    t, end = lanes[model.dt_at + 1, lane], (slot.k + 1) * interval
    j = int(t / GRID + _EPS)
    upto = min((j + 1) * GRID, end)
    set_column(model.process.Disturbance, _disturb(slot, j, series, model.process), lanes, model.d_at, lane)
    lanes[model.dt_at, lane], lanes[model.dt_at + 1, lane] = upto - t, upto


@jittable
def _heat(memory: Any, first: Any, count: Any, lanes: Any, interval: Any, model: Any) -> None:
    """Give the lanes of slow heaters the power that heats in their substep."""
    for lane in range(count):
        slot, stop = memory.slots[first + lane], lanes[model.dt_at + 1, lane]
        if lanes[model.dt_at + 2, lane] > 0.0 and is_slow(slot.episode):
            start = stop - lanes[model.dt_at, lane]
            lanes[model.power_at, lane] = mean_power(slot, memory.frames[first + lane], start, stop, interval)


@inlined
def _integrate(lanes: Any, ends: Any, count: Any, model: Any) -> None:
    """Write the state that one RK4 substep of every lane ends in.

    No branch, no call, no array both read and written: so the compiler takes several lanes at once.
    """
    process = model.process
    for lane in range(count):
        x, u = column(process.State, lanes, model.constants, lane), column(Inputs, lanes, model.u_at, lane)
        d, p = column(process.Disturbance, lanes, model.d_at, lane), column(process.Constants, lanes, 0, lane)
        new = rk4(process.rates, x, u, d, p, lanes[model.dt_at, lane], model.meniscus)
        set_column(process.State, new, ends, 0, lane)


@jittable
def _accept_substep(slot: Any, frames: Any, lanes: Any, ends: Any, lane: Any, fixed: Any, model: Any) -> Any:
    """Accept or reject a substep; return whether the slot needs another one."""
    process, m = model.process, model.meniscus
    dt, upto = lanes[model.dt_at, lane], lanes[model.dt_at + 1, lane]
    x, u = column(process.State, lanes, model.constants, lane), column(Inputs, lanes, model.u_at, lane)
    d, new = column(process.Disturbance, lanes, model.d_at, lane), column(process.State, ends, 0, lane)
    new, slot.over = process.accept(slot, x, new, u, d, upto, dt, fixed.radius_limit, m)
    set_column(process.State, new, lanes, model.constants, lane)
    more = upto < (slot.k + 1) * fixed.interval - _EPS
    if more and slot.episode.latency > 0.0:
        seen = process.perfect_readings(new, slot.puller, m)
        store_camera_frame(slot, frames, upto, seen.reading, seen.h_c)
    return slot.over == GROWS and more


@jittable
def advance(memory: Any, active: Any, first: Any, count: Any, fixed: Any, model: Any) -> None:
    """Integrate the active ones of up to :data:`LANES` slots over one control interval, split at the 5 s grid.

    A slot is over if its crystal does not grow on.
    """
    goes = model.dt_at + 2
    going, slow, lanes, ends = 0, False, scratch(model.lane_rows, LANES), scratch(model.states, LANES)
    for lane in range(count):
        i = first + lane
        _begin(memory.slots[i], memory.numbers[i], lanes, lane, fixed.interval, model)
        lanes[goes, lane] = 1.0 if active[i] else 0.0
        going += 1 if active[i] else 0
        slow = slow or is_slow(memory.slots[i].episode)
    while going > 0:
        for lane in range(count):
            if lanes[goes, lane] > 0.0:
                _prepare(memory.slots[first + lane], lanes, lane, fixed.interval, fixed.series, model)
        if slow:
            _heat(memory, first, count, lanes, fixed.interval, model)
        _integrate(lanes, ends, count, model)
        for lane in range(count):
            if lanes[goes, lane] > 0.0:
                i = first + lane
                if not _accept_substep(memory.slots[i], memory.frames[i], lanes, ends, lane, fixed, model):
                    lanes[goes, lane] = 0.0
                    going -= 1
    for lane in range(count):
        if active[first + lane]:
            x = column(model.process.State, lanes, model.constants, lane)
            set_labelled(model.process.State, x, memory.slots[first + lane].x)
            memory.slots[first + lane].k += 1
