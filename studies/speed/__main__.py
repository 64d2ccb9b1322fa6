"""How fast: ``python -m studies.speed [--quick] [--json FILE]``.

Every case is measured in turn, the round is repeated, and medians are reported, so that a machine that is busy for a
while is busy for all. Steps per second count every slot's step, resets included unless a name says otherwise.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import timeit
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.commands import OneLineParser

from .cases import SLOTS, THREADS, Case, Stepper, cases, stepper

QUICK, FULL = 3, 15
"""Rounds of a measurement."""


class Row(NamedTuple):
    """One line of the table."""

    name: str
    num_envs: int
    steps_per_s: float


class Ratio(NamedTuple):
    """Speed of one row over that of another: of each the fastest whose name begins so, of 1,024 slots if any."""

    row: str
    over: str
    promised: float | None = None
    """Least value that is aimed at; None for a ratio that is only reported."""


OURS = "Cz-v0 batch, measured"
RATIOS = {
    "scalar_vs_pendulum": Ratio("Cz-v0 scalar", "Pendulum-v1 scalar", 1.7),
    "vector1024_vs_envpool_pendulum": Ratio(OURS, "EnvPool Pendulum-v1", 5.0),
    "vector1024_vs_pcgym": Ratio(OURS, "pc-gym CSTR", 2000.0),
    "vector1024_vs_kernel": Ratio(
        "Cz-v0 batch without resets, 1 thread", "bare compiled plant and ring, 1 thread", 0.65
    ),
    "sb3_adapter_vs_subproc": Ratio("SB3 adapter over the batch", "SB3 SubprocVecEnv", 100.0),
    "sb3_adapter_vs_dummy": Ratio("SB3 adapter over the batch", "SB3 DummyVecEnv", 12.0),
    "derivatives_vs_step": Ratio("step with derivatives", "step without derivatives", 0.125),
    "sb3_make_vec_env_vs_pendulum": Ratio("SB3 make_vec_env, cz_gym:Cz-v0", "SB3 make_vec_env, Pendulum-v1", 1.8),
    "sync_vector_env_vs_pendulum": Ratio("SyncVectorEnv, cz_gym:Cz-v0", "SyncVectorEnv, Pendulum-v1", 1.5),
    "vector1024_vs_envpool_pendulum_one_thread": Ratio(f"{OURS}, 1 thread", "EnvPool Pendulum-v1, 1 thread"),
}


def measure(wanted: Sequence[Case], rounds: int) -> tuple[list[Row], dict[str, str]]:
    """Median speeds over interleaved rounds, and by name why a case was skipped that cannot be made here."""
    from tqdm import tqdm

    running: dict[Case, tuple[Stepper, timeit.Timer, int]] = {}
    skipped = {}
    for case in wanted:
        try:
            made = stepper(case.make())
            made.step()
        except Exception as error:  # what a peer lacks must not end the run
            skipped[case.name] = f"{type(error).__name__}: {' '.join(str(error).split())}"[:100]
            continue
        timer = timeit.Timer(made.step, "import gc; gc.enable()")
        running[case] = made, timer, timer.autorange()[0]
    speeds: dict[Case, list[float]] = {case: [] for case in running}
    for _ in tqdm(range(rounds), desc="rounds", disable=None):
        for case, (made, timer, calls) in running.items():
            speeds[case].append(calls * made.num_envs / timer.timeit(calls))
    for made, *_ in running.values():
        made.close()
    return [Row(case.name, running[case][0].num_envs, statistics.median(speeds[case])) for case in running], skipped


def ratio(rows: Sequence[Row], asked: Ratio) -> float | None:
    """A ratio of the table's rows; None where one is missing."""
    speeds = []
    for begins in (asked.row, asked.over):
        found = [row for row in rows if row.name.startswith(begins)]
        speeds += (
            [max(row.steps_per_s for row in [row for row in found if row.num_envs == SLOTS] or found)] if found else []
        )
    return speeds[0] / speeds[1] if len(speeds) == 2 else None


def table(result: dict[str, Any]) -> str:
    """The result as text."""
    lines = [f"{'':44}{'slots':>7}{'steps/s':>14}{'us/step':>10}"]
    for name, num_envs, speed in (row.values() for row in result["rows"]):
        lines.append(f"{name:44}{num_envs:7d}{speed:14,.0f}{1e6 / speed:10.3f}")
    lines += [f"{name:44}skipped: {why}" for name, why in result["skipped"].items()] + [""]
    for name, value in result["ratios"].items():
        shown = "-" if value is None else f"{value:.2f}"
        aim = RATIOS[name].promised
        lines.append(f"{name:44}{shown:>10} x" + (f"   (at least {aim:g} x)" if aim else ""))
    return "\n".join(lines)


def run(quick: bool) -> dict[str, Any]:
    """Measure everything; the content of the JSON file."""
    rows, skipped = measure(cases(quick), QUICK if quick else FULL)
    return {
        "ratios": {name: ratio(rows, asked) for name, asked in RATIOS.items()},
        "rows": [row._asdict() for row in rows],
        "skipped": skipped,
        "threads": THREADS,
    }


def main(argv: list[str] | None = None) -> int:
    """Measure and print; 2 if the file cannot be written."""
    parser = OneLineParser(prog="python -m studies.speed", description="Measure speed beside installed peers.")
    parser.add_argument("--quick", action="store_true", help="fewer repeats: under 40 s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures here")
    return parser.run(_measure, argv, "benchmark")


def _measure(arguments: argparse.Namespace) -> None:
    if arguments.json is not None:
        check_writable(arguments.json.parent)
    result = run(arguments.quick)
    print(table(result))
    if arguments.json is not None:
        write_files({arguments.json: (json.dumps(result, indent=1, allow_nan=False) + "\n").encode()})


if __name__ == "__main__":
    sys.exit(main())
