"""The parts of the shell: its ports and alarms, its memory, and the checks of a call, its readings and its drives.

:data:`INPUTS`, :func:`settings_of` and :data:`OUTPUTS` are what a plant sees. :func:`call_of` decides how many samples
a call takes, :func:`sample_of` which readings are good, :class:`Drive` where a setpoint may go. :mod:`.shell` puts them
together.
"""

import inspect
import math
import re
from collections.abc import Mapping
from enum import IntFlag
from functools import cache, reduce
from operator import and_
from typing import Any, NamedTuple

import numpy as np

from cz_gym.baselines.policy import DIFFERENCE_TIME, READING_OFFSET, READING_SCALE
from cz_gym.body.signals import Measured, moved_mean
from cz_gym.config import Config
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.process import scales
from cz_gym.spaces import CLIP, MEASURED, readable
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN

from .trace import FINITE, PASSES, Floats, Port

NO_LIMIT = 1e30
"""A slew rate that limits nothing."""


class Alarm(IntFlag):
    """The bits of ``alarms``."""

    RING = 1
    """The ring reading is invalid, too old, outside its range, or does not change; the last good one is held."""
    PYROMETER = 2
    """The pyrometer is outside its range, has jumped, or has not changed for 2 min; the last good reading is held."""
    DRIVES = 4
    """An applied drive is no number or outside its range; the last setpoint is held."""
    REFERENCE = 8
    """A reference or its preview is no number or outside its range; the last good one is held."""
    LATE = 16
    """The call came more than a tenth of the control interval late."""
    CLOCK = 32
    """The time stood still, ran back, or was no number."""
    PULL_LIMITED = 64
    """The pull speed's range or slew rate cuts its setpoint, on one side, for minutes."""
    HEATER_LIMITED = 128
    """The heater's range or slew rate cuts its setpoint, on one side, for minutes."""
    TAKEOVER = 256
    """The setpoints still move from the drives found at a takeover to the controller's."""
    FALLBACK = 512
    """The PID controls instead of the controller: until ``return_after_s`` of good readings if they were bad, else
    until reset or the next takeover."""
    FAILED = 1024
    """The controller's output was no number."""
    MANUAL = 2048
    """The controller does not act: ``automatic`` is not set, a setting is wrong, or a drive was never read. The
    setpoints follow the applied drives."""
    SETTINGS = 4096
    """A setting is no number, or a range or a slew rate is in the wrong order."""
    ASTRAY = 8192
    """A drive has not followed its setpoint for a minute; its setpoint stays near it."""
    MODEL = 16384
    """The controller's model does not explain the readings: the PID takes over."""
    READING_ERROR = 32768
    """The reading of a drive has differed from its setpoint for minutes, by no more than such readings may err; the
    setpoint counts as applied. Two outputs tell by how much."""
    RING_STEP = 65536
    """The ring has jumped by more than a crystal can; once it has stayed there, its old place is its new one."""
    RADIUS = 131072
    """The ring has been farther than ``radius_limit_mm`` from the reference for ``radius_limit_s``."""
    CAMERA_CLOCK = 262144
    """The ring changes, but for a minute its time has been in the future or older than ``oldest_reading_s``: the
    camera's clock is wrong, see ``camera_clock_s``, or its readings come late."""


def meanings(kind: Any) -> dict[Any, str]:
    """The members of an enumeration with the docstrings below them."""
    members = re.findall(r'^    (\w+) = \d+\n    """(.*?)"""', inspect.getsource(kind), re.MULTILINE | re.DOTALL)
    return {kind[name]: " ".join(text.split()) for name, text in members}


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
    **{f"T_1{end}": (f"T_1{end}_K", "nominal_T_1_K", "T_1_0", 1.0) for end in ("_ref", "_ref_1min", "_ref_5min", "")},
    "v_p": ("pull_speed_mm_per_min", "nominal_pull_speed_mm_per_min", "v_0", MM_PER_MIN),
    "Q_H": ("heater_power_kW", "nominal_heater_power_kW", "Q_H_0", KILO),
}
"""Readings but the ring: input, setting with its nominal value, that of a puller, and the input's unit."""
OUTPUTS = (
    Port("pull_speed_setpoint_mm_per_min", "setpoint of the pull speed"),
    Port("heater_power_setpoint_kW", "setpoint of the heater power"),
    Port("alarms", "sum of the alarm bits"),
    Port("pull_speed_reading_error_mm_per_min", "what the reading of the pull speed shows too much, as estimated"),
    Port("heater_power_reading_error_kW", "what the reading of the heater power shows too much, as estimated"),
)
"""The outputs of every block."""
SETPOINT_NAMES = dict(zip((port.name for port in OUTPUTS), ("pull_speed_mm_per_min", "heater_power_kW"), strict=False))
"""The setpoints, and the applied drives that follow them."""


