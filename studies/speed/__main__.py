"""How fast: ``python -m studies.speed [--quick] [--json FILE]``.

Every case is measured in turn, the round is repeated, and medians are reported, so that a machine that is busy for a
while is busy for all. Steps per second count every slot's step, resets included unless a name says otherwise.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.commands import OneLineParser, guarded
from cz_gym.units import MICRO

from . import cases, peers, training
from .cases import THREADS, Case, Skipped
from .costs import KIB, megabytes, memory_per_slot, reset_seconds, start_seconds

GROWTH = (1, 16, 256, 1024, 4096, 16384, 65536)
"""Slots whose cost per step is compared."""
RATIOS = (
    "scalar_vs_pendulum", "vector1024_vs_envpool_pendulum", "vector1024_vs_pcgym", "vector1024_vs_kernel",
    "sb3_adapter_vs_subproc", "sb3_adapter_vs_dummy",
)  # fmt: skip
FLOORS = {
    "scalar_vs_pendulum": 1.7,
    "vector1024_vs_envpool_pendulum": 3.0,
    "vector1024_vs_pcgym": 1500.0,
    "vector1024_vs_kernel": 0.6,
    "sb3_adapter_vs_subproc": 100.0,
    "sb3_adapter_vs_dummy": 12.0,
}


class Plan(NamedTuple):
    """How long to measure."""

    repeats: int
    seconds: float
    """Least time a case gets in each round."""
    most_slots: int


QUICK = Plan(3, 0.1, 4096)
FULL = Plan(9, 0.5, 65536)


class Row(NamedTuple):
    """One line of the table."""

    name: str
    num_envs: int
    steps_per_s: float


def steps_per_second(case: Case, seconds: float) -> float:
    """Step for about that long; slots times steps over time."""
    began = time.perf_counter()
    done = 0
    while True:
        for _ in range(case.calls):
            case.step()
        done += case.calls
        passed = time.perf_counter() - began
        if passed >= seconds:
            return done * case.num_envs / passed


def measure(groups: list[list[Case]], plan: Plan, progress: Callable[[str], None] = lambda _: None) -> list[Row]:
    """Medians of interleaved repeats; a group's cases live together and are closed before the next group's begin."""
    rows = []
    for group in groups:
        for case in group:
            case.step()
        found: list[list[float]] = [[] for _ in group]
        for repeat in range(plan.repeats):
            for case, speeds in zip(group, found, strict=True):
                progress(f"{case.name}, {case.num_envs} slots, round {repeat + 1} of {plan.repeats}")
                speeds.append(steps_per_second(case, plan.seconds))
        for case, speeds in zip(group, found, strict=True):
            rows.append(Row(case.name, case.num_envs, statistics.median(speeds)))
            case.close()
    return rows


def own_cases(plan: Plan) -> list[Case]:
    """This package's cases but for the largest."""
    threads = sorted({1, THREADS})
    found = cases.scalars()
    found += [cases.ours(n, 1) for n in GROWTH if n <= min(plan.most_slots, 4096)]
    found += [cases.ours(1024, n) for n in threads[1:]]
    found += [cases.ours(1024, n, "history") for n in threads]
    for n in threads:
        found += [cases.in_step(1024, n), cases.bare(1024, n)]
    found += [cases.plain_numpy(1024), cases.failing(1024, False), cases.failing(1024, True)]
    return found


def ratios(rows: list[Row]) -> dict[str, float | None]:
    """The figures that are promised; None where a peer is missing."""

    def best(name: str, num_envs: int | None = None) -> float:
        found = [row.steps_per_s for row in rows if row.name.startswith(name) and num_envs in (None, row.num_envs)]
        return max(found, default=math.nan)

    ours = best("Cz-v0 batch, measured", 1024)
    adapter = best(peers.ADAPTER)
    values = (
        best("Cz-v0 scalar") / best("Pendulum-v1 scalar"),
        ours / best(peers.ENVPOOL),
        ours / best(peers.PCGYM),
        best("Cz-v0 batch without resets, 1 thread") / best("bare compiled plant and ring, 1 thread"),
        adapter / best(peers.SUBPROC),
        adapter / best(peers.DUMMY),
    )
    return {name: None if math.isnan(value) else value for name, value in zip(RATIOS, values, strict=True)}


