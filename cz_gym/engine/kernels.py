"""The compiled loops: draws, drives, plant, sensors, observation and reward, for one slot or ten thousand.

The equations are the functions of a :class:`cz_gym.process.Process`, compiled in; this module calls them in order for
each slot, and turns its signals into scaled channels, the memory of "history" and the rows of ``info``.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from cz_gym.episodes.draw import (
    draw_episode,
    draw_factors,
    draw_scenario,
    first_fluctuation,
    fluctuation,
    sample_noise,
    seed_streams,
)
from cz_gym.jit import fetch, hashed, inlined, jittable, kernel, labelled, scratch, set_labelled
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.physics.numerics import along, clip
from cz_gym.process import GROWS, LOST, Inputs, Process, Readings
from cz_gym.spaces import CLIP, INTEGRAL_SCALE

from .loop import LANES, advance, drive, sample_drives, sample_sensors
from .slots import model_of


@jittable
def write_channels(values: Any, per_scale: Any, out: Any) -> None:
    """Write signals scaled and clipped, as "measured" or "state" channels."""
    for channel in range(len(values)):
        out[channel] = clip(values[channel] * per_scale[channel], CLIP)


@jittable
def update_history(slot: Any, history: Any, interval: Any, out: Any, process: Any) -> None:
    """Add the sample's scaled channels to the running sums, and the first of them, the error, to its integral."""
    depth, error = history.shape[0], process.past_at[0]
    if slot.k == 0:
        for back in range(depth):
            history[depth - 1 - back, 0] = -out[error] * back
            for channel in range(1, len(process.past_at)):
                history[depth - 1 - back, channel] = 0.0
    else:
        step = out[error] * (process.integrated_scale / INTEGRAL_SCALE) * interval
        slot.integral = clip(slot.integral + step, CLIP)
    at = slot.k % depth
    before = at - 1 if at > 0 else depth - 1
    for channel in range(len(process.past_at)):
        history[at, channel] = history[before, channel] + out[process.past_at[channel]]


@jittable
def write_history(slot: Any, measured: Any, history: Any, scales: Any, out: Any, process: Any) -> None:
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


TRIES = 100
"""Largest number of draws of a puller, all from one stream, until one has an operating point."""
_LINE = 8
"""Eight-byte numbers in a cache line."""


@jittable
def _begin(slot: Any, interval: Any, model: Any) -> None:
    """Put a slot with drawn constants at the start of its episode."""
    e, process = slot.episode, model.process
    set_labelled(process.State, process.begin(slot, model.meniscus), slot.x)
    nominal = process.nominal(slot.x, slot, interval)
    slot.v_p, slot.Q_H, slot.Q_H_slewed = nominal.v_p, nominal.Q_H, nominal.Q_H
    slot.v_p_before, slot.Q_H_before, slot.clipped = nominal.v_p, nominal.Q_H, 0.0
    slot.v_p_nominal, slot.Q_H_nominal = nominal.v_p, nominal.Q_H
    slot.fast, slot.slow = first_fluctuation(e, slot.streams)
    slot.dT_i, slot.Q_d, slot.drift = fluctuation(e, slot.fast, slot.slow), 0.0, np.nan
    slot.integral, slot.Q_heats = 0.0, nominal.Q_H
    slot.v_p_misread = slot.Q_H_misread = 0.0
    slot.k = slot.frames = slot.over = slot.point = 0


