"""What a plant needs around a controller: takeover, limits, hold, fallback, alarms.

The controller runs on a grid of its own interval. A call makes as many samples as intervals have passed, up to
:data:`PASSES` of them; after a gap it is a takeover. Readings that are not finite, invalid, too old, outside the range
of the observations, or of a pyrometer that jumps or stands still are replaced by the last good ones. If that lasts, if
the controller's output is not finite, or if its model does not explain the readings, the fallback PID takes over until
the next takeover; without a ring it holds the pull speed, without a pyrometer the heater follows the recipe and the
pull speed alone. After every takeover the setpoints start at the applied drives and move to the controller's within
``takeover_s``. All of it is NumPy code on arrays of shape (n,): :meth:`Block.run` runs it on n plants at once, and
:attr:`Block.program` is its record, from which other languages are written.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add, and_
from typing import Any, NamedTuple, Protocol

import numpy as np

from cz_gym.config import Config
from cz_gym.observation import Measured, readable
from cz_gym.physics.linearisation import INPUTS as COLUMNS
from cz_gym.physics.linearisation import STATES, linearise
from cz_gym.support.units import KILO, MINUTE, MM_PER_MIN

from .ports import INPUTS, OUTPUTS, Alarm, nominal_puller, readings_of, settings_of
from .program import PASSES, Port, Program, record
from .trace import FINITE, Floats

JUMP, MEND = 8.0, 0.02 / MINUTE
"""Largest difference of the pyrometer from what is expected [K], and its growth without a good reading [K/s]."""
STUCK, SAME = 2.0 * MINUTE, 1e-4
"""Time after which a pyrometer that changes by less than SAME [K] counts as stuck [s]."""
BLIND = MINUTE
"""Time for which a controller that estimates the temperature keeps the heater without a pyrometer [s]."""
ASTRAY, FAR = MINUTE, 0.05
"""Time after which a drive counts as not following [s], and its distance from the setpoint in shares of its range."""
LEVEL, TRIM_T_1, TRIM_Q_H = 5.0 * MINUTE, 0.5, 0.005
"""Averaging time of the pull speed [s]; what a takeover leaves of the deviation from the nominal temperature [K] and
power [share of the heater's range]. The rest counts as an error of the nominal values."""
SETTLED = 30.0 * MINUTE
"""Time since a takeover or a bad pyrometer, from which it counts that a model does not explain the readings [s]."""
SLOWER, FOLLOWED = 1.5, 0.5
"""Of the heater without a pyrometer: the time constant of the mean pull speed, in multiples of its averaging time; the
share of the recipe's movement that is followed [-]."""
TEMPERATURES = "T_1", "T_2", "T_b"
UNKNOWN = "clock_s", "called_s", "pull", "heater", "shown"
"""Memory that is infinite before the first sample."""


_INPUTS = {port.name for port in INPUTS}


class Controller(Protocol):
    """What the shell is put around, :class:`cz_gym.baselines.policy.MeasuredController` for one."""

    @property
    def estimates_temperature(self) -> bool:
        """Whether it is given a pyrometer reading that is not finite as such."""

    def at_rest(self, seen: Measured) -> Any:
        """Its memory before the first sample."""

    def step(self, seen: Measured, memory: Any) -> tuple[Any, Any, Any]:
        """Pull speed [m/s] and heater power [W] above nominal, and the new memory."""


class Facts(NamedTuple):
    """The numbers of a block's puller that are no settings."""

    dt: float
    """Control interval [s]."""
    ranges: tuple[float, float]
    """:attr:`cz_gym.config.Config.ranges`."""
    jump: float
    """Largest jump of the pyrometer [K]."""
    feed: float
    """Heater power for a lasting change of the heater temperature [W/K]."""
    trim: float
    """Heater power without a pyrometer for a relative deviation of the mean pull speed [W]."""
    slow: float
    """Slowest time constant of the temperatures, integral time of that trim [s]."""
    nominal: tuple[float, float]
    """Pull speed [mm/min] and heater power [kW] at the operating point: where even the settings are no numbers."""


class Memory(NamedTuple):
    """The memory of the shell, of its controller and of its PID."""

    clock_s: Any
    """Time up to which samples were taken [s], infinite before the first."""
    called_s: Any
    """Time of the last call that took one [s]."""
    late: Any
    """1 if that call was late."""
    engaged: Any
    """1 if the last sample was automatic."""
    since: Any
    """Time since the takeover [s]."""
    bad: Any
    """Time without a good set of readings [s]."""
    fallback: Any
    """1 if the PID controls."""
    pull: Any
    """Last setpoint of the pull speed [mm/min], infinite before the first."""
    heater: Any
    """Last setpoint of the heater power [kW]."""
    astray: Any
    """Time for which a drive has not followed [s]."""
    shown: Any
    """Last reading of the pyrometer, good or not [K]."""
    still: Any
    """Time for which it has not changed [s]."""
    dark: Any
    """Time without a good reading of the pyrometer [s]."""
    level: Any
    """Mean pull speed above nominal, relative [-]."""
    calm: Any
    """Time since the takeover and since the pyrometer was last bad [s]."""
    off_T_1: Any
    """Error of the nominal temperature [K], as the takeover found it."""
    off_Q_H: Any
    """Error of the nominal power [W]."""
    readings: Measured
    """Last good readings, deviations, SI."""
    controller: Any
    pid: Any


class Call(NamedTuple):
    """What a call's time means."""

    due: Any
    """Whether a sample is taken in this pass."""
    again: Any
    """Whether another one follows in this call."""
    later: Any
    """Whether one went before in this call."""
    share: Any
    """1 over the number of samples that are left with this one."""
    starts: Any
    """Whether this is the first call, or the first after a gap."""
    late: Any
    sound: Any
    """Whether the time moves forward."""
    clock: Any
    """Time up to which samples will have been taken [s]."""


def _call(dt: float, given: Any, memory: Memory) -> Call:
    time, begun = given["time_s"], _finite(memory.clock_s)
    later = begun & (time == memory.called_s)
    behind = np.where(begun, time - memory.clock_s, dt)
    back, gap = behind < -dt, begun & (time - memory.called_s > given["gap_s"])
    overdue = (behind > 1.1 * dt) & (time - memory.called_s > 1.1 * dt)
    late = np.where(later, memory.late > 0.5, begun & overdue)
    behind = np.where(back | gap, dt, np.minimum(behind, PASSES * dt))
    due = _finite(time) & (behind >= 0.5 * dt)
    again = due & (behind >= 1.5 * dt)
    left = 1.0 + np.where(again, 1.0, 0.0) + np.where(behind >= 2.5 * dt, 1.0, 0.0)
    sound = _finite(time) & ~back & (~begun | (time > memory.called_s) | (later & due))
    return Call(due, again, later, 1.0 / left, ~begun | gap, late, sound, time - behind + dt)


class Readings(NamedTuple):
    """The readings of a sample and what is known of them."""

    read: Measured
    """With the last good one in place of each bad one; from the nominal values as set."""
    T_1: Any
    """The pyrometer's, infinite if it is bad [K]."""
    plausible: Measured
    ring: Any
    """Whether the ring is good."""
    pyrometer: Any
    """The same of the pyrometer."""
    reference: Any
    """The same of references and previews."""
    shown: Any
    still: Any


def _readings(facts: Facts, call: Call, manual: Any, given: Any, memory: Memory) -> Readings:
    seen, plausible = readings_of(given, facts.ranges)
    age = given["time_s"] - given["ring_time_s"]
    ring = plausible.ring_error & (seen.valid > 0.5) & (np.abs(age) <= given["oldest_reading_s"])
    reference = reduce(and_, (getattr(plausible, name) for name in Measured._fields if "ref" in name))
    first = Measured(*(np.where(good, value, 0.0) for good, value in zip(plausible, seen, strict=True)))
    last = Measured(*(np.where(call.starts, new, old) for old, new in zip(memory.readings, first, strict=True)))
    same = ~call.starts & (np.abs(seen.T_1 - memory.shown) <= SAME)
    still = np.where(same, memory.still + np.where(call.later, 0.0, facts.dt), 0.0)
    expected = last.T_1 + np.where(reference, seen.T_1_ref - last.T_1_ref, 0.0)
    near = np.abs(seen.T_1 - expected) <= facts.jump + MEND * memory.dark
    pyrometer = plausible.T_1 & (still <= STUCK) & (near | manual | call.starts)
    good = plausible._replace(T_1=pyrometer)
    trusted = Measured(*(np.where(each, value, np.inf) for each, value in zip(good, seen, strict=True)))
    read = readable(trusted._replace(valid=np.where(ring, 1.0, 0.0)), last)
    read = read._replace(T_1=np.where(pyrometer, seen.T_1, np.where(call.starts, 0.0, expected)))
    shown = np.where(_finite(seen.T_1), seen.T_1, np.inf)
    return Readings(read, trusted.T_1, plausible, ring, pyrometer, reference, shown, still)


def _trimmed(read: Measured, off_T_1: Any, off_Q_H: Any) -> Measured:
    """The readings from the nominal values less their errors."""
    temperatures = {name: getattr(read, name) - off_T_1 for name in Measured._fields if name.startswith("T_1")}
    return read._replace(**temperatures, Q_H=read.Q_H - off_Q_H)


def _sane(given: Any) -> Any:
    """Whether the settings are numbers in the right order."""
    ordered = (given["pull_speed_min_mm_per_min"] <= given["pull_speed_max_mm_per_min"]) & (
        given["heater_power_min_kW"] <= given["heater_power_max_kW"]
    )
    positive = ("pull_slew_mm_per_min2", "heater_slew_kW_per_min", "nominal_pull_speed_mm_per_min", "gap_s")
    finite = (_finite(given[name]) for name in given if name not in _INPUTS)
    return reduce(and_, (given[port] > 0.0 for port in positive), reduce(and_, finite, ordered))


def step(controller: Controller, pid: Controller, facts: Facts, given: Any, memory: Any) -> Any:
    """Outputs, memory, whether a sample was due and whether another is, for settings and inputs by their names."""
    dt, sane, call = facts.dt, _sane(given), _call(facts.dt, given, memory)
    automatic, before = (given["automatic"] > 0.5) & sane, (memory.engaged > 0.5) & ~call.starts
    seen = _readings(facts, call, ~(automatic & before), given, memory)
    drives = [_drive(sane, facts, call, seen, given, memory, which) for which in (0, 1)]
    known = drives[0].known & drives[1].known
    engaged = automatic & (before | known)
    runs = engaged & before
    away = runs & (drives[0].away | drives[1].away)
    astray = np.where(call.later, memory.astray, np.where(away, memory.astray + dt, 0.0))
    good = seen.ring & seen.reference & known
    bad = np.where(good, 0.0, np.where(call.starts, 0.0, memory.bad) + dt)
    dark = np.where(seen.pyrometer, 0.0, np.where(call.starts, 0.0, memory.dark) + dt)
    calm = np.where(runs & seen.pyrometer, memory.calm + dt, 0.0)
    puzzled = (calm > SETTLED) & (controller.puzzled(memory.controller) if hasattr(controller, "puzzled") else False)
    fallen = runs & (memory.fallback > 0.5)
    fallback = runs & (fallen | (bad > given["fallback_after_s"]) | puzzled)
    since = np.where(runs & (fallen | ~fallback), memory.since + dt, 0.0)
    share = np.minimum(since / np.maximum(given["takeover_s"], 1e-3), 1.0)

    off_T_1 = np.where(runs, memory.off_T_1, np.where(seen.pyrometer, _beyond(seen.read.T_1, TRIM_T_1), 0.0))
    off_Q_H = np.where(runs, memory.off_Q_H, _beyond(seen.read.Q_H, TRIM_Q_H * facts.ranges[1]))
    read = _trimmed(seen.read, off_T_1, off_Q_H)
    nominal = drives[0].nominal, drives[1].nominal + off_Q_H / KILO
    after = [(each.held - at) * unit for each, at, unit in zip(drives, nominal, (MM_PER_MIN, KILO), strict=True)]
    later = call.later & runs
    between = memory.readings.ring_error + call.share * (read.ring_error - memory.readings.ring_error)
    read = read._replace(
        ring_error=np.where(runs & call.again, between, read.ring_error),
        v_p=np.where(later, after[0], read.v_p),
        Q_H=np.where(later, after[1], read.Q_H),
    )
    estimates = controller.estimates_temperature
    shown = np.where(call.again, np.inf, seen.T_1 - off_T_1)
    told = read._replace(T_1=shown, valid=np.where(call.again, 0.0, read.valid)) if estimates else read
    own = controller.step(
        told, memory.controller if runs.all() else select(runs, memory.controller, controller.at_rest(read))
    )
    other = own[0], own[1], memory.pid
    if (fallback | ~(_finite(own[0]) & _finite(own[1]))).any():
        other = pid.step(read, select(fallen, memory.pid, pid.at_rest(read)))
    pull, heater = (
        np.where(fallback, second, first) / unit + at
        for first, second, unit, at in zip(own[:2], other[:2], (MM_PER_MIN, KILO), nominal, strict=True)
    )
    lost = astray > ASTRAY
    old = [np.where(runs, each.near(each.held, lost), each.applied) for each in drives]
    level = np.where(call.starts, 0.0, memory.level)
    level = level + min(dt / LEVEL, 1.0) * (seen.read.v_p / (drives[0].nominal * MM_PER_MIN) - level)
    blind = ~seen.pyrometer & ((dark > BLIND) | fallback | (not estimates))
    moved = np.where(seen.reference & ~call.starts, seen.read.T_1_ref - memory.readings.T_1_ref, 0.0)
    trim = FOLLOWED * facts.feed * moved + facts.trim * (level - memory.level + dt / facts.slow * level)
    wanted = np.where(fallback & ~seen.ring, old[0], pull), np.where(blind, old[1] + trim / KILO, heater)
    sound = _finite(wanted[0]) & _finite(wanted[1])
    moves = [
        each.move(start, np.where(sound, target, start), share, dt)
        for each, start, target in zip(drives, old, wanted, strict=True)
    ]
    setpoints = [
        np.where(call.due, np.where(engaged, each.near(value, lost), each.applied), each.held)
        for each, (value, _) in zip(drives, moves, strict=True)
    ]
    bits = {
        Alarm.RING: ~seen.ring, Alarm.PYROMETER: ~seen.pyrometer, Alarm.DRIVES: ~known,
        Alarm.REFERENCE: ~seen.reference, Alarm.LATE: call.late, Alarm.CLOCK: ~call.sound,
        Alarm.PULL_LIMITED: engaged & moves[0][1], Alarm.HEATER_LIMITED: engaged & moves[1][1],
        Alarm.TAKEOVER: engaged & (share < 1.0), Alarm.FALLBACK: fallback, Alarm.FAILED: engaged & ~sound,
        Alarm.MANUAL: ~engaged, Alarm.SETTINGS: ~sane, Alarm.ASTRAY: lost, Alarm.MODEL: puzzled,
    }  # fmt: skip
    alarms = reduce(add, (np.where(holds, float(bit), 0.0) for bit, holds in bits.items()))
    outputs = dict(zip((port.name for port in OUTPUTS), (*setpoints, alarms), strict=True))
    now = Memory(
        clock_s=call.clock,
        called_s=given["time_s"],
        late=np.where(call.late, 1.0, 0.0),
        engaged=np.where(engaged, 1.0, 0.0),
        since=since,
        bad=bad,
        fallback=np.where(fallback | (engaged & ~sound), 1.0, 0.0),
        pull=setpoints[0],
        heater=setpoints[1],
        astray=astray,
        shown=seen.shown,
        still=seen.still,
        dark=dark,
        level=level,
        calm=calm,
        off_T_1=off_T_1,
        off_Q_H=off_Q_H,
        readings=seen.read._replace(ring_error=read.ring_error),
        controller=own[2],
        pid=other[2],
    )
    return outputs, now, call.due, call.again


class Drive(NamedTuple):
    """One drive at a sample, in the unit of its port."""

    known: Any
    """Whether its reading is good."""
    applied: Any
    """The reading; without a good one the last setpoint."""
    held: Any
    """The last setpoint; before the first one the nominal value."""
    nominal: Any
    far: Any
    """Distance from which it does not follow."""
    slew: Any
    """Largest change in a minute."""
    span: tuple[Any, Any]
    """Range of its setpoint."""

    @property
    def away(self) -> Any:
        """Whether it is far from its last setpoint."""
        return self.known & (np.abs(self.applied - self.held) > self.far)

    def near(self, setpoint: Any, lost: Any) -> Any:
        """The setpoint; where the drive does not follow, no farther from it than needed to see that it does again."""
        return np.where(lost, np.clip(setpoint, self.applied - 2.0 * self.far, self.applied + 2.0 * self.far), setpoint)

    def move(self, old: Any, wanted: Any, share: Any, dt: float) -> tuple[Any, Any]:
        """The setpoint on its way from ``old`` to a value, and whether range or slew rate cut it."""
        free, bound = (
            np.where(share < 1.0, old + share * (to - old), to) for to in (wanted, np.clip(wanted, *self.span))
        )
        most = self.slew * (dt / MINUTE)
        limit = np.clip(bound, old - most, old + most)
        return limit, np.abs(limit - free) > 1e-6


_PORTS = (
    ("pull_speed_mm_per_min", "pull_speed_{}_mm_per_min", "nominal_pull_speed_mm_per_min", "pull_slew_mm_per_min2"),
    ("heater_power_kW", "heater_power_{}_kW", "nominal_heater_power_kW", "heater_slew_kW_per_min"),
)
"""Of each drive: its reading, the ends of its range, its nominal value and its slew rate."""


def _drive(sane: Any, facts: Facts, call: Call, seen: Readings, given: Any, memory: Memory, which: int) -> Drive:
    reading, end, at_rest, slew = _PORTS[which]
    known = np.where(sane, (seen.plausible.v_p, seen.plausible.Q_H)[which], _finite(given[reading]))
    nominal, last = given[at_rest], (memory.pull, memory.heater)[which]
    held = np.where(_finite(last), last, np.where(_finite(nominal), nominal, facts.nominal[which]))
    span = given[end.format("min")], given[end.format("max")]
    applied, far = np.where(known, given[reading], held), FAR * (span[1] - span[0])
    return Drive(known, applied, held, nominal, far, given[slew], span)


def _beyond(value: Any, most: float) -> Any:
    """What a value has beyond +-most."""
    return value - np.clip(value, -most, most)


def _finite(value: Any) -> Any:
    return np.abs(value) <= FINITE


def select(condition: Any, one: Any, other: Any) -> Any:
    """``one`` where the condition of shape (n,) holds, else ``other``: arrays, or nested tuples of them."""
    if isinstance(other, tuple):
        parts = [select(condition, a, b) for a, b in zip(one, other, strict=True)]
        return type(other)(*parts) if hasattr(other, "_fields") else tuple(parts)
    return np.where(np.reshape(condition, (-1, *(1,) * (np.ndim(other) - 1))), one, other)


@dataclass(frozen=True)
class Block:
    """A controller in its shell, for the puller and the control interval of an environment."""

    name: str
    controller: Controller
    pid: Controller
    """The fallback."""
    config: Config
    notes: tuple[str, ...] = ()
    """Facts for the header of each written file: puller, hashes, scenario."""

    @cached_property
    def ports(self) -> dict[str, Port]:
        """Settings and inputs by name."""
        return {port.name: port for port in (*settings_of(self.config), *INPUTS)}

    def start(self, n: int) -> Memory:
        """The memory of n blocks before their first sample."""
        zero = Measured(*(np.zeros(n) for _ in Measured._fields))
        return Memory(
            **{name: np.full(n, math.inf if name in UNKNOWN else 0.0) for name in Memory._fields[:-3]},
            readings=zero,
            controller=self.controller.at_rest(zero),
            pid=self.pid.at_rest(zero),
        )

    def run(self, inputs: Mapping[str, Any], memory: Memory) -> tuple[dict[str, Floats], Memory]:
        """The outputs, each of shape (n,), and the next memory, for inputs and settings; missing ones have defaults."""
        n = len(memory.pull)
        given = {
            name: np.broadcast_to(np.asarray(inputs.get(name, port.default), np.float64), (n,))
            for name, port in self.ports.items()
        }
        outputs, again = dict[str, Any](), np.ones(n, np.bool_)
        for _ in range(PASSES):
            with np.errstate(all="ignore"):
                shown, after, due, more = self._step(given, memory)
            outputs = {name: np.where(again, value, outputs.get(name, value)) for name, value in shown.items()}
            memory, again = after if due.all() else select(due, after, memory), more
            if not again.any():
                break
        return outputs, memory

    @cached_property
    def facts(self) -> Facts:
        """What the shell knows of the puller."""
        config, puller = self.config, nominal_puller(self.config)
        hot = linearise(puller, config.meniscus)
        at = [STATES.index(name) for name in TEMPERATURES]
        A, B = hot.A[np.ix_(at, at)], hot.B[at, COLUMNS.index("Q_H")]
        T_1, _, T_b = -np.linalg.solve(A, B)
        pull = T_b * puller.k_l / (puller.v_0 * puller.rho_dH * puller.h_0)
        slow = -1.0 / float(np.linalg.eigvals(A).real.max())
        noise = max(each.sensor.pyrometer_noise[1] for each in config.scenario.scenarios)
        nominal = puller.v_0 / MM_PER_MIN, puller.Q_H_0 / KILO
        return Facts(
            config.control_interval,
            config.ranges,
            JUMP + 8.0 * noise,
            1.0 / T_1,
            slow / (pull * SLOWER * LEVEL),
            slow,
            nominal,
        )

    def _step(self, given: Any, memory: Any) -> Any:
        return step(self.controller, self.pid, self.facts, given, memory)

    @cached_property
    def program(self) -> Program:
        """What it computes, recorded."""
        ports = settings_of(self.config), INPUTS, OUTPUTS
        return record(self._step, self.start(1), ports, self.name, self.notes)
