"""The shell around a controller: takeover, limits, hold, fallback, alarms.

The controller runs on a grid of its own interval. A call makes as many samples as intervals have passed, up to
:data:`PASSES` of them; after a gap it is a takeover. Readings that are not finite, invalid, too old, outside the range
of the observations, or of a pyrometer that jumps or stands still are replaced by the last good ones. If that lasts, if
the controller's output is not finite, or if its model does not explain the readings, the fallback PID takes over until
the next takeover; without a ring the pull speed is nominal, without a pyrometer the heater follows the recipe and the
pull speed alone. After every takeover the setpoints start at the applied drives and move to the controller's within
``takeover_s``. All of it is NumPy code on arrays of shape (n,): :meth:`Block.run` runs it on n plants at once, and
:attr:`Block.program` is its record, from which other languages are written.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from cz_gym.body.process import INPUTS as COLUMNS
from cz_gym.body.process import STATES, linearise
from cz_gym.body.signals import Measured
from cz_gym.config import Config
from cz_gym.spaces import TargetEnv, decode, tag
from cz_gym.support.errors import select
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN

from .block import (
    INPUTS,
    OUTPUTS,
    PYROMETER_JUMP,
    READINGS,
    Alarm,
    Memory,
    PullerConstants,
    call_of,
    drive_of,
    finite,
    in_plant_units,
    in_shares,
    nominal_puller,
    readings_of,
    sample_of,
    settings_are_sane,
    settings_of,
)
from .trace import PASSES, Floats, Port, Program, record

NO_PYROMETER_TIME = MINUTE
"""Time for which a controller that estimates the temperature keeps the heater without a pyrometer [s]."""
NO_RING_TIME = 15.0
"""Time without a ring after which a controller that does not observe gives the pull speed to its nominal value [s]."""
DRIVE_ERROR_TIME, MISDATED_TIME = MINUTE, MINUTE
"""Time after which a drive counts as not following, and the camera's clock as wrong [s]."""
PULL_BIAS_TIME, TRIM_T_1, TRIM_Q_H = 5.0 * MINUTE, 0.5, 0.005
"""Averaging time of the pull speed [s]; what a takeover leaves of the deviation from the nominal temperature [K] and
power [share of the heater's range]. The rest counts as an error of the nominal values."""
READING_ERROR_TIME, LIMITED = 5.0 * MINUTE, 0.5
"""Time after which an error of a drive's reading counts [s]; mean side of the cuts, averaged over PULL_BIAS_TIME, from
which limiting does [-]. What noise cuts on both sides is no limiting."""
ARRIVAL_TIME, LEVEL_TIME = 4.0 * MINUTE, 10.0 * MINUTE
"""Longest wait of a takeover for a slow heater [s]; averaging time of the heater temperature above its recipe [s]."""
FAR_PULL = 0.05
"""Relative deviation of the pull speed from nominal with which a takeover begins with the PID [-]."""
SETTLED_TIME = 30.0 * MINUTE
"""Time since a takeover or a bad pyrometer, from which it counts that a model does not explain the readings [s]."""
SLOWER, FOLLOWED = 1.5, 0.5
"""Heater without a pyrometer: time constant of the mean pull speed, in multiples of its averaging time, and share of
the recipe's movement that is followed [-]."""
TEMPERATURES = "T_1", "T_2", "T_b"
UNKNOWN = "clock_s", "called_s", "pull", "heater", "sent_pull", "sent_heater", "last_T_1", "last_ring", "ring_level"
"""Fields of :class:`.block.Memory` that are infinite before the first sample."""


class Controller(Protocol):
    """A controller that can stand in the shell, such as :class:`cz_gym.baselines.policy.MeasuredController`.

    One with a method ``model_mismatch(memory)`` also says where its model does not explain the readings.
    """

    @property
    def accepts_missing_temperature(self) -> bool:
        """True if the controller estimates the temperature, and so gets an infinite reading of a bad pyrometer."""

    @property
    def observes(self) -> bool:
        """True if the controller's memory follows the crystal also while another controller or a hold sets the drives,
        as that of a filter or of a trained agent does. Else it begins anew when the fallback gives way."""

    def at_rest(self, seen: Measured) -> Any:
        """The controller's memory before the first sample."""

    def step(self, seen: Measured, memory: Any) -> tuple[Any, Any, Any]:
        """Pull speed [m/s] and heater power [W] above nominal, and the new memory."""


