"""Run the examples over training seeds: what they reach, and in how many minutes; kept as they come."""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from cz_gym.commands import OneLineParser, between
from cz_gym.errors import CzError
from cz_gym.evaluation.files import csv_text
from cz_gym.evaluation.report.tables import markdown as table

from .runs import Row, timed

EXAMPLES = ("sb3_ppo", "cleanrl_ppo", "rllib_ppo")
HEAD = """# The examples, training seed by training seed

Each example as it stands, judged on 100 validation crystals of `randomized`.

"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.plain_tools", __doc__)
    about = "which (default: those without RLlib)"
    parser.add_argument("--examples", nargs="+", choices=EXAMPLES, default=EXAMPLES[:2], help=about)
    parser.add_argument("--seeds", type=between(1, 100), default=5, help="training seeds of each (default: 5)")
    parser.add_argument("--steps", type=between(1, 10**9), help="steps of each run (default: the example's)")
    parser.add_argument("--jobs", type=between(1, 64), default=1, help="runs at once (default: 1)")
    parser.add_argument("--out", type=Path, default=Path("results/plain_tools"), help="results (default: %(default)s)")
    return parser.run(_main, arguments, "agents", "finished runs are kept; the same command goes on")


def _main(given: argparse.Namespace) -> None:
    from cz_gym.atomic_files import check_writable, write_files

    check_writable(given.out)
    path = given.out / "runs.csv"
    rows = read(path)
    asked = [(name, seed) for seed in range(given.seeds) for name in given.examples]
    missing = [each for each in asked if each not in {row[:2] for row in rows}]
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        for each in as_completed([pool.submit(timed, *task, given.steps) for task in missing]):
            rows = sorted([*rows, each.result()])
            print(to_table([each.result()]), flush=True)
            write_files({path: to_csv(rows), given.out / "table.md": (HEAD + to_table(rows) + "\n").encode()})
    print(to_table([row for row in rows if row[:2] in asked]))


def read(path: Path) -> list[Row]:
    """The rows of a file that :func:`to_csv` wrote; none if there is no file. ValueError if it is damaged."""
    if not path.exists():
        return []
    try:
        rows = list(csv.DictReader(path.read_text().splitlines()))
        return [Row(row["example"], int(row["seed"]), *(float(row[name]) for name in Row._fields[2:])) for row in rows]
    except (KeyError, TypeError, ValueError):
        raise CzError(f"{path}: damaged; move it away to run everything again") from None


def to_csv(rows: Sequence[Row]) -> bytes:
    """A line a training seed."""
    return csv_text(Row._fields, ([*row[:2], *(f"{value:.4g}" for value in row[2:])] for row in rows)).encode()


def to_table(rows: Sequence[Row]) -> str:
    """The same for people."""
    heads = ("example", "seed", "minutes", "RMSE [mm]", "pull step [mm/min]", "lost")
    forms = "{}", "{}", "{:.1f}", "{:.3f}", "{:.4f}", "{:.1%}"
    return table(heads, ([form.format(value) for form, value in zip(forms, row, strict=True)] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
