"""Identify a puller from its logs: ``cz-gym identify LOG.csv --puller start.toml --out my.toml``."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cz_gym.episodes.log_series import to_csv
from cz_gym.errors import CzError
from cz_gym.machine.puller import find_puller, to_toml
from cz_gym.support.atomic_files import check_writable, write_files
from cz_gym.support.command_line import OneLineParser

from .estimate import identify
from .log import check_puller, column_map, read_log
from .table import COLUMNS

NO_FIT = 3
"""Exit code where the model does not fit the log."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("cz-gym identify", "Identify a puller from its logs.")
    add = parser.add_argument
    add("log", type=Path, nargs="+", help=f"CSV or Parquet file of one machine, with the columns {', '.join(COLUMNS)}")
    add("--puller", default="default", help="puller file to start from (default: %(default)s)")
    add("--out", type=Path, required=True, help="puller file to write; its report stands beside it")
    about = "write the load on the melt and the fluctuations of the log too, as a scenario: scenario='FILE.csv'"
    add("--series", type=Path, metavar="FILE.csv", help=about)
    named = "NAME=COLUMN[:UNIT]"
    add("--column", action="append", default=[], metavar=named, help="a column with another name or unit")
    add("--columns", type=Path, metavar="FILE", help='TOML file with lines NAME = "COLUMN:UNIT"')
    add("--prior", action="append", default=[], metavar="NAME=SD", help="sd of the logarithm of a start value")
    add("--force", action="store_true", help="write the puller file although the model does not fit the log")
    return parser.run(_main, arguments, "plant")


def _main(given: argparse.Namespace) -> int:
    from .report import report

    for option, path, suffix in (("--out", given.out, ".toml"), ("--series", given.series, ".csv")):
        if path is not None and path.suffix != suffix:
            raise CzError(f"{option} must be a file NAME{suffix}, not {path}")
        if path is not None:
            check_writable(path.absolute().parent)
    start = find_puller(given.puller)
    if start.file is not None and given.out.exists() and given.out.samefile(start.file):
        raise CzError(f"--out {given.out} is the file to start from: name another one")
    logs = [read_log(path, column_map(given.column, given.columns)) for path in given.log]
    for path, log in zip(given.log, logs, strict=True):
        check_puller(log, start, str(path))
    identified = identify(logs, start, dict(map(_prior, given.prior)))
    page, files = given.out.with_suffix(".md"), dict[Path, bytes]()
    if given.force or not identified.misfits:
        files[given.out] = to_toml(replace(identified.puller, name=given.out.stem)).encode()
        files |= {given.series: to_csv(identified.series()).encode()} if given.series else {}
    print(identified.verdict)
    write_files(report(identified, logs, ", ".join(path.name for path in given.log), page) | files)
    for e in identified.estimates:
        said = f"{e.value:.4g} ({e.low:.4g} to {e.high:.4g})" if e.informed else "this log says nothing about it"
        print(f"{e.name}: {said}")
    print(f"wrote {' and '.join(map(str, (*files, page)))}")
    return NO_FIT if identified.misfits else 0


def _prior(text: str) -> tuple[str, float]:
    name, _, sd = text.partition("=")
    try:
        return name, float(sd)
    except ValueError:
        raise CzError(f"--prior {text}: write it as NAME=SD") from None
