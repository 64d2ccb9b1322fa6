"""Blocks under the faults of a plant: ``python -m studies.faults``.

Every controller's block grows the same crystals without and with each fault: calls that come early, late or unevenly, a
pyrometer that is gone for two hours or drifts, nominal values that are off, drives that stand still or are read wrong,
a ring that steps or gets stuck, an operator who left the pull off its nominal speed. The environment runs at half of
the block's interval, and the ring's time is that of its frame. Where drives are read wrong, the scenario's own errors
of their readings are left out: each error stands alone, beside "drives read exactly". Agents grow under these faults.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.agents import shipped_names
from cz_gym.config import make_config
from cz_gym.episodes.scenario import DriveReadings
from cz_gym.evaluation.protocol import TEST_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.command_line import between
from cz_gym.support.errors import CzError
from cz_gym.support.files import write_files
from cz_gym.support.units import HOUR, MINUTE, MM
from cz_gym.tools.export.block import SETPOINT_NAMES, Alarm
from cz_gym.tools.export.controllers import make_block
from cz_gym.tools.export.shell import Block, BlockPolicy, Runner
from cz_gym.tools.export.text import CompiledBlock
from cz_gym.tools.report.tables import NOTHING, markdown

from . import StudyParser

CONTROLLERS, CRYSTALS = ("lqg-at-0.02", "paper-tuned", "fallback", "gradient"), 100
GONE = 0.5 * HOUR, 2.5 * HOUR
"""Beginning and end of the time without a pyrometer [s]."""
STILL = 1.0 * HOUR, 1.0 * HOUR + 10.0 * MINUTE
"""Beginning and end of the time in which the drives stand still [s]."""
OFF = {"nominal_heater_power_kW": 2.0, "nominal_T_1_K": 10.0, "nominal_radius_mm": 0.2}
"""Errors of the nominal values."""
STEP = 0.75 * HOUR
"""Time at which the ring steps or gets stuck [s]."""
FULL, STEPS = (2.4, 20.0), (0.01, 0.1)
"""Full ranges of pull speed [mm/min] and heater power [kW], and largest resolutions of their readings."""
DRIVES = tuple(SETPOINT_NAMES.values())
TAKEN_OVER = 10.0 * MINUTE
"""Time at which a block takes over from an operator [s]."""
SETTLED = 0.5 * HOUR
"""Time from which errors count [s]."""


class Reading(NamedTuple):
    """The errors of a drive's reading, in its unit."""

    scale: float = 1.0
    offset: float = 0.0
    resolution: float = 1e-9

    def __call__(self, true: Any) -> Any:
        """The reading of a drive."""
        return self.resolution * np.rint((self.scale * np.asarray(true) + self.offset) / self.resolution)


def _draws(count: int) -> dict[str, Fault]:
    """Joint draws of all errors of both readings."""
    random, draws = np.random.default_rng(1), {}
    for at in range(1, count + 1):
        reads = (
            Reading(
                random.uniform(0.97, 1.03), 0.02 * full * random.uniform(-1.0, 1.0), random.uniform(0.0, 1.0) * step
            )
            for full, step in zip(FULL, STEPS, strict=True)
        )
        draws[f"drives read wrong, draw {at}"] = Fault(
            reads=(next(reads), next(reads)), delay=int(random.integers(0, 3))
        )
    return draws


