"""Logs of a puller: read from CSV with any names and units, onto a regular grid in SI units; and written from a run."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.atomic_files import naming, write_files
from cz_gym.errors import CzError
from cz_gym.names import unknown
from cz_gym.observation import decode
from cz_gym.physics.plant import make_puller
from cz_gym.puller import Puller
from cz_gym.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

Floats = npt.NDArray[np.float64]
TIME = {"s": 1.0, "min": MINUTE, "h": HOUR, "iso": 1.0}
LENGTH = {"mm": MM, "cm": 10.0 * MM, "m": 1.0}
DIAMETER = {f"diameter {unit}": 0.5 * factor for unit, factor in LENGTH.items()}
SPEED = {"mm/min": MM_PER_MIN, "mm/h": MM / HOUR, "m/s": 1.0}
POWER = {"kW": KILO, "W": 1.0}
TEMPERATURE = {"K": 0.0, "degC": 273.15}
"""Units by kind: factors to SI, and for temperatures what is added."""
COLUMNS: dict[str, tuple[dict[str, float], str]] = {
    "time_s": (TIME, "s"),
    "ring_radius_mm": (LENGTH | DIAMETER, "mm"),
    "pull_speed_mm_per_min": (SPEED, "mm/min"),
    "heater_power_kW": (POWER, "kW"),
    "T_1_K": (TEMPERATURE, "K"),
    "valid": ({"1": 1.0}, "1"),
    "r_ref_mm": (LENGTH | DIAMETER, "mm"),
    "T_1_ref_K": (TEMPERATURE, "K"),
}
"""A log's columns, with the units that each may have and its own."""
REQUIRED = 5
"""The first columns, which a log must have."""
SHORTEST, FEWEST = 30.0 * MINUTE, 200
"""Least length [s] and number of rows of a log that says anything."""
ABSENT = ("", "nan", "null", "none", "na", "n/a", "-")
"""Fields that hold no number."""
LONG_GAP = 2.0 * MINUTE
"""Gap [s] after which the filter begins anew."""
OUTLIER, STEADY = 6.0, 0.02 * MM
"""Readings of the ring count as not valid so many robust deviations from their neighbours' median; a deviation is at
least STEADY [m]."""


class Log(NamedTuple):
    """A log on a regular grid, SI units; each of shape (rows,). Readings that are missing are NaN."""

    time: Floats
    """[s]"""
    ring: Floats
    """Radius of the bright ring as the camera gives it [m]."""
    v_p: Floats
    """Pull speed applied since the row before [m/s]."""
    Q_H: Floats
    """Heater power applied since the row before [W]."""
    T_1: Floats
    """Pyrometer [K]."""
    r_ref: Floats
    """Reference of the radius [m]; NaN if the log has none."""
    T_1_ref: Floats
    """Recipe of the pyrometer's temperature [K]; NaN if the log has none."""
    gap: npt.NDArray[np.bool_]
    """Whether the row is the first after a long gap."""
    interval: float
    """Time between rows [s]."""
    notes: tuple[str, ...] = ()
    """What was left out or filled, in words."""


def column_map(given: Sequence[str], file: Path | None = None) -> dict[str, tuple[str, str]]:
    """Names and units of a log's columns, by standard name, from ``NAME=COLUMN[:UNIT]`` and a TOML file.

    The file holds ``NAME = "COLUMN:UNIT"``. Raises CzError for names and units that there are not.
    """
    pairs: list[tuple[str, Any]] = []
    if file is not None:
        with naming(file):
            try:
                pairs = list(tomllib.loads(file.read_text(encoding="utf-8")).items())
            except tomllib.TOMLDecodeError as error:
                raise CzError(f"{file}: {error}") from None
    pairs += [(text.partition("=")[0], text.partition("=")[2]) for text in given]
    found = {}
    for name, text in pairs:
        if name not in COLUMNS:
            raise CzError(unknown("column", name, COLUMNS))
        column, colon, unit = str(text).rpartition(":")
        units, own = COLUMNS[name]
        if colon and unit not in units:
            raise CzError(unknown(f"unit of {name}", unit, units))
        found[name] = (column, unit) if colon else (unit, own)
        if not found[name][0]:
            raise CzError(f"{name}: say which column it is, as {name}=COLUMN:{own}")
    return found


