"""Log of a puller: read from CSV or Parquet with any names and units, put on a regular grid, written.

Fields are read as text, because a line about a wrong one names its row and column as the file has them; pandas' own
conversion of a column would tell neither. The grid follows the times of the rows slowly, as a clock drifts: pandas'
``merge_asof`` on equal times would lose one reading in twelve of a log whose clock drifts by 0.1 %.
"""

import csv
import io
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.physics.plant import make_puller
from cz_gym.puller.file import PullerFile
from cz_gym.spaces import decode
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.files import name_file_in_errors, write_files
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
"""Columns of a log, with the units that each may have; the first is its own."""
REQUIRED = tuple(COLUMNS)[:5]
"""Columns that a log must have."""
DRIVES = "pull_speed_mm_per_min", "heater_power_kW"
ABSENT = ("", "nan", "null", "none", "na", "n/a", "#n/a", "-", "--", "---", "<na>", "nat")
"""Fields that hold no number."""
TOP = 100
"""Lines of a file among which its columns are named."""


def read_fields(path: Path, wanted: set[str]) -> tuple[Any, int]:
    """Read a file's fields as text, and the line of its first row; the line above names most of the ``wanted`` columns.

    CzError for a file that is no table.
    """
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


def parse_times(column: Any, unit: str, line: int, notes: dict[str, int]) -> tuple[Any, int]:
    """Parse times [s] from the first to the last row that has one, and count the rows before; CzError names a row."""
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
    """Parse times [s]; NaN where a field is none."""
    import pandas

    factor, _ = TIME[unit]
    if unit == "clock":
        whole = text.str.replace(r"^\d+:\d+$", r"\g<0>:00", regex=True).str.replace(",", ".")
        only = whole.where(whole.str.match(r"\d+:\d+:\d+(\.\d+)?$"))
        return pandas.to_timedelta(only, errors="coerce").dt.total_seconds()
    if unit not in DATED:
        return pandas.to_numeric(_plain_numbers(text), errors="coerce").astype(float) * factor
    plain = text.where(text.str.contains(r"\d[-./]\d")).str.replace(r",(\d+)$", r".\1", regex=True)
    how: Any = {"format": "ISO8601"} if unit == "iso" else {"format": "mixed", "dayfirst": unit == "dmy"}
    times = pandas.to_datetime(plain, utc=True, errors="coerce", **how)
    return (times - pandas.Timestamp(0, tz="utc")).dt.total_seconds()


def _plain_numbers(text: Any) -> Any:
    """Write numbers with a decimal point and nothing between thousands; of two signs in a field the last is decimal."""
    text = text.str.replace(r"(?<=\d)[\s'](?=\d)", "", regex=True)
    both = text.str.extract(r"([.,]).*([.,])")
    both = both[both[0] != both[1]].dropna()
    if len(both):
        text = text.str.replace(both[0].iloc[0], "", regex=False)
    return text.str.replace(",", ".", regex=False).replace({"True": "1", "False": "0"})


def parse_numbers(column: Any, line: int) -> Any:
    """Parse a column's numbers; an absent one is NaN. CzError names the row of a field that is none."""
    import pandas

    text = column.fillna("").str.strip()
    absent = text.str.lower().isin(ABSENT)
    numbers = pandas.to_numeric(_plain_numbers(text).mask(absent), errors="coerce").astype(float)
    wrong = numbers.isna() & ~absent
    if wrong.any():
        row = wrong.idxmax()
        raise CzError(f"row {row + line}: {column.name} = {text[row]!r} is no number")
    return numbers


# Rows at equal times, without outliers; notes of what was left out or filled.

Floats = npt.NDArray[np.float64]
SHORTEST, FEWEST = 30.0 * MINUTE, 200
"""Least length [s] and number of rows of a log that says anything."""
INTERVALS = 0.05, 120.0
"""Shortest and longest time between rows [s]."""
LONG_GAP = 20.0
"""Gap [s] after which the filter begins anew."""
OUTLIERS = {
    "ring_radius_mm": (11, 6.0, 0.02 * MM, 0.0),
    "T_1_K": (11, 6.0, 1.0, 0.0),
    "pull_speed_mm_per_min": (5, 6.0, 0.0, 0.3),
    "heater_power_kW": (5, 6.0, 0.0, 0.3),
}
"""Hampel's filter of each column: number of neighbours, threshold in robust deviations from their median, and the
least deviation that counts, in the column's SI unit and as a share of its median. A drive's step is no outlier, because
half of its neighbours have made it."""
THIN = 11.0
"""Longest time between the rows that are estimated from, where the log's own are closer [s]."""
ABSURD = 2.0
"""Readings of ring and pyrometer that differ from their median by more than this factor are outliers too."""