class Fault(NamedTuple):
    """Changes to calls, readings, settings and drives between a plant and its block."""

    pace: Sequence[float] = (1.0,)
    """Times between calls in intervals of the block, multiples of a half, over and over."""
    pyrometer: Callable[[Any, Any], Any] | None = None
    """The pyrometer's reading while it is gone, from the true one and the last one before."""
    off: float = 0.0
    """Error of the nominal values, in multiples of OFF."""
    still: bool = False
    """True if the drives stand still during :data:`STILL`."""
    reads: tuple[Reading, Reading] | None = None
    """Errors of the readings of pull speed [mm/min] and heater power [kW]."""
    delay: int = 0
    """Age of both readings [control intervals of the block]."""
    ring: Callable[[Any, Any], Any] | None = None
    """The ring from :data:`STEP` on, from the true one [mm] and the last one before."""
    ring_ends: float = math.inf
    """Time at which the ring is read right again [s]."""
    drift: float = 0.0
    """Drift of the pyrometer [K/h]."""
    operator: float = 0.0
    """Pull speed above nominal of an operator, who has the drives until :data:`TAKEN_OVER` [mm/min]; 0: nobody."""

    @property
    def of_readings(self) -> bool:
        """True if the drives are read in another way than the scenario has it."""
        return self.reads is not None or self.delay > 0


EXACT = "drives read exactly"
UNEVEN = tuple(np.random.default_rng(0).integers(1, 5, 997) / 2.0)
FAULTS = {
    "none": Fault(),
    "twice as often": Fault((0.5,)),
    "every 1.5 intervals": Fault((1.5,)),
    "every 3 intervals": Fault((3.0,)),
    "0.5 to 2 intervals": Fault(UNEVEN),
    "pyrometer no number": Fault(pyrometer=lambda true, last: np.nan * true),
    "pyrometer at 0": Fault(pyrometer=lambda true, last: 0.0 * true),
    "pyrometer 20 K too high": Fault(pyrometer=lambda true, last: true + 20.0),
    "pyrometer stuck": Fault(pyrometer=lambda true, last: last),
    "nominal values too high": Fault(off=1.0),
    "nominal values too low": Fault(off=-1.0),
    "drives stand still": Fault(still=True),
    EXACT: Fault(reads=(Reading(), Reading())),
    "pull reads 0.97": Fault(reads=(Reading(0.97), Reading())),
    "pull reads 1.03": Fault(reads=(Reading(1.03), Reading())),
    "pull reads -2 % of its range": Fault(reads=(Reading(offset=-0.02 * FULL[0]), Reading())),
    "pull reads +2 % of its range": Fault(reads=(Reading(offset=0.02 * FULL[0]), Reading())),
    "heater reads 0.97": Fault(reads=(Reading(), Reading(0.97))),
    "heater reads 0.995": Fault(reads=(Reading(), Reading(0.995))),
    "heater reads 1.03": Fault(reads=(Reading(), Reading(1.03))),
    "heater reads -2 % of its range": Fault(reads=(Reading(), Reading(offset=-0.02 * FULL[1]))),
    "heater reads +2 % of its range": Fault(reads=(Reading(), Reading(offset=0.02 * FULL[1]))),
    "drives read in steps": Fault(reads=(Reading(resolution=STEPS[0]), Reading(resolution=STEPS[1]))),
    "drives read two intervals late": Fault(delay=2),
    **_draws(10),
    "ring steps by +2 mm": Fault(ring=lambda true, last: true + 2.0),
    "ring steps by -2 mm": Fault(ring=lambda true, last: true - 2.0),
    "ring stuck for 10 min": Fault(ring=lambda true, last: last, ring_ends=STEP + 10.0 * MINUTE),
    "ring stuck for 30 min": Fault(ring=lambda true, last: last, ring_ends=STEP + 30.0 * MINUTE),
    "pyrometer drifts by -2 K/h": Fault(drift=-2.0),
    "pyrometer drifts by -4 K/h": Fault(drift=-4.0),
    "operator left -0.1 mm/min": Fault(operator=-0.1),
    "operator left -0.2 mm/min": Fault(operator=-0.2),
}


