"""Fields of a CSV or Parquet file: their encoding, separators, decimal signs and times, and the units of a log."""

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.errors import CzError
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

Units = dict[str, tuple[float, float]]
"""Units of a column: the factor to SI, and what is added then."""
INCH, DAY = 25.4 * MM, 24.0 * HOUR
DATED = {"iso": "2026-03-01 12:00:05", "dmy": "01.03.2026 12:00:05", "mdy": "03/01/2026 12:00:05", "clock": "12:00:05"}
"""Times that are no numbers, each with an example; ``clock``, the time of day, may run over midnight."""
TIME: Units = {name: (size, 0.0) for name, size in (("s", 1.0), ("min", MINUTE), ("h", HOUR), ("ms", 1e-3))}
TIME |= dict.fromkeys(DATED, (1.0, 0.0))
LENGTH = {"mm": MM, "cm": 10.0 * MM, "m": 1.0, "in": INCH}
RADIUS: Units = {unit: (size, 0.0) for unit, size in LENGTH.items()}
RADIUS |= {f"diameter {unit}": (0.5 * size, 0.0) for unit, size in LENGTH.items()}
SPEED: Units = {"mm/min": (MM_PER_MIN, 0.0), "mm/h": (MM / HOUR, 0.0), "m/s": (1.0, 0.0), "in/h": (INCH / HOUR, 0.0)}
POWER: Units = {"kW": (KILO, 0.0), "W": (1.0, 0.0)}
TEMPERATURE: Units = {"K": (1.0, 0.0), "degC": (1.0, 273.15), "degF": (1.0 / 1.8, 459.67 / 1.8)}
COLUMNS: dict[str, Units] = {
    "time_s": TIME,
    "ring_radius_mm": RADIUS,
    "pull_speed_mm_per_min": SPEED,
    "heater_power_kW": POWER,
    "T_1_K": TEMPERATURE,
    "valid": {"1": (1.0, 0.0)},
    "r_ref_mm": RADIUS,
    "T_1_ref_K": TEMPERATURE,
}
"""A log's columns, with the units that each may have; the first is its own."""
REQUIRED = tuple(COLUMNS)[:5]
"""The columns that a log must have."""
DRIVES = "pull_speed_mm_per_min", "heater_power_kW"
ABSENT = ("", "nan", "null", "none", "na", "n/a", "#n/a", "-", "--", "---", "<na>", "nat")
"""Fields that hold no number."""
TOP = 100
"""Lines of a file among which its columns are named."""


def text_table(path: Path, wanted: set[str]) -> tuple[Any, int]:
    """A file's fields as text, and the line of its first row."""
    import pandas

    try:
        if path.suffix == ".parquet":
            return pandas.read_parquet(path).reset_index(drop=True).astype(str), 2
        lines = _decoded(path.read_bytes()).rstrip().splitlines()
        wanted |= {part for name in wanted for part in name.split("+")}
        places = [(n, separator) for n in range(min(len(lines), TOP)) for separator in ",;\t|"]

        def matches(place: tuple[int, str]) -> tuple[int, int]:
            fields = _fields(lines[place[0]], place[1])
            return len(wanted & set(fields)), len(fields)

        top, separator = max(places, key=matches, default=(0, ","))
        asked: Any = {"dtype": str, "keep_default_na": False, "skip_blank_lines": False, "index_col": False}
        table = pandas.read_csv(io.StringIO("\n".join(lines[top:])), sep=separator, **asked)
        names = _fields(lines[top], separator)
        return table.set_axis(names[: table.shape[1]], axis=1), top + 2
    except ValueError as error:  # an empty file, or rows of another length
        raise CzError(" ".join(str(error).split())) from None


def _decoded(raw: bytes) -> str:
    text = raw.decode("utf-16") if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else ""
    try:
        text = text or raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    if "\0" in text:
        raise CzError("not a text file")
    return text


def _fields(line: str, separator: str) -> list[str]:
    return [field.strip() for field in next(csv.reader([line], delimiter=separator), [])]


def times(column: Any, unit: str, line: int, notes: dict[str, int]) -> tuple[Any, int]:
    """Times [s] of the rows from the first to the last one that has a time, and the number of rows before."""
    text = column.fillna("").str.strip()
    times, absent = _read_times(text, unit), text.str.lower().isin(ABSENT)
    good = np.flatnonzero(times.notna())
    if not len(good):
        row = int((~absent).argmax()) if len(text) else 0
        meant = [other for other in TIME if len(text) and np.isfinite(_read_times(text[[row]], other)).all()]
        hint = f": did you mean time_s={column.name}:{meant[0]}?" if meant else ""
        raise CzError(f"row {row + line}: {column.name} = {text.get(row, '')!r} is no time in {unit}{hint}")
    first, end = int(good[0]), int(good[-1]) + 1
    notes["rows above or below the table have no time"] = first + len(text) - end
    inside = times.iloc[first:end]
    if inside.isna().any():
        row = int(inside.isna().argmax()) + first
        what = "the time is missing" if absent[row] else f"{column.name} = {text[row]!r} is no time in {unit}"
        raise CzError(f"row {row + line}: {what}")
    if unit in DATED:
        step = inside.diff()
        inside = inside + DAY * (step < -0.5 * DAY).cumsum() * (unit == "clock")
        again = (step > -HOUR) & (step <= -0.9 * HOUR)
        notes["hours are repeated, as at the end of summer time: the times below are an hour later"] = int(again.sum())
        inside = inside + HOUR * again.cumsum()
    return inside, first


def _read_times(text: Any, unit: str) -> Any:
    """Times [s]; NaN where a field is none."""
    import pandas

    factor, _ = TIME[unit]
    if unit == "clock":
        whole = text.str.replace(r"^\d+:\d+$", r"\g<0>:00", regex=True).str.replace(",", ".")
        only = whole.where(whole.str.match(r"\d+:\d+:\d+(\.\d+)?$"))
        return pandas.to_timedelta(only, errors="coerce").dt.total_seconds()
    if unit not in DATED:
        return pandas.to_numeric(_plain(text), errors="coerce").astype(float) * factor
    plain = text.where(text.str.contains(r"\d[-./]\d")).str.replace(r",(\d+)$", r".\1", regex=True)
    how: Any = {"format": "ISO8601"} if unit == "iso" else {"format": "mixed", "dayfirst": unit == "dmy"}
    times = pandas.to_datetime(plain, utc=True, errors="coerce", **how)
    return (times - pandas.Timestamp(0, tz="utc")).dt.total_seconds()


def _plain(text: Any) -> Any:
    """Numbers with a decimal point and nothing between thousands; where a field has both signs, the last is decimal."""
    text = text.str.replace(r"(?<=\d)[\s'](?=\d)", "", regex=True)
    both = text.str.extract(r"([.,]).*([.,])")
    both = both[both[0] != both[1]].dropna()
    if len(both):
        text = text.str.replace(both[0].iloc[0], "", regex=False)
    return text.str.replace(",", ".", regex=False).replace({"True": "1", "False": "0"})


def numbers(column: Any, line: int) -> Any:
    """A column's numbers; an absent one is NaN."""
    import pandas

    text = column.fillna("").str.strip()
    absent = text.str.lower().isin(ABSENT)
    numbers = pandas.to_numeric(_plain(text).mask(absent), errors="coerce").astype(float)
    wrong = numbers.isna() & ~absent
    if wrong.any():
        row = wrong.idxmax()
        raise CzError(f"row {row + line}: {column.name} = {text[row]!r} is no number")
    return numbers