@inlined
def _sample(memory: Any, i: Any, fresh: Any, fixed: Any, scales: Any, out: Any, model: Any) -> Any:
    """Read the sensors of slot i if ``fresh``, write observation and info, and return the terms of the step's cost."""
    process, slot = model.process, memory.slots[i]
    t, x = slot.k * fixed.interval, labelled(process.State, slot.x)
    seen = process.perfect_readings(x, slot.puller, model.meniscus)
    if fresh:
        camera, pyrometer = sample_noise(slot.episode, slot.streams)
        sample_sensors(slot, camera, pyrometer, memory.frames[i], t, seen)
        sample_drives(slot, memory.frames[i], fixed.interval)
        process.draw_sensor_noise(slot)
    u, before = labelled(Inputs, slot), Inputs(slot.v_p_before, slot.Q_H_before)
    step_memory = labelled(process.StepMemory, slot)
    nominal = Inputs(slot.v_p_nominal, slot.Q_H_nominal)
    measured = process.measure(x, u, nominal, step_memory, labelled(Readings, slot), slot, t)
    row = out.observation[i]
    write_channels(measured, scales.measured, row)
    if memory.history.shape[1] > 0:
        if fresh:
            update_history(slot, memory.history[i], fixed.interval, row, process)
        write_history(slot, measured, memory.history[i], scales, row, process)
    if out.state.shape[1] > 0:
        write_channels(process.true_state(slot, measured, t), scales.state, out.state[i])
    cost = process.cost_terms(process.cost_inputs(x, u, before, step_memory, slot, t), fixed.weights)
    if slot.k == 0:
        cost = along(cost, -1.0, cost)
    if scales.everything:
        logged = process.logged(slot, measured, cost, t, seen.ring, model.meniscus)
        for entry in range(len(logged)):
            out.info[entry, i] = logged[entry]
    else:
        brief = process.brief_info(slot, measured)
        for entry in range(len(brief)):
            out.info[model.brief_rows[entry], i] = brief[entry]
        out.info[model.brief_rows[len(brief)], i] = slot.clipped
    return cost


def _read(memory: Any, i: Any, fresh: Any, fixed: Any, scales: Any, out: Any, model: Any) -> None:
    _sample(memory, i, fresh, fixed, scales, out, model)
    out.reward[i] = 0.0
    out.terminated[i] = out.truncated[i] = False


_sample_alone = kernel(_read, keep=False, allocates=False)
"""A sample as a compiled function, with the options of the step, so that the functions it calls compile only once."""


@jittable
def _fetch_slot(numbers: Any, i: Any, model: Any) -> None:
    """Prefetch slot i: fetching a slot of a large batch takes longer than a step."""
    for at in range(0, model.slot_numbers, _LINE):
        fetch(numbers, i * model.stride + at)


@jittable
def _fetch_info(info: Any, i: Any, model: Any) -> None:
    """Prefetch the info columns from slot i on."""
    for row in range(model.info_rows):
        fetch(info, row * info.shape[1] + i)


@jittable
def _fetch_history(slot: Any, history: Any, before: Any) -> None:
    """Prefetch the samples at which the spans of a slot's past end."""
    depth, channels = history.shape
    at = slot.k % depth
    for lag in range(before.size):
        place = at - before[lag]
        fetch(history, (place if place >= 0 else place + depth) * channels)


class Kernels(NamedTuple):
    """The compiled loops for one process on one meniscus model."""

    step: Any
    """``step(memory, actions, active, fixed, drives, scales, out, start, stop)``: one control interval of the active
    slots; returns how many episodes ended."""
    draw: Any
    """``draw(memory, which, keys, lots, parameters, fixed, scales, out, start, stop)``: new episodes, each
    from its key, for the slots ``which[start:stop]``, with their first sample; returns -1, or a slot whose
    :data:`TRIES` draws gave no puller with an operating point."""
    show: Any
    """``show(memory, which, fixed, scales, out, start, stop)``: writes the last sample of the slots
    ``which[start:stop]`` again."""
    plant: Any
    """``plant(memory, actions, active, fixed, drives, rings, start, stop)``: drives, plant and ring of all slots alone,
    to measure speed against."""


