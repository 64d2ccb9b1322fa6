"""What a plant needs around a controller: takeover, limits, hold, fallback, alarms.

Every sample: readings that are not finite, invalid, too old or outside the range of the observations are replaced by
the last good ones, and the controller is told that its ring reading is not valid. If that lasts, or the controller's
output is not finite, the fallback PID takes over until the next reset or takeover; without a ring it holds the pull
speed. After every takeover the setpoints start at the applied drives and move to the controller's within
``takeover_s``. All of it is NumPy code on arrays of shape (n,): :meth:`Block.run` runs it on n plants at once, and
:attr:`Block.program` is its record, from which other languages are written.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from functools import cache, cached_property, reduce
from operator import add, and_
from typing import Any, NamedTuple, Protocol

import numpy as np

from cz_gym.body.plant import Puller, make_puller
from cz_gym.config import Config
from cz_gym.observation import CLIP, MEASURED, Measured, readable, scales
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from .program import Port, Program, record
from .trace import FINITE, Floats

NO_LIMIT = 1e30
"""A slew rate that limits nothing."""


class Controller(Protocol):
    """What the shell is put around, :class:`cz_gym.baselines.policy.MeasuredController` for one."""

    @property
    def accepts_missing_temperature(self) -> bool:
        """Whether it is given a pyrometer reading that is not finite as such."""

    def at_rest(self, seen: Measured) -> Any:
        """Its memory before the first sample."""

    def step(self, seen: Measured, memory: Any) -> tuple[Any, Any, Any]:
        """Pull speed [m/s] and heater power [W] above nominal, and the new memory."""


class Alarm(IntFlag):
    """The bits of ``alarms``."""

    RING = 1
    """The ring reading is invalid, too old, or outside its range; the last good one is held."""
    PYROMETER = 2
    """The same of the pyrometer."""
    DRIVES = 4
    """The same of an applied drive."""
    REFERENCE = 8
    """The same of a reference or its preview."""
    LATE = 16
    """The sample came more than a tenth of the control interval late."""
    CLOCK = 32
    """The time stood still, ran back, or was no number."""
    PULL_LIMITED = 64
    """The pull speed's range or slew rate cut its setpoint."""
    HEATER_LIMITED = 128
    """The heater's range or slew rate cut its setpoint."""
    TAKEOVER = 256
    """The setpoints still move from the drives found at a takeover to the controller's."""
    FALLBACK = 512
    """The PID controls instead of the controller, until reset or the next takeover."""
    FAILED = 1024
    """The controller's output was no number."""
    MANUAL = 2048
    """``automatic`` is not set: the setpoints follow the applied drives."""


INPUTS = (
    Port("time_s", "time of this call"),
    Port("ring_time_s", "time of the ring reading"),
    Port("ring_radius_mm", "radius of the bright ring, as the camera gives it"),
    Port("valid", "whether the camera says that the reading is good", 1.0, True),
    Port("r_ref_mm", "radius reference now"),
    Port("r_ref_1min_mm", "radius reference in 1 minute"),
    Port("r_ref_5min_mm", "radius reference in 5 minutes"),
    Port("T_1_ref_K", "recipe of the heater temperature now"),
    Port("T_1_ref_1min_K", "recipe in 1 minute"),
    Port("T_1_ref_5min_K", "recipe in 5 minutes"),
    Port("T_1_K", "pyrometer reading of the heater temperature"),
    Port("pull_speed_mm_per_min", "applied pull speed"),
    Port("heater_power_kW", "applied heater power"),
    Port("automatic", "whether the controller acts; a rising edge is a takeover", 1.0, True),
)
"""The inputs of every block."""
READINGS = {
    **{name: (f"{name}_mm", "nominal_radius_mm", "r_0", MM) for name in ("r_ref", "r_ref_1min", "r_ref_5min")},
    **{
        name: (f"{name}_K", "nominal_T_1_K", "T_1_0", 1.0)
        for name in ("T_1_ref", "T_1_ref_1min", "T_1_ref_5min", "T_1")
    },
    "v_p": ("pull_speed_mm_per_min", "nominal_pull_speed_mm_per_min", "v_0", MM_PER_MIN),
    "Q_H": ("heater_power_kW", "nominal_heater_power_kW", "Q_H_0", KILO),
}
"""Readings but the ring: input, setting with its nominal value, that of a puller, and the input's unit."""
OUTPUTS = (
    Port("pull_speed_setpoint_mm_per_min", "setpoint of the pull speed"),
    Port("heater_power_setpoint_kW", "setpoint of the heater power"),
    Port("alarms", "sum of the alarm bits"),
)
"""The outputs of every block."""


