"""Derivatives of a step, by complex steps through its own functions and the chain rule.

The differentiable state of a slot is :func:`smooth`; :func:`build_tangents` compiles the loop that writes the
derivatives of the next state and of the cost by this state and by the action. f'(x) = Im f(x + i h) / h, without
subtraction, so h can be arbitrarily small (Squire and Trapp, SIAM Review 1998).
"""

from functools import lru_cache
from typing import Any

from cz_gym.episodes.scenario import GRID
from cz_gym.jit.cache import hashed
from cz_gym.jit.compile import column, compiled_as, jittable, kernel, labelled, scratch, set_column
from cz_gym.physics.arithmetic import along, plus_product, rk4
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.process import Inputs, Process, Readings, Seen

from .drives import next_inputs
from .layout import model_of

ACTIONS = 2
_H = 2.0**-100
"""The imaginary step: a power of two, by which a compiler divides as quickly as it multiplies."""
_EPS = 1e-9
_INPUTS = len(Inputs._fields)


def smooth(process: Process) -> tuple[str, ...]:
    """Names of the differentiable state: the plant's; pull speed [m/s] and heater power [W], the latter before it is
    rounded to whole steps; what the process carries on; the nominal drives, where they move; the bright ring [m], and
    the camera's reading of it without the operator's bias [m]."""
    nominal = tuple(f"{name}_nominal" for name in Inputs._fields) if process.nominal_moves else ()
    return (*process.State._fields, *Inputs._fields, *process.Extra._fields, *nominal, "ring", "reading")


def rows(process: Process) -> tuple[str, ...]:
    """Rows of the Jacobian: the next state and the terms of the step's cost."""
    return (*smooth(process), *process.Cost._fields)


def work_shape(process: Process) -> tuple[int, int, int]:
    """Shape of the loop's work array."""
    states = len(process.State._fields)
    return 6, states, states + _INPUTS


def derivatives(kind: Any, function: Any, at: Any, rest: Any, by: Any) -> Any:
    """Return ``function(*at, *rest)``, a ``kind``, and write its derivatives by each field of the tuples ``at``.

    ``by`` has shape (fields of the result, fields of all tuples). Only the number that is stepped is complex, and all
    results are computed before any is written: this lets the compiler share their common terms.
    """
    to = 0
    for place, x in enumerate(at):
        for name in x._fields:
            stepped = x._replace(**{name: complex(getattr(x, name), _H)})
            result = function(*at[:place], stepped, *at[place + 1 :], *rest)
            by[:, to] = [value.imag / _H for value in result]
            to += 1
    return kind(*(value.real for value in result))


@compiled_as(derivatives)
def _derivatives(kind: Any, function: Any, at: Any, rest: Any, by: Any) -> Any:
    others = [f"rest[{place}]" for place in range(len(rest))]
    values, results, scope = kind.instance_class._fields, [], {}
    for place, x in enumerate(at):
        scope[f"X{place}"] = x.instance_class
        for stepped in x.fields:
            named = (f"complex(at[{place}].{n}, {_H!r})" if n == stepped else f"at[{place}].{n}" for n in x.fields)
            parts = [f"at[{p}]" for p in range(len(at))]
            parts[place] = f"X{place}({', '.join(named)})"
            results.append(f"function({', '.join([*parts, *others])})")
    lines = [f"k{to} = {result}" for to, result in enumerate(results)]
    for to in range(len(results)):
        lines += [f"by[{i}, {to}] = k{to}.{name}.imag / {_H!r}" for i, name in enumerate(values)]
    real = ", ".join(f"k{len(results) - 1}.{name}.real" for name in values)
    return [*lines, f"return kind({real})"], scope


