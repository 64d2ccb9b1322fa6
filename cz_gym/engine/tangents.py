"""Derivatives of a step, by complex steps through its own functions and the chain rule.

The differentiable state of a slot is :func:`smooth`; :func:`build_tangents` compiles the loop that writes the
derivatives of the next state and of the cost by this state and by the action, and :class:`DifferentiableBatch` is the
batch that calls it. f'(x) = Im f(x + i h) / h, without subtraction, so h can be arbitrarily small (Squire and Trapp,
SIAM Review 1998).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from operator import index
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.error import InvalidAction, ResetNeeded

from cz_gym.body.process import BODY
from cz_gym.config import Config, check_config, positive_whole
from cz_gym.episodes.scenario import GRID
from cz_gym.jit import column, compiled_as, hashed, jittable, kernel, labelled, scratch, set_column
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.process import LOST, Inputs, PerfectReadings, Process, Readings, along, plus_product, rk4
from cz_gym.spaces import TaggedAction, check_tagged
from cz_gym.support.errors import CzError

from .batch import Batch, first_key
from .kernels import Out, model_of
from .loop import next_inputs

ACTIONS = 2
_H = 2.0**-100
"""The imaginary step: a power of two, by which a compiler divides as quickly as it multiplies."""
_EPS = 1e-9
_INPUTS = len(Inputs._fields)


def smooth(process: Process) -> tuple[str, ...]:
    """Names of the differentiable state: the plant's; pull speed [m/s] and heater power [W], the latter before it is
    rounded to whole steps; the process's ``StepMemory``; the nominal drives, where they move; the bright ring [m], and
    the camera's reading of it without the operator's bias [m]."""
    nominal = tuple(f"{name}_nominal" for name in Inputs._fields) if process.nominal_moves else ()
    return (*process.State._fields, *Inputs._fields, *process.StepMemory._fields, *nominal, "ring", "reading")


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
        for j in range(model.memory_at):
            K[i, j] = plus_product(A[i, j], ahead, by_state, last, j)
    for i in range(model.states):
        for j in range(model.memory_at):
            last[i, j] = K[i, j]
            total[i, j] += weight * K[i, j]
    return k


@jittable
def rk4_by(work: Any, x: Any, u: Any, d: Any, p: Any, dt: Any, model: Any) -> None:
    """Derivatives of :func:`cz_gym.process.rk4` by state and inputs, into ``work[3]``."""
    for i in range(model.states):
        for j in range(model.memory_at):
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
    """Derivative by z_j of a quantity with these partials in plant state and inputs, both at the start of the step."""
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
        for j in range(model.memory_at):
            J[model.states + drive, j] = by[drive, j]
        for action_of in range(ACTIONS):
            J[model.states + drive, model.smooth + action_of] = by[drive, model.memory_at + action_of]
        for of in range(model.nominals):
            J[model.states + drive, model.nominal + of] = by[drive, model.memory_at + ACTIONS + of]
    if model.nominals > 0:
        derivatives(Inputs, process.nominal, (x,), (slot, interval), by)
        for drive in range(2):
            for j in range(model.states):
                J[model.nominal + drive, j] = by[drive, j]


@jittable
def _memory_by(J: Any, slot: Any, step_memory: Any, interval: Any, model: Any) -> None:
    """Derivatives of ``StepMemory``, from those of the inputs and the nominal ones."""
    if model.memories > 0:
        by, process = scratch(model.memories, model.memory_by), model.process
        nominal = Inputs(slot.v_p_nominal, slot.Q_H_nominal)
        if model.nominals > 0:
            at: Any = step_memory, labelled(Inputs, slot), nominal
            derivatives(process.StepMemory, process.update_memory, at, (interval,), by)
        else:
            at = step_memory, labelled(Inputs, slot)
            derivatives(process.StepMemory, process.update_memory, at, (nominal, interval), by)
        for j in range(model.columns):
            for row in range(model.memories):
                total = by[row, j - model.memory_at] if model.memory_at <= j < model.nominal else 0.0
                for drive in range(2):
                    total += by[row, model.memories + drive] * J[model.states + drive, j]
                for drive in range(model.nominals):
                    total += by[row, model.memories + 2 + drive] * J[model.nominal + drive, j]
                J[model.memory_at + row, j] = total


@jittable
def _cost_by(J: Any, slot: Any, t: Any, weights: Any, model: Any) -> None:
    """Derivatives of the cost's terms, from those of the next state."""
    process, n, by = model.process, model.states, scratch(model.costs, model.cost_by)
    at = (
        labelled(process.State, slot.x), labelled(Inputs, slot), Inputs(slot.v_p_before, slot.Q_H_before),
        labelled(process.StepMemory, slot),
    )  # fmt: skip
    slopes = process.cost_slopes(derivatives(process.Cost, process.cost_inputs, at, (slot, t), by), weights)
    for term in range(model.costs):
        row = J[model.smooth + term]
        for i in range(model.cost_by - 2):
            weight = by[term, i if i < model.memory_at else i + 2]  # between stand the inputs before
            if weight != 0.0:
                for j in range(model.columns):
                    row[j] += weight * J[i, j]
        for drive in range(2):
            row[n + drive] += by[term, model.memory_at + drive]
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
    x, step_memory, nominal = (
        labelled(process.State, slot.x),
        labelled(process.StepMemory, slot),
        Inputs(slot.v_p_nominal, slot.Q_H_nominal),
    )
    at = x, labelled(Inputs, slot), nominal, step_memory, labelled(Readings, slot)
    derivatives(process.Measured, process.measure, at, (slot, t), by)
    derivatives(PerfectReadings, process.perfect_readings, (x,), (slot.puller, model.meniscus), seen_by)
    reading = model.shown_by - 2
    for row in range(model.channels):
        for j in range(model.memory_at):
            of = by[row, j] + (by[row, reading + 1] * seen_by[3, j] if j < model.states else 0.0)
            by_state[row, j] = of * per_scale[row]
        for j in range(model.memories):
            by_state[row, model.memory_at + j] = by[row, model.memory_at + 2 + j] * per_scale[row]
        for j in range(model.nominals):
            by_state[row, model.nominal + j] = by[row, model.memory_at + j] * per_scale[row]
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
            set_column(process.StepMemory, slot, numbers, model.memory_at, i)
            if model.nominals > 0:
                state[i, model.nominal], state[i, model.nominal + 1] = slot.v_p_nominal, slot.Q_H_nominal
            state[i, model.ring] = process.perfect_readings(labelled(process.State, slot.x), slot.puller, m).ring
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
            _memory_by(J, slot, column(process.StepMemory, state.T, model.memory_at, i), dt, model)
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
                derivatives(PerfectReadings, process.perfect_readings, (begun,), (p, m), seen_by)
                for j in range(model.memory_at):
                    work[1, 0, j] = 0.0
                    for row in range(model.states):
                        work[1, 0, j] += seen_by[0, row] * work[4, row, j]
                for j in range(model.columns):
                    J[reading, j] = _through_drives(work[1, 0], J, j, model)
            rk4_by(work, begun, u, d, p, left, model)
            if inside:
                _after(work)
            derivatives(PerfectReadings, process.perfect_readings, (labelled(process.State, slot.x),), (p, m), seen_by)
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