class Memory(NamedTuple):
    """The memory of the shell, of its controller and of its PID."""

    last_time_s: Any
    """Time of the last sample [s], infinite before the first."""
    engaged: Any
    """1 if the last sample was automatic."""
    since: Any
    """Time since the takeover [s]."""
    bad: Any
    """Time without a good set of readings [s]."""
    fallback: Any
    """1 if the PID controls."""
    pull: Any
    """Last setpoint of the pull speed [mm/min]."""
    heater: Any
    """Last setpoint of the heater power [kW]."""
    readings: Measured
    """Last good readings, deviations, SI."""
    controller: Any
    pid: Any


def nominal_puller(config: Config) -> Puller:
    """The puller at its operating point that a block is made for."""
    return _puller(config.parameters, config.meniscus)


_puller = cache(lambda parameters, meniscus: make_puller(parameters, 0.5, meniscus))


def settings_of(config: Config, puller: Puller | None = None) -> tuple[Port, ...]:
    """The settings of a block for an environment's puller, or for one that was drawn there; its file's limits of the
    drives are the defaults.
    """
    puller, drives = puller or nominal_puller(config), config.puller
    v_0, Q_0 = puller.v_0 / MM_PER_MIN, puller.Q_H_0 / KILO
    window = min(puller.v_0, math.inf if drives.pull_window is None else drives.pull_window) / MM_PER_MIN
    fastest = min(v_0 + window, math.inf if drives.pull_max is None else drives.pull_max / MM_PER_MIN)
    pull_slew = NO_LIMIT if drives.pull_slew is None else drives.pull_slew / (MM_PER_MIN / MINUTE)
    heater_slew = NO_LIMIT if drives.heater_slew is None else drives.heater_slew / (KILO / MINUTE)
    reach = config.heater_range / KILO
    return (
        Port("nominal_radius_mm", "crystal radius at the operating point", puller.r_0 / MM),
        Port("ring_bias_mm", "the operator's bias: ring radius minus crystal radius at nominal", puller.ring_bias / MM),
        Port("nominal_pull_speed_mm_per_min", "this puller's pull speed at its operating point", v_0),
        Port("nominal_heater_power_kW", "this puller's heater power there", Q_0),
        Port("nominal_T_1_K", "this puller's pyrometer reading there", puller.T_1_0),
        Port("pull_speed_min_mm_per_min", "lowest setpoint of the pull speed", v_0 - window),
        Port("pull_speed_max_mm_per_min", "highest setpoint of the pull speed", fastest),
        Port("heater_power_min_kW", "lowest setpoint of the heater power", max(Q_0 - reach, 0.0)),
        Port("heater_power_max_kW", "highest setpoint of the heater power", Q_0 + reach),
        Port("pull_slew_mm_per_min2", "largest change of the pull speed in a minute; 1e30: no limit", pull_slew),
        Port("heater_slew_kW_per_min", "largest change of the heater power in a minute; 1e30: no limit", heater_slew),
        Port("takeover_s", "time from a takeover to the controller's full authority", 60.0),
        Port("fallback_after_s", "time without good readings after which the PID takes over", 240.0),
        Port("oldest_reading_s", "age from which a ring reading counts as stale", 3.0 * config.control_interval),
    )