class Faulty:
    """A runner behind a fault."""

    def __init__(self, block: Block, runner: Runner, fault: Fault) -> None:
        self.fault, self.runner, self.dt = fault, runner, block.config.control_interval
        self.off = {name: block.ports[name].default + fault.off * most for name, most in OFF.items()}
        self.latency = max(each.sensor.latency for each in block.config.scenario.scenarios)
        rest = (block.ports[f"nominal_{name}"].default for name in DRIVES)
        self.operated = dict(zip(SETPOINT_NAMES, np.add(list(rest), (fault.operator, 0.0)), strict=True))
        self.time, self.calls, self.due, self.bits = 0.0, 0, 0.0, 0
        self.limited = list[float]()
        self.seen: Any = 0.0
        self.ring: Any = 0.0
        self.past = list[Any]()
        self.held: dict[str, Any] = {}

    def start(self, n: int) -> Any:
        """The memory of n blocks before their first sample."""
        return self.runner.start(n)

    def held_at(self, memory: Any, pull: Any, heater: Any) -> Any:
        """The memory with other last setpoints [mm/min, kW]."""
        return self.runner.held_at(memory, pull, heater)

    def run(self, inputs: Mapping[str, Any], memory: Any) -> Any:
        """The setpoints that reach the plant, and the next memory."""
        time, self.time = self.time, self.time + 0.5 * self.dt
        self.past.append([inputs[name] for name in DRIVES])
        late = self.past[max(len(self.past) - 1 - 2 * self.fault.delay, 0)]
        reads = self.fault.reads or (Reading(), Reading())
        drives = {name: read(value) for name, read, value in zip(DRIVES, reads, late, strict=True)}
        if time < self.due - 1e-6:
            return self.held, memory
        self.due = time + self.fault.pace[self.calls % len(self.fault.pace)] * self.dt
        self.calls += 1
        ring_time = {"ring_time_s": np.asarray(inputs["time_s"]) - self.latency}
        given = dict(inputs) | ring_time | self.off | drives | self._sensors(inputs, time)
        operated = self.fault.operator != 0.0 and time < TAKEN_OVER
        outputs, memory = self.runner.run(given | ({"automatic": 0.0} if operated else {}), memory)
        if operated:
            outputs = outputs | {name: 0.0 * outputs[name] + at for name, at in self.operated.items()}
        if time > SETTLED:
            alarms = outputs["alarms"].astype(np.int64)
            self.bits |= int(np.bitwise_or.reduce(alarms))
            self.limited.append(float(np.mean(alarms & (Alarm.PULL_LIMITED | Alarm.HEATER_LIMITED) > 0)))
        if not (self.fault.still and STILL[0] <= time < STILL[1]):
            self.held = outputs
        return self.held, memory

    def _sensors(self, inputs: Mapping[str, Any], time: float) -> dict[str, Any]:
        """Faulty readings of pyrometer [K] and ring [mm] at a time [s]."""
        T_1, ring = inputs["T_1_K"], inputs["ring_radius_mm"]
        if self.fault.pyrometer and GONE[0] <= time < GONE[1]:
            T_1 = self.fault.pyrometer(T_1, self.seen)
        else:
            self.seen = T_1
        if self.fault.ring and STEP <= time < self.fault.ring_ends:
            ring = self.fault.ring(ring, self.ring)
        else:
            self.ring = ring
        return {"T_1_K": T_1 + self.fault.drift * time / HOUR, "ring_radius_mm": ring}


class Row(NamedTuple):
    """A controller under a fault."""

    rmse: float
    """Radius error from half an hour on, of the crystals that were not lost [mm]."""
    lost: int
    helpless: int
    """Number of crystals that were lost while the drives stood still."""
    alarms: Alarm
    limited: float
    """Share of the time in which a drive counts as limited [-]."""


def grow(block: Block, fault: str, crystals: int, runner: Runner | None = None, horizon: float = 3.0 * HOUR) -> Row:
    """Grow test crystals with a block, or what runs it, under the fault of that name."""
    interval = 0.5 * block.config.control_interval
    config = replace(block.config, control_interval=interval, horizon=horizon)
    if FAULTS[fault].of_readings:
        config = replace(config, scenario=replace(config.sole_scenario, readings=DriveReadings()))
    faulty = Faulty(block, runner or block, FAULTS[fault])
    run = rollout(BlockPolicy(block, faulty, interval), config, TEST_SEEDS[:crystals])
    error = (run.signals.r_c - run.signals.r_ref)[round(SETTLED / interval) :, ~run.failed] / MM
    ends = run.alive.sum(axis=0)[run.failed] * interval
    helpless = (ends > STILL[0]) & (ends <= STILL[1]) & FAULTS[fault].still
    rmse, limited = float(np.sqrt(np.mean(np.square(error)))), float(np.mean(faulty.limited))
    return Row(rmse, len(ends), int(helpless.sum()), Alarm(faulty.bits), limited)