class Log(NamedTuple):
    """Log on a regular grid, SI units; arrays of shape (rows,). Readings that are missing are NaN."""

    time: Floats
    """Times of the rows [s]."""
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
    """True in the first row after a long gap."""
    unsure: Floats
    """Standard deviations of pull speed [m/s] and power [W] in rows that do not have them, shape (rows, 2); else 0."""
    interval: float
    """Time between rows [s]."""
    notes: tuple[str, ...] = ()
    """Notes of what was left out or filled, in words."""
    mean_of: int = 1
    """Number of the sensors' readings that a row's are the means of."""


def sound_rows(table: Any, line: int, notes: dict[str, int]) -> Any:
    """Select the rows from the first one with both drives on, one a time; CzError for times that go back, and for too
    short a log.
    """
    time = table["time_s"].to_numpy()
    back = np.diff(time) < 0.0
    if back.any():
        row = int(np.argmax(back)) + 1
        raise CzError(f"row {row + line}: time goes back by {time[row - 1] - time[row]:g} s; sort the rows by time")
    begun = table[list(DRIVES)].notna().cummax().all(axis=1)
    for name in DRIVES:
        if not table[name].notna().any():
            raise CzError(f"{name} is empty")
    last = ~table["time_s"].duplicated(keep="last")
    notes["rows repeat a time"] = int((~last).sum())
    notes["rows come before the first drives"] = int((~begun).sum())
    table = table[begun & last]
    time = table["time_s"].to_numpy()
    if len(time) < FEWEST or time[-1] - time[0] < SHORTEST:
        raise CzError(
            f"{len(time)} rows over {np.ptp(time) / MINUTE if len(time) else 0.0:.3g} min are too short a log: "
            f"it needs {FEWEST} rows and {SHORTEST / MINUTE:g} min"
        )
    return table


def _slots(time: Floats, interval: float) -> npt.NDArray[np.int64]:
    """Find the row of the grid that each time belongs to; the grid follows the times slowly: jitter does not matter."""
    phases = np.exp(2j * np.pi * (time[:50] - time[0]) / interval)
    slots, at = np.zeros(len(time), np.int64), time[0] + interval * np.angle(phases.mean()) / (2.0 * np.pi)
    for k in range(1, len(time)):
        steps = round((time[k] - at) / interval)
        slots[k], at = slots[k - 1] + steps, at + steps * interval
        at += 0.05 * (time[k] - at)
    return slots


def on_grid(table: Any, notes: dict[str, int]) -> Log:
    """Put the table's rows at equal times; add to the notes what was left out or filled."""
    time = table["time_s"].to_numpy()
    steps = np.diff(time)
    interval = float(steps[np.abs(steps / np.median(steps) - 1.0) <= 0.5].mean())
    if not INTERVALS[0] <= interval <= INTERVALS[1]:
        meant = [unit for unit in TIME if unit not in DATED and 0.2 <= interval * TIME[unit][0] <= 60.0]
        hint = f": did you mean time_s=COLUMN:{meant[0]}?" if meant else ""
        raise CzError(f"the rows are {interval:.4g} s apart{hint}")
    index = _slots(time, interval)
    if index[-1] > 50 * len(time):
        raise CzError("nearly all of it are gaps: are its times in another unit?")
    last = np.append(np.diff(index) > 0, True)
    n, present = int(index[-1]) + 1, index[last]
    interval = float(time[-1] - time[0]) / (n - 1)
    notes["rows repeat a time"] += len(time) - len(present)
    notes["rows are missing"] = n - len(present)
    grid = table[last].set_axis(present).reindex(range(n))
    _drop_bad_readings(grid, present, notes)
    after_gap = present[1:][np.diff(present) * interval > LONG_GAP]
    notes[f"gaps are longer than {LONG_GAP:g} s"] = len(after_gap)
    filled = grid[list(DRIVES)].interpolate(limit_direction="both")
    unsure = np.stack([_unsure(grid[name], filled[name].to_numpy()) for name in DRIVES], axis=1)
    held = grid[["r_ref_mm", "T_1_ref_K"]].ffill()
    parts = (grid[REQUIRED[1]], *(filled[name] for name in DRIVES), grid["T_1_K"], held["r_ref_mm"], held["T_1_ref_K"])
    readings: list[Any] = [np.array(part, np.float64) for part in parts]
    gap = np.isin(np.arange(n), after_gap)
    said = tuple(f"{count} {what}" for what, count in notes.items() if count)
    return Log._make([interval * np.arange(n, dtype=np.float64), *readings, gap, unsure, interval, said, 1])


