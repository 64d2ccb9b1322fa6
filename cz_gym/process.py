"""The record that the engine compiles into an environment, :class:`Process`, and the arithmetic of any such record.

The types name the numbers, the functions move them. Slots, lanes, complex steps, rows of ``info`` and channels of
observations follow from the types; ``Cz-v0`` is :data:`cz_gym.body.process.BODY`.

Every process stands in a puller: two drives move it (:class:`Inputs`), a camera and a pyrometer read it
(:class:`PerfectReadings`), a scenario disturbs it (:class:`cz_gym.episodes.draw.Episode`). All functions take SI units
and are pure, but for ``begin``, and marked :func:`cz_gym.jit.jittable`. ``p`` are the puller's constants, ``e`` is the
episode, ``m`` the meniscus model, ``t`` the time [s]. ``slot`` is a record of :func:`cz_gym.engine.kernels.slot_type`,
with ``slot.puller``, ``slot.episode``, ``slot.x``, the drives and the last readings.

Another process is one more value, in a room of its own:

* References that run with length: ``nominal``, ``accept``, ``cost_inputs`` and ``measure`` read the state, and the
  derivatives of a step follow them; where ``nominal`` does, :attr:`Process.nominal_moves` is true.
* A recipe of each reset: :attr:`Process.table` is the shape of ``slot.table``, which ``begin`` fills, with random
  numbers from ``slot.streams`` where it needs some.
* Numbers that outlive a step, as a running mean of the pull speed: the fields of :attr:`Process.StepMemory` stand in
  the slot; ``begin`` sets them, ``update_memory`` moves them on at every step, ``cost_inputs`` may charge them.
* Sensors beside camera and pyrometer: ``read_sensors`` writes their readings into the fields of ``Sensed``.
* Constants of an episode: fields of ``StepMemory`` that ``begin`` draws, or new ones of ``Episode`` and of the
  scenario.
* Stages: numbers of the parameters, which ``derive`` hands on as constants.
* An end with success: ``accept`` returns :data:`DONE`, which ``slot.over`` then is; a row ``succeeded`` of ``info``
  tells it to rollouts.
* Channels of its own: ``Measured``, ``TrueState``, ``Logged``, ``past`` and ``relative``.
"""

from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any, NamedTuple, get_type_hints

import numpy as np
import numpy.typing as npt

from cz_gym.support.errors import CzError
from cz_gym.support.units import HOUR, KILO, MM_PER_MIN

from .jit import compiled_as, force_inlined, jittable, static

GROWS, LOST, DONE = 0, 1, 2
"""Outcomes of a substep by ``accept``: the crystal grows on, is lost, is done with success."""
PULL_SCALE, HEATER_SCALE = 1.2 * MM_PER_MIN, 10.0 * KILO
"""Ranges of the default puller's drives [m/s, W], in which channels of these units are scaled."""
NO_OPERATING_POINT = "these parameters have no finite operating point; check temperatures and conductances"
Function = Callable[..., Any]


class Channel(NamedTuple):
    """One number of an observation or of ``info``."""

    unit: str
    """SI unit; "1" for none."""
    scale: float
    """Observations hold the number divided by this [unit]."""
    meaning: str
    """Description for tables."""
    name: str = ""
    """The field that it annotates."""


class Past(NamedTuple):
    """A signal whose past "history" shows, as differences of the means of neighbouring time spans."""

    name: str
    scale: float
    """Scale of these differences [unit of the signal]."""


class Relative(NamedTuple):
    """Signal that "history" shows relative to another one."""

    name: str
    to: str
    """Name of the other signal."""
    scale: float
    """Scale of the difference [unit of the signal]."""
    meaning: str
    """Description for tables."""


class Inputs(NamedTuple):
    """Inputs u, held over a step: the drives of a puller."""

    v_p: Any
    """Pull speed relative to the melt surface [m/s]."""
    Q_H: Any
    """Heater power [W]."""


@jittable
def read_drives(u: Any, slot: Any) -> Any:
    """Readings of the applied drives u: scale and offset of the episode, and what resolution and delay change."""
    e = slot.episode
    return Inputs(
        e.pull_scale * u.v_p + e.pull_offset + slot.v_p_misread,
        e.heater_scale * u.Q_H + e.heater_offset + slot.Q_H_misread,
    )


class PerfectReadings(NamedTuple):
    """Readings of noise-free sensors."""

    ring: Any
    """Radius of the bright ring [m]."""
    reading: Any
    """Radius of the bright ring less the operator's bias [m]."""
    h_c: Any
    """Height of the meniscus within its limits [m]."""
    T_1: Any
    """Temperature at the pyrometer [K]."""


