"""Machines that are not ours, from their log to a controller that drives them: ``python -m studies.other_machine``.

A simulator by somebody else (``tests/foreign_puller.py``, nothing of cz_gym) is logged as a PLC does, its log is
identified, an LQG designed from the file and exported, and the exported block drives the simulator. Beside it stands
the block of the true file on the same crystals. Twenty machines drawn about the start file show whether intervals hold
the truth.
"""

import argparse
import math
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym import Parameters
from cz_gym.config import make_config
from cz_gym.evaluation.report.tables import markdown
from cz_gym.machine.export.compiled import CompiledBlock
from cz_gym.machine.export.controllers import make_block
from cz_gym.machine.export.ports import OUTPUTS
from cz_gym.machine.identify import Identified, identify, read_log
from cz_gym.machine.identify.estimate import LAGS
from cz_gym.machine.puller import PullerFile
from cz_gym.support.atomic_files import check_writable, write_files
from cz_gym.support.command_line import OneLineParser
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN, PERCENT
from studies.identify import HOT_ZONE, MELT, wrong
from tests.foreign_puller import ZONE, ForeignPuller, Operator, drive, write_log

SLOW = {
    "heater_slew": 1e3 / 60.0, "heater_step": 50.0, "pull_slew": 0.2 / 60.0, "pull_window": 0.3, "camera_noise": 0.05,
}  # fmt: skip
"""Drives and camera of the machine: 1 kW/min in steps of 50 W, 0.3 mm/min, 0.2 mm/min in a minute."""
PLC = {"second": 1.0, "jitter": 0.3, "missing_rows": 0.02, "missing_drives": 0.05, "digits": (2, 3, 2, 1)}
"""What its historian does to a log."""
CASES: dict[str, dict[str, float]] = {
    "the machine is the model": {},
    "latency 4 s": {"camera_latency": 4.0},
    "heater's lag 10 s": {"heater_lag": 10.0},
    "dead time 5 s": {"heater_dead_time": 5.0},
    "pyrometer's filter 20 s": {"pyrometer_filter": 20.0},
    "camera's scale 1 % off": {"camera_scale": 1.01},
}
CASES["all of these"] = {name: value for case in CASES.values() for name, value in case.items()}
"""What the machine has besides; the start file knows the latency alone."""
MACHINES, CRYSTALS, SETTLING = 20, 5, 30.0 * MINUTE
"""Machines of the intervals, crystals of each case, and the time of each that does not count [s]."""


class Row(NamedTuple):
    """One case of the chain."""

    case: str
    identified: Identified
    errors: tuple[float, float]
    """Root mean square radius error with the identified and with the true file [mm]."""
    lost: tuple[int, int]


def machine_file(zone: Mapping[str, float], quirks: Mapping[str, float], name: str) -> PullerFile:
    """A puller file of a machine's numbers, with its drives and camera."""
    numbers = {name: value for name, value in zone.items() if name != "lam"}
    delays: Any = {name: (quirks[name],) * 2 for name in LAGS if name in quirks}
    return PullerFile(
        name, Parameters()._replace(**numbers), control_interval=2.0, latency=quirks.get("camera_latency", 0.0),
        pull_window=SLOW["pull_window"] * MM_PER_MIN, pull_slew=SLOW["pull_slew"] * MM_PER_MIN,
        heater_slew=SLOW["heater_slew"], heater_step=SLOW["heater_step"], camera_noise=(0.05 * MM,) * 2,
        pyrometer_noise=(0.1, 0.1), **delays,
    )  # fmt: skip


def log_of(zone: Mapping[str, float], quirks: Mapping[str, float], seed: int, **plc: Any) -> Any:
    """Three hours of a machine under its operator, as its historian has them."""
    puller = ForeignPuller(zone, seed, **SLOW, **quirks)
    with tempfile.TemporaryDirectory() as folder:
        rows = drive(puller, Operator(puller, seed).setpoints)
        return read_log(write_log(Path(folder) / "log.csv", rows, seed, **plc))


def drawn(number: int) -> dict[str, float]:
    """A machine whose hot zone the start file has wrong by factors of lognormal distribution."""
    zone: dict[str, float] = ZONE
    return zone | {name: zone[name] * factor for name, factor in wrong(np.random.default_rng([11, number])).items()}


