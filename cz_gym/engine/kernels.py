"""The compiled loops: draws, drives, plant, sensors, observation and reward, for one slot or ten thousand.

The equations are the functions of :mod:`cz_gym.body.plant`, :mod:`cz_gym.body.schedule` and :mod:`cz_gym.body.task`,
compiled in; this module calls them in order for each slot.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from cz_gym.body.cost import Cost, cost_terms, reward
from cz_gym.body.plant import Disturbance, State, derive_puller, growth
from cz_gym.body.schedule import bias_offset
from cz_gym.body.signals import INFO, LEAN, logged, measure, true_state
from cz_gym.episodes.draw import draw_episode, draw_factors, draw_scenario, randomised, seed_streams
from cz_gym.episodes.noise import first_fluctuation, fluctuation, sample_noise
from cz_gym.jit.cache import hashed
from cz_gym.jit.compile import fetch, inlined, jittable, kernel
from cz_gym.physics.meniscus import MeniscusModel

from .layout import EPISODE_AT, PULLER_AT, SLOT
from .lockstep import LANES, advance, height_inside
from .outputs import clip, recall, remember, write_channels, write_info
from .sensors import sense

TRIES = 100
"""Largest number of draws of a puller, all from one stream, until one has an operating point."""
_R_C, _R_REF, _CLIPPED = (INFO.index(name) for name in (*LEAN, "action_clipped"))
_LINE = 8
"""Eight-byte numbers in a cache line."""
_NUMBERS, _INFOS = SLOT.itemsize // 8, len(INFO)


@jittable
def _begin(slot: Any) -> None:
    """Put a slot with drawn constants at the start of its episode."""
    p, e = slot.puller, slot.episode
    slot.x.r_c, slot.x.h_c = p.r_0 + e.r_c_start, p.h_0
    slot.x.T_1, slot.x.T_2, slot.x.T_b = p.T_1_0, p.T_2_0, p.T_b_0
    slot.v_p, slot.Q_H, slot.Q_H_slewed = p.v_0, p.Q_H_0, p.Q_H_0
    slot.v_p_before, slot.Q_H_before, slot.clipped = p.v_0, p.Q_H_0, 0.0
    slot.fast, slot.slow = first_fluctuation(e, slot.streams)
    slot.dT_i, slot.Q_d, slot.drift = fluctuation(e, slot.fast, slot.slow), 0.0, np.nan
    slot.integral = 0.0
    slot.k = slot.frames = slot.over = slot.point = 0


@jittable
def next_speed(v_p: Any, pull: Any, drives: Any, p: Any, e: Any, interval: Any) -> Any:
    """The pull speed [m/s] after an action, within its window and slew rate."""
    speed = drives.keep * ((v_p - p.v_0) / p.v_0) + drives.pull * clip(pull, 1.0)
    wanted = p.v_0 + clip(p.v_0 * clip(speed, 1.0), e.pull_window)
    return v_p + clip(wanted - v_p, e.pull_slew * interval)


@jittable
def next_power(Q_H: Any, heat: Any, drives: Any, p: Any, e: Any, interval: Any) -> Any:
    """The heater power [W] after an action, within its slew rate, before it is rounded to whole steps."""
    share = drives.keep * ((Q_H - p.Q_H_0) / drives.power) + drives.heater * clip(heat, 1.0)
    power = p.Q_H_0 + drives.power * clip(share, 1.0)
    power = power if power.real > 0.0 else 0.0
    return Q_H + clip(power - Q_H, e.heater_slew * interval)


@jittable
def _drive(slot: Any, pull: Any, heat: Any, drives: Any, interval: Any) -> None:
    """Move the drives by an action, the heater in whole steps."""
    p, e = slot.puller, slot.episode
    slot.v_p_before, slot.Q_H_before = slot.v_p, slot.Q_H
    slot.clipped = 1.0 if (np.abs(pull) > 1.0 or np.abs(heat) > 1.0) else 0.0
    slot.v_p = next_speed(slot.v_p, pull, drives, p, e, interval)
    slot.Q_H_slewed = next_power(slot.Q_H_slewed, heat, drives, p, e, interval)
    slot.Q_H = slot.Q_H_slewed
    if e.heater_step > 0.0:
        whole = p.Q_H_0 + e.heater_step * np.rint((slot.Q_H_slewed - p.Q_H_0) / e.heater_step)
        slot.Q_H = np.maximum(whole, 0.0)


@inlined
def _sample(memory: Any, i: Any, fresh: Any, clock: Any, scales: Any, out: Any, slope: Any, ring_offset: Any) -> Any:
    """Read the sensors of slot i if ``fresh``, write observation and info, and return the terms of the step's cost."""
    slot, p, x = memory.slots[i], memory.slots[i].puller, memory.slots[i].x
    t, h_c = slot.k * clock.interval, height_inside(x.h_c, p)
    ring = x.r_c + ring_offset(x.r_c, h_c, p)
    if fresh:
        camera, pyrometer = sample_noise(slot.episode, slot.streams)
        sense(slot, camera, pyrometer, memory.frames[i], t, ring - p.ring_bias, h_c)
    measured = measure(slot, t)
    row = out.observation[i]
    write_channels(measured, scales.measured, row)
    if memory.history.shape[1] > 0:
        if fresh:
            remember(slot, memory.history[i], clock.interval, row)
        recall(slot, measured, memory.history[i], scales, row)
    if out.state.shape[1] > 0:
        write_channels(true_state(slot, measured, t), scales.state, out.state[i])
    error = x.r_c - p.r_0 - measured.r_ref + bias_offset(t, slot.episode)
    cost = cost_terms(error, measured.v_p, slot.v_p - slot.v_p_before, slot.Q_H - slot.Q_H_before)
    if slot.k == 0:
        cost = Cost(0.0, 0.0, 0.0, 0.0)
    if scales.everything:
        at_interface = growth(State(x.r_c, h_c, x.T_1, x.T_2, x.T_b), Disturbance(slot.Q_d, slot.dT_i, 1.0), p, slope)
        write_info(logged(slot, measured, cost, t, ring, at_interface), out.info[:, i])
    else:
        out.info[_R_C, i], out.info[_R_REF, i] = x.r_c, p.r_0 + measured.r_ref
        out.info[_CLIPPED, i] = slot.clipped
    return cost


