"""Series of disturbances from logs: a CSV file that ``cz-gym identify LOG --series FILE.csv`` writes, as a scenario.

Each episode meets one of its series, drawn by the seed: the heat load on the melt and the fluctuation of the interface
temperature stand in place of drawn ones. The sensors' noise is that of ``randomized``, or the puller file's.
"""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.errors import CzError

from .mixture import Distribution, make_mixture
from .scenario import GRID, Pullers, Scenario, Sensor

Floats = npt.NDArray[np.float64]
COLUMNS = "series", "time_s", "load_W", "fluctuation_K"
MIX = 0.5
"""Share of conduction that an identification assumes where a log does not tell it [-]."""


def to_csv(series: Sequence[tuple[Floats, Floats, Floats]]) -> str:
    """The text of a file: of each series its times [s], loads [W] and fluctuations [K], each of shape (rows,)."""
    rows = [f"{k},{t:.10g},{q:.8g},{d:.8g}" for k, each in enumerate(series) for t, q, d in zip(*each, strict=True)]
    return "\n".join([",".join(COLUMNS), *rows, ""])


def read_series(path: Path, sensor: Sensor) -> Distribution:
    """The scenario of a file, a mixture if it holds several series; CzError for what is none."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            table = list(csv.DictReader(file))
        numbers = np.array([[float(row[name]) for name in COLUMNS] for row in table])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CzError(f"scenario {path}: must be a CSV file with columns {', '.join(COLUMNS)}: {error!r:.80}") from None
    if not len(numbers) or not np.isfinite(numbers).all():
        raise CzError(f"scenario {path}: every row needs four finite numbers, and there must be one")
    names = np.unique(numbers[:, 0])
    each = [_on_grid(numbers[numbers[:, 0] == name, 1:], path) for name in names]
    scenarios = [
        Scenario(
            path.stem if len(each) == 1 else f"{path.stem}-{name:g}", Pullers(mix=(MIX, MIX)), sensor=sensor, series=one
        )
        for name, one in zip(names, each, strict=True)
    ]
    return scenarios[0] if len(scenarios) == 1 else make_mixture([(one, 1.0) for one in scenarios])


def _on_grid(rows: Floats, path: Path) -> tuple[tuple[float, float], ...]:
    """Load and fluctuation of rows (time, load, fluctuation), straight between them, on the grid."""
    time = rows[:, 0]
    if (np.diff(time) <= 0.0).any() or time[0] < 0.0:
        raise CzError(f"scenario {path}: the times of a series must begin at 0 or later, and grow")
    at = GRID * np.arange(int(time[-1] / GRID) + 1)
    return tuple(zip(*(np.interp(at, time, column).tolist() for column in rows[:, 1:].T), strict=True))


def series_table(scenarios: Sequence[Scenario]) -> Any:
    """The series of scenarios as an array for the compiled loops, shape (scenarios, points, 2); no points: none."""
    points = max(len(each.series) for each in scenarios)
    table = np.full((len(scenarios), points, 2), np.nan)
    for row, each in zip(table, scenarios, strict=True):
        if each.series:
            row[:] = [*each.series, *[each.series[-1]] * (points - len(each.series))]
    return table