class Takeover(NamedTuple):
    """How far a takeover is at a sample, arrays of bool."""

    fallen: Any
    """The fallback controlled at the last sample."""
    unsure: Any
    """The controller has not begun: the setpoints may have been read wrong."""
    brings_back: Any
    """The PID brings back what an operator left far from nominal."""
    settles: Any
    """The controller, or that PID, is sure from this sample on."""
    corrects: Any
    """Setpoints that the takeover read wrong are set right at this sample."""


class Duty(NamedTuple):
    """Who sets the drives at a sample, arrays of bool, and what that follows from, times [s]."""

    fallback: Any
    begins_far: Any
    returns: Any
    """The controller takes over again from the fallback."""
    mismatch: Any
    confused: Any
    """The controller's model does not explain the readings, so its memory begins anew."""
    beyond: Any
    """The radius is beyond its limit."""
    authority: Any
    """Share of the way from the applied drives to the controller's setpoints [-]."""
    since_takeover: Any
    bad_readings_time: Any
    no_pyrometer_time: Any
    settled_time: Any
    good_time: Any


class Control(NamedTuple):
    """Setpoints that are wanted of the drives [mm/min, kW], and the readings and memories behind them."""

    read: Measured
    nominal: tuple[Any, Any]
    T_1_offset: Any
    Q_H_offset: Any
    own: Any
    """Memory of the controller."""
    pid: Any
    """Memory of the fallback."""
    pull: Any
    heater: Any