def read_log(path: str | Path, columns: Mapping[str, tuple[str, str]] | None = None) -> Log:
    """Read a CSV or Parquet file; CzError names the row and what is wrong with it.

    ``columns`` gives column and unit of standard names that the file calls otherwise (:func:`column_map`). Repeated
    times count once, with their last row. Readings that are absent, not valid or outliers of the ring become NaN, and
    drives hold.
    """
    header, rows, decimal = _fields(Path(path))
    table: dict[str, Floats] = {}
    try:
        for index, (name, (units, own)) in enumerate(COLUMNS.items()):
            column, unit = (columns or {}).get(name, (name, own))
            if column in header:
                values = _numbers(rows, header.index(column), column, unit, decimal)
                table[name] = values + units[unit] if units is TEMPERATURE else values * units[unit]
            elif index < REQUIRED or name in (columns or {}):
                raise CzError(f"{unknown('column', column, header)}; {name}=COLUMN:{own} says which one it is")
        _check_rows(table)
        return _on_grid(table)
    except CzError as error:
        raise CzError(f"{path}: {error}") from None


def _fields(path: Path) -> tuple[list[str], list[list[str]], str]:
    """Header, fields and decimal sign of a file."""
    with naming(path):
        if path.suffix == ".parquet":
            try:
                import pandas

                frame = pandas.read_parquet(path)
            except ImportError as error:
                raise CzError(f"{path}: Parquet needs pandas and pyarrow, CSV does not ({error})") from None
            return list(map(str, frame.columns)), frame.astype(str).to_numpy().tolist(), "."
        text = path.read_text(encoding="utf-8-sig")
    separator = max(",;\t", key=text.partition("\n")[0].count)
    table = [
        [field.strip() for field in row] for row in csv.reader(text.rstrip().splitlines(), delimiter=separator)
    ] or [[]]
    return table[0], table[1:], "," if separator == ";" else "."


def _numbers(rows: list[list[str]], at: int, column: str, unit: str, decimal: str) -> Floats:
    """A column's numbers; an empty field is NaN."""
    values = np.full(len(rows), np.nan)
    for k, row in enumerate(rows):
        text = row[at] if at < len(row) else ""
        try:
            if unit == "iso":
                values[k] = datetime.fromisoformat(text).timestamp()
            elif text.lower() not in ABSENT:
                values[k] = float(text.replace(decimal, "."))
        except ValueError:
            raise CzError(f"row {k + 2}: {column} = {text!r} is no {'time' if unit == 'iso' else 'number'}") from None
    return values


def _check_rows(table: dict[str, Floats]) -> None:
    """Raise CzError for times that are absent or go back, drives without a first value, and a log that is too short."""
    time = table["time_s"]
    if not np.isfinite(time).all():
        raise CzError(f"row {2 + int(np.argmin(np.isfinite(time)))}: the time is missing")
    if len(time) < FEWEST or 0.0 <= time[-1] - time[0] < SHORTEST:
        raise CzError(
            f"{len(time)} rows over {np.ptp(time) / MINUTE if len(time) else 0.0:.3g} min are too short a log: "
            f"it needs {FEWEST} rows and {SHORTEST / MINUTE:g} min"
        )
    back = np.diff(time) < 0.0
    if back.any():
        row = int(np.argmax(back)) + 1
        raise CzError(f"row {row + 2}: time goes back by {time[row - 1] - time[row]:g} s; sort the rows by time")
    for name in ("pull_speed_mm_per_min", "heater_power_kW"):
        if not np.isfinite(table[name][0]):
            raise CzError(f"row 2: {name} is missing")


