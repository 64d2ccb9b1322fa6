"""The plant of eight slots in lockstep, so that the processor works on eight independent equations at once.

Each slot has a lane, a column of a small array on the stack. Its substeps are prepared and judged one slot after the
other; the integration between runs over all lanes at once, with the processor's vector instructions. Those do the same
arithmetic, so that a slot's trajectory does not depend, in any bit, on the slots beside it.
"""

from typing import Any

import numpy as np

from cz_gym.episodes.noise import fluctuation, next_fluctuation
from cz_gym.episodes.scenario import GRID
from cz_gym.episodes.schedule import drift
from cz_gym.jit.compile import column, inlined, jittable, scratch, set_column, set_labelled
from cz_gym.physics.arithmetic import rk4
from cz_gym.process import GROWS, Inputs

from .drives import is_slow, mean_power
from .sensors import photograph

LANES = 8
"""Slots in lockstep; the rows of a lane are those of :class:`cz_gym.engine.layout.Model`."""
_EPS = 1e-9


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
        seen = process.see(new, slot.puller, m)
        photograph(slot, frames, upto, seen.reading, seen.h_c)
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
