"""Logs of a puller: read from CSV with any names and units, onto a regular grid in SI units; and written from a run."""

from __future__ import annotations

import csv
import io
import math
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
from cz_gym.physics.parameters import Parameters
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
LONG_GAP = 2.0 * MINUTE
"""Gap [s] after which the filter begins anew."""
OUTLIER = 6.0
"""Readings of the ring so many robust deviations from their neighbours' median count as not valid."""


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
    pairs = []
    if file is not None:
        with naming(file):
            try:
                pairs = list(tomllib.loads(file.read_text(encoding="utf-8")).items())
            except tomllib.TOMLDecodeError as error:
                raise CzError(f"{file}: {error}") from None
    pairs += [tuple(text.partition("=")[::2]) for text in given]
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
    """Read a CSV file; CzError names the row and what is wrong with it.

    ``columns`` gives column and unit of standard names that the file calls otherwise (:func:`column_map`). Repeated
    times count once, with their last row; gaps and readings that are not valid, NaN or outliers of the ring stay NaN,
    and drives hold.
    """
    path = Path(path)
    with naming(path):
        text = path.read_text(encoding="utf-8-sig")
    head = text.partition("\n")[0]
    separator = max(",;\t", key=head.count)
    rows = list(csv.reader(io.StringIO(text), delimiter=separator))
    if not rows:
        raise CzError(f"{path}: the file is empty")
    header = [name.strip() for name in rows[0]]
    table: dict[str, Floats] = {}
    for index, name in enumerate(COLUMNS):
        column, unit = (columns or {}).get(name, (name, COLUMNS[name][1]))
        if column in header:
            table[name] = _numbers(path, rows, header.index(column), column, unit, separator)
            table[name] = table[name] + TEMPERATURE[unit] if unit in TEMPERATURE else table[name] * COLUMNS[name][0][unit]
        elif index < REQUIRED or name in (columns or {}):
            raise CzError(f"{path}: {unknown('column', column, header)}; --column {name}=COLUMN:UNIT says which it is")
    return _on_grid(path, table)


def _numbers(path: Path, rows: list[list[str]], at: int, column: str, unit: str, separator: str) -> Floats:
    """A column's numbers; an empty field and what reads as NaN are NaN."""
    values = np.full(len(rows) - 1, np.nan)
    for k, row in enumerate(rows[1:]):
        text = row[at].strip() if at < len(row) else ""
        try:
            if unit == "iso":
                values[k] = datetime.fromisoformat(text).timestamp()
            elif text:
                values[k] = float(text.replace(",", ".") if separator == ";" else text)
        except ValueError:
            if text.lower() not in ("null", "none", "na", "n/a", "-"):
                raise CzError(f"{path}, row {k + 2}: {column} = {text!r} is no {'time' if unit == 'iso' else 'number'}") from None
    return values


def _on_grid(path: Path, table: dict[str, Floats]) -> Log:
    """The table's rows at equal times, and what had to be done for it in words."""
    time = table["time_s"]
    for name in ("time_s", "pull_speed_mm_per_min", "heater_power_kW"):
        if len(time) and not np.isfinite(table[name][0] if name != "time_s" else time).all():
            row = 2 + int(np.argmin(np.isfinite(table[name])))
            raise CzError(f"{path}, row {row}: {name} is missing")
    step = np.diff(time)
    if (step < 0.0).any():
        row = int(np.argmax(step < 0.0)) + 3
        raise CzError(f"{path}, row {row}: time goes back by {-step[row - 3]:g} s; sort the rows by time")
    span = time[-1] - time[0] if len(time) else 0.0
    if span < SHORTEST or len(time) < FEWEST:
        raise CzError(f"{path}: {len(time)} rows over {span / MINUTE:.3g} min are too short: at least {FEWEST} rows over {SHORTEST / MINUTE:g} min are needed")
    interval = float(np.median(step[step > 0.0]))
    index = np.rint((time - time[0]) / interval).astype(int)
    n, last = index[-1] + 1, np.append(np.diff(index) > 0, True)
    if n > 50 * len(time):
        raise CzError(f"{path}: gaps make up nearly all of it; are its times in another unit?")
    missing = np.ones(n, np.bool_)
    missing[index] = False
    given = np.full((len(COLUMNS), n), np.nan)
    for row, name in enumerate(COLUMNS):
        if name in table:
            given[row, index[last]] = table[name][last]
    grid = dict(zip(COLUMNS, given, strict=True))
    for name in ("pull_speed_mm_per_min", "heater_power_kW", "r_ref_mm", "T_1_ref_K"):
        held = np.maximum.accumulate(np.where(np.isfinite(grid[name]), np.arange(n), 0))
        grid[name] = grid[name][held]
    ring = grid["ring_radius_mm"]
    invalid = (grid["valid"] < 0.5) & np.isfinite(ring) if "valid" in table else np.zeros(n, np.bool_)
    ring[invalid] = np.nan
    outliers = _outliers(ring)
    ring[outliers] = np.nan
    for name in ("ring_radius_mm", "T_1_K"):
        good = grid[name][np.isfinite(grid[name])]
        if len(good) < 0.3 * n:
            raise CzError(f"{path}: {name} has only {len(good)} good readings in {n} rows")
        if np.ptp(good) == 0.0:
            raise CzError(f"{path}: {name} is constant, so it says nothing")
    since = np.arange(n) - np.maximum.accumulate(np.where(missing, 0, np.arange(n)))
    gap = np.zeros(n, np.bool_)
    gap[1:] = ~missing[1:] & (since[:-1] * interval > LONG_GAP)
    counts = {
        "rows repeat a time": int(np.sum(~last)), "rows are missing": int(missing.sum()),
        "readings of the ring are not valid": int(invalid.sum()), "are outliers of the ring": int(outliers.sum()),
        "gaps are longer than 2 min": int(gap.sum()),
    }  # fmt: skip
    notes = tuple(f"{count} {what}" for what, count in counts.items() if count)
    drives = grid["pull_speed_mm_per_min"], grid["heater_power_kW"]
    return Log(interval * np.arange(n), ring, *drives, grid["T_1_K"], grid["r_ref_mm"], grid["T_1_ref_K"], gap, interval, notes)