def _on_grid(table: dict[str, Floats]) -> Log:
    """The table's rows at equal times, and what was left out or filled."""
    time = table["time_s"]
    interval = float(np.median(np.diff(np.unique(time))))
    index = np.rint((time - time[0]) / interval).astype(int)
    n, last = int(index[-1]) + 1, np.append(np.diff(index) > 0, True)
    if n > 50 * len(time):
        raise CzError("nearly all of it are gaps: are its times in another unit?")
    present = np.zeros(n, np.bool_)
    present[index] = True
    rows = np.arange(n)

    def at_grid(name: str, held: bool = False) -> Floats:
        values = np.full(n, np.nan)
        if name in table:
            values[index[last]] = table[name][last]
        return values[np.maximum.accumulate(np.where(np.isfinite(values), rows, 0))] if held else values

    ring, T_1 = at_grid("ring_radius_mm"), at_grid("T_1_K")
    invalid = np.isfinite(ring) & (at_grid("valid") < 0.5)
    ring[invalid] = np.nan
    outlier = _outliers(ring)
    ring[outlier] = np.nan
    for name, values in (("ring_radius_mm", ring), ("T_1_K", T_1)):
        good = values[np.isfinite(values)]
        if len(good) < 0.3 * n:
            raise CzError(f"{name} has only {len(good)} good readings in {n} rows")
        if np.ptp(good) == 0.0:
            raise CzError(f"{name} is constant, so it tells nothing")
    seen = np.maximum.accumulate(np.where(present, rows, 0))
    gap = np.diff(seen, prepend=0) * interval > LONG_GAP
    counts = {
        "rows repeat a time": len(time) - int(last.sum()),
        "rows are missing": n - int(present.sum()),
        f"gaps are longer than {LONG_GAP:g} s": int(gap.sum()),
        "readings of the ring are not valid": int(invalid.sum()),
        "readings of the ring are outliers": int(outlier.sum()),
    }
    held = (at_grid(name, held=True) for name in ("pull_speed_mm_per_min", "heater_power_kW", "r_ref_mm", "T_1_ref_K"))
    v_p, Q_H, r_ref, T_1_ref = held
    notes = tuple(f"{count} {what}" for what, count in counts.items() if count)
    return Log(interval * np.arange(n, dtype=np.float64), ring, v_p, Q_H, T_1, r_ref, T_1_ref, gap, interval, notes)


def _outliers(ring: Floats) -> npt.NDArray[np.bool_]:
    """The readings that are far from the median of the eleven around them (Hampel's filter)."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(ring, 5, constant_values=np.nan), 11)
    known = np.isfinite(ring)
    if not known.any():
        return known
    away = np.zeros(len(ring))
    away[known] = np.abs(ring[known] - np.nanmedian(around[known], axis=1))
    found: npt.NDArray[np.bool_] = away > OUTLIER * max(1.4826 * float(np.median(away[known])), STEADY)
    return found


def check_puller(log: Log, machine: Puller) -> None:
    """Raise CzError for a log in other units than it says, or of another puller."""
    puller = make_puller(machine.parameters)
    for name, values, low, high in (
        ("ring_radius_mm", log.ring - puller.ring_bias, 0.8 * puller.r_0, 1.25 * puller.r_0),
        ("pull_speed_mm_per_min", log.v_p, 0.4 * puller.v_0, 2.5 * puller.v_0),
        ("T_1_K", log.T_1, puller.T_m, puller.T_m + 800.0),
        ("heater_power_kW", log.Q_H, 0.25 * puller.Q_H_0, 4.0 * puller.Q_H_0),
    ):
        units, own = COLUMNS[name]
        middle = float(np.nanmedian(values))
        if low <= middle <= high:
            continue
        added = units is TEMPERATURE
        as_read = {unit: middle + f - units[own] if added else middle * f / units[own] for unit, f in units.items()}
        meant = [unit for unit, value in as_read.items() if low <= value <= high]
        guess = f'did you mean {name}="COLUMN:{meant[0]}"' if meant else "is it another puller's log"
        middle, low, high = (value if added else value / units[own] for value in (middle, low, high))
        raise CzError(f"{name} is {middle:.4g} in the middle, this puller's is {low:.4g} to {high:.4g}: {guess}?")


def record_log(env: Any, policy: Any, path: str | Path, seed: int | None = None) -> int:
    """Run a policy for an episode of an environment made with ``info="all"``, and write its log; return the rows."""
    config = env.unwrapped.config
    observation, info = env.reset(seed=seed)
    if "r_br_measured" not in info:
        raise CzError('record_log needs an environment made with info="all"')
    lines, state, over = [",".join(COLUMNS)], None, False
    while True:
        seen = decode(observation, config.parameters.v_0)
        row = (
            (len(lines) - 1) * config.control_interval,
            info["r_br_measured"] / MM,
            info["v_p"] / MM_PER_MIN,
            info["Q_H"] / KILO,
            info["T_1_ref"] - seen.T_1_ref + seen.T_1,
            seen.valid,
            info["r_ref"] / MM,
            info["T_1_ref"],
        )
        lines.append(",".join(f"{value:.10g}" for value in row))
        if over:
            break
        action, state = policy.predict(observation, state, np.array([state is None]), deterministic=True)
        observation, _, terminated, truncated, info = env.step(np.asarray(action))
        over = terminated or truncated
    write_files({Path(path): ("\n".join(lines) + "\n").encode()})
    return len(lines) - 1
