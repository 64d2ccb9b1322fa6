"""Measure what helps: ``python -m studies.ablation`` changes one thing of the ``ppo`` recipe at a time.

Each row is trained for the same number of steps with the same training seeds, and judged on validation crystals that
all rows share. Every finished run is kept; the same command goes on where it stopped.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cz_gym.commands import OneLineParser, guarded

PROG = "python -m studies.ablation"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    args = _parser().parse_args(arguments)
    left = "finished runs are kept, and the same command goes on from the others' checkpoints"
    return guarded(PROG, lambda: _main(args), "agents", left)


def _parser() -> OneLineParser:
    parser = OneLineParser(prog=PROG, description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rows", help="rows to run, joined by commas (default: all)")
    parser.add_argument("--seeds", type=int, default=3, help="training seeds a row (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=3_000_000, help="environment steps a run (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("results/ablation"), help="results (default: %(default)s)")
    parser.add_argument(
        "--work", type=Path, default=Path("runs/ablation"), help="unfinished runs and imitations (default: %(default)s)"
    )
    parser.add_argument("--list", action="store_true", help="say what the rows are and how many of their runs are done")
    return parser


def _main(args: argparse.Namespace) -> int:
    for name, most in (("seeds", 100), ("steps", 10**9), ("jobs", 64)):
        if not 1 <= getattr(args, name) <= most:
            raise ValueError(f"--{name} must be between 1 and {most}, not {getattr(args, name)}")
    from cz_gym.agents.training.recipes import PPO
    from cz_gym.atomic_files import check_writable, locked
    from studies.comparison.jobs import missing, run_all
    from studies.comparison.runs import Plan, read_all

    from .rows import ROWS, find_rows

    rows = ROWS if args.rows is None else find_rows(args.rows.split(","))
    plan = Plan(args.steps, args.out, args.work, PPO().recipe.weights)
    if args.list:
        for row in rows:
            done = len(read_all(plan, [row], range(args.seeds)).get(row.name, ()))
            print(f"{row.name:20} {done}/{args.seeds}  {row.meaning}")
        return 0
    check_writable(plan.out)
    with locked(plan.work):
        tasks = missing(plan, [(row, seed) for row in rows for seed in range(args.seeds)])
        print(f"{len(rows) * args.seeds - len(tasks)} runs are done, {len(tasks)} to do")
        run_all(plan, tasks, args.jobs, lambda: _write(plan, range(args.seeds)))
        _write(plan, range(args.seeds))
    print(f"wrote {plan.out / 'table.md'}")
    return 0


def _write(plan: Any, seeds: Sequence[int]) -> None:
    """Write the table and its picture from everything that is finished."""
    from cz_gym.atomic_files import write_files
    from studies.comparison.lqg_family import rivals
    from studies.comparison.runs import read_all

    from .figure import forest
    from .rows import ROWS
    from .table import tabulate, to_csv, to_markdown

    runs = read_all(plan, ROWS, seeds)
    if not runs:
        return
    lines = tabulate(ROWS, runs)
    files = {"table.csv": to_csv(lines).encode(), "table.md": to_markdown(lines, plan.steps, rivals(plan)).encode()}
    files["forest.png"] = forest(lines)
    write_files({plan.out / name: content for name, content in files.items()})


if __name__ == "__main__":
    sys.exit(main())