def _read(memory: Any, i: Any, fresh: Any, clock: Any, scales: Any, out: Any, slope: Any, ring_offset: Any) -> None:
    _sample(memory, i, fresh, clock, scales, out, slope, ring_offset)
    out.reward[i] = 0.0
    out.terminated[i] = out.truncated[i] = False


_sample_alone = kernel(_read, keep=False, allocates=False)
"""A sample as a compiled function, with the options of the step, so that the functions it calls compile only once."""


@jittable
def _fetch_slot(numbers: Any, i: Any) -> None:
    """Prefetch slot i: fetching a slot of a large batch takes longer than a step."""
    for at in range(0, _NUMBERS, _LINE):
        fetch(numbers, i * _NUMBERS + at)


@jittable
def _fetch_info(info: Any, i: Any) -> None:
    """Prefetch the info columns from slot i on."""
    for row in range(_INFOS):
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
    """The compiled loops for one meniscus model."""

    step: Any
    """``step(memory, actions, active, clock, drives, scales, out, start, stop)``: one control interval of the active
    slots; returns how many episodes ended."""
    draw: Any
    """``draw(memory, which, keys, lots, parameters, clock, scales, out, start, stop)``: new episodes, each
    from its key, for the slots ``which[start:stop]``, with their first sample; returns -1, or a slot whose
    :data:`TRIES` draws gave no puller with an operating point."""
    show: Any
    """``show(memory, which, clock, scales, out, start, stop)``: writes the last sample of the slots
    ``which[start:stop]`` again."""
    plant: Any
    """``plant(memory, actions, active, clock, drives, rings, start, stop)``: drives, plant and ring of all slots alone,
    to measure speed against."""


@lru_cache(maxsize=8)
def build_kernels(meniscus: MeniscusModel) -> Kernels:
    """Compile the loops for a meniscus model; those of this package's models are cached on disk."""
    slope, ring_offset, height = meniscus.slope, meniscus.ring_offset, meniscus.height

    def step(
        memory: Any, actions: Any, active: Any, clock: Any, drives: Any, scales: Any, out: Any, start: int, stop: int
    ) -> int:
        ended, remembers = 0, memory.history.shape[1] > 0
        for first in range(start, stop, LANES):
            count = min(LANES, stop - first)
            for i in range(first, first + count):
                if active[i]:
                    _drive(memory.slots[i], actions[i, 0], actions[i, 1], drives, clock.interval)
            advance(memory, active, first, count, clock, slope, ring_offset)
            if scales.everything:
                _fetch_info(out.info, first + LANES)
            for i in range(first, first + count):
                _fetch_slot(memory.numbers, i + LANES)
                if remembers and i + 1 < first + count:
                    _fetch_history(memory.slots[i + 1], memory.history[i + 1], scales.before)
                if not active[i]:
                    continue
                slot, grows = memory.slots[i], memory.slots[i].over == 0
                cost = _sample(memory, i, True, clock, scales, out, slope, ring_offset)
                ends = slot.k >= clock.steps
                out.reward[i] = reward(cost, grows)
                out.terminated[i] = not grows
                out.truncated[i] = grows and ends
                slot.over = 1 if (not grows or ends) else 0
                ended += slot.over
        return ended

    def draw(
        memory: Any, which: Any, keys: Any, lots: Any, parameters: Any, clock: Any, scales: Any, out: Any,
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
                puller = derive_puller(randomised(parameters, factors), factors.lam, height, ring_offset)
                tries, sound = tries + 1, True
                for number in range(len(puller)):
                    numbers[PULLER_AT + number] = puller[number]
                    sound = sound and np.isfinite(puller[number])
            impossible = impossible if sound else i
            episode = draw_episode(record, slot.streams, slot.freezes)
            for number in range(len(episode)):
                numbers[EPISODE_AT + number] = episode[number]
            _begin(slot)
            _sample_alone(memory, i, True, clock, scales, out, slope, ring_offset)
        return impossible

    def show(memory: Any, which: Any, clock: Any, scales: Any, out: Any, start: int, stop: int) -> None:
        for at in range(start, stop):
            _sample_alone(memory, which[at], False, clock, scales, out, slope, ring_offset)

    def plant(
        memory: Any, actions: Any, active: Any, clock: Any, drives: Any, rings: Any, start: int, stop: int
    ) -> None:
        for first in range(start, stop, LANES):
            count = min(LANES, stop - first)
            for i in range(first, first + count):
                _drive(memory.slots[i], actions[i, 0], actions[i, 1], drives, clock.interval)
            advance(memory, active, first, count, clock, slope, ring_offset)
            for i in range(first, first + count):
                _fetch_slot(memory.numbers, i + LANES)
                p, x = memory.slots[i].puller, memory.slots[i].x
                rings[i] = x.r_c + ring_offset(x.r_c, height_inside(x.h_c, p), p)

    keep = hashed(*meniscus.functions)
    return Kernels(
        kernel(step, keep, allocates=False),
        kernel(draw, keep),
        kernel(show, keep, allocates=False),
        kernel(plant, keep, allocates=False),
    )
