"""A sample of a block: what the time of a call means, which readings are good, what the drives do."""

from functools import reduce
from operator import and_
from typing import Any, NamedTuple

import numpy as np

from cz_gym.body.cost import moved_mean
from cz_gym.observation import Measured, readable
from cz_gym.support.units import MINUTE

from .ports import INPUTS, readings_of
from .program import PASSES
from .trace import FINITE

JUMP, MEND = 8.0, 0.02 / MINUTE
"""Largest difference of the pyrometer from what is expected [K], and its growth without a good reading [K/s]."""
STUCK, SAME = 2.0 * MINUTE, 1e-4
"""Time after which a pyrometer that changes by less than SAME [K] counts as stuck [s]."""
FAR = 0.05
"""Distance from its setpoint from which a drive does not follow, in shares of its range [-]."""
_INPUTS = {port.name for port in INPUTS}


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
    samples: Any
    """Number of samples of that call."""
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
    samples: Any
    """Number of samples of the call."""
    starts: Any
    """Whether this is the first call, or the first after a gap."""
    late: Any
    sound: Any
    """Whether the time moves forward."""
    clock: Any
    """Time up to which samples will have been taken [s]."""


def call_of(dt: float, given: Any, memory: Memory) -> Call:
    """What the time of a call means for a control interval of dt [s]."""
    time, begun = given["time_s"], finite(memory.clock_s)
    later = begun & (time == memory.called_s)
    behind = np.where(begun, time - memory.clock_s, dt)
    back, gap = behind < -dt, begun & (time - memory.called_s > given["gap_s"])
    overdue = (behind > 1.1 * dt) & (time - memory.called_s > 1.1 * dt)
    late = np.where(later, memory.late > 0.5, begun & overdue)
    behind = np.where(back | gap, dt, np.minimum(behind, PASSES * dt))
    due = finite(time) & (behind >= 0.5 * dt)
    again = due & (behind >= 1.5 * dt)
    left = 1.0 + np.where(again, 1.0, 0.0) + np.where(behind >= 2.5 * dt, 1.0, 0.0)
    samples = np.where(later, memory.samples, left)
    sound = finite(time) & ~back & (~begun | (time > memory.called_s) | (later & due))
    return Call(due, again, later, 1.0 / left, samples, ~begun | gap, late, sound, time - behind + dt)


class Readings(NamedTuple):
    """The readings of a sample and what is known of them."""

    read: Measured
    """With the last good one in place of each bad one, ring and drives on their way from the call before; from the
    nominal values as set."""
    T_1: Any
    """The pyrometer's, infinite if it is bad [K]."""
    plausible: Measured
    ring: Any
    """Whether the ring is good."""
    pyrometer: Any
    """Whether the pyrometer is good."""
    reference: Any
    """Whether references and previews are good."""
    shown: Any
    still: Any


def sample_of(facts: Facts, call: Call, manual: Any, given: Any, memory: Memory) -> Readings:
    """The readings of a call; ``manual``: whether the operator answers for them."""
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
    moving = {name: (getattr(last, name), getattr(read, name)) for name in ("ring_error", "v_p", "Q_H")}
    share = np.where(manual, 1.0, call.share)
    read = read._replace(**{name: old + share * (new - old) for name, (old, new) in moving.items()})
    mean = np.where(call.starts, read.v_p, moved_mean(last.v_p_mean, read.v_p, facts.dt))
    read = read._replace(v_p_mean=mean)
    shown = np.where(finite(seen.T_1), seen.T_1, np.inf)
    return Readings(read, trusted.T_1, plausible, ring, pyrometer, reference, shown, still)


def trimmed(read: Measured, off_T_1: Any, off_Q_H: Any) -> Measured:
    """The readings from the nominal values less their errors."""
    temperatures = {name: getattr(read, name) - off_T_1 for name in Measured._fields if name.startswith("T_1")}
    return read._replace(**temperatures, Q_H=read.Q_H - off_Q_H)


def sane_of(given: Any) -> Any:
    """Whether the settings are numbers in the right order."""
    ordered = given["pull_speed_min_mm_per_min"] <= given["pull_speed_max_mm_per_min"]
    ordered = ordered & (given["heater_power_min_kW"] <= given["heater_power_max_kW"])
    positive = ("pull_slew_mm_per_min2", "heater_slew_kW_per_min", "nominal_pull_speed_mm_per_min", "gap_s")
    numbers = (finite(given[name]) for name in given if name not in _INPUTS)
    return reduce(and_, (given[port] > 0.0 for port in positive), reduce(and_, numbers, ordered))


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
        ends = wanted, np.clip(wanted, *self.span)
        free, bound = (np.where(share < 1.0, old + share * (to - old), to) for to in ends)
        most = self.slew * (dt / MINUTE)
        limit = np.clip(bound, old - most, old + most)
        return limit, np.abs(limit - free) > 1e-6


_PORTS = (
    ("pull_speed_mm_per_min", "pull_speed_{}_mm_per_min", "nominal_pull_speed_mm_per_min", "pull_slew_mm_per_min2"),
    ("heater_power_kW", "heater_power_{}_kW", "nominal_heater_power_kW", "heater_slew_kW_per_min"),
)
"""Names of each drive's reading, of the ends of its range, its nominal value and its slew rate."""


def drive_of(sane: Any, facts: Facts, call: Call, seen: Readings, given: Any, memory: Memory, which: int) -> Drive:
    """The pull (0) or the heater (1) at a sample."""
    reading, end, at_rest, slew = _PORTS[which]
    known = np.where(sane, (seen.plausible.v_p, seen.plausible.Q_H)[which], finite(given[reading]))
    nominal, last = given[at_rest], (memory.pull, memory.heater)[which]
    held = np.where(finite(last), last, np.where(finite(nominal), nominal, facts.nominal[which]))
    span = given[end.format("min")], given[end.format("max")]
    applied, far = np.where(known, given[reading], held), FAR * (span[1] - span[0])
    return Drive(known, applied, held, nominal, far, given[slew], span)


def finite(value: Any) -> Any:
    """Whether a number is neither NaN nor infinite, which recorded programs have as large ones."""
    return np.abs(value) <= FINITE