class Readings(NamedTuple):
    """The sensors' last readings, in fields of the slot."""

    ring: Any
    """Camera's reading of the bright ring, less the operator's bias [m]."""
    T_1: Any
    """Pyrometer's reading of the heater temperature [K]."""


class NoMemory(NamedTuple):
    """No numbers besides the state."""


@jittable
def keep_memory(memory: Any, u: Any, nominal: Any, interval: Any) -> Any:
    """Return the memory unchanged."""
    return memory


@jittable
def no_sensors(slot: Any, m: Any) -> None:
    """Write nothing: camera and pyrometer are the only sensors."""


class InImage(NamedTuple):
    """A slot's crystal in the camera's image."""

    r_c: Any
    """Radius of the crystal by the last reading [m]; NaN: the image is black."""
    inwards: Any
    """Distance of the image's middle from the optical axis, towards the crystal's [m]."""


_RADIUS_STEPS = 4


@jittable
def seen_radius(r_c: Any, ring: Any, h_c: Any, p: Any, m: Any) -> Any:
    """The crystal's radius for a bright ring [m], by a fixed point that begins at ``r_c``."""
    for _ in range(_RADIUS_STEPS):
        r_c = ring - m.ring_offset(r_c, h_c, p)
    return r_c


@jittable
def in_image(slot: Any, m: Any) -> Any:
    """The crystal whose ring is at the last reading; the image is black while that is flagged invalid."""
    p = slot.puller
    ring = slot.ring + p.ring_bias
    r_c = seen_radius(ring - p.ring_bias, ring, slot.h_seen, p, m)
    return InImage(r_c if slot.valid > 0.0 else np.nan, 0.0)


def no_stages(parameters: Any, machine: Any, stage: Any) -> Any:
    """The parameters of a process without stages; CzError for a stage."""
    if stage is not None:
        raise CzError(f"only CzCrystal-v0 has stages, not this environment: stage={stage!r} must be left out")
    return parameters


def three_hours(parameters: Any, meniscus: Any, interval: float) -> float:
    """The usual length of an episode [s]."""
    return 3.0 * HOUR


