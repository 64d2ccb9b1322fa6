"""Identify a puller from its log: ``python -m cz_gym.machine.identify LOG.csv --puller start.toml --out my.toml``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cz_gym.errors import CzError
from cz_gym.machine.puller import find_puller, to_toml
from cz_gym.support.atomic_files import check_writable, write_files
from cz_gym.support.command_line import OneLineParser

from .estimate import identify
from .log import COLUMNS, check_puller, column_map, read_log


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m cz_gym.machine.identify", "Identify a puller from its log.")
    add = parser.add_argument
    add("log", type=Path, help=f"CSV or Parquet file with the columns {', '.join(COLUMNS)}")
    add("--puller", default="default", help="puller file to start from (default: %(default)s)")
    add("--out", type=Path, required=True, help="puller file to write; its report stands beside it")
    named = "NAME=COLUMN[:UNIT]"
    add("--column", action="append", default=[], metavar=named, help="a column with another name or unit")
    add("--columns", type=Path, metavar="FILE", help='TOML file with lines NAME = "COLUMN:UNIT"')
    add("--prior", action="append", default=[], metavar="NAME=SD", help="sd of the logarithm of a start value")
    return parser.run(_main, arguments, "plant")


def _main(given: argparse.Namespace) -> None:
    from .report import report

    if given.out.suffix != ".toml":
        raise CzError(f"--out must be a file NAME.toml, not {given.out}")
    start = find_puller(given.puller)
    log = read_log(given.log, column_map(given.column, given.columns))
    check_puller(log, start)
    check_writable(given.out.parent)
    found = identify(log, start, dict(map(_prior, given.prior)))
    page = given.out.with_suffix(".md")
    write_files(report(found, log, given.log.name, page) | {given.out: to_toml(found.puller).encode()})
    for e in found.estimates:
        said = f"{e.value:.4g} ({e.low:.4g} to {e.high:.4g})" if e.informed else "this log says nothing about it"
        print(f"{e.name}: {said}")
    print(f"wrote {given.out} and {page}")


def _prior(text: str) -> tuple[str, float]:
    name, _, sd = text.partition("=")
    try:
        return name, float(sd)
    except ValueError:
        raise CzError(f"--prior {text}: write it as NAME=SD") from None


if __name__ == "__main__":
    sys.exit(main())