def step(controller: Controller, pid: Controller, constants: PullerConstants, given: Any, memory: Any) -> Any:
    """Take one sample: outputs, memory, whether a sample was due and whether another one is.

    ``given`` holds settings and inputs by name. The order is: time and readings, drives, who controls, the controller
    and the PID on the same readings, limits, alarms.
    """
    dt, sane, call = constants.dt, settings_are_sane(given), call_of(constants.dt, given, memory)
    automatic, before = (given["automatic"] > 0.5) & sane, (memory.engaged > 0.5) & ~call.starts
    raw, plausible = readings_of(given, constants.ranges)
    drives = [drive_of(sane, constants, call, before, plausible, given, memory, which) for which in (0, 1)]
    known = drives[0].known & drives[1].known
    engaged = automatic & (before | known)
    runs = engaged & before
    away = runs & (drives[0].away | drives[1].away)
    held_error = np.where(away, memory.drive_error_time + dt, 0.0)
    drive_error_time = np.where(call.later, memory.drive_error_time, held_error)
    lost = drive_error_time > DRIVE_ERROR_TIME
    follows = runs & ~lost
    takeover = _takeover(dt, drives, given, memory, runs)
    told_drives = {
        name: np.where(runs, (each.told(follows, takeover.corrects) - given[nominal]) * unit, getattr(raw, name))
        for each, (name, (_, nominal, _, unit)) in zip(drives, list(READINGS.items())[-2:], strict=True)
    }
    trusted = plausible._replace(v_p=plausible.v_p | follows, Q_H=plausible.Q_H | follows)
    seen = sample_of(constants, call, ~(automatic & before), given, memory, raw._replace(**told_drives), trusted)
    good = seen.ring.good & seen.reference & known
    duty = _duty(controller, dt, call, given, memory, engaged, runs, good, raw, seen, takeover)
    control = _control(controller, pid, constants, call, memory, drives, runs, seen, takeover, duty)

    old = [np.where(runs, each.near(each.held, lost), each.applied) for each in drives]
    bias = np.where(call.starts, 0.0, memory.pull_bias)
    bias = bias + min(dt / PULL_BIAS_TIME, 1.0) * (seen.read.v_p / (drives[0].nominal * MM_PER_MIN) - bias)
    wanted = _without_readings(controller, constants, call, memory, seen, duty, control, old[1], bias)
    sound = finite(wanted[0]) & finite(wanted[1])
    moves = [
        each.move(start, np.where(sound, target, start), duty.authority, dt)
        for each, start, target in zip(drives, old, wanted, strict=True)
    ]
    sides = [
        np.where(runs, mean + min(dt / PULL_BIAS_TIME, 1.0) * (side - mean), 0.0)
        for mean, (_, side) in zip((memory.pull_limited, memory.heater_limited), moves, strict=True)
    ]
    erring = runs & (drives[0].errs | drives[1].errs)
    reading_error_time = np.where(erring, memory.reading_error_time + dt, 0.0)
    radius_time = np.where(duty.beyond, memory.radius_time + dt, 0.0)
    setpoints = [
        np.where(call.due, np.where(engaged, each.near(value, lost), each.applied), each.held)
        for each, (value, _) in zip(drives, moves, strict=True)
    ]
    bits = {
        Alarm.RING: ~seen.ring.good, Alarm.PYROMETER: ~seen.pyrometer, Alarm.DRIVES: ~known,
        Alarm.REFERENCE: ~seen.reference, Alarm.LATE: call.late, Alarm.CLOCK: ~call.sound,
        Alarm.PULL_LIMITED: np.abs(sides[0]) > LIMITED, Alarm.HEATER_LIMITED: np.abs(sides[1]) > LIMITED,
        Alarm.TAKEOVER: engaged & ((duty.authority < 1.0) | (duty.since_takeover < given["takeover_s"])),
        Alarm.FALLBACK: duty.fallback, Alarm.FAILED: engaged & ~sound,
        Alarm.MANUAL: ~engaged, Alarm.SETTINGS: ~sane, Alarm.ASTRAY: lost, Alarm.MODEL: duty.mismatch,
        Alarm.READING_ERROR: reading_error_time > READING_ERROR_TIME, Alarm.RING_STEP: seen.ring.stepped,
        Alarm.RADIUS: radius_time > given["radius_limit_s"],
        Alarm.CAMERA_CLOCK: seen.ring.misdated_time > MISDATED_TIME,
    }  # fmt: skip
    alarms = reduce(add, (np.where(holds, float(bit), 0.0) for bit, holds in bits.items()))
    errors = (np.where(runs, each.error, 0.0) for each in drives)
    outputs = dict(zip((port.name for port in OUTPUTS), (*setpoints, alarms, *errors), strict=True))
    failed = engaged & ~sound
    stays = np.where(duty.fallback & ((memory.stays > 0.5) | duty.mismatch) | failed, 1.0, 0.0)
    pace = np.where(good & seen.pyrometer & ~duty.fallback, min(dt / LEVEL_TIME, 1.0), 0.0)
    level = memory.T_1_level + pace * (control.read.T_1 - control.read.T_1_ref - memory.T_1_level)
    level = np.where(runs & (stays < 0.5), level, 0.0)
    now = Memory(
        clock_s=call.clock, called_s=given["time_s"], late=np.where(call.late, 1.0, 0.0), samples=call.samples,
        engaged=np.where(engaged, 1.0, 0.0), since_takeover=duty.since_takeover,
        bad_readings_time=duty.bad_readings_time,
        fallback=np.where(duty.fallback | duty.begins_far | failed, 1.0, 0.0), pull=setpoints[0],
        heater=setpoints[1], drive_error_time=drive_error_time, last_T_1=seen.last_T_1,
        frozen_time=seen.frozen_time, no_pyrometer_time=duty.no_pyrometer_time, pull_bias=bias,
        settled_time=duty.settled_time, T_1_offset=control.T_1_offset, Q_H_offset=control.Q_H_offset, T_1_level=level,
        unsure=np.where(takeover.unsure & ~takeover.settles, 1.0, 0.0),
        sent_pull=drives[0].sent, sent_heater=drives[1].sent,
        pull_difference=drives[0].difference, heater_difference=drives[1].difference,
        reading_error_time=reading_error_time, pull_limited=sides[0], heater_limited=sides[1],
        good_time=duty.good_time, stays=stays, last_ring=seen.ring.last, ring_still_time=seen.ring.still_time,
        no_ring_time=seen.ring.gone_time, ring_level=seen.ring.level, ring_offset=seen.ring.offset,
        ring_step=seen.ring.step, ring_step_time=seen.ring.step_time, misdated_time=seen.ring.misdated_time,
        radius_time=radius_time,
        readings=seen.read, controller=control.own, pid=control.pid,
    )  # fmt: skip
    return outputs, now, call.due, call.again