def nominal_puller(config: Config) -> Puller:
    """The puller at its operating point that a block is made for."""
    return _puller(config.parameters, config.meniscus)


_puller = cache(lambda parameters, meniscus: make_puller(parameters, 0.5, meniscus))


def settings_of(config: Config, puller: Puller | None = None) -> tuple[Port, ...]:
    """The settings of a block for an environment's puller, or for one that was drawn there; the limits of the drives,
    of its file or of its scenario, are the defaults.
    """
    puller, drives = puller or nominal_puller(config), config.puller
    scenarios = config.scenario.scenarios
    window, pull_slew, heater_slew = (
        max(getattr(each.actuators, name) for each in scenarios)
        if getattr(drives, name) is None else getattr(drives, name)
        for name in ("pull_window", "pull_slew", "heater_slew")
    )  # fmt: skip
    v_0, Q_0 = puller.v_0 / MM_PER_MIN, puller.Q_H_0 / KILO
    window = min(puller.v_0, window) / MM_PER_MIN
    fastest = min(v_0 + window, math.inf if drives.pull_max is None else drives.pull_max / MM_PER_MIN)
    pull_slew = min(pull_slew / (MM_PER_MIN / MINUTE), NO_LIMIT)
    heater_slew = min(heater_slew / (KILO / MINUTE), NO_LIMIT)
    reach, interval = config.heater_range / KILO, config.control_interval
    latency = max(each.sensor.latency for each in scenarios)
    noise = max(6.0 * each.sensor.camera_noise[1] + 2.0 * each.sensor.ripple[1] for each in scenarios)
    step = max(config.puller.scale, noise / MM)
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
        Port("takeover_s", "time from a takeover to the controller's full authority", 120.0),
        Port("fallback_after_s", "time without good readings after which the PID takes over", 240.0),
        Port("oldest_reading_s", "age from which a ring reading counts as stale", latency + 3.0 * interval),
        Port(
            "camera_clock_s", "time by which the camera's clock is ahead of the block's, as ring_time_s shows it", 0.0
        ),
        Port("gap_s", "time without a call after which the next one is a takeover", max(10.0 * interval, 30.0)),
        Port("return_after_s", "time of good readings near nominal after which a PID gives way; 0: never", 1200.0),
        Port("ring_step_mm", "change of the ring that no crystal makes in a sample", step),
        Port("ring_still_s", "time after which a ring that does not change counts as stuck", 60.0),
        Port("radius_limit_mm", "distance of the ring from its reference that raises a bit", config.puller.scale),
        Port("radius_limit_s", "time after which it does", 600.0),
    )


def readings_of(given: Any, ranges: tuple[float, float]) -> tuple[Measured, Measured]:
    """Readings as deviations in SI units, and whether each lies within the range of the observations.

    The mean pull speed, which is no reading, is the pull speed.
    """
    seen = {each: (given[port] - given[nominal]) * unit for each, (port, nominal, _, unit) in READINGS.items()}
    ring = (given["ring_radius_mm"] - given["ring_bias_mm"] - given["r_ref_mm"]) * MM
    read = Measured(ring_error=ring, valid=np.where(given["valid"] > 0.5, 1.0, 0.0), v_p_mean=seen["v_p"], **seen)
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
    puller, (pull, heater) = nominal_puller(config), OUTPUTS[:2]
    power = setpoints[heater.name] * KILO - puller.Q_H_0
    return np.stack([setpoints[pull.name] * MM_PER_MIN / puller.v_0 - 1.0, power / config.heater_range], axis=-1)


