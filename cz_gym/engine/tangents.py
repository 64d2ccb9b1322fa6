"""Derivatives of a step, by complex steps through its own functions and the chain rule.

The differentiable state of a slot is :data:`SMOOTH`; :func:`build_tangents` compiles the loop that writes the
derivatives of the next state and of the cost by this state and by the action. f'(x) = Im f(x + i h) / h, without
subtraction, so h can be arbitrarily small (Squire and Trapp, SIAM Review 1998).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from cz_gym.body.cost import Cost, cost_slopes
from cz_gym.body.plant import Disturbance, Inputs, State, along, rates, rk4
from cz_gym.episodes.schedule import bias_offset, melt_left, reference
from cz_gym.episodes.record import GRID
from cz_gym.jit.cache import hashed
from cz_gym.jit.compile import force_inlined, jittable, kernel
from cz_gym.physics.meniscus import MeniscusModel

from .kernels import next_power, next_speed
from .lockstep import height_inside

SMOOTH = ("r_c", "h_c", "T_1", "T_2", "T_b", "v_p", "Q_H", "ring", "reading")
"""The plant's state [m, K]; pull speed [m/s] and heater power [W], the latter before it is rounded to whole steps; the
bright ring [m] and the camera's reading of it, without the operator's bias [m]."""
ACTIONS = 2
ROWS = (*SMOOTH, *Cost._fields)
"""Rows of the Jacobian: the next state and the terms of the step's cost."""
SCRATCH = (6, len(State._fields), len(State._fields) + len(Inputs._fields))
"""Shape of the loop's work array."""
_H = 2.0**-100
"""The imaginary step: a power of two, by which a compiler divides as quickly as it multiplies."""
_EPS = 1e-9
_X, _INPUTS = len(State._fields), len(Inputs._fields)
_V, _Q, _RING, _READING = (SMOOTH.index(name) for name in ("v_p", "Q_H", "ring", "reading"))
_COST = _ACT = len(SMOOTH)


@force_inlined
def _step(value: Any) -> Any:
    """The value plus an imaginary step."""
    return complex(value, _H)


@force_inlined
def _column(A: Any, j: Any, k: Any) -> None:
    """Derivatives of the rates along one of their arguments."""
    A[0, j], A[1, j], A[2, j], A[3, j], A[4, j] = (
        k.r_c.imag / _H, k.h_c.imag / _H, k.T_1.imag / _H, k.T_2.imag / _H, k.T_b.imag / _H,
    )  # fmt: skip


@force_inlined
def _rates_by(A: Any, x: Any, u: Any, d: Any, p: Any, slope: Any) -> Any:
    """Return the rates and write their derivatives into ``A``.

    Only the number that is stepped is complex, and all rates are computed before any is written: this lets the compiler
    share their common terms.
    """
    by_r = rates(State(_step(x.r_c), x.h_c, x.T_1, x.T_2, x.T_b), u, d, p, slope)
    by_h = rates(State(x.r_c, _step(x.h_c), x.T_1, x.T_2, x.T_b), u, d, p, slope)
    by_1 = rates(State(x.r_c, x.h_c, _step(x.T_1), x.T_2, x.T_b), u, d, p, slope)
    by_2 = rates(State(x.r_c, x.h_c, x.T_1, _step(x.T_2), x.T_b), u, d, p, slope)
    by_b = rates(State(x.r_c, x.h_c, x.T_1, x.T_2, _step(x.T_b)), u, d, p, slope)
    by_v = rates(x, Inputs(_step(u.v_p), u.Q_H), d, p, slope)
    k = rates(x, Inputs(u.v_p, _step(u.Q_H)), d, p, slope)
    _column(A, 0, by_r)
    _column(A, 1, by_h)
    _column(A, 2, by_1)
    _column(A, 3, by_2)
    _column(A, 4, by_b)
    _column(A, 5, by_v)
    _column(A, 6, k)
    return State(k.r_c.real, k.h_c.real, k.T_1.real, k.T_2.real, k.T_b.real)