@jittable
def _stage(work: Any, weight: Any, ahead: Any, x: Any, u: Any, d: Any, p: Any, model: Any) -> Any:
    """One stage of RK4: its rates, and their derivatives.

    ``work`` holds the derivatives of the rates, of this stage's and the last one's as functions of where the step began
    (K), and of the step so far. This stage is at ``ahead`` [s] times the last one's rates; it counts ``weight`` [s].
    """
    A, last, K, total = work[0], work[1], work[2], work[3]
    k = derivatives(model.process.State, model.process.rates, (x, u), (d, p, model.meniscus), A)
    for i in range(model.states):
        by_state = column(model.process.State, A.T, 0, i)
        for j in range(model.extra):
            K[i, j] = plus_product(A[i, j], ahead, by_state, last, j)
    for i in range(model.states):
        for j in range(model.extra):
            last[i, j] = K[i, j]
            total[i, j] += weight * K[i, j]
    return k


@jittable
def rk4_by(work: Any, x: Any, u: Any, d: Any, p: Any, dt: Any, model: Any) -> None:
    """Derivatives of :func:`cz_gym.physics.arithmetic.rk4` by state and inputs, into ``work[3]``."""
    for i in range(model.states):
        for j in range(model.extra):
            work[1, i, j], work[3, i, j] = 0.0, 1.0 if i == j else 0.0
    k_1 = _stage(work, dt / 6.0, 0.0, x, u, d, p, model)
    k_2 = _stage(work, dt / 3.0, 0.5 * dt, along(x, 0.5 * dt, k_1), u, d, p, model)
    k_3 = _stage(work, dt / 3.0, 0.5 * dt, along(x, 0.5 * dt, k_2), u, d, p, model)
    _stage(work, dt / 6.0, dt, along(x, dt, k_3), u, d, p, model)


@jittable
def _copy(work: Any, of: Any, to: Any) -> None:
    """Copy one of the work array's matrices."""
    for i in range(work.shape[1]):
        for j in range(work.shape[2]):
            work[to, i, j] = work[of, i, j]


@jittable
def _after(work: Any) -> None:
    """Derivatives of two substeps, one after the other: those of the first in ``work[4]``, of both in ``work[3]``."""
    states = work.shape[1]
    for i in range(states):
        for j in range(work.shape[2]):
            work[5, i, j] = 0.0 if j < states else work[3, i, j]
            for between in range(states):
                work[5, i, j] += work[3, i, between] * work[4, between, j]
    _copy(work, 5, 3)


@jittable
def _through_drives(by: Any, J: Any, j: Any, model: Any) -> Any:
    """Derivative by number j of what depends so on plant state and applied inputs at the begin of the step."""
    direct = by[j] if j < model.states else 0.0
    return direct + by[model.states] * J[model.states, j] + by[model.states + 1] * J[model.states + 1, j]


@jittable
def _drives_by(
    J: Any, slot: Any, x: Any, u: Any, action: Any, before: Any, drives: Any, interval: Any, model: Any
) -> None:
    """Derivatives of the next inputs; whole steps of the heater are taken for a power that moves freely."""
    by, process = scratch(2, model.driven_by), model.process
    if model.nominals > 0:
        derivatives(Inputs, next_inputs, (x, u, action, before), (drives, slot, interval, process), by)
    else:
        derivatives(Inputs, next_inputs, (x, u, action), (before, drives, slot, interval, process), by)
    for drive in range(2):
        for j in range(model.extra):
            J[model.states + drive, j] = by[drive, j]
        for action_of in range(ACTIONS):
            J[model.states + drive, model.smooth + action_of] = by[drive, model.extra + action_of]
        for of in range(model.nominals):
            J[model.states + drive, model.nominal + of] = by[drive, model.extra + ACTIONS + of]
    if model.nominals > 0:
        derivatives(Inputs, process.nominal, (x,), (slot, interval), by)
        for drive in range(2):
            for j in range(model.states):
                J[model.nominal + drive, j] = by[drive, j]


@jittable
def _carried_by(J: Any, slot: Any, extra: Any, interval: Any, model: Any) -> None:
    """Derivatives of what the process carries on, from those of the inputs and the nominal ones."""
    if model.extras > 0:
        by, process = scratch(model.extras, model.carried_by), model.process
        nominal = Inputs(slot.v_p_nominal, slot.Q_H_nominal)
        if model.nominals > 0:
            derivatives(process.Extra, process.carry, (extra, labelled(Inputs, slot), nominal), (interval,), by)
        else:
            derivatives(process.Extra, process.carry, (extra, labelled(Inputs, slot)), (nominal, interval), by)
        for j in range(model.columns):
            for row in range(model.extras):
                total = by[row, j - model.extra] if model.extra <= j < model.nominal else 0.0
                for drive in range(2):
                    total += by[row, model.extras + drive] * J[model.states + drive, j]
                for drive in range(model.nominals):
                    total += by[row, model.extras + 2 + drive] * J[model.nominal + drive, j]
                J[model.extra + row, j] = total