PYROMETER_JUMP, JUMP_GROWTH = 8.0, 0.02 / MINUTE
"""Largest difference of the pyrometer from what is expected [K], and its growth without a good reading [K/s]."""
FROZEN_TIME, FROZEN_CHANGE = 2.0 * MINUTE, 1e-4
"""Time after which a pyrometer that changes by less than FROZEN_CHANGE [K] counts as stuck [s]."""
FOLLOWING_ERROR = 0.05
"""Distance from its setpoint from which a drive does not follow, in shares of its range [-]."""
TOLD_ERROR = 0.25
"""Error of a drive's reading that raises a bit, in shares of the largest one that counts as such [-]."""
STILL_DRIVE = 0.001
"""Change of a drive's difference that counts as none, in shares of its range [-]."""
STILL_RING = 1e-6 * MM
"""Change of a ring that counts as none [m]."""
RING_TIME, RING_GROWTH = 30.0, 1.0 * MM / MINUTE
"""Averaging time of the ring, after which a step of it counts as its new place [s]; the growth of the largest step
without a ring [m/s]."""
_INPUTS = {port.name for port in INPUTS}


class PullerConstants(NamedTuple):
    """Constants of the puller compiled into the block."""

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
    """The memory of the shell, of its controller and of its PID: numbers of shape (n,) each."""

    clock_s: Any
    """Time up to which samples were taken [s]; infinite before the first."""
    called_s: Any
    """Time of the last call that took a sample [s]."""
    late: Any
    """1 if that call was late."""
    samples: Any
    """Number of samples of that call."""
    engaged: Any
    """1 if the last sample was automatic."""
    since_takeover: Any
    """Time since the takeover [s]."""
    bad_readings_time: Any
    """Time without a good set of readings [s]."""
    fallback: Any
    """1 if the PID controls."""
    pull: Any
    """Last setpoint of the pull speed [mm/min]; infinite before the first."""
    heater: Any
    """Last setpoint of the heater power [kW]; infinite before the first."""
    drive_error_time: Any
    """Time for which a drive has not followed [s]."""
    last_T_1: Any
    """Last reading of the pyrometer, good or not, above nominal [K]."""
    frozen_time: Any
    """Time for which the pyrometer's reading has not changed [s]."""
    no_pyrometer_time: Any
    """Time without a good reading of the pyrometer [s]."""
    pull_bias: Any
    """Mean pull speed above nominal, relative [-]."""
    settled_time: Any
    """Time since the takeover and since the pyrometer was last bad [s]."""
    T_1_offset: Any
    """Error of the nominal temperature, as the takeover found it [K]."""
    Q_H_offset: Any
    """Error of the nominal power, as the takeover found it [W]."""
    T_1_level: Any
    """Mean heater temperature above its recipe while the controller held the crystal by good readings [K]."""
    unsure: Any
    """1 from a takeover until its setpoints are known to be right."""
    sent_pull: Any
    """Setpoint of the pull speed until this call [mm/min]."""
    sent_heater: Any
    """Setpoint of the heater power until this call [kW]."""
    pull_difference: Any
    """Reading of the pull speed minus its setpoint, averaged [mm/min]."""
    heater_difference: Any
    """Reading of the heater power minus its setpoint, averaged [kW]."""
    reading_error_time: Any
    """Time for which a reading of a drive has erred [s]."""
    pull_limited: Any
    """Mean side on which the setpoint of the pull speed is cut, -1 to 1 [-]."""
    heater_limited: Any
    """Mean side on which the setpoint of the heater power is cut, -1 to 1 [-]."""
    good_time: Any
    """Time of good readings while the PID controls [s]."""
    stays: Any
    """1 if the PID controls for another reason than bad readings."""
    last_ring: Any
    """Last ring, good or not, above nominal [m]."""
    ring_still_time: Any
    """Time for which the ring has not changed [s]."""
    no_ring_time: Any
    """Time without a good ring, but for its steps [s]."""
    ring_level: Any
    """Averaged ring above nominal [m]; infinite before the first."""
    ring_offset: Any
    """Sum of the ring's steps since the takeover [m]."""
    ring_step: Any
    """Mean of a step that has not yet stayed [m]."""
    ring_step_time: Any
    """Time for which the step has stayed [s]."""
    misdated_time: Any
    """Time for which a ring that changes has had a time that cannot be [s]."""
    radius_time: Any
    """Time for which the radius has been beyond its limit [s]."""
    readings: Measured
    """Last good readings, as deviations in SI units."""
    controller: Any
    """The controller's own memory."""
    pid: Any
    """The fallback's own memory."""