@lru_cache(maxsize=8)
def build_kernels(process: Process, meniscus: MeniscusModel) -> Kernels:
    """Compile the loops for a process on a meniscus; those of this package's own are cached on disk."""
    model = model_of(process, meniscus)

    def step(
        memory: Any, actions: Any, active: Any, fixed: Any, drives: Any, scales: Any, out: Any, start: int, stop: int
    ) -> int:
        ended, remembers = 0, memory.history.shape[1] > 0
        for first in range(start, stop, LANES):
            count = min(LANES, stop - first)
            for i in range(first, first + count):
                if active[i]:
                    drive(memory.slots[i], actions[i, 0], actions[i, 1], drives, fixed.interval, model.process)
            advance(memory, active, first, count, fixed, model)
            if scales.everything:
                _fetch_info(out.info, first + LANES, model)
            for i in range(first, first + count):
                _fetch_slot(memory.numbers, i + LANES, model)
                if remembers and i + 1 < first + count:
                    _fetch_history(memory.slots[i + 1], memory.history[i + 1], scales.before)
                if not active[i]:
                    continue
                slot, outcome = memory.slots[i], memory.slots[i].over
                cost = _sample(memory, i, True, fixed, scales, out, model)
                ends = slot.k >= fixed.steps
                out.reward[i] = model.process.reward(cost, outcome != LOST)
                out.terminated[i] = outcome != GROWS
                out.truncated[i] = outcome == GROWS and ends
                slot.over = LOST if outcome == GROWS and ends else outcome
                ended += 1 if slot.over != GROWS else 0
        return ended

    def draw(
        memory: Any, which: Any, keys: Any, lots: Any, parameters: Any, fixed: Any, scales: Any, out: Any,
        start: int, stop: int,
    ) -> int:  # fmt: skip
        impossible = -1
        for at in range(start, stop):
            i = which[at]
            slot, numbers = memory.slots[i], memory.numbers[i]
            slot.key[0], slot.key[1] = keys[at, 0], keys[at, 1]
            seed_streams(slot.streams, slot.key)
            slot.scenario = draw_scenario(lots.cumulative_share, slot.key)
            record, mix = lots.records[slot.scenario], lots.mixes[slot.scenario]
            tries, sound = 0, False
            while not sound and tries < TRIES:
                factors = draw_factors(record, mix, slot.streams)
                puller = model.process.derive(parameters, factors, model.meniscus)
                tries, sound = tries + 1, True
                for number in range(len(puller)):
                    numbers[number] = puller[number]
                    sound = sound and np.isfinite(puller[number])
            impossible = impossible if sound else i
            episode = draw_episode(record, slot.streams, slot.freezes)
            for number in range(len(episode)):
                numbers[model.constants + number] = episode[number]
            _begin(slot, fixed.interval, model)
            memory.frames[i, :, 3] = slot.Q_H
            memory.frames[i, :, 4], memory.frames[i, :, 5] = slot.v_p, slot.Q_H
            _sample_alone(memory, i, True, fixed, scales, out, model)
        return impossible

    def show(memory: Any, which: Any, fixed: Any, scales: Any, out: Any, start: int, stop: int) -> None:
        for at in range(start, stop):
            _sample_alone(memory, which[at], False, fixed, scales, out, model)

    def plant(
        memory: Any, actions: Any, active: Any, fixed: Any, drives: Any, rings: Any, start: int, stop: int
    ) -> None:
        for first in range(start, stop, LANES):
            count = min(LANES, stop - first)
            for i in range(first, first + count):
                drive(memory.slots[i], actions[i, 0], actions[i, 1], drives, fixed.interval, model.process)
            advance(memory, active, first, count, fixed, model)
            for i in range(first, first + count):
                _fetch_slot(memory.numbers, i + LANES, model)
                x = labelled(process.State, memory.slots[i].x)
                rings[i] = process.perfect_readings(x, memory.slots[i].puller, meniscus).ring

    keep = hashed(*process.functions, *meniscus.functions)
    return Kernels(
        kernel(step, keep, allocates=False),
        kernel(draw, keep),
        kernel(show, keep, allocates=False),
        kernel(plant, keep, allocates=False),
    )