# A batch whose step has derivatives: gradients of a cost through a crystal, for learning, identification, shooting.

Floats = npt.NDArray[np.float64]


class Step(NamedTuple):
    """The result of a step, one row per slot, and its derivatives."""

    state: Floats
    """The differentiable state, of Cz-v0 :data:`STATES`, SI units, shape (n, 10)."""
    measured: npt.NDArray[np.float32]
    """The "measured" observation, shape (n, 12)."""
    cost: Floats
    """The four terms of the cost (:class:`cz_gym.body.signals.Cost`), shape (n, 4)."""
    error: Floats
    """The true radius error r_c - r_ref [m], shape (n,)."""
    offset: Floats
    """Offset of the bright ring that no sensor shows [m], shape (n,)."""
    grows: npt.NDArray[np.bool_]
    """True if the crystal grew, shape (n,). One that is lost or whose episode is over stays as it is; its cost and its
    derivatives are 0."""
    jacobian: Floats
    """Derivatives of the next state and of the cost's terms, shape (n, 14, 12): rows are state and cost, columns the
    state before and the two actions."""


STATES = smooth(BODY)
"""The differentiable state of Cz-v0: radius, meniscus height [m], T_1, T_2, T_b [K], v_p [m/s], Q_H [W], the mean
of v_p [m/s], the bright ring [m] and the camera's reading of it [m]. All else that a step depends on (disturbances,
noise, time) depends on no action. That of another process is ``smooth(process)``."""