class Call(NamedTuple):
    """The samples that a call takes, from its time; shape (n,) each."""

    due: Any
    """True if a sample is taken in this pass."""
    again: Any
    """True if another sample follows in this call."""
    later: Any
    """True if a sample went before in this call."""
    share: Any
    """1 over the number of samples that are left with this one."""
    samples: Any
    """Number of samples of the call."""
    starts: Any
    """True if this is the first call, or the first after a gap."""
    late: Any
    """True if the call came late."""
    sound: Any
    """True if the time moves forward."""
    clock: Any
    """Time up to which samples will have been taken [s]."""


def call_of(dt: float, given: Any, memory: Memory) -> Call:
    """The samples of a call at a control interval ``dt`` [s]: at most :data:`.trace.PASSES`; one after a gap."""
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


class Ring(NamedTuple):
    """The checked ring of a sample; shape (n,) each."""

    good: Any
    """True if the ring is good."""
    error: Any
    """Distance of the ring from the reference, without the ring's steps [m]."""
    stepped: Any
    """True if the ring has jumped by more than a crystal can."""
    last: Any
    """:attr:`Memory.last_ring` [m]."""
    still_time: Any
    gone_time: Any
    level: Any
    offset: Any
    step: Any
    step_time: Any
    misdated_time: Any


def ring_of(
    constants: PullerConstants, call: Call, manual: Any, given: Any, memory: Memory, seen: Measured, plausible: Any
) -> Ring:
    """Check the ring of a sample: valid, new, in its range, alive, and where a crystal can be.

    A ring that jumps by more than ``ring_step_mm`` is held. Once it has stayed for :data:`RING_TIME`, the step counts
    as one of the camera, and is taken off. In ``manual`` no jump is questioned.
    """
    dt, pace, anew = constants.dt, -math.expm1(-constants.dt / RING_TIME), manual | call.starts
    age, place = given["time_s"] + given["camera_clock_s"] - given["ring_time_s"], seen.ring_error + seen.r_ref
    same = ~call.starts & (np.abs(place - memory.last_ring) <= STILL_RING)
    still_time = np.where(same, memory.ring_still_time + np.where(call.later, 0.0, dt), 0.0)
    alive = still_time <= given["ring_still_s"]
    looks, timely = plausible & (seen.valid > 0.5) & alive, np.abs(age) <= given["oldest_reading_s"]
    read, misdated = looks & timely, looks & ~(timely & (age >= -0.5 * dt))
    longer = memory.misdated_time + np.where(call.later, 0.0, dt)
    misdated_time = np.where(same, memory.misdated_time, np.where(misdated, longer, 0.0))
    offset = np.where(anew, 0.0, memory.ring_offset)
    known, gap = ~anew & finite(memory.ring_level), place - offset - memory.ring_level
    largest = given["ring_step_mm"] * MM + RING_GROWTH * memory.no_ring_time
    jumped = read & known & (np.abs(gap) > largest)
    step_time = np.where(read, np.where(jumped, memory.ring_step_time + dt, 0.0), memory.ring_step_time)
    step = memory.ring_step + np.where(jumped, dt / np.maximum(step_time, dt) * (gap - memory.ring_step), 0.0)
    stays = jumped & (step_time > RING_TIME)
    offset = offset + np.where(stays, step, 0.0)
    good, place_now = read & (~jumped | stays), np.where(read, place - offset, 0.0)
    averaged = known & (memory.no_ring_time < MINUTE)
    old = np.where(averaged, memory.ring_level, place_now)
    level = np.where(good, old + pace * (place_now - old), np.where(anew, np.inf, memory.ring_level))
    stepped = (jumped & ~stays & (2.0 * step_time > RING_TIME)) | (np.abs(offset) > 0.25 * MM * given["ring_step_mm"])
    return Ring(
        good, seen.ring_error - offset, stepped, np.where(finite(place), place, np.inf), still_time,
        np.where(read | anew, 0.0, memory.no_ring_time + dt), level, offset, step, np.where(stays, 0.0, step_time),
        misdated_time,
    )  # fmt: skip