def _takeover(dt: float, drives: Any, given: Any, memory: Any, runs: Any) -> Takeover:
    """Setpoints that a takeover read wrong are set right once, when that has shown; then the controller begins. The PID
    that brings back what an operator left far from nominal acts at once, where the slew rate makes that gradual.
    """
    fallen, takeover, unsure = runs & (memory.fallback > 0.5), given["takeover_s"], ~runs | (memory.unsure > 0.5)
    gradual = drives[0].slew * (dt / MINUTE) <= FAR_PULL * drives[0].nominal
    brings_back = fallen & unsure & (takeover > 0.0) & gradual
    waited = memory.since_takeover + dt - np.where(brings_back, 1.0, 0.5) * takeover
    arrived = drives[1].still | brings_back | (waited >= ARRIVAL_TIME)
    settles = runs & unsure & (takeover > 0.0) & (waited >= 0.0) & arrived
    return Takeover(fallen, unsure, brings_back, settles, settles & ~brings_back)


def _duty(
    controller: Any, dt: float, call: Any, given: Any, memory: Any, engaged: Any, runs: Any, good: Any, raw: Any,
    seen: Any, takeover: Takeover,
) -> Duty:  # fmt: skip
    """Who sets the drives, from readings that are ``good``, from the radius and from the pull speed."""
    fallen, wait = takeover.fallen, given["return_after_s"]
    bad_readings_time = np.where(good, 0.0, np.where(call.starts, 0.0, memory.bad_readings_time) + dt)
    no_pyrometer_time = np.where(seen.pyrometer, 0.0, np.where(call.starts, 0.0, memory.no_pyrometer_time) + dt)
    settled_time = np.where(runs & seen.pyrometer & (memory.fallback < 0.5), memory.settled_time + dt, 0.0)
    check = getattr(controller, "model_mismatch", None)
    unexplained = check(memory.controller) if check else False
    mismatch = (settled_time > SETTLED_TIME) & unexplained
    # A model that lost the crystal without readings begins anew, and is watched for all of the wait.
    confused = fallen & (memory.stays < 0.5) & unexplained
    distance = np.abs(seen.ring.level - seen.read.r_ref)
    beyond = engaged & finite(seen.ring.level) & (distance > given["radius_limit_mm"] * MM)
    calm = (2.0 * distance < given["radius_limit_mm"] * MM) & (np.abs(memory.pull_bias) < FAR_PULL)
    good_time = np.where(fallen & good & seen.pyrometer & calm & ~confused, memory.good_time + dt, 0.0)
    far = beyond | (np.abs(raw.v_p) > FAR_PULL * given["nominal_pull_speed_mm_per_min"] * MM_PER_MIN)
    begins_far = engaged & ~runs & far & (wait > 0.0)
    returns = fallen & (memory.stays < 0.5) & (wait > 0.0) & (good_time >= wait)
    fallback = runs & ~returns & (fallen | (bad_readings_time > given["fallback_after_s"]) | mismatch)
    length, begins = given["takeover_s"], fallback & ~fallen | returns | takeover.corrects
    since_takeover = np.where(begins, 0.5 * length, memory.since_takeover + dt)
    since_takeover = np.where(runs, since_takeover, 0.0)
    authority = np.clip(2.0 * since_takeover / np.maximum(length, 1e-3) - 1.0, 0.0, 1.0)
    authority = np.where(takeover.brings_back, 1.0, np.where(takeover.unsure & (length > 0.0), 0.0, authority))
    return Duty(
        *(fallback, begins_far, returns, mismatch, confused, beyond, authority, since_takeover),
        *(bad_readings_time, no_pyrometer_time, settled_time, good_time),
    )