def held(number: int) -> tuple[Identified, list[bool]]:
    """A drawn machine's identification, and whether the interval of each informed parameter holds the truth."""
    zone = drawn(number)
    identified = identify(log_of(zone, {}, number, **PLC), machine_file(ZONE, {}, "start"))
    told = [e for e in identified.estimates if e.informed and e.name in HOT_ZONE + MELT]
    return identified, [e.low <= zone[e.name] <= e.high for e in told]


def run(
    file: PullerFile, zone: Mapping[str, float], quirks: Mapping[str, float], crystals: int, hours: float = 3.0
) -> Any:
    """Radius error [mm] and crystals lost of the block that is exported for a puller file, on the machine.

    As an operator does, nominal power, temperature and ring are trimmed to the machine's.
    """
    config = make_config("randomized", observation="measured", action="direct", puller=file)
    runner, squares, lost = CompiledBlock(make_block("lqg", config)), [], 0
    for seed in range(100, 100 + crystals):
        puller = ForeignPuller(zone, seed, **SLOW, **quirks)
        trims = {
            "ring_bias_mm": puller.ring_bias / MM, "nominal_T_1_K": puller.T_1_0,
            "nominal_heater_power_kW": puller.power_0 / KILO, "oldest_reading_s": 20.0,
            "heater_power_min_kW": (puller.power_0 - 1e4) / KILO, "heater_power_max_kW": (puller.power_0 + 1e4) / KILO,
        }  # fmt: skip
        memory = runner.start(1)

        def setpoints(seen: Mapping[str, float], trims: Any = trims) -> dict[str, float]:
            nonlocal memory
            outputs, memory = runner.run({**seen, **trims, "automatic": 1.0}, memory)
            return {port.name: float(outputs[port.name][0]) for port in OUTPUTS}

        rows = drive(puller, setpoints, hours)
        error = np.array([row["true_radius_mm"] - row["r_ref_mm"] for row in rows if row["time_s"] >= SETTLING])
        squares.append(8.0**2 if puller.lost else float(np.mean(error**2)))
        lost += puller.lost
    return math.sqrt(np.mean(squares)), lost


def chain(case: str, crystals: int = CRYSTALS, seed: int = 1) -> Row:
    """Log, identify, design, export and drive a machine, with the identified and with the true file."""
    quirks, zone = CASES[case], drawn(seed)
    known = {name: quirks[name] for name in ("camera_latency",) if name in quirks}
    identified = identify(log_of(zone, quirks, seed, **PLC), machine_file(ZONE, known, "start"))
    results = [run(file, zone, quirks, crystals) for file in (identified.puller, machine_file(zone, quirks, "truth"))]
    (mine, true), (lost, lost_too) = zip(*results, strict=True)
    return Row(case, identified, (mine, true), (lost, lost_too))


def report(rows: Sequence[Row], inside: Sequence[Sequence[bool]], fits: int) -> str:
    """The table of the cases, and what the intervals hold."""
    heads = "machine", "fits", "identified file [mm]", "true file [mm]", "ratio", "lost", "lost, true file"
    lines = []
    for row in rows:
        errors = *(f"{error:.3f}" for error in row.errors), f"{row.errors[0] / row.errors[1]:.2f}"
        lines.append((row.case, "no" if row.identified.misfits else "yes", *errors, *map(str, row.lost)))
    flat = [each for one in inside for each in one]
    share = f"{np.mean(flat) / PERCENT:.0f} % of {len(flat)}" if flat else "none"
    return f"""{markdown(heads, lines)}

{len(inside)} PLC-like logs of slow machines: the model fits {fits}
intervals that hold the truth: {share} informed numbers
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.other_machine", "Identify and drive machines that are not ours.")
    parser.add_argument("--out", type=Path, default=Path("results/other_machine"), metavar="FOLDER", help="%(default)s")
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    check_writable(given.out)
    rows, inside, fits = list[Row](), list[list[bool]](), 0

    def save() -> None:
        write_files({given.out / "machines.txt": report(rows, inside, fits).encode()})

    for case in CASES:
        rows.append(chain(case))
        save()
    for number in range(MACHINES):
        identified, hold = held(number)
        inside.append(hold)
        fits += not identified.misfits
        print(f"log {number}: {sum(hold)} of {len(hold)} intervals hold the truth; {identified.verdict}", flush=True)
        save()
    print(report(rows, inside, fits), end="")


if __name__ == "__main__":
    sys.exit(main())