@static
class Process(NamedTuple):
    """A process: types, tables and functions; see the module for how a further one is written."""

    Constants: Any
    """The puller's constants p, the puller's equations solved."""
    State: Any
    """State x."""
    Disturbance: Any
    """Disturbance d, held over a substep."""
    Measured: Any
    """Channels of "measured", annotated with :class:`Channel`; ``v_p`` and ``Q_H`` are deviations from nominal."""
    TrueState: Any
    """Channels of "state"."""
    Logged: Any
    """Rows of ``info``; among them those of ``BriefInfo``, ``v_p``, ``Q_H``, ``ring_offset``, ``action_clipped``, and
    ``term_`` with each name of ``Cost``."""
    BriefInfo: Any
    """Rows of ``info="lean"``: the controlled quantity and its reference first."""
    Cost: Any
    """Terms of a step's cost; each depends on one number."""
    past: tuple[Past, ...]
    """The signals whose past "history" shows; the first is the one that is integrated."""
    relative: tuple[Relative, ...]
    """The signals that "history" shows relative to others."""
    check: Function
    """``check(parameters, meniscus)``: the parameters, checked; CzError if nothing can grow with them."""
    derive: Function
    """``derive(parameters, factors, m)``: ``Constants`` at these factors of the hot zone
    (:class:`cz_gym.episodes.draw.Factors`)."""
    begin: Function
    """``begin(slot, m)``: the first ``State``; sets ``StepMemory`` and the table in the slot."""
    nominal: Function
    """``nominal(x, slot, interval)``: the ``Inputs`` from which actions and observed drives are counted in the control
    interval [s] that begins at x."""
    hidden_load: Function
    """``hidden_load(p_drift, p)``: heat load [W] that a recipe shifted by p_drift [K] would cancel."""
    disturb: Function
    """``disturb(Q_d, dT_i, t, e)``: ``Disturbance`` at a point of the 5 s grid, with the hidden load [W] and the
    interface's fluctuation [K] there."""
    rates: Function
    """``rates(x, u, d, p, m)``: time derivatives of the state; mark it ``force_inlined``."""
    accept: Function
    """``accept(slot, x, new, u, d, t, dt, limit, m)``: the state after the substep of dt [s] that ended at t, and
    :data:`GROWS`, :data:`LOST` or :data:`DONE`; ``limit`` is the largest radius error [m]."""
    perfect_readings: Function
    """``perfect_readings(x, p, m)``: :class:`PerfectReadings`; complex for a complex state."""
    measure: Function
    """``measure(x, u, nominal, memory, readings, slot, t)``: ``Measured`` of state, ``Inputs``, those from which
    actions are counted, ``StepMemory`` and :class:`Readings`; complex for complex ones."""
    true_state: Function
    """``true_state(slot, measured, t)``: ``TrueState``."""
    logged: Function
    """``logged(slot, measured, cost, t, ring, m)``: ``Logged``."""
    brief_info: Function
    """``brief_info(slot, measured)``: ``BriefInfo``."""
    cost_inputs: Function
    """``cost_inputs(x, u, before, memory, slot, t)``: ``Cost`` of the numbers that the terms charge; ``before`` are the
    inputs of the step before."""
    cost_terms: Function
    """``cost_terms(cost_inputs, weights)``: ``Cost``."""
    cost_slopes: Function
    """``cost_slopes(cost_inputs, weights)``: the derivative of each term by its own number."""
    reward: Function
    """``reward(cost, grows)``: the reward of a step [-], whose cost is ``Cost``; false if the crystal is lost in it."""
    check_points: Function
    """``check_points(p)``: a list of (x, u, d) in reach of a crystal. What the plant computes there is hashed
    (:attr:`cz_gym.config.Config.plant_hash`)."""
    weights: Any
    """The usual weights of the cost's terms, a named tuple of numbers."""
    StepMemory: Any = NoMemory
    """Numbers of a slot that outlive a step."""
    update_memory: Function = keep_memory
    """``update_memory(memory, u, nominal, interval)``: ``StepMemory`` after the drives have moved to u, counted from
    ``nominal``."""
    Sensed: Any = NoMemory
    """Numbers of a slot that sensors of its own write."""
    read_sensors: Function = no_sensors
    """``read_sensors(slot, m)``: writes a sample of them into ``Sensed``, with random numbers of ``slot.streams``;
    may flag the ring's reading invalid."""
    in_image: Function = in_image
    """``in_image(slot, m)``: :class:`InImage`."""
    nominal_moves: bool = False
    """True where ``nominal`` depends on the state."""
    name: str = ""
    """Name of its environment in ``gym.make``."""
    table: tuple[int, int] = (0, 0)
    """Rows and columns of ``slot.table``, which ``begin`` fills; none by default."""
    complete: Function = no_stages
    """``complete(parameters, machine, stage)``: the parameters that ``check`` takes, of a puller's, its file
    (:class:`cz_gym.puller.file.PullerFile`) and the stage that the user names; CzError if there is no such stage."""
    apart: tuple[str, ...] = ()
    """Parameters that say what an episode grows; the plant does not depend on them."""
    duration: Function = three_hours
    """``duration(parameters, meniscus, interval)``: the usual length of an episode [s]."""

    @property
    def functions(self) -> tuple[Any, ...]:
        """The functions among the fields."""
        return tuple(field for field in self if isinstance(field, FunctionType))

    @property
    def info(self) -> tuple[str, ...]:
        """Names of the rows of ``info``."""
        return tuple(self.Logged._fields)

    @property
    def measured(self) -> tuple[Channel, ...]:
        """Channels of ``observation="measured"``."""
        return tuple(signals(self.Measured).values())

    @property
    def state(self) -> tuple[Channel, ...]:
        """Channels of ``observation="state"``."""
        return tuple(signals(self.TrueState).values())

    @property
    def past_at(self) -> tuple[int, ...]:
        """Places in "measured" of the signals in ``past``."""
        return tuple(self.Measured._fields.index(each.name) for each in self.past)

    @property
    def lagged(self) -> int:
        """Number of signals whose past "history" shows."""
        return len(self.past)

    @property
    def past_change(self) -> tuple[float, ...]:
        """Ratio of each remembered signal's scale to the scale of its past differences [-]."""
        return tuple(signals(self.Measured)[each.name].scale / each.scale for each in self.past)

    @property
    def relative_at(self) -> tuple[int, ...]:
        """Places in "measured" of the signals in ``relative``."""
        return tuple(self.Measured._fields.index(each.name) for each in self.relative)

    @property
    def relative_to(self) -> tuple[int, ...]:
        """Places in "measured" of the signals that they are relative to."""
        return tuple(self.Measured._fields.index(each.to) for each in self.relative)

    @property
    def relative_change(self) -> tuple[float, ...]:
        """Ratio of each relative signal's scale to the scale of the difference [-]."""
        return tuple(signals(self.Measured)[each.name].scale / each.scale for each in self.relative)

    @property
    def integrated_scale(self) -> float:
        """Scale of the signal that "history" integrates [its unit]."""
        return self.measured[self.past_at[0]].scale