def _control(
    controller: Any, pid: Any, constants: PullerConstants, call: Any, memory: Any, drives: Any, runs: Any, seen: Any,
    takeover: Takeover, duty: Duty,
) -> Control:  # fmt: skip
    """The controller and the fallback on the same readings. Errors of the nominal values, as the takeover finds them,
    are taken off all later readings.
    """
    fallen, brings_back, corrects = takeover.fallen, takeover.brings_back, takeover.corrects
    at_takeover = np.where(seen.pyrometer, _excess(seen.read.T_1, TRIM_T_1), 0.0)
    T_1_offset = np.where(runs, memory.T_1_offset, at_takeover)
    Q_H_offset = np.where(runs & ~corrects, memory.Q_H_offset, _excess(seen.read.Q_H, TRIM_Q_H * constants.ranges[1]))
    temperatures = {n: getattr(seen.read, n) - T_1_offset for n in Measured._fields if n.startswith("T_1")}
    read = seen.read._replace(**temperatures, Q_H=seen.read.Q_H - Q_H_offset)
    nominal = drives[0].nominal, drives[1].nominal + Q_H_offset / KILO
    # The samples of a call have one frame in common, whose noise counts once.
    told = read._replace(T_1=np.where(call.again, np.inf, seen.T_1 - T_1_offset), valid=read.valid / call.samples)
    goes_on = runs & ~corrects & ~duty.confused & (True if controller.observes else ~duty.returns)
    held = memory.controller if goes_on.all() else select(goes_on, memory.controller, controller.at_rest(read))
    own = controller.step(told if controller.accepts_missing_temperature else read, held)
    other = own[0], own[1], memory.pid
    if (duty.fallback | ~(finite(own[0]) & finite(own[1]))).any():
        # Its heater makes the mean pull nominal: the operator's, as its integral, would stand in the radius for hours.
        begun = pid.at_rest(read._replace(v_p=np.where(brings_back, 0.0, read.v_p)))
        acts = fallen & ((memory.unsure < 0.5) | (brings_back & (memory.since_takeover > 0.0)))
        # Nor does it know by how much the heater is warmer than the recipe for that pull; the last minutes do.
        other = pid.step(read._replace(T_1=read.T_1 - memory.T_1_level), select(acts, memory.pid, begun))
    pull, heater = (
        np.where(duty.fallback, second, first) / unit + at
        for first, second, unit, at in zip(own[:2], other[:2], (MM_PER_MIN, KILO), nominal, strict=True)
    )
    return Control(read, nominal, T_1_offset, Q_H_offset, own[2], other[2], pull, heater)


def _without_readings(
    controller: Any, constants: PullerConstants, call: Any, memory: Any, seen: Any, duty: Duty, control: Control,
    old_heater: Any, bias: Any,
) -> tuple[Any, Any]:  # fmt: skip
    """The wanted setpoints, with the nominal pull speed where no ring is seen, and a heater that follows the recipe and
    the mean pull speed where no temperature is.
    """
    estimates, dt = controller.accepts_missing_temperature, constants.dt
    blind = ~seen.pyrometer & ((duty.no_pyrometer_time > NO_PYROMETER_TIME) | duty.fallback | (not estimates))
    moved = np.where(seen.reference & ~call.starts, seen.read.T_1_ref - memory.readings.T_1_ref, 0.0)
    trim = FOLLOWED * constants.feed * moved + constants.trim * (bias - memory.pull_bias + dt / constants.slow * bias)
    # Any other pull than the mean one grows into the radius unseen, and the last one is none.
    no_ring_time = False if controller.observes else memory.no_ring_time > NO_RING_TIME
    no_ring = ~seen.ring.good & (duty.fallback | no_ring_time)
    return np.where(no_ring, control.nominal[0], control.pull), np.where(
        blind, old_heater + trim / KILO, control.heater
    )