@force_inlined
def _stage(work: Any, weight: Any, ahead: Any, x: Any, u: Any, d: Any, p: Any, slope: Any) -> Any:
    """One stage of RK4: its rates, and their derivatives.

    ``work`` holds the derivatives of the rates, of this stage's and the last one's as functions of where the step began
    (K), and of the step so far. This stage is at ``ahead`` [s] times the last one's rates; it counts ``weight`` [s].
    """
    A, last, K, total = work[0], work[1], work[2], work[3]
    k = _rates_by(A, x, u, d, p, slope)
    for i in range(_X):
        a, b, c, e, f = ahead * A[i, 0], ahead * A[i, 1], ahead * A[i, 2], ahead * A[i, 3], ahead * A[i, 4]
        for j in range(_X + _INPUTS):
            K[i, j] = A[i, j] + a * last[0, j] + b * last[1, j] + c * last[2, j] + e * last[3, j] + f * last[4, j]
    for i in range(_X):
        for j in range(_X + _INPUTS):
            last[i, j] = K[i, j]
            total[i, j] += weight * K[i, j]
    return k


@jittable
def rk4_by(work: Any, x: Any, u: Any, d: Any, p: Any, dt: Any, slope: Any) -> None:
    """Derivatives of :func:`cz_gym.body.plant.rk4` by state and inputs, into ``work[3]``, shape (5, 7)."""
    for i in range(_X):
        for j in range(_X + _INPUTS):
            work[1, i, j], work[3, i, j] = 0.0, 1.0 if i == j else 0.0
    k_1 = _stage(work, dt / 6.0, 0.0, x, u, d, p, slope)
    k_2 = _stage(work, dt / 3.0, 0.5 * dt, along(x, 0.5 * dt, k_1), u, d, p, slope)
    k_3 = _stage(work, dt / 3.0, 0.5 * dt, along(x, 0.5 * dt, k_2), u, d, p, slope)
    _stage(work, dt / 6.0, dt, along(x, dt, k_3), u, d, p, slope)


@jittable
def _copy(work: Any, of: Any, to: Any) -> None:
    """Copy one of the work array's matrices."""
    for i in range(_X):
        for j in range(_X + _INPUTS):
            work[to, i, j] = work[of, i, j]


@jittable
def _after(work: Any) -> None:
    """Derivatives of two substeps, one after the other: those of the first in ``work[4]``, of both in ``work[3]``."""
    for i in range(_X):
        for j in range(_X + _INPUTS):
            work[5, i, j] = 0.0 if j < _X else work[3, i, j]
            for between in range(_X):
                work[5, i, j] += work[3, i, between] * work[4, between, j]
    _copy(work, 5, 3)