class Readings(NamedTuple):
    """The checked readings of a sample; shape (n,) each."""

    read: Measured
    """Deviations from the nominal settings. The last good reading stands for each bad one; ring and drives are on their
    way from the call before."""
    T_1: Any
    """The pyrometer's reading above nominal; infinite if it is bad [K]."""
    ring: Ring
    pyrometer: Any
    """True if the pyrometer is good."""
    reference: Any
    """True if references and previews are good."""
    last_T_1: Any
    """:attr:`Memory.last_T_1`."""
    frozen_time: Any
    """:attr:`Memory.frozen_time` [s]."""


def sample_of(
    constants: PullerConstants, call: Call, manual: Any, given: Any, memory: Memory, seen: Measured, plausible: Measured
) -> Readings:
    """Check and complete the readings of a sample, each ``plausible`` or not; in ``manual`` no jump of ring or
    pyrometer is questioned.
    """
    ring = ring_of(constants, call, manual, given, memory, seen, plausible.ring_error)
    seen = seen._replace(ring_error=ring.error)
    reference = reduce(and_, (getattr(plausible, name) for name in Measured._fields if "ref" in name))
    first = Measured(*(np.where(good, value, 0.0) for good, value in zip(plausible, seen, strict=True)))
    last = Measured(*(np.where(call.starts, new, old) for old, new in zip(memory.readings, first, strict=True)))
    same = ~call.starts & (np.abs(seen.T_1 - memory.last_T_1) <= FROZEN_CHANGE)
    frozen_time = np.where(same, memory.frozen_time + np.where(call.later, 0.0, constants.dt), 0.0)
    expected = last.T_1 + np.where(reference, seen.T_1_ref - last.T_1_ref, 0.0)
    near = np.abs(seen.T_1 - expected) <= constants.jump + JUMP_GROWTH * memory.no_pyrometer_time
    pyrometer = plausible.T_1 & (frozen_time <= FROZEN_TIME) & (near | manual | call.starts)
    good = plausible._replace(T_1=pyrometer)
    trusted = Measured(*(np.where(each, value, np.inf) for each, value in zip(good, seen, strict=True)))
    read = readable(trusted._replace(valid=np.where(ring.good, 1.0, 0.0)), last)
    read = read._replace(T_1=np.where(pyrometer, seen.T_1, np.where(call.starts, 0.0, expected)))
    moving = {name: (getattr(last, name), getattr(read, name)) for name in ("ring_error", "v_p", "Q_H")}
    share = np.where(manual, 1.0, call.share)
    read = read._replace(**{name: old + share * (new - old) for name, (old, new) in moving.items()})
    mean = np.where(call.starts, read.v_p, moved_mean(last.v_p_mean, read.v_p, constants.dt))
    read = read._replace(v_p_mean=mean)
    last_T_1 = np.where(finite(seen.T_1), seen.T_1, np.inf)
    return Readings(read, trusted.T_1, ring, pyrometer, reference, last_T_1, frozen_time)


def settings_are_sane(given: Any) -> Any:
    """True if the settings are numbers in the right order."""
    ordered = given["pull_speed_min_mm_per_min"] <= given["pull_speed_max_mm_per_min"]
    ordered = ordered & (given["heater_power_min_kW"] <= given["heater_power_max_kW"])
    positive = ("pull_slew_mm_per_min2", "heater_slew_kW_per_min", "nominal_pull_speed_mm_per_min", "gap_s",
        "ring_step_mm", "ring_still_s", "radius_limit_mm")  # fmt: skip
    numbers = (finite(given[name]) for name in given if name not in _INPUTS)
    return reduce(and_, (given[port] > 0.0 for port in positive), reduce(and_, numbers, ordered))


