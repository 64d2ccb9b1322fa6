"""``python -m studies.paper --out results/paper``: Part II of the paper, redone on our plant."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.commands import OneLineParser

from .comparison import as_markdown, numbers, rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.paper", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/paper"), help="folder for the results")
    return parser.run(_compare, arguments, "benchmark")


def _compare(given: argparse.Namespace) -> None:
    import control  # noqa: F401  (missing? say so before the work, not after it)
    import matplotlib  # noqa: F401

    check_writable(given.out)
    write_files({given.out / name: content for name, content in contents().items()})
    print(as_markdown(rows()))
    print(f"\nreport: {given.out / 'report.md'}")


def contents() -> dict[str, bytes]:
    """The report, its figures and the numbers by file name; runs every experiment."""
    from .figures import drawn
    from .report import report

    text = json.dumps(numbers(), indent=2, allow_nan=False) + "\n"
    return {**drawn(), "report.md": report().encode(), "numbers.json": text.encode()}


if __name__ == "__main__":
    sys.exit(main())