def readings_of(given: Any, ranges: tuple[float, float]) -> tuple[Measured, Measured]:
    """Readings as deviations in SI units, and whether each lies within the range of the observations."""
    seen = {each: (given[port] - given[nominal]) * unit for each, (port, nominal, _, unit) in READINGS.items()}
    ring = (given["ring_radius_mm"] - given["ring_bias_mm"] - given["r_ref_mm"]) * MM
    read = Measured(ring_error=ring, valid=np.where(given["valid"] > 0.5, 1.0, 0.0), **seen)
    limits = 1.001 * CLIP * scales(MEASURED, *ranges)
    return read, Measured(*(np.abs(value) <= limit for value, limit in zip(read, limits, strict=True)))


def in_plant_units(seen: Measured, puller: Any) -> dict[str, Any]:
    """The readings of a sample as a plant has them, by the names of :data:`INPUTS`: the inverse of readings_of."""
    ring = (seen.ring_error + seen.r_ref + puller.r_0 + puller.ring_bias) / MM
    return {"ring_radius_mm": ring, "valid": seen.valid} | {
        port: (getattr(seen, each) + getattr(puller, at_rest)) / unit
        for each, (port, _, at_rest, unit) in READINGS.items()
    }


def in_shares(setpoints: Mapping[str, Any], config: Config) -> Floats:
    """Setpoints by their names in :data:`OUTPUTS` as shares of the drives' ranges above nominal, shape (..., 2)."""
    puller, (pull, heater, _) = nominal_puller(config), OUTPUTS
    shares = (
        setpoints[pull.name] * MM_PER_MIN / puller.v_0 - 1.0,
        (setpoints[heater.name] * KILO - puller.Q_H_0) / config.heater_range,
    )
    return np.stack(shares, axis=-1)