def _outliers(ring: Floats) -> npt.NDArray[np.bool_]:
    """Readings far from the median of their eleven neighbours (Hampel's filter)."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(ring, 5, constant_values=np.nan), 11)
    with np.errstate(all="ignore"):
        away = np.abs(ring - np.where(np.isfinite(around).any(axis=1), np.nanmedian(np.where(np.isfinite(around).any(axis=1)[:, None], around, 0.0), axis=1), np.nan))
    return away > OUTLIER * max(1.4826 * float(np.nanmedian(away)), 1e-9)


def check_puller(log: Log, parameters: Parameters, ring_bias: float) -> None:
    """Raise CzError for a log in another unit than it says, or of another puller."""
    T_m = parameters.T_m
    for name, values, low, high in (
        ("ring_radius_mm", log.ring - ring_bias, 0.8 * parameters.r_0, 1.25 * parameters.r_0),
        ("pull_speed_mm_per_min", log.v_p, 0.4 * parameters.v_0, 2.5 * parameters.v_0),
        ("T_1_K", log.T_1, T_m, T_m + 800.0),
        ("heater_power_kW", log.Q_H, KILO, 1000.0 * KILO),
    ):
        units, own = COLUMNS[name]
        middle = float(np.nanmedian(values))
        if low <= middle <= high:
            continue
        shift = name == "T_1_K"
        fits = [u for u, f in units.items() if u != own and low <= (middle + f - units[own] if shift else middle * f / units[own]) <= high]
        meant = f"; is it in {fits[0]}? --column {name}=COLUMN:{fits[0].replace(' ', '_')}" if fits else "; is it another puller's log?"
        scale = 1.0 if shift else units[own]
        raise CzError(f"{name}: its median {middle / scale:.4g} lies outside {low / scale:.4g} to {high / scale:.4g} of this puller{meant}")


def record_log(env: Any, policy: Any, path: str | Path, seed: int | None = None) -> int:
    """Let a policy act for an episode of an environment made with ``info="all"``, and write its log; returns the rows."""
    v_0 = env.unwrapped.config.parameters.v_0
    observation, info = env.reset(seed=seed)
    if "r_br_measured" not in info:
        raise CzError('record_log needs an environment made with info="all"')
    lines, state, over, begins = [",".join(COLUMNS)], None, False, np.array([True])
    while True:
        seen = decode(observation, v_0)
        T_1 = info["T_1_ref"] - seen.T_1_ref + seen.T_1
        row = {
            "time_s": (len(lines) - 1) * env.unwrapped.config.control_interval, "ring_radius_mm": info["r_br_measured"] / MM,
            "pull_speed_mm_per_min": info["v_p"] / MM_PER_MIN, "heater_power_kW": info["Q_H"] / KILO, "T_1_K": T_1,
            "valid": seen.valid, "r_ref_mm": info["r_ref"] / MM, "T_1_ref_K": info["T_1_ref"],
        }  # fmt: skip
        lines.append(",".join(f"{row[name]:.10g}" for name in COLUMNS))
        if over:
            break
        action, state = policy.predict(observation, state, begins, deterministic=True)
        observation, _, terminated, truncated, info = env.step(np.asarray(action))
        over, begins = terminated or truncated, np.array([False])
    write_files({Path(path): ("\n".join(lines) + "\n").encode()})
    return len(lines) - 1