def _drop_bad_readings(grid: Any, present: npt.NDArray[np.int64], notes: dict[str, int]) -> None:
    """Make readings that are not valid, and outliers, NaN; CzError for a column with few or equal readings."""
    invalid = grid["ring_radius_mm"].notna() & (grid["valid"] < 0.5)
    notes["readings of the ring are not valid"] = int(invalid.sum())
    grid["ring_radius_mm"] = grid["ring_radius_mm"].mask(invalid)
    for name in OUTLIERS:
        outlier = _outliers(grid[name], name)
        notes[f"readings of {name} are outliers"] = int(outlier.sum())
        grid[name] = grid[name].mask(outlier)
        notes[f"readings of {name} are missing"] = int(grid[name][present].isna().sum() - outlier.sum())
        if grid[name].count() < 0.3 * len(grid):
            raise CzError(f"{name} has only {grid[name].count()} good readings in {len(grid)} rows")
        if name not in DRIVES and grid[name].min() == grid[name].max():
            raise CzError(f"{name} is constant, so it tells nothing")
    notes["readings of ring_radius_mm are missing"] -= notes["readings of the ring are not valid"]


def _outliers(values: Any, name: str) -> Any:
    """Find readings that Hampel's filter of their column, or a factor of :data:`ABSURD`, refuses."""
    neighbours, deviations, least, share = OUTLIERS[name]
    middle = abs(values.median())
    absurd = ((values < middle / ABSURD) | (values > middle * ABSURD)) & (name not in DRIVES)
    rest = values.mask(absurd)
    away = (rest - rest.rolling(neighbours, center=True, min_periods=int(0.8 * neighbours)).median()).abs()
    return absurd | (away > max(deviations * max(1.4826 * away.median(), least), share * middle))


def _unsure(values: Any, filled: Floats) -> Floats:
    """Standard deviation of a drive where it was filled, else 0: half of its usual move in as many rows, larger by the
    root of their number, because their errors are alike.
    """
    absent = values.isna()
    lengths = absent.groupby((~absent).cumsum()).transform("sum").to_numpy() * absent.to_numpy()
    sd = {int(m): np.sqrt(m) * 0.5 * np.std(filled[int(m) :] - filled[: -int(m)]) for m in set(lengths) - {0}}
    return np.array([sd.get(int(m), 0.0) for m in lengths])