def step(controller: Controller, pid: Controller, dt: float, ranges: Any, given: Any, memory: Any) -> Any:
    """Outputs, memory and whether a sample was due, for settings and inputs by their names."""
    started = _finite(memory.last_time_s)
    elapsed = np.where(started, given["time_s"] - memory.last_time_s, dt)
    clock = _finite(given["time_s"]) & ((elapsed > 0.0) | ~started)
    due = _finite(given["time_s"]) & ((elapsed >= 0.9 * dt) | (elapsed < 0.0))
    late = elapsed > 1.1 * dt

    seen, plausible = readings_of(given, ranges)
    age = given["time_s"] - given["ring_time_s"]
    ring = plausible.ring_error & (seen.valid > 0.5) & (np.abs(age) <= given["oldest_reading_s"])
    first = Measured(*(np.where(good, value, 0.0) for good, value in zip(plausible, seen, strict=True)))
    last = Measured(*(np.where(started, old, new) for old, new in zip(memory.readings, first, strict=True)))
    trusted = Measured(*(np.where(good, value, np.inf) for good, value in zip(plausible, seen, strict=True)))
    read = readable(trusted._replace(valid=np.where(ring, 1.0, 0.0)), last)
    reference = reduce(and_, (getattr(plausible, name) for name in Measured._fields if "ref" in name))
    good = ring & reference & plausible.T_1 & plausible.v_p & plausible.Q_H
    bad = np.where(good & ~late, 0.0, memory.bad + np.clip(np.abs(elapsed), 0.0, HOUR))

    engaged = given["automatic"] > 0.5
    runs = engaged & (memory.engaged > 0.5)
    fallen = runs & (memory.fallback > 0.5)
    fallback = runs & (fallen | (bad > given["fallback_after_s"]))
    since = np.where(runs & (fallen | ~fallback), memory.since + np.clip(elapsed, 0.0, HOUR), 0.0)
    share = np.minimum(since / np.maximum(given["takeover_s"], 1e-3), 1.0)

    seen_by = read._replace(T_1=trusted.T_1) if controller.accepts_missing_temperature else read
    own = controller.step(
        seen_by, memory.controller if runs.all() else select(runs, memory.controller, controller.at_rest(read))
    )
    other = own[0], own[1], memory.pid
    if (fallback | ~(_finite(own[0]) & _finite(own[1]))).any():
        other = pid.step(read, select(fallen, memory.pid, pid.at_rest(read)))
    applied = (
        np.where(plausible.v_p, given["pull_speed_mm_per_min"], memory.pull),
        np.where(plausible.Q_H, given["heater_power_kW"], memory.heater),
    )
    before = tuple(np.where(runs, old, new) for old, new in zip((memory.pull, memory.heater), applied, strict=True))
    nominal = given["nominal_pull_speed_mm_per_min"], given["nominal_heater_power_kW"]
    wanted = [
        np.where(fallback, second, first) / unit + at
        for first, second, unit, at in zip(own[:2], other[:2], (MM_PER_MIN, KILO), nominal, strict=True)
    ]
    wanted[0] = np.where(fallback & ~ring, before[0], wanted[0])
    sound = _finite(wanted[0]) & _finite(wanted[1])
    slews = given["pull_slew_mm_per_min2"], given["heater_slew_kW_per_min"]
    ranges = (
        (given["pull_speed_min_mm_per_min"], given["pull_speed_max_mm_per_min"]),
        (given["heater_power_min_kW"], given["heater_power_max_kW"]),
    )
    setpoints: list[Any] = []
    limited: list[Any] = []
    for value, old, drive, slew, span in zip(wanted, before, applied, slews, ranges, strict=True):
        target = np.where(sound, value, old)
        target = np.where(share < 1.0, old + share * (target - old), target)
        most = slew * (dt / MINUTE)
        limit = np.clip(np.where(engaged, np.clip(target, old - most, old + most), drive), *span)
        limited.append(engaged & (np.abs(limit - target) > 1e-6))
        setpoints.append(np.where(due, limit, np.clip(memory.pull if not setpoints else memory.heater, *span)))

    bits = {
        Alarm.RING: ~ring, Alarm.PYROMETER: ~plausible.T_1, Alarm.DRIVES: ~(plausible.v_p & plausible.Q_H),
        Alarm.REFERENCE: ~reference, Alarm.LATE: late, Alarm.CLOCK: ~clock, Alarm.PULL_LIMITED: limited[0],
        Alarm.HEATER_LIMITED: limited[1], Alarm.TAKEOVER: engaged & (share < 1.0), Alarm.FALLBACK: fallback,
        Alarm.FAILED: engaged & ~sound, Alarm.MANUAL: ~engaged,
    }  # fmt: skip
    alarms = reduce(add, (np.where(holds, float(bit), 0.0) for bit, holds in bits.items()))
    outputs = dict(zip((port.name for port in OUTPUTS), (*setpoints, alarms), strict=True))
    now = Memory(
        last_time_s=given["time_s"],
        engaged=np.where(engaged, 1.0, 0.0),
        since=since,
        bad=bad,
        fallback=np.where(fallback | (engaged & ~sound), 1.0, 0.0),
        pull=setpoints[0],
        heater=setpoints[1],
        readings=read,
        controller=own[2],
        pid=other[2],
    )
    return outputs, now, due


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
        puller, zero = nominal_puller(self.config), Measured(*(np.zeros(n) for _ in Measured._fields))
        return Memory(
            last_time_s=np.full(n, math.inf),
            **{name: np.zeros(n) for name in ("engaged", "since", "bad", "fallback")},
            pull=np.full(n, puller.v_0 / MM_PER_MIN),
            heater=np.full(n, puller.Q_H_0 / KILO),
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
        with np.errstate(all="ignore"):
            outputs, after, due = self._step(given, memory)
        return outputs, after if due.all() else select(due, after, memory)

    def _step(self, given: Any, memory: Any) -> Any:
        return step(self.controller, self.pid, self.config.control_interval, self.config.ranges, given, memory)

    @cached_property
    def program(self) -> Program:
        """What it computes, recorded."""
        ports = settings_of(self.config), INPUTS, OUTPUTS
        return record(self._step, self.start(1), ports, self.name, self.notes)