def _excess(value: Any, most: float) -> Any:
    """Excess over the limits +-most; zero inside."""
    return value - np.clip(value, -most, most)


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
        numbers = (np.full(n, math.inf if name in UNKNOWN else 0.0) for name in Memory._fields[:-3])
        return Memory._make([*numbers, zero, self.controller.at_rest(zero), self.pid.at_rest(zero)])

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

    @staticmethod
    def held_at(memory: Memory, pull: Any, heater: Any) -> Memory:
        """The memory with other last setpoints [mm/min, kW], from which the next ones move."""
        return memory._replace(pull=pull, heater=heater)

    @cached_property
    def constants(self) -> PullerConstants:
        """Constants of the puller compiled into the block."""
        config, puller = self.config, nominal_puller(self.config)
        hot = linearise(puller, config.meniscus)
        at = [STATES.index(name) for name in TEMPERATURES]
        A, B = hot.A[np.ix_(at, at)], hot.B[at, COLUMNS.index("Q_H")]
        T_1, _, T_b = -np.linalg.solve(A, B)
        pull = T_b * puller.k_l / (puller.v_0 * puller.rho_dH * (puller.h_0 + puller.layer))
        slow = -1.0 / float(np.linalg.eigvals(A).real.max())
        noise = max(each.sensor.pyrometer_noise[1] for each in config.scenario.scenarios)
        trim, nominal = slow / (pull * SLOWER * PULL_BIAS_TIME), (puller.v_0 / MM_PER_MIN, puller.Q_H_0 / KILO)
        return PullerConstants(
            config.control_interval, config.ranges, PYROMETER_JUMP + 8.0 * noise, 1.0 / T_1, trim, slow, nominal
        )

    def _step(self, given: Any, memory: Any) -> Any:
        return step(self.controller, self.pid, self.constants, given, memory)

    @cached_property
    def program(self) -> Program:
        """The recorded operations of one sample."""
        return record(self._step, self.start(1), (settings_of(self.config), INPUTS, OUTPUTS), self.name, self.notes)


# An exported controller in the simulator: a block, in Python or in another language, as a policy.


class Runner(Protocol):
    """Runs n blocks at once: :class:`Block`, or its compiled form."""

    def start(self, n: int) -> Any:
        """The memory of n blocks before their first sample."""

    def run(self, inputs: Mapping[str, Any], memory: Any) -> tuple[dict[str, Floats], Any]:
        """The outputs, each of shape (n,), and the next memory."""

    def held_at(self, memory: Any, pull: Any, heater: Any) -> Any:
        """The memory with other last setpoints [mm/min, kW]."""


class BlockState(NamedTuple):
    """The state of :class:`BlockPolicy` between calls."""

    samples: npt.NDArray[np.int64]
    """Number of samples since the episode began, shape (n,)."""
    memory: Any
    outputs: Mapping[str, Floats]
    """Setpoints and alarm bits of the last sample, each of shape (n,)."""


@dataclass(frozen=True)
class BlockPolicy:
    """A block that acts in the environment that it was exported for.

    The environment's readings are deviations from each crystal's own nominal values; the block gets them added to its
    nominal ones, so that every puller looks as if it had been calibrated.
    """

    observation: ClassVar[str] = "measured"
    action: ClassVar[str] = "direct"

    block: Block
    runner: Runner | None = None
    """Runs the block in place of Python."""
    interval: float | None = None
    """Control interval of the environment, if it differs from the block's [s]."""

    @property
    def made_for(self) -> TargetEnv:
        """The environment for which the actions are meant."""
        made_for = self.block.config.made_for
        return made_for._replace(action=self.action, control_interval=self.interval or made_for.control_interval)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Actions and the next state; arguments as of every policy."""
        rows = np.atleast_2d(np.asarray(observation, np.float64))
        n, runner = len(rows), self.runner or self.block
        if state is None:
            state = BlockState(np.zeros(n, np.int64), runner.start(n), {})
        elif episode_start is not None and np.any(episode_start):
            samples, memory = select(np.asarray(episode_start), (0 * state.samples, runner.start(n)), state[:2])
            state = BlockState(samples, memory, state.outputs)
        outputs, memory = runner.run(self.inputs(rows, state.samples), state.memory)
        action = self.action_of(outputs)
        tagged = tag(action[0] if np.ndim(observation) == 1 else action, self.made_for)
        return tagged, BlockState(state.samples + 1, memory, outputs)

    def inputs(self, rows: Any, samples: Any) -> dict[str, Any]:
        """The block's inputs for observations of shape (n, channels) at those samples of their episodes."""
        config = self.block.config
        time = samples * (self.interval or config.control_interval)
        readings = in_plant_units(decode(rows, *config.ranges), nominal_puller(config))
        return readings | {"time_s": time, "ring_time_s": time, "automatic": 1.0}

    def action_of(self, outputs: Mapping[str, Any]) -> npt.NDArray[np.float32]:
        """The environment's action for the setpoints, shape (n, 2)."""
        action: npt.NDArray[np.float32] = np.clip(in_shares(outputs, self.block.config), -1.0, 1.0).astype(np.float32)
        return action