def prepare(log: Log, latency: float = 0.0) -> Log:
    """Put the ring at the time of its frames, ``latency`` [s] before, and thin the log to rows of about THIN [s].

    Readings are means of the rows around a time, drives of those since the row before: neither is late.
    """
    late, n = round(latency / log.interval), len(log.time)
    log = log._replace(ring=np.append(log.ring[late:], np.full(late, np.nan)))
    size = (int(THIN / log.interval + 1e-9) - 1) // 2 * 2 + 1
    if size < 3:
        return log
    rows = np.arange(size // 2, n - size // 2, size)
    around = rows[:, None] + np.arange(size) - size // 2
    since = np.maximum(rows[:, None] + np.arange(size) - size + 1, 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # rows without a reading stay so
        ring, T_1 = (np.nanmean(each[around], axis=1) for each in (log.ring, log.T_1))
    v_p, Q_H = (each[since].mean(axis=1) for each in (log.v_p, log.Q_H))
    unsure, gap = np.sqrt(np.square(log.unsure[since]).mean(axis=1)), log.gap[since].any(axis=1)
    parts = ring, v_p, Q_H, T_1, log.r_ref[rows], log.T_1_ref[rows], gap, unsure
    return Log(log.time[rows], *parts, size * log.interval, log.notes, size)


def shift_drives(log: Log) -> Log:
    """Move a log's drives by a row, to later times."""
    v_p, Q_H = (np.append(drive[:1], drive[:-1]) for drive in (log.v_p, log.Q_H))
    return log._replace(v_p=v_p, Q_H=Q_H, notes=(*log.notes, "a row's drives act after it: they were moved by a row"))


def join_logs(logs: Sequence[Log]) -> Log:
    """Join logs one after the other, for pictures."""
    ends = np.cumsum([0.0, *(log.time[-1] + log.interval for log in logs)])
    logs = [log._replace(time=log.time + end) for log, end in zip(logs, ends, strict=False)]
    arrays: list[Any] = [np.concatenate([getattr(log, name) for log in logs]) for name in Log._fields[:9]]
    return Log._make([*arrays, logs[0].interval, tuple(note for log in logs for note in log.notes), 1])


# Logs as files.

BODY, CONE = 0.15, 0.02
"""Largest deviation of the ring in a body, in radii, and the share of rows beyond it that a cone has at least."""


def column_map(given: Sequence[str], file: Path | None = None) -> dict[str, tuple[str, str]]:
    """Map standard names of a log's columns to the file's and their units, by ``NAME=COLUMN[:UNIT]`` and a TOML file.

    The file holds ``NAME = "COLUMN:UNIT"``. Raises CzError for names and units that there are not.
    """
    pairs: list[tuple[str, Any]] = []
    if file is not None:
        with name_file_in_errors(file):
            try:
                pairs = list(tomllib.loads(file.read_text(encoding="utf-8-sig")).items())
            except tomllib.TOMLDecodeError as error:
                raise CzError(f"{file}: {error}") from None
    pairs += [(text.partition("=")[0], text.partition("=")[2]) for text in given]
    columns = {}
    for name, text in pairs:
        if name not in COLUMNS:
            raise CzError(unknown_name_message("column", name, COLUMNS))
        own = next(iter(COLUMNS[name]))
        column, colon, unit = str(text).rpartition(":")
        if colon and unit not in COLUMNS[name]:
            raise CzError(unknown_name_message(f"unit of {name}", unit, COLUMNS[name]))
        columns[name] = (column, unit) if colon else (unit, own)
        if not columns[name][0]:
            raise CzError(f"{name}: say which column it is, as {name}=COLUMN:{own}")
    return columns


def read_log(path: str | Path, columns: Mapping[str, tuple[str, str]] | None = None) -> Log:
    """Read a CSV or Parquet file; CzError names the row and what is wrong with it.

    ``columns`` gives column and unit of standard names that the file calls otherwise (:func:`column_map`); the time may
    stand in two columns, ``DATE+CLOCK``. Lines before the names of the columns, and below them those without a time,
    are left out. Repeated times count once, with their last row. Readings that are absent, infinite, not valid or
    outliers become NaN, and drives are interpolated.
    """
    import pandas

    named = {name: (name, next(iter(units))) for name, units in COLUMNS.items()} | dict(columns or {})
    try:
        with name_file_in_errors(path):
            file, line = read_fields(Path(path), {column for column, _ in named.values()})
        if (time := named["time_s"][0]) not in file and set(parts := time.split("+")) <= set(file):
            file[time] = file[parts].fillna("").agg(" ".join, axis=1)
        for name in (*REQUIRED, *(columns or {})):
            if (column := named[name][0]) not in file:
                own = next(iter(COLUMNS[name]))
                raise CzError(
                    f"{unknown_name_message('column', column, file)}; {name}=COLUMN:{own} says which one it is"
                )
        present = {name: (column, unit) for name, (column, unit) in named.items() if column in file}
        for column, _ in present.values():
            if isinstance(file[column], pandas.DataFrame):
                raise CzError(f"two columns are called {column!r}: give one of them another name")
        notes, unit = dict[str, int](), present["time_s"][1]
        seconds, first = parse_times(file[time], unit, line, notes)
        table = pandas.DataFrame(index=seconds.index, columns=list(COLUMNS), dtype=float).assign(time_s=seconds)
        for name, (column, unit) in list(present.items())[1:]:
            factor, added = COLUMNS[name][unit]
            table[name] = parse_numbers(file[column][seconds.index], line) * factor + added
        infinite = np.isinf(table.to_numpy()).sum()
        notes["numbers are infinite"] = int(infinite)
        return on_grid(sound_rows(table.replace([np.inf, -np.inf], np.nan), line + first, notes), notes)
    except CzError as error:
        raise CzError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


def check_puller(log: Log, machine: PullerFile, source: str = "the log") -> None:
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
        own, added = next(iter(units.values()))
        as_read = {unit: (middle - added) / own * factor + plus for unit, (factor, plus) in units.items()}
        meant = [unit for unit, value in as_read.items() if low <= value <= high]
        guess = f'did you mean {name}="COLUMN:{meant[0]}"' if meant else "is it another puller's log"
        middle, low, high = (value / own for value in (middle, low, high))
        raise CzError(
            f"{source}: {name} is {middle:.4g} in the middle, this puller's is {low:.4g} to {high:.4g}: {guess}?"
        )
    off = np.abs(log.ring - puller.ring_bias - puller.r_0) > BODY * puller.r_0
    if off.sum() > CONE * np.isfinite(log.ring).sum():
        raise CzError(
            f"{source}: in {off.sum()} of {off.size} rows the ring is more than {BODY * puller.r_0 / MM:.0f} mm from "
            f"the body's: identification fits the body alone, so cut crown and tail off"
        )


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