@jittable
def _cost_by(J: Any, slot: Any, t: Any, weights: Any, model: Any) -> None:
    """Derivatives of the cost's terms, from those of the next state."""
    process, n, by = model.process, model.states, scratch(model.costs, model.charged_by)
    at = (
        labelled(process.State, slot.x), labelled(Inputs, slot), Inputs(slot.v_p_before, slot.Q_H_before),
        labelled(process.Extra, slot),
    )  # fmt: skip
    slopes = process.cost_slopes(derivatives(process.Cost, process.charged, at, (slot, t), by), weights)
    for term in range(model.costs):
        row = J[model.smooth + term]
        for i in range(model.charged_by - 2):
            weight = by[term, i if i < model.extra else i + 2]  # between stand the inputs before
            if weight != 0.0:
                for j in range(model.columns):
                    row[j] += weight * J[i, j]
        for drive in range(2):
            row[n + drive] += by[term, model.extra + drive]
        for j in range(model.columns):
            row[j] *= slopes[term]


@jittable
def _nominal_of(numbers: Any, i: Any, slot: Any, model: Any) -> Any:
    """The inputs from which actions were counted, in slot i of the differentiable states; its slot's if constant."""
    if model.nominals > 0:
        return column(Inputs, numbers, model.nominal, i)
    return Inputs(slot.v_p_nominal, slot.Q_H_nominal)


@jittable
def _shown_by(by_state: Any, slot: Any, t: Any, per_scale: Any, model: Any) -> None:
    """Derivatives of the "measured" channels by the differentiable state; the pyrometer's reading is of now."""
    process, by, seen_by = model.process, scratch(model.channels, model.shown_by), scratch(4, model.states)
    x, extra, nominal = (
        labelled(process.State, slot.x),
        labelled(process.Extra, slot),
        Inputs(slot.v_p_nominal, slot.Q_H_nominal),
    )
    at = x, labelled(Inputs, slot), nominal, extra, labelled(Readings, slot)
    derivatives(process.Measured, process.measure, at, (slot, t), by)
    derivatives(Seen, process.see, (x,), (slot.puller, model.meniscus), seen_by)
    reading = model.shown_by - 2
    for row in range(model.channels):
        for j in range(model.extra):
            of = by[row, j] + (by[row, reading + 1] * seen_by[3, j] if j < model.states else 0.0)
            by_state[row, j] = of * per_scale[row]
        for j in range(model.extras):
            by_state[row, model.extra + j] = by[row, model.extra + 2 + j] * per_scale[row]
        for j in range(model.nominals):
            by_state[row, model.nominal + j] = by[row, model.extra + j] * per_scale[row]
        by_state[row, model.ring], by_state[row, model.ring + 1] = 0.0, by[row, reading] * per_scale[row]


