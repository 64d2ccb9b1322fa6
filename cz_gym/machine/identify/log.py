"""Logs of a puller: read from CSV or Parquet with any names and units, onto a regular grid in SI units; and written."""

from __future__ import annotations

import io
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.plant import make_puller
from cz_gym.errors import CzError
from cz_gym.machine.puller import PullerFile
from cz_gym.observation import decode
from cz_gym.support.atomic_files import naming, write_files
from cz_gym.support.names import unknown
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

Floats = npt.NDArray[np.float64]
TIME = {"s": 1.0, "min": MINUTE, "h": HOUR, "iso": 1.0}
LENGTH = {"mm": MM, "cm": 10.0 * MM, "m": 1.0}
RADIUS = LENGTH | {f"diameter {unit}": 0.5 * factor for unit, factor in LENGTH.items()}
SPEED = {"mm/min": MM_PER_MIN, "mm/h": MM / HOUR, "m/s": 1.0}
POWER = {"kW": KILO, "W": 1.0}
TEMPERATURE = {"K": 0.0, "degC": 273.15}
"""Units by kind: factors to SI, and for temperatures what is added."""
COLUMNS: dict[str, dict[str, float]] = {
    "time_s": TIME,
    "ring_radius_mm": RADIUS,
    "pull_speed_mm_per_min": SPEED,
    "heater_power_kW": POWER,
    "T_1_K": TEMPERATURE,
    "valid": {"1": 1.0},
    "r_ref_mm": RADIUS,
    "T_1_ref_K": TEMPERATURE,
}
"""A log's columns, with the units that each may have; the first is its own."""
REQUIRED = tuple(COLUMNS)[:5]
"""The columns that a log must have."""
DRIVES = "pull_speed_mm_per_min", "heater_power_kW"
SHORTEST, FEWEST = 30.0 * MINUTE, 200
"""Least length [s] and number of rows of a log that says anything."""
ABSENT = ("", "nan", "null", "none", "na", "n/a", "-", "<na>", "nat")
"""Fields that hold no number."""
LONG_GAP = 2.0 * MINUTE
"""Gap [s] after which the filter begins anew."""
NEIGHBOURS, OUTLIER, STEADY = 11, 6.0, 0.02 * MM
"""Readings of the ring count as not valid so many robust deviations from their neighbours' median (Hampel's filter); a
deviation is at least STEADY [m]."""


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
    columns = {}
    for name, text in pairs:
        if name not in COLUMNS:
            raise CzError(unknown("column", name, COLUMNS))
        own = next(iter(COLUMNS[name]))
        column, colon, unit = str(text).rpartition(":")
        if colon and unit not in COLUMNS[name]:
            raise CzError(unknown(f"unit of {name}", unit, COLUMNS[name]))
        columns[name] = (column, unit) if colon else (unit, own)
        if not columns[name][0]:
            raise CzError(f"{name}: say which column it is, as {name}=COLUMN:{own}")
    return columns


def read_log(path: str | Path, columns: Mapping[str, tuple[str, str]] | None = None) -> Log:
    """Read a CSV or Parquet file; CzError names the row and what is wrong with it.

    ``columns`` gives column and unit of standard names that the file calls otherwise (:func:`column_map`). Repeated
    times count once, with their last row. Readings that are absent, not valid or outliers of the ring become NaN, and
    drives hold.
    """
    import pandas

    try:
        with naming(path):
            file, decimal = _text_table(Path(path))
        table = pandas.DataFrame(index=file.index, columns=list(COLUMNS), dtype=float)
        for name, units in COLUMNS.items():
            own = next(iter(units))
            column, unit = (columns or {}).get(name, (name, own))
            if column in file:
                values = _numbers(file[column], unit, decimal)
                table[name] = values + units[unit] if units is TEMPERATURE else values * units[unit]
            elif name in REQUIRED or name in (columns or {}):
                raise CzError(f"{unknown('column', column, file)}; {name}=COLUMN:{own} says which one it is")
        _check_rows(table)
        return _on_grid(table)
    except CzError as error:
        raise CzError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


def _text_table(path: Path) -> tuple[Any, str]:
    """A file's fields as text, and its decimal sign."""
    import pandas

    try:
        if path.suffix == ".parquet":
            return pandas.read_parquet(path).reset_index(drop=True).astype(str), "."
        text = path.read_text(encoding="utf-8-sig").rstrip()
        separator = max(",;\t", key=text.partition("\n")[0].count)
        asked: Any = {"dtype": str, "keep_default_na": False, "skip_blank_lines": False, "index_col": False}
        table = pandas.read_csv(io.StringIO(text), sep=separator, **asked)
    except UnicodeDecodeError:
        raise
    except ValueError as error:  # an empty file, or rows of another length
        raise CzError(" ".join(str(error).split())) from None
    return table.rename(columns=str.strip), "," if separator == ";" else "."


def _numbers(column: Any, unit: str, decimal: str) -> Any:
    """A column's numbers; an absent one is NaN."""
    import pandas

    text = column.fillna("").str.strip()
    absent = text.str.lower().isin(ABSENT)
    if unit == "iso":
        times = pandas.to_datetime(text, format="ISO8601", utc=True, errors="coerce")
        numbers = (times - times.min()).dt.total_seconds()
    else:
        plain = text.str.replace(decimal, ".", regex=False).replace({"True": "1", "False": "0"})
        numbers = pandas.to_numeric(plain.mask(absent), errors="coerce").astype(float)
    wrong = numbers.isna() & ~absent
    if wrong.any():
        row, kind = int(wrong.argmax()), "time" if unit == "iso" else "number"
        raise CzError(f"row {row + 2}: {column.name} = {text[row]!r} is no {kind}")
    return numbers