def more_figures(rows: list[Row]) -> dict[str, float]:
    """Further ratios of the table."""
    speed = {(row.name, row.num_envs): row.steps_per_s for row in rows}

    def of(top: tuple[str, int], bottom: tuple[str, int]) -> float:
        return speed.get(top, math.nan) / speed.get(bottom, math.nan)

    mine = "Cz-v0 batch, measured, 1 thread"
    most = max(row.num_envs for row in rows if row.name == mine)
    found = {
        f"cost_per_step_{most}_vs_1024": of((mine, 1024), (mine, most)),
        "vector1024_vs_envpool_pendulum_one_thread": of((mine, 1024), (f"{peers.ENVPOOL}, 1 thread", 1024)),
        "vector1024_vs_numpy": of((mine, 1024), ("plain NumPy plant and ring", 1024)),
        "failing_vs_not_failing": of(
            ("open loop on hard, failing episodes", 1024), ("open loop on hard, no failures", 1024)
        ),
    }
    return {name: value for name, value in found.items() if not math.isnan(value)}


def costs(quick: bool) -> dict[str, float]:
    """Memory, resets and start-up."""
    found = {"memory_per_slot_randomized_kib": memory_per_slot("randomized", "measured") / KIB}
    if not quick:
        found["memory_per_slot_puller_history_kib"] = memory_per_slot("puller", "history") / KIB
    found["reset_scalar_us"] = reset_seconds(1) / MICRO
    found["reset_1024_us_per_slot"] = reset_seconds(1024) / MICRO
    cold, cached = start_seconds(cold=not quick)
    found["start_cached_s"] = cached
    if cold is not None:
        found["start_cold_s"] = cold
    return found


def table(rows: list[Row], skipped: list[Skipped], result: dict[str, Any]) -> str:
    """The whole result as text."""
    lines = [f"{'':44}{'slots':>7}{'steps/s':>14}{'us/step':>10}"]
    lines += [f"{row.name:44}{row.num_envs:7d}{row.steps_per_s:14,.0f}{1e6 / row.steps_per_s:10.3f}" for row in rows]
    lines += [f"{skip.name:44}skipped: {skip.why}" for skip in skipped]
    lines.append("")
    for name, value in result["ratios"].items():
        shown = "-" if value is None else f"{value:.2f}"
        lines.append(f"{name:44}{shown:>10} x   (at least {FLOORS[name]:g} x)")
    lines += [f"{name:44}{value:10.2f}" for name, value in {**result["figures"], **result["costs"]}.items()]
    return "\n".join(lines)


def run(plan: Plan, quick: bool, progress: Callable[[str], None] = lambda _: None) -> tuple[dict[str, Any], str]:
    """Measure everything; the JSON's contents and the table."""
    measured_costs = costs(quick)
    others = peers.peers(quick)
    skipped = [other for other in others if isinstance(other, Skipped)]
    share = {} if quick else training.environment_share()
    if isinstance(share, Skipped):
        skipped, share = [*skipped, share], {}
    groups = [own_cases(plan) + [other for other in others if isinstance(other, Case)]]
    rows = measure(groups, plan, progress)
    large = [n for n in GROWTH if 4096 < n <= plan.most_slots]
    for n in large:
        if megabytes() > n * 0.1:
            rows += measure([[cases.ours(n, 1)]], plan._replace(repeats=3, seconds=2.0), progress)
        else:
            skipped.append(Skipped(f"Cz-v0 batch of {n}", "not enough memory"))
    result: dict[str, Any] = {
        "ratios": ratios(rows),
        "rows": [row._asdict() for row in rows],
        "figures": more_figures(rows) | share,
        "costs": measured_costs,
        "skipped": [skip._asdict() for skip in skipped],
        "threads": THREADS,
    }
    return result, table(rows, skipped, result)


def main(argv: list[str] | None = None) -> int:
    """Measure and print; 2 if the file cannot be written."""
    parser = OneLineParser(prog="python -m studies.speed", description="Measure speed beside installed peers.")
    parser.add_argument("--quick", action="store_true", help="fewer repeats, up to 4,096 slots: under 40 s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures here")
    arguments = parser.parse_args(argv)
    return guarded(parser.prog, lambda: _measure(arguments), "benchmark")


def _measure(arguments: argparse.Namespace) -> int:
    if arguments.json is not None:
        if arguments.json.is_dir():
            raise IsADirectoryError(f"{arguments.json} is a folder")
        check_writable(arguments.json.parent)
    try:
        with peers.silenced():
            result, text = run(QUICK if arguments.quick else FULL, arguments.quick, _say)
    finally:
        _say("")
    print(text)
    if arguments.json is not None:
        write_files({arguments.json: (json.dumps(result, indent=1, allow_nan=False) + "\n").encode()})
    return 0


def _say(what: str) -> None:
    if sys.stderr.isatty():
        print(f"\r{what:100.100}", end="" if what else "\r", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
