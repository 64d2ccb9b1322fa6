"""The compiled loops and their arrays: draws, drives, plant, sensors, observation, reward, for one slot or thousands.

The equations are the functions of a :class:`cz_gym.process.Process`, compiled in; this module calls them in order for
each slot, and turns its signals into scaled channels, the memory of "history" and the rows of ``info``. First come
the arrays: the memory of a slot, the constants of a step and its results.
"""

from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from cz_gym.episodes.draw import (
    FREEZES,
    Episode,
    Stream,
    draw_episode,
    draw_factors,
    draw_scenario,
    first_fluctuation,
    fluctuation,
    sample_noise,
    seed_streams,
)
from cz_gym.episodes.rng import WORDS
from cz_gym.jit import fetch, hashed, inlined, jittable, kernel, labelled, scratch, set_labelled, static
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.process import GROWS, LOST, Inputs, Process, Readings, along, clip
from cz_gym.spaces import CLIP, INTEGRAL_SCALE
from cz_gym.support.errors import CzError

from .loop import LANES, advance, drive, sample_drives, sample_sensors


def _record(kind: Any) -> np.dtype[Any]:
    return np.dtype([(name, np.float64) for name in kind._fields])


@cache
def slot_type(process: Process) -> np.dtype[Any]:
    """One slot of a process.

    Constants of puller and episode, plant state, drives [m/s, W], the disturbance of the last substep, last readings
    (``ring`` [m] without the operator's bias, with the meniscus height ``h_seen`` [m] and the sample ``k_seen`` it was
    taken at, ``T_1`` [K], ``valid``), the integral of the scaled ring error, the drift [K] that ``Q_d`` belongs to, the
    sample number ``k``, the number of camera frames taken, whether the episode is over, the ``key`` it was drawn from
    and the index of its ``scenario`` in the mixture, the drives [m/s, W] of the step before and whether the action was
    clipped: a sample can be written again from its slot. Then the 5 s grid point that ``dT_i`` belongs to with its two
    processes [standard deviations], the episode's random streams, as far as they are drawn from, the power that heats
    [W] where the heater is slow, the pyrometer's filter with the true temperature at the last sample [K], the nominal
    drives [m/s, W] from which the last action was counted, what resolution and delay change in the readings of the
    drives [m/s, W], and what the process adds: the fields of ``StepMemory``
    and ``Sensed``, and its table.
    """
    number, whole, table = np.float64, np.int64, process.table
    return np.dtype(
        [
            ("puller", _record(process.Constants)),
            ("episode", _record(Episode)),
            ("x", _record(process.State)),
            ("freezes", number, (FREEZES, 2)),
            *((name, number) for name in ("v_p", "Q_H", "Q_H_slewed", "dT_i", "Q_d", "ring", "h_seen", "T_1", "valid")),
            *((name, number) for name in ("integral", "drift")),
            *((name, whole) for name in ("k", "frames", "over", "k_seen")),
            ("key", np.uint64, (2,)),
            ("scenario", whole),
            *((name, number) for name in ("v_p_before", "Q_H_before", "clipped")),
            ("point", whole),
            ("fast", number),
            ("slow", number),
            ("streams", np.uint64, (len(Stream), WORDS)),
            *((name, number) for name in ("Q_heats", "T_filtered", "T_1_before")),
            *((name, number) for name in ("v_p_nominal", "Q_H_nominal", "v_p_misread", "Q_H_misread")),
            *((name, number) for name in (*process.StepMemory._fields, *process.Sensed._fields)),
            *([("table", number, table)] if table[0] else []),
        ],
        align=True,
    )


@static
class Model(NamedTuple):
    """A process on a meniscus, compiled into the loops, and the places of its numbers (:func:`model_of`)."""

    process: Process
    meniscus: MeniscusModel
    stride: int
    """Length of a slot [numbers of 8 bytes]."""
    slot_numbers: int
    """Length of a slot without its table [numbers of 8 bytes]."""
    info_rows: int
    """Rows of ``info``."""
    brief_rows: tuple[int, ...]
    """Rows of ``info="lean"``, and that of the clipped action."""
    constants: int
    """Number of the puller's constants: place of the episode in a slot, row of the state in a lane."""
    states: int
    """Number of states: place of the pull speed in the differentiable state."""
    u_at: int
    """Row of the inputs in a lane."""
    power_at: int
    """Row of the power that heats in a lane."""
    d_at: int
    """Row of the disturbance in a lane."""
    dt_at: int
    """Row of the substep [s] in a lane; then the time that is reached [s], and whether the slot goes on."""
    lane_rows: int
    memory_at: int
    """Place of ``StepMemory`` in the differentiable state; number of states and inputs."""
    memories: int
    """Number of fields of ``StepMemory``."""
    nominal: int
    """Place of the nominal inputs in the differentiable state."""
    nominals: int
    """Number of nominal inputs in the differentiable state: none where they do not move."""
    ring: int
    """Place of the ring in the differentiable state; the reading follows."""
    smooth: int
    """Length of the differentiable state: column of the first action, row of the cost's first term."""
    columns: int
    """Columns of a Jacobian: differentiable state and actions."""
    costs: int
    """Number of terms of the cost."""
    driven_by: int
    """Columns of the next inputs' derivatives: state, inputs, actions, the nominal inputs before."""
    memory_by: int
    """Columns of the derivatives of ``StepMemory``: itself, the inputs, the nominal ones."""
    cost_by: int
    """Columns of the cost's derivatives: state, inputs and those before, ``StepMemory``."""
    channels: int
    """Number of channels of "measured"."""
    shown_by: int
    """Columns of the channels' derivatives: state, inputs, the nominal ones, ``StepMemory``, readings."""