@lru_cache(maxsize=8)
def build_tangents(meniscus: MeniscusModel) -> tuple[Any, Any]:
    """Compile the loops for a meniscus model.

    ``gather(memory, state, start, stop)`` writes the differentiable states. ``tangents(memory, state, held,
    actions, grows, clock, drives, work, jacobian, start, stop)`` writes the derivatives of the step that led from
    ``state`` to where the slots are now, shape (n, rows, states + actions); zero for a slot that does not grow.
    ``held``, shape (n, 2), is Q_d [W] and dT_i [K] before the step, which may be 5 s long: those of its first substep
    if a point of the grid lies inside.
    """
    slope, ring_offset = meniscus.slope, meniscus.ring_offset

    def gather(memory: Any, state: Any, start: int, stop: int) -> None:
        for i in range(start, stop):
            slot, p, x, row = memory.slots[i], memory.slots[i].puller, memory.slots[i].x, state[i]
            row[0], row[1], row[2], row[3], row[4] = x.r_c, x.h_c, x.T_1, x.T_2, x.T_b
            row[_V], row[_Q] = slot.v_p, slot.Q_H_slewed
            row[_RING] = x.r_c + ring_offset(x.r_c, height_inside(x.h_c, p), p)
            row[_READING] = slot.ring

    def tangents(
        memory: Any, state: Any, held: Any, actions: Any, grows: Any, clock: Any, drives: Any, work: Any,
        jacobian: Any, start: int, stop: int,
    ) -> None:  # fmt: skip
        for i in range(start, stop):
            J = jacobian[i]
            J[:, :] = 0.0
            if not grows[i]:
                continue
            slot, now = memory.slots[i], state[i]
            p, e, x = slot.puller, slot.episode, slot.x
            d = Disturbance(slot.Q_d, slot.dT_i, melt_left(slot.point * GRID, e))
            v, Q, pull, heat, dt = now[_V], now[_Q], actions[i, 0], actions[i, 1], clock.interval
            J[_V, _V] = next_speed(_step(v), pull, drives, p, e, dt).imag / _H
            J[_V, _ACT] = next_speed(v, _step(pull), drives, p, e, dt).imag / _H
            # Whole steps of the heater are taken for a power that moves freely.
            J[_Q, _Q] = next_power(_step(Q), heat, drives, p, e, dt).imag / _H
            J[_Q, _ACT + 1] = next_power(Q, _step(heat), drives, p, e, dt).imag / _H
            begun, u = State(now[0], now[1], now[2], now[3], now[4]), Inputs(slot.v_p, slot.Q_H)
            point = int((slot.k - 1) * dt / GRID + _EPS)
            at, late = (point + 1) * GRID, e.latency > 0.0
            inside, left, seen_r, seen_h = at < slot.k * dt - _EPS, dt, 0.0, 0.0
            if inside:
                first = Disturbance(held[i, 0], held[i, 1], melt_left(point * GRID, e))
                left = slot.k * dt - at
                rk4_by(work, begun, u, first, p, dt - left, slope)
                begun = rk4(begun, u, first, p, dt - left, slope)
                _copy(work, 3, 4)
                h_c = height_inside(begun.h_c, p)
                seen_r = 1.0 + ring_offset(_step(begun.r_c), h_c, p).imag / _H
                seen_h = ring_offset(begun.r_c, _step(h_c), p).imag / _H
            rk4_by(work, begun, u, d, p, left, slope)
            if inside:
                _after(work)
            h_c = height_inside(x.h_c, p)
            ring_by_r = 1.0 + ring_offset(_step(x.r_c), h_c, p).imag / _H
            ring_by_h = ring_offset(x.r_c, _step(h_c), p).imag / _H
            error = x.r_c - p.r_0 - reference(slot.k * dt, e) + bias_offset(slot.k * dt, e)
            slopes = cost_slopes(error, slot.v_p - p.v_0, slot.v_p - slot.v_p_before, slot.Q_H - slot.Q_H_before)
            for j in range(_ACT + ACTIONS):
                drive = _V if j in (_V, _ACT) else _Q
                if j < _X:
                    share, column = 1.0, j
                elif j in (_RING, _READING):
                    continue
                else:
                    share, column = J[drive, j], drive
                for row in range(_X):
                    J[row, j] = share * work[3, row, column]
                J[_RING, j] = ring_by_r * J[0, j] + ring_by_h * J[1, j]
                if inside:
                    J[_READING, j] = share * (seen_r * work[4, 0, column] + seen_h * work[4, 1, column])
                J[_COST, j] = slopes.radius * J[0, j]
                J[_COST + 1, j] = slopes.pull * J[_V, j]
                J[_COST + 2, j] = slopes.pull_step * (J[_V, j] - (1.0 if j == _V else 0.0))
                J[_COST + 3, j] = slopes.heater_step * (J[_Q, j] - (1.0 if j == _Q else 0.0))
            # The camera's frame is of now, of the grid point inside the step, or of the sample before.
            fresh, between = slot.k_seen == slot.k, inside and at <= slot.k * dt - e.latency + _EPS
            for j in range(_ACT + ACTIONS):
                if fresh and not late:
                    J[_READING, j] = J[_RING, j]
                elif not (fresh and between):
                    J[_READING, j] = 0.0
            if fresh and late and not between:
                J[_READING, _RING] = 1.0
            if not fresh:
                J[_READING, _READING] = 1.0

    keep = hashed(*meniscus.functions)
    return kernel(gather, keep, allocates=False), kernel(tangents, keep, allocates=False)