def _check_rows(table: Any) -> None:
    """Raise CzError for times that are absent or go back, drives without a first value, and a log that is too short."""
    time = table["time_s"].to_numpy()
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
    for name in DRIVES:
        if not np.isfinite(table[name][0]):
            raise CzError(f"row 2: {name} is missing")


def _on_grid(table: Any) -> Log:
    """The table's rows at equal times, and what was left out or filled."""
    time = table["time_s"]
    interval = float(time.drop_duplicates().diff().median())
    index = np.rint((time - time[0]) / interval).astype(int)
    n, last = int(index.iloc[-1]) + 1, ~index.duplicated(keep="last")
    if n > 50 * len(time):
        raise CzError("nearly all of it are gaps: are its times in another unit?")
    present = index[last].to_numpy()
    grid = table[last].set_axis(present).reindex(range(n))
    ring, T_1 = grid["ring_radius_mm"], grid["T_1_K"]
    invalid = ring.notna() & (grid["valid"] < 0.5)
    ring = ring.mask(invalid)
    away = (ring - ring.rolling(NEIGHBOURS, center=True, min_periods=1).median()).abs()
    outlier = away > OUTLIER * max(1.4826 * away.median(), STEADY)
    ring = ring.mask(outlier)
    for name, values in (("ring_radius_mm", ring), ("T_1_K", T_1)):
        if values.count() < 0.3 * n:
            raise CzError(f"{name} has only {values.count()} good readings in {n} rows")
        if values.min() == values.max():
            raise CzError(f"{name} is constant, so it tells nothing")
    after_gap = present[1:][np.diff(present) * interval > LONG_GAP]
    counts = {
        "rows repeat a time": len(time) - len(present),
        "rows are missing": n - len(present),
        f"gaps are longer than {LONG_GAP:g} s": len(after_gap),
        "readings of the ring are not valid": int(invalid.sum()),
        "readings of the ring are outliers": int(outlier.sum()),
    }
    held = grid[[*DRIVES, "r_ref_mm", "T_1_ref_K"]].ffill()
    v_p, Q_H, r_ref, T_1_ref = (np.array(held[name], np.float64) for name in held)
    gap, notes = np.isin(np.arange(n), after_gap), tuple(f"{count} {what}" for what, count in counts.items() if count)
    readings = np.array(ring), v_p, Q_H, np.array(T_1), r_ref, T_1_ref
    return Log(interval * np.arange(n, dtype=np.float64), *readings, gap, interval, notes)


def check_puller(log: Log, machine: PullerFile) -> None:
    """Raise CzError for a log in other units than it says, or of another puller."""
    puller = make_puller(machine.parameters)
    for name, values, low, high in (
        ("ring_radius_mm", log.ring - puller.ring_bias, 0.8 * puller.r_0, 1.25 * puller.r_0),
        ("pull_speed_mm_per_min", log.v_p, 0.4 * puller.v_0, 2.5 * puller.v_0),
        ("T_1_K", log.T_1, puller.T_m, puller.T_m + 800.0),
        ("heater_power_kW", log.Q_H, 0.25 * puller.Q_H_0, 4.0 * puller.Q_H_0),
    ):
        middle, units = float(np.nanmedian(values)), COLUMNS[name]
        if low <= middle <= high:
            continue
        own, added = next(iter(units.values())), units is TEMPERATURE
        as_read = {unit: middle + f - own if added else middle * f / own for unit, f in units.items()}
        meant = [unit for unit, value in as_read.items() if low <= value <= high]
        guess = f'did you mean {name}="COLUMN:{meant[0]}"' if meant else "is it another puller's log"
        middle, low, high = (value if added else value / own for value in (middle, low, high))
        raise CzError(f"{name} is {middle:.4g} in the middle, this puller's is {low:.4g} to {high:.4g}: {guess}?")


def record_log(env: Any, policy: Any, path: str | Path, seed: int | None = None) -> int:
    """Run a policy for an episode of an environment made with ``info="all"``; write its log, CSV or Parquet by the
    file's ending; return the rows.
    """
    import pandas

    config, rows, state, over = env.unwrapped.config, list[tuple[float, ...]](), None, False
    observation, info = env.reset(seed=seed)
    if "r_br_measured" not in info:
        raise CzError('record_log needs an environment made with info="all"')
    while True:
        seen, time = decode(observation, config.parameters.v_0), len(rows) * config.control_interval
        drives, T_1 = (info["v_p"] / MM_PER_MIN, info["Q_H"] / KILO), info["T_1_ref"] - seen.T_1_ref + seen.T_1
        ring, r_ref = info["r_br_measured"] / MM, info["r_ref"] / MM
        rows.append((time, ring, *drives, T_1, seen.valid, r_ref, info["T_1_ref"]))
        if over:
            break
        action, state = policy.predict(observation, state, np.array([state is None]), deterministic=True)
        observation, _, terminated, truncated, info = env.step(np.asarray(action))
        over = terminated or truncated
    table, path = pandas.DataFrame(rows, columns=list(COLUMNS)), Path(path)
    parquet = path.suffix == ".parquet"
    text = table.to_parquet(index=False) if parquet else table.to_csv(index=False, float_format="%.10g").encode()
    write_files({path: text})
    return len(rows)