@cache
def signals(kind: Any) -> dict[str, Channel]:
    """The channels of an annotated type by name, in their order."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name].__metadata__[0]._replace(name=name) for name in kind._fields}


def scales(listed: tuple[Channel, ...], v_0: float, heater_range: float = HEATER_SCALE) -> npt.NDArray[np.float64]:
    """Scales of the channels for a puller of nominal pull speed v_0 [m/s] and heater range [W], shape (channels,)."""
    own = {"m/s": (v_0, PULL_SCALE), "W": (heater_range, HEATER_SCALE)}

    def scale(channel: Channel) -> float:
        size, default = own.get(channel.unit, (1.0, 1.0))
        return size * (channel.scale / default)

    return np.array([scale(channel) for channel in listed])


# Arithmetic of numbers and labelled tuples: limits, the integration of any process, and its linear model.
#
# Derivatives are taken by complex step through the very functions that are simulated, so they are exact to rounding:
# f'(x) = Im f(x + i h) / h, with a step h so small that nothing is subtracted (Squire and Trapp, SIAM Review 1998).

Floats = npt.NDArray[np.float64]
_STEP = 1e-30


@jittable
def clip(value: Any, limit: Any) -> Any:
    """The value limited to +-limit, a complex one by its real part; NaN stays NaN."""
    if value.real < -limit:
        return -limit
    return limit if value.real > limit else value


def along(x: Any, s: Any, k: Any) -> Any:
    """The labelled tuple x + s k."""
    return type(x)(*(value + s * rate for value, rate in zip(x, k, strict=True)))


@compiled_as(along)
def _along(x: Any, s: Any, k: Any) -> Any:
    fields = ", ".join(f"x.{name} + s * k.{name}" for name in x.instance_class._fields)
    return [f"return X({fields})"], {"X": x.instance_class}


def plus_product(start: Any, s: Any, k: Any, rows: Any, j: Any) -> Any:
    """``start`` plus the sum of s k times column j of ``rows``, one row for each field of k, in their order."""
    for row, value in enumerate(k):
        start = start + (s * value) * rows[row, j]
    return start


@compiled_as(plus_product)
def _plus_product(start: Any, s: Any, k: Any, rows: Any, j: Any) -> Any:
    terms = (f"(s * k.{name}) * rows[{row}, j]" for row, name in enumerate(k.instance_class._fields))
    return [f"return {' + '.join(['start', *terms])}"], {}


@force_inlined
def rk4(rates: Any, x: Any, u: Any, d: Any, p: Any, dt: Any, m: Any) -> Any:
    """One classical Runge-Kutta step of dt [s], inputs and disturbance held."""
    k_1 = rates(x, u, d, p, m)
    k_2 = rates(along(x, 0.5 * dt, k_1), u, d, p, m)
    k_3 = rates(along(x, 0.5 * dt, k_2), u, d, p, m)
    k_4 = rates(along(x, dt, k_3), u, d, p, m)
    return along(along(along(along(x, dt / 6.0, k_1), dt / 3.0, k_2), dt / 3.0, k_3), dt / 6.0, k_4)


class StateSpace(NamedTuple):
    """x' = A x + B u, y = C x + D u, all deviations from the point of linearisation; SI units, radians."""

    A: Floats
    """Shape (n, n)."""
    B: Floats
    """Shape (n, inputs)."""
    C: Floats
    """Shape (outputs, n)."""
    D: Floats
    """Shape (outputs, inputs)."""


def jacobian(function: Callable[..., Any], at: tuple[float, ...]) -> Floats:
    """Derivatives of a function of len(at) numbers that returns a tuple, by complex step; shape (values, len(at))."""
    columns = []
    for j in range(len(at)):
        shifted: list[complex] = list(at)
        shifted[j] = complex(at[j], _STEP)
        columns.append(np.imag(np.array(function(*shifted), np.complex128)) / _STEP)
    return np.stack(columns, axis=1)


def linearise(
    process: Process, p: Any, m: Any, at: tuple[Any, Any, Any], loads: tuple[str, ...], outputs: Callable[..., Any]
) -> StateSpace:
    """Linearise a process with constants p on a meniscus m around state, inputs and disturbance ``at``.

    Inputs are the drives and the fields ``loads`` of the disturbance; ``outputs(x, u, d)`` is a tuple. The point need
    not be a steady state: the result describes deviations from the trajectory through it.
    """
    x, u, d = at
    n, driven = len(x), len(x) + len(u)

    def labelled(values: tuple[Any, ...]) -> tuple[Any, Any, Any]:
        held = d._replace(**dict(zip(loads, values[driven:], strict=True)))
        return type(x)(*values[:n]), Inputs(*values[n:driven]), held

    point = (*x, *u, *(getattr(d, name) for name in loads))
    AB = jacobian(lambda *values: process.rates(*labelled(values), p, m), point)
    CD = jacobian(lambda *values: outputs(*labelled(values)), point)
    return StateSpace(AB[:, :n], AB[:, n:], CD[:, :n], CD[:, n:])
