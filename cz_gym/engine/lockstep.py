"""The plant of eight slots in lockstep, so that the processor works on eight independent equations at once.

Each slot has a lane, a column of a small array on the stack. Its substeps are prepared and judged one slot after the
other; the integration between runs over all lanes at once, with the processor's vector instructions. Those do the same
arithmetic, so that a slot's trajectory does not depend, in any bit, on the slots beside it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cz_gym.body.plant import Disturbance, Inputs, Puller, State, growth, hidden_load, rk4
from cz_gym.body.schedule import drift, melt_left, reference
from cz_gym.body.task import HEIGHT_MAX_IN_A, HEIGHT_MIN, RADIUS_LIMIT, within_limits
from cz_gym.episodes.noise import fluctuation, next_fluctuation
from cz_gym.episodes.record import GRID
from cz_gym.jit.compile import column, inlined, jittable, scratch, set_column
from cz_gym.support.units import MM

from .layout import PULLER_AT, STATE_AT
from .sensors import photograph

LANES = 8
"""Slots in lockstep."""
_P, _X, _U, _D = len(Puller._fields), len(State._fields), len(Inputs._fields), len(Disturbance._fields)
_X_AT, _U_AT, _D_AT, _DT, _T, _GOES, _ROWS = np.cumsum([_P, _X, _U, _D, 1, 1, 1]).tolist()
"""Rows of the lanes: the puller first, then state, inputs and disturbance; the substep [s]; the time that is reached
[s]; whether the slot has not reached the end of its interval."""
_EPS = 1e-9
_LOW = 5.0 * MM
"""Above this height no melt can freeze the meniscus within half a substep [m]."""
_JUMP = HEIGHT_MIN


@jittable
def height_inside(h_c: Any, p: Any) -> Any:
    """The meniscus height limited to its range, so that a failed state can still be measured."""
    top = HEIGHT_MAX_IN_A * p.a
    if h_c.real < HEIGHT_MIN:
        return HEIGHT_MIN
    return top if h_c.real > top else h_c


@jittable
def judged(
    x: Any, new: Any, u: Any, d: Any, p: Any, dt: Any, r_ref: Any, slope: Any, radius_limit: Any = RADIUS_LIMIT
) -> Any:
    """The state after a substep and whether the crystal still grows; after an impossible jump the state before it.

    Over a melt far too cold a low meniscus freezes within seconds, and a step across that singularity can end anywhere,
    inside the limits too. There the height falls faster and faster, so half the step at the first rate tells.
    """
    inside = within_limits(new.r_c, new.h_c, r_ref, p.a, radius_limit)
    grows = inside
    if inside and x.h_c < _LOW:
        grows = x.h_c + 0.5 * dt * (u.v_p - growth(x, d, p, slope).v_g) >= HEIGHT_MIN
    if not grows and (inside or not (np.abs(new.r_c - x.r_c) < _JUMP and np.abs(new.h_c - x.h_c) < _JUMP)):
        new = State(x.r_c, x.h_c, x.T_1, x.T_2, x.T_b)
    return new, grows


@jittable
def _disturb(slot: Any, j: Any) -> Any:
    """The disturbance at grid point j, this one or the next; the hidden load is solved only while the drift moves."""
    p, e = slot.puller, slot.episode
    if j != slot.point:
        slot.point = j
        slot.fast, slot.slow = next_fluctuation(e, slot.streams, slot.fast, slot.slow)
        slot.dT_i = fluctuation(e, slot.fast, slot.slow)
    shift = drift(j * GRID, e)
    if shift != slot.drift:
        slot.drift, slot.Q_d = shift, hidden_load(shift, p)
    return Disturbance(slot.Q_d, slot.dT_i, melt_left(j * GRID, e))


@jittable
def _begin(slot: Any, numbers: Any, lanes: Any, lane: Any, interval: Any) -> None:
    """Copy a slot into its lane at the start of a control interval."""
    for constant in range(_P):
        lanes[constant, lane] = numbers[PULLER_AT + constant]
    set_column(State, slot.x, lanes, _X_AT, lane)
    set_column(Inputs, slot, lanes, _U_AT, lane)
    lanes[_T, lane] = slot.k * interval


@jittable
def _prepare(slot: Any, lanes: Any, lane: Any, interval: Any) -> None:
    """Prepare the next substep, to the next point of the 5 s grid or to the end of the interval."""
    t, end = lanes[_T, lane], (slot.k + 1) * interval
    j = int(t / GRID + _EPS)
    upto = min((j + 1) * GRID, end)
    set_column(Disturbance, _disturb(slot, j), lanes, _D_AT, lane)
    lanes[_DT, lane], lanes[_T, lane] = upto - t, upto


@inlined
def _integrate(lanes: Any, found: Any, count: Any, slope: Any) -> None:
    """Write the state that one RK4 substep of every lane ends in.

    No branch, no call, no array both read and written: so the compiler takes several lanes at once.
    """
    for lane in range(count):
        x, u = column(State, lanes, _X_AT, lane), column(Inputs, lanes, _U_AT, lane)
        d, p = column(Disturbance, lanes, _D_AT, lane), column(Puller, lanes, 0, lane)
        set_column(State, rk4(x, u, d, p, lanes[_DT, lane], slope), found, 0, lane)


@jittable
def _judge(slot: Any, frames: Any, lanes: Any, found: Any, lane: Any, clock: Any, slope: Any, ring_offset: Any) -> Any:
    """Accept or reject a substep; return whether the slot needs another one."""
    p, e, upto = slot.puller, slot.episode, lanes[_T, lane]
    x, u = column(State, lanes, _X_AT, lane), column(Inputs, lanes, _U_AT, lane)
    d, new = column(Disturbance, lanes, _D_AT, lane), column(State, found, 0, lane)
    new, grows = judged(x, new, u, d, p, lanes[_DT, lane], p.r_0 + reference(upto, e), slope, clock.radius_limit)
    set_column(State, new, lanes, _X_AT, lane)
    slot.over = 0 if grows else 1
    more = upto < (slot.k + 1) * clock.interval - _EPS
    if more and e.latency > 0.0:
        h_c = height_inside(new.h_c, p)
        photograph(slot, frames, upto, new.r_c + ring_offset(new.r_c, h_c, p) - p.ring_bias, h_c)
    return grows and more


@jittable
def advance(memory: Any, active: Any, first: Any, count: Any, clock: Any, slope: Any, ring_offset: Any) -> None:
    """Integrate the active ones of up to :data:`LANES` slots over one control interval, split at the 5 s grid.

    A slot is over if its crystal does not grow on.
    """
    going, lanes, found = 0, scratch(_ROWS, LANES), scratch(_X, LANES)
    for lane in range(count):
        _begin(memory.slots[first + lane], memory.numbers[first + lane], lanes, lane, clock.interval)
        lanes[_GOES, lane] = 1.0 if active[first + lane] else 0.0
        going += 1 if active[first + lane] else 0
    while going > 0:
        for lane in range(count):
            if lanes[_GOES, lane] > 0.0:
                _prepare(memory.slots[first + lane], lanes, lane, clock.interval)
        _integrate(lanes, found, count, slope)
        for lane in range(count):
            if lanes[_GOES, lane] > 0.0:
                i = first + lane
                if not _judge(memory.slots[i], memory.frames[i], lanes, found, lane, clock, slope, ring_offset):
                    lanes[_GOES, lane] = 0.0
                    going -= 1
    for lane in range(count):
        if active[first + lane]:
            for row in range(_X):
                memory.numbers[first + lane, STATE_AT + row] = lanes[_X_AT + row, lane]
            memory.slots[first + lane].k += 1