@cache
def model_of(process: Process, meniscus: MeniscusModel) -> Model:
    """The model of a process on a meniscus."""
    u, stride = len(Inputs._fields), slot_type(process).itemsize // 8
    constants, states, loads, memories, costs = (
        len(kind._fields)
        for kind in (process.Constants, process.State, process.Disturbance, process.StepMemory, process.Cost)
    )
    u_at, nominal, nominals = constants + states, states + u + memories, u if process.nominal_moves else 0
    ring = nominal + nominals
    dt_at, lean = u_at + u + loads, (*process.BriefInfo._fields, "action_clipped")
    return Model(
        process, meniscus, stride, stride - process.table[0] * process.table[1], len(process.info),
        tuple(map(process.info.index, lean)), constants, states, u_at, u_at + 1, u_at + u, dt_at, dt_at + 3,
        states + u, memories, nominal, nominals, ring, ring + 2, ring + 2 + u, costs, states + 3 * u, memories + 2 * u,
        states + 2 * u + memories, len(process.measured), states + 2 * u + memories + len(Readings._fields),
    )  # fmt: skip


class BatchConstants(NamedTuple):
    """Constants that all slots share and no step changes: time base, radius limit, cost weights, logged series."""

    interval: float
    """Control interval [s]."""
    steps: int
    """Steps in an episode."""
    grid_points: int
    """Points of the 5 s grid in an episode."""
    radius_limit: float
    """Largest |r_c - r_ref| [m]."""
    weights: Any
    """Weights of the cost's terms, a named tuple."""
    series: Any
    """Load [W] and fluctuation [K] from logs, one row a scenario, shape (scenarios, points, 2); no points: none."""


class SlotMemory(NamedTuple):
    """The memory of the slots, one row per slot."""

    slots: Any
    """Records of :func:`slot_type`, shape (n,)."""
    numbers: Any
    """The same memory as plain float64, shape (n, numbers a record)."""
    history: Any
    """Running sums of the remembered channels, circular in time, shape (n, depth, channels); depth 0: none."""
    frames: Any
    """Time [s], ring [m] and meniscus height [m] of camera frames, the power [W] set in each control interval, and
    pull speed [m/s] and power [W] at each sample: all circular in time, shape (n, depth, 6)."""


class Out(NamedTuple):
    """The results of a step, one row per slot."""

    observation: Any
    """The "measured" or "history" channels, float32, shape (n, channels)."""
    state: Any
    """The "state" channels, float32, shape (n, channels); of width 0 if not wanted."""
    image: Any
    """The camera's image, uint8, shape (n, rows, columns, 1); empty unless it is the observation. Written after the
    step, by :mod:`cz_gym.camera.image`."""
    reward: Any
    """Float64, shape (n,)."""
    terminated: Any
    """Bool, shape (n,)."""
    truncated: Any
    """Bool, shape (n,)."""
    info: Any
    """Rows of the process' ``Logged``, float64, shape (rows, n or a little more:
    see :func:`info_width`)."""


class ObservationScales(NamedTuple):
    """Constants with which a slot's signals become an observation."""

    measured: Any
    """One over the scales of the measured channels, shape (channels,)."""
    state: Any
    """One over the scales of the state channels, shape (channels,)."""
    newest: Any
    """Age of the newest sample of each remembered span, shape (lags,)."""
    before: Any
    """Age of the sample before the oldest one of each span, shape (lags,)."""
    share: Any
    """One over the number of samples in each span, shape (lags,)."""
    everything: bool
    """True: all of ``info`` is written; false: the rows of ``BriefInfo`` and ``action_clipped``."""


INFO_CHOICES = ("lean", "all")


def check_info(info: str) -> bool:
    """Return whether all of ``info`` is wanted; raise CzError for anything but "lean" and "all"."""
    if info not in INFO_CHOICES:
        raise CzError(f"info must be one of {', '.join(INFO_CHOICES)}, not {info!r}")
    return info == "all"


def info_width(n: int) -> int:
    """Length of an info row for n slots: rows a multiple of 4 KiB apart would share one set of the cache."""
    return n + 8 if n % 64 == 0 else n


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
    power = nominal.Q_H - e.told_power  # the crystal grows, whatever the controller is told
    slot.v_p, slot.Q_H, slot.Q_H_slewed = nominal.v_p, power, power
    slot.v_p_before, slot.Q_H_before, slot.clipped = nominal.v_p, power, 0.0
    slot.v_p_nominal, slot.Q_H_nominal = nominal.v_p, nominal.Q_H
    slot.fast, slot.slow = first_fluctuation(e, slot.streams)
    slot.dT_i, slot.Q_d, slot.drift = fluctuation(e, slot.fast, slot.slow), 0.0, np.nan
    slot.integral, slot.Q_heats = 0.0, power
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
        process.read_sensors(slot, model.meniscus)
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
