"""Agents on other plants: ``python -m studies.generalisation results/generalisation`` tabulates a benchmark's episodes:
radius error, lost crystals and the paired difference to one controller, with 95 % intervals.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from cz_gym.atomic_files import write_files
from cz_gym.commands import OneLineParser
from cz_gym.errors import CzError
from cz_gym.evaluation.files import EPISODES, read_episodes
from cz_gym.evaluation.report.tables import markdown as table
from cz_gym.evaluation.statistics import Estimate, Floats, Resamples, differences, means

OBSERVABLE = ("sensor-fault", "puller")
"""Rows with an offset that no sensor shows: the error against what can be seen is counted there."""
MICRON = 1e-3
"""A micrometre in millimetres."""


class Cell(NamedTuple):
    """One controller on one row."""

    row: str
    controller: str
    seeds: int
    """Training seeds; 1 for a controller that is not trained."""
    rmse: Estimate
    """[mm]"""
    lost: Estimate
    """Share of crystals [-]."""
    apart: Estimate
    """RMSE less the compared controller's on the same crystals [mm]."""
    worst: float
    """RMSE of the worst training seed [mm]."""


def figures(row: str) -> tuple[str, ...]:
    """What is read of a row's episodes: RMSE [mm] and failure."""
    return ("rmse_observable_mm" if row in OBSERVABLE else "rmse_mm"), "failure_rate"


def tabulate(episodes: Mapping[str, Mapping[str, Floats]], against: str) -> list[Cell]:
    """A cell a row and controller; ValueError unless the compared one took part in every row, on the same crystals."""
    if len({values.shape[1] for by_name in episodes.values() for values in by_name.values()}) != 1:
        raise CzError("every controller and row needs the same crystals, and at least one")
    for row, by_name in episodes.items():
        if against not in by_name:
            raise CzError(f"{against!r} took no part in {row!r}; choose from {', '.join(by_name)}")
    weights = Resamples.draw(next(iter(next(iter(episodes.values())).values())).shape[1])
    cells = []
    for row, by_name in episodes.items():
        for name, values in by_name.items():
            rmse, lost = means(values, weights)
            apart = differences(values, by_name[against], weights)[0]
            worst = float(values[:, :, 0].mean(axis=1).max())
            cells.append(Cell(row, name, len(values), rmse, lost, apart, worst))
    return cells


def to_markdown(cells: Sequence[Cell], against: str) -> str:
    """``table.md``: radius error and lost crystals; then the paired differences."""

    def error(cell: Cell) -> str:
        lost = f", {100.0 * cell.lost.mean:.1f} % lost" if cell.lost.mean else ""
        worst = f", worst seed {cell.worst:.3f}" if cell.seeds > 1 else ""
        return f"{cell.rmse.text('.3f')}{lost}{worst}"

    others = [cell for cell in cells if cell.controller != against]
    return f"""# Agents on other plants

RMSE of the radius [mm] on the first {cells[0].rmse.n} test crystals of each row, 95 % interval in brackets, and \
crystals lost; on {" and ".join(OBSERVABLE)} against the radius that sensors can show.

{_table(cells, error)}

The same less `{against}`'s, crystal by crystal [µm]; negative is better.

{_table(others, lambda cell: cell.apart.text("+.0f", MICRON))}
"""


def _table(cells: Sequence[Cell], tell: Callable[[Cell], str]) -> str:
    names = list(dict.fromkeys(cell.controller for cell in cells))
    told = {(cell.row, cell.controller): tell(cell) for cell in cells}
    rows = dict.fromkeys(cell.row for cell in cells)
    return table(("row", *names), ((row, *(told[row, name] for name in names)) for row in rows))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.generalisation", (__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path, help="a benchmark's folder, with its episodes.csv")
    parser.add_argument("--against", default="lqg-at-0.02", metavar="NAME", help="compared with (%(default)s)")
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    cells = tabulate(read_episodes(given.folder / EPISODES, figures), given.against)
    text = to_markdown(cells, given.against)
    write_files({given.folder / "table.md": text.encode()})
    print(text, end="")


if __name__ == "__main__":
    sys.exit(main())