class DifferentiableBatch:
    """Many crystals that are stepped together, each step with its derivatives.

    ``config`` is the environment's (:func:`cz_gym.config.make_config`). Its control interval may be up to the
    5 s for which disturbances are held, and its camera's latency must not be longer than the control interval.

    Noise, freezes and drop-outs are those of the environment; a held reading depends on the state at which it was
    taken. The derivatives ignore that the heater moves in whole steps and that observations are rounded; where a
    scenario has a heater's lag or a pyrometer's filter, they are those of a machine without either.
    """

    def __init__(self, config: Config, num_envs: int, threads: int | None = 1) -> None:
        check_config(config)
        self.num_envs = positive_whole("num_envs", num_envs)
        if config.control_interval > GRID:
            raise CzError(f"control_interval must be at most {GRID:g} s, not {config.control_interval:g} s")
        latency = max(scenario.sensor.latency for scenario in config.scenario.scenarios)
        if latency > config.control_interval:
            raise CzError(
                f"the camera's latency of {latency:g} s is longer than the control interval; a puller file's latency_s "
                "stands in place of the scenario's"
            )
        if any(max(each.actuators.heater_dead_time) > 0.0 for each in config.scenario.scenarios):
            raise CzError("a heater with a dead time has no derivatives: heater_dead_time must be 0")
        if any(each.readings.delay > 0.0 for each in config.scenario.scenarios):
            raise CzError("readings of drives with a delay have no derivatives: readings.delay must be 0")
        self.config = config = replace(config, observation="measured")
        self._made_for = config.made_for
        self._batch = Batch(config, self.num_envs, threads)
        self._gather, self._shown, self._tangents = build_tangents(config.process, config.meniscus)
        self._out = self._batch.new_out()
        self._names, info = smooth(config.process), config.process.info
        self._state = np.zeros((num_envs, len(self._names)))
        self._costs = [info.index(f"term_{name}") for name in config.process.Cost._fields]
        self._errors = [info.index(name) for name in (*config.process.BriefInfo._fields[:2], "ring_offset")]
        self.grows, self._begun = np.ones(num_envs, np.bool_), np.zeros(num_envs, np.bool_)
        """True for each crystal that grew in the last step, and for each slot that has one, shape (n,)."""
        self._work = np.zeros(work_shape(config.process))
        self._jacobian = self.num_envs, len(rows(config.process)), len(self._names) + ACTIONS
        shows = len(config.process.measured), len(self._names)
        self._moves = config.process.nominal_moves
        self.measured_by_state: Floats = np.zeros(shows)
        """Derivatives of the last "measured" observation by the last state, shape (12, 10), the same for all slots and
        steps; (n, 17, 17) on CzCrystal-v0, where references run with the length. Zero before the first reset, and for a
        crystal that is lost."""

    def reset(self, seeds: Sequence[int], which: Sequence[int] | None = None) -> tuple[Floats, npt.NDArray[np.float32]]:
        """Draw the episodes of these seeds, one for each of the slots ``which``, by default all; the others stay.

        Returns state, shape (n, 10), and "measured" observation, shape (n, 12), of all slots. ValueError unless each
        seed is a whole number and each slot there is named once at most.
        """
        slots = list(range(self.num_envs) if which is None else which)
        if len(seeds) != len(slots):
            raise CzError(f"expected a seed for each of {len(slots)} slots, not {len(seeds)}")
        if len(set(slots)) != len(slots) or not set(slots) <= set(range(self.num_envs)):
            raise CzError(f"slots must be different ones of 0 to {self.num_envs - 1}, not {slots!r:.80}")
        try:
            keys = [first_key(index(seed)) for seed in seeds]
        except TypeError:
            raise CzError(f"seeds must be whole numbers, not {seeds!r:.80}") from None
        self._out = self._copied()
        self._batch.reset(slots, keys, self._out)
        self.grows = self.grows.copy()
        self.grows[slots] = self._begun[slots] = True
        self._update_state(first=True)
        return self._state, self._out.observation

    def step(self, actions: npt.ArrayLike) -> Step:
        """Hold actions, shape (n, 2), for one control interval; crystals that are lost or whose episode is over stay.

        InvalidAction for NaN, another shape, and actions made for another environment;
        ResetNeeded before every slot had its first reset.
        """
        if type(actions) is TaggedAction:
            check_tagged(actions, self._made_for)
        if not self._begun.all():
            raise ResetNeeded("every slot needs a crystal: call reset()")
        before, n = self._state, self.num_envs
        given = np.asarray(actions, np.float64)
        if given.shape != (n, ACTIONS) or np.isnan(given).any():
            raise InvalidAction(f"actions must be numbers of shape {(n, ACTIONS)}, not {actions!r:.80}")
        batch, out = self._batch, self._copied()
        slots = batch.memory.slots
        held = np.stack([slots["Q_d"], slots["dT_i"]], axis=1)
        active = self.grows & (batch.memory.slots["k"] < batch.fixed.steps)
        batch.step(given, out, active)
        self.grows = active & ~out.terminated
        self._out = out
        self._update_state()
        jacobian = np.empty(self._jacobian)
        step = (held, batch.actions, self.grows, batch.fixed, batch.drives)
        self._tangents(batch.memory, before, *step, self._work, jacobian, 0, n)
        info = out.info[:, :n]
        cost = np.where(self.grows, info[self._costs], 0.0).T
        value, reference, offset = info[self._errors]
        return Step(self._state, out.observation, cost, value - reference, offset, self.grows, jacobian)

    def _copied(self) -> Out:
        """A copy of the last step's results in new arrays."""
        out = self._batch.new_out()
        for new, old in zip(out, self._out, strict=True):
            new[...] = old
        return out

    def _update_state(self, first: bool = False) -> None:
        """Read the slots' states, and how observations depend on them."""
        self._state = self._now()
        if self._moves or first:
            batch, shape = self._batch, self.measured_by_state.shape[-2:]
            shown = np.empty((self.num_envs if self._moves else 1, *shape))
            self._shown(batch.memory, batch.scales.measured, batch.fixed.interval, shown, 0, len(shown))
            shown[~self.grows[: len(shown)]] = 0.0  # those of a lost crystal may be infinite
            self.measured_by_state = shown if self._moves else shown[0]

    def _now(self) -> Floats:
        state = np.empty((self.num_envs, len(self._names)))
        self._gather(self._batch.memory, state, 0, self.num_envs)
        return state

    @property
    def lost(self) -> npt.NDArray[np.bool_]:
        """True if each crystal is lost, shape (n,): one that has reached its length does not grow on either."""
        lost: npt.NDArray[np.bool_] = ~self.grows & (self._batch.memory.slots["over"] == LOST)
        return lost

    @property
    def scenarios(self) -> npt.NDArray[Any]:
        """Name of each crystal's scenario, shape (n,)."""
        return self._batch.scenarios.copy()

    def close(self) -> None:
        """Stop the threads."""
        self._batch.close()