class Drive(NamedTuple):
    """One drive at a sample, in the unit of its port."""

    known: Any
    """True if the reading of the drive is good."""
    applied: Any
    """The reading; without a good one the last setpoint."""
    held: Any
    """The last setpoint; before the first one the nominal value."""
    nominal: Any
    """The drive at the operating point, as set."""
    far: Any
    """Distance from its setpoint from which the drive does not follow."""
    slew: Any
    """Largest change in a minute."""
    span: tuple[Any, Any]
    """Range of its setpoint."""
    sent: Any
    """Setpoint of the drive until this call."""
    difference: Any
    """Reading minus the setpoint until this call, averaged."""
    error: Any
    """Part of the difference that counts as an error of the reading."""
    errs: Any
    """True if the error is large enough to raise a bit."""
    still: Any
    """True if the difference stands still: the drive has arrived."""

    @property
    def away(self) -> Any:
        """True if the drive is far from its last setpoint."""
        return self.known & (np.abs(self.applied - self.error - self.sent) > self.far)

    def told(self, follows: Any, corrects: Any) -> Any:
        """The drive as the controller is told: its setpoint while it ``follows``, so that no move adds the reading's
        error; the reading else. Where a takeover ``corrects`` its setpoint, the error is taken off that.
        """
        return np.where(follows, self.sent - np.where(corrects, self.error, 0.0), self.applied - self.error)

    def near(self, setpoint: Any, lost: Any) -> Any:
        """Keep the setpoint of a drive that does not follow so near that one sees when the drive follows again."""
        at, most = self.applied - self.error, 2.0 * self.far
        return np.where(lost, np.clip(setpoint, at - most, at + most), setpoint)

    def move(self, old: Any, wanted: Any, authority: Any, dt: float) -> tuple[Any, Any]:
        """The setpoint after one interval on its way from ``old`` to a value, and the side on which range or slew rate
        cut it: 1 from above, -1 from below, else 0.
        """
        ends = wanted, np.clip(wanted, *self.span)
        free, bound = (np.where(authority < 1.0, old + authority * (to - old), to) for to in ends)
        most = self.slew * (dt / MINUTE)
        limit = np.clip(bound, old - most, old + most)
        return limit, np.where(free - limit > 1e-6, 1.0, np.where(limit - free > 1e-6, -1.0, 0.0))


_PORTS = (
    ("pull_speed_mm_per_min", "pull_speed_{}_mm_per_min", "nominal_pull_speed_mm_per_min", "pull_slew_mm_per_min2"),
    ("heater_power_kW", "heater_power_{}_kW", "nominal_heater_power_kW", "heater_slew_kW_per_min"),
)
"""Names of each drive's reading, of the ends of its range, its nominal value and its slew rate."""


def drive_of(
    sane: Any, constants: PullerConstants, call: Call, before: Any, plausible: Measured, given: Any, memory: Memory,
    which: int,
) -> Drive:  # fmt: skip
    """The pull (``which`` = 0) or the heater (1) at a sample; ``before``: whether the block has set its setpoint."""
    reading, end, at_rest, slew = _PORTS[which]
    known = np.where(sane, (plausible.v_p, plausible.Q_H)[which], finite(given[reading]))
    nominal, last = given[at_rest], (memory.pull, memory.heater)[which]
    held = np.where(finite(last), last, np.where(finite(nominal), nominal, constants.nominal[which]))
    span = given[end.format("min")], given[end.format("max")]
    sent = np.where(call.later, (memory.sent_pull, memory.sent_heater)[which], held)
    applied, full = np.where(known, given[reading], sent), 2.0 * constants.ranges[which] / (MM_PER_MIN, KILO)[which]
    averaged = (memory.pull_difference, memory.heater_difference)[which]
    pace = np.where(memory.unsure > 0.5, 0.5, -math.expm1(-constants.dt / DIFFERENCE_TIME))
    difference = averaged + pace * (np.where(known, applied - sent, averaged) - averaged)
    difference = np.where(before, difference, 0.0)
    largest = READING_SCALE * np.abs(applied) + READING_OFFSET * full
    error = np.clip(difference, -largest, largest)
    errs = np.abs(error) > TOLD_ERROR * largest
    far = FOLLOWING_ERROR * full
    still = before & (np.abs(applied - sent - averaged) <= STILL_DRIVE * full)
    return Drive(known, applied, held, nominal, far, given[slew], span, sent, difference, error, errs, still)


def finite(value: Any) -> Any:
    """True if a number is neither NaN nor infinite, which recorded programs have as large ones."""
    return np.abs(value) <= FINITE