@lru_cache(maxsize=8)
def build_tangents(process: Process, meniscus: MeniscusModel) -> tuple[Any, ...]:
    """Compile the loops for a process on a meniscus model.

    ``gather(memory, state, start, stop)`` writes the differentiable states.
    ``shown(memory, per_scale, interval, by_state, start, stop)`` writes the derivatives of "measured" by them, shape
    (n, channels, states).
    ``tangents(memory, state, held, actions, grows, fixed, drives, work, jacobian, start, stop)`` writes the derivatives
    of the step that led from ``state`` to where the slots are now, shape (n, rows, states + actions); zero for a slot
    that does not grow. ``held``, shape (n, 2), is Q_d [W] and dT_i [K] before the step, which may be 5 s long: those of
    its first substep if a point of the grid lies inside.
    """
    model, m = model_of(process, meniscus), meniscus

    def gather(memory: Any, state: Any, start: int, stop: int) -> None:
        for i in range(start, stop):
            slot, numbers = memory.slots[i], state.T
            set_column(process.State, slot.x, numbers, 0, i)
            state[i, model.states], state[i, model.states + 1] = slot.v_p, slot.Q_H_slewed
            set_column(process.Extra, slot, numbers, model.extra, i)
            if model.nominals > 0:
                state[i, model.nominal], state[i, model.nominal + 1] = slot.v_p_nominal, slot.Q_H_nominal
            state[i, model.ring] = process.see(labelled(process.State, slot.x), slot.puller, m).ring
            state[i, model.ring + 1] = slot.ring

    def shown(memory: Any, per_scale: Any, interval: float, by_state: Any, start: int, stop: int) -> None:
        for i in range(start, stop):
            slot = memory.slots[i]
            _shown_by(by_state[i], slot, slot.k * interval, per_scale, model)

    def tangents(
        memory: Any, state: Any, held: Any, actions: Any, grows: Any, fixed: Any, drives: Any, work: Any,
        jacobian: Any, start: int, stop: int,
    ) -> None:  # fmt: skip
        ring, reading, seen_by = model.ring, model.ring + 1, scratch(4, model.states)
        for i in range(start, stop):
            J = jacobian[i]
            J[:, :] = 0.0
            if not grows[i]:
                continue
            slot, dt = memory.slots[i], fixed.interval
            p, e = slot.puller, slot.episode
            begun, before = column(process.State, state.T, 0, i), column(Inputs, state.T, model.states, i)
            action, nominal = Inputs(actions[i, 0], actions[i, 1]), _nominal_of(state.T, i, slot, model)
            _drives_by(J, slot, begun, before, action, nominal, drives, dt, model)
            _carried_by(J, slot, column(process.Extra, state.T, model.extra, i), dt, model)
            u, d = labelled(Inputs, slot), process.disturb(slot.Q_d, slot.dT_i, slot.point * GRID, e)
            point = int((slot.k - 1) * dt / GRID + _EPS)
            at, late = (point + 1) * GRID, e.latency > 0.0
            inside, left = at < slot.k * dt - _EPS, dt
            if inside:
                first = process.disturb(held[i, 0], held[i, 1], point * GRID, e)
                left = slot.k * dt - at
                rk4_by(work, begun, u, first, p, dt - left, model)
                begun = rk4(process.rates, begun, u, first, p, dt - left, m)
                _copy(work, 3, 4)
                derivatives(Seen, process.see, (begun,), (p, m), seen_by)
                for j in range(model.extra):
                    work[1, 0, j] = 0.0
                    for row in range(model.states):
                        work[1, 0, j] += seen_by[0, row] * work[4, row, j]
                for j in range(model.columns):
                    J[reading, j] = _through_drives(work[1, 0], J, j, model)
            rk4_by(work, begun, u, d, p, left, model)
            if inside:
                _after(work)
            derivatives(Seen, process.see, (labelled(process.State, slot.x),), (p, m), seen_by)
            for j in range(model.columns):
                for row in range(model.states):
                    J[row, j] = _through_drives(work[3, row], J, j, model)
            for row in range(model.states):
                if seen_by[0, row] != 0.0:
                    for j in range(model.columns):
                        J[ring, j] += seen_by[0, row] * J[row, j]
            _cost_by(J, slot, slot.k * dt, fixed.weights, model)
            # The camera's frame is of now, of the grid point inside the step, or of the sample before.
            fresh, between = slot.k_seen == slot.k, inside and at <= slot.k * dt - e.latency + _EPS
            for j in range(model.columns):
                if fresh and not late:
                    J[reading, j] = J[ring, j]
                elif not (fresh and between):
                    J[reading, j] = 0.0
            if fresh and late and not between:
                J[reading, ring] = 1.0
            if not fresh:
                J[reading, reading] = 1.0

    keep = hashed(*process.functions, *meniscus.functions)
    compiled: Any = (kernel(loop, keep, allocates=False) for loop in (gather, shown, tangents))
    return tuple(compiled)