Cells = tuple[str, ...]
"""The texts of a row of the report behind its controller and fault."""


def row_of(row: Row, exact: float | None) -> Cells:
    """The texts of a row; ``exact`` is the controller's error to compare with [mm]."""
    lost = f"{row.lost} ({row.helpless})" if row.helpless else str(row.lost)
    names = ", ".join(bit.name or "" for bit in row.alarms)
    return f"{row.rmse:.3f}", f"{row.rmse / exact:.2f}" if exact else NOTHING, lost, f"{row.limited:.1%}", names


def earlier(file: Path, about: str) -> dict[tuple[str, str], Cells]:
    """The rows of a report, if there is one, by controller and fault; CzError if it is of other crystals."""
    if not file.is_file():
        return {}
    if about not in (text := file.read_text("utf-8")):
        raise CzError(f"{file} is not of {about}: give its --crystals, or another --out")
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return {(line[0], line[1]): tuple(line[2:]) for line in lines if line[1] in FAULTS}


def report(rows: Mapping[tuple[str, str], Cells], about: str) -> str:
    """The table, by controller and fault."""
    names, order = list(dict.fromkeys(name for name, _ in rows)), list(FAULTS)
    keys = sorted(rows, key=lambda key: (names.index(key[0]), order.index(key[1])))
    heads = "controller", "fault", "RMSE [mm]", "ratio", "lost", "limited", "alarms"
    return f"""# Blocks under the faults of a plant

{about}, errors from half an hour on, of those that were kept. In brackets: those
of the lost that were lost while the drives stood still, when no block acts. Limited: share of the time with a bit that
says so. Ratio: to the error without a fault, or with drives that read exactly.

{markdown(heads, [(*key, *rows[key]) for key in keys])}
"""


def faults_of(name: str) -> list[str]:
    """The faults under which a controller's block grows: an agent's those of the drives' readings."""
    agents = shipped_names()
    return [fault for fault, each in FAULTS.items() if name not in agents or each.of_readings]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = StudyParser("faults", __doc__, "results/faults")
    parser.add_argument("controllers", nargs="*", help=f"names ({', '.join(CONTROLLERS)})")
    about = "test crystals (%(default)s)"
    parser.add_argument("--crystals", type=between(1, 500), default=CRYSTALS, metavar="N", help=about)
    about = "a fault, may be given again; the other rows of a report on as many crystals stay (all, a new report)"
    parser.add_argument("--fault", action="append", choices=FAULTS, metavar="FAULT", help=about)
    return parser.run(_main, arguments, "plant")


def _main(given: argparse.Namespace) -> None:
    about, file = f"{given.crystals} test crystals of three hours each", given.out / "report.md"
    rows = earlier(file, about) if given.fault else {}
    errors = {key: float(cells[0]) for key, cells in rows.items()}
    for name in given.controllers or CONTROLLERS:
        block = make_block(name, make_config("puller", observation="measured", action="direct"))
        runner = CompiledBlock(block)
        for fault in [each for each in faults_of(name) if each in (given.fault or FAULTS)]:
            row = grow(block, fault, given.crystals, runner)
            errors[name, fault] = row.rmse
            exact = errors.get((name, EXACT if FAULTS[fault].of_readings else "none"))
            rows[name, fault] = row_of(row, exact)
            print(name, fault, *row, flush=True)
        write_files({file: report(rows, about).encode()})


if __name__ == "__main__":
    sys.exit(main())
