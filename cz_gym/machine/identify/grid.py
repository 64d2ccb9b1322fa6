"""A log on a regular grid: rows at equal times, without outliers, and what was left out or filled."""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.errors import CzError
from cz_gym.support.units import MINUTE, MM

from .table import DATED, DRIVES, REQUIRED, TIME

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
    """A log on a regular grid, SI units; each of shape (rows,). Readings that are missing are NaN."""

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
    """Whether the row is the first after a long gap."""
    unsure: Floats
    """Standard deviations of pull speed [m/s] and power [W] in rows that do not have them, shape (rows, 2); else 0."""
    interval: float
    """Time between rows [s]."""
    notes: tuple[str, ...] = ()
    """What was left out or filled, in words."""
    mean_of: int = 1
    """Number of the sensors' readings that a row's are the means of."""


def sound_rows(table: Any, line: int, notes: dict[str, int]) -> Any:
    """Rows from the first one with both drives, one a time; CzError for times that go back, and too short a log."""
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
    """Number of the grid's row that each time belongs to; the grid follows the times slowly, so that jitter does not
    matter."""
    phases = np.exp(2j * np.pi * (time[:50] - time[0]) / interval)
    slots, at = np.zeros(len(time), np.int64), time[0] + interval * np.angle(phases.mean()) / (2.0 * np.pi)
    for k in range(1, len(time)):
        steps = round((time[k] - at) / interval)
        slots[k], at = slots[k - 1] + steps, at + steps * interval
        at += 0.05 * (time[k] - at)
    return slots


def on_grid(table: Any, notes: dict[str, int]) -> Log:
    """The table's rows at equal times, and what was left out or filled."""
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
    invalid = grid["ring_radius_mm"].notna() & (grid["valid"] < 0.5)
    notes["readings of the ring are not valid"] = int(invalid.sum())
    grid["ring_radius_mm"] = grid["ring_radius_mm"].mask(invalid)
    for name in OUTLIERS:
        outlier = _outliers(grid[name], name)
        notes[f"readings of {name} are outliers"] = int(outlier.sum())
        grid[name] = grid[name].mask(outlier)
        notes[f"readings of {name} are missing"] = int(grid[name][present].isna().sum() - outlier.sum())
        if grid[name].count() < 0.3 * n:
            raise CzError(f"{name} has only {grid[name].count()} good readings in {n} rows")
        if name not in DRIVES and grid[name].min() == grid[name].max():
            raise CzError(f"{name} is constant, so it tells nothing")
    notes["readings of ring_radius_mm are missing"] -= notes["readings of the ring are not valid"]
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


def _outliers(values: Any, name: str) -> Any:
    neighbours, deviations, least, share = OUTLIERS[name]
    middle = abs(values.median())
    absurd = ((values < middle / ABSURD) | (values > middle * ABSURD)) & (name not in DRIVES)
    rest = values.mask(absurd)
    away = (rest - rest.rolling(neighbours, center=True, min_periods=int(0.8 * neighbours)).median()).abs()
    return absurd | (away > max(deviations * max(1.4826 * away.median(), least), share * middle))


def _unsure(values: Any, filled: Floats) -> Floats:
    """Standard deviation of a drive where it was filled: half of its usual move in as many rows.

    It is larger by the root of their number, because their errors are alike.
    """
    absent = values.isna()
    lengths = absent.groupby((~absent).cumsum()).transform("sum").to_numpy() * absent.to_numpy()
    sd = {int(m): np.sqrt(m) * 0.5 * np.std(filled[int(m) :] - filled[: -int(m)]) for m in set(lengths) - {0}}
    return np.array([sd.get(int(m), 0.0) for m in lengths])


def prepare(log: Log, latency: float = 0.0) -> Log:
    """The log with the ring at the time of its frames, ``latency`` [s] before, and thinned to rows of about THIN [s].

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
    """The log with its drives a row later."""
    v_p, Q_H = (np.append(drive[:1], drive[:-1]) for drive in (log.v_p, log.Q_H))
    return log._replace(v_p=v_p, Q_H=Q_H, notes=(*log.notes, "a row's drives act after it: they were moved by a row"))


def join(logs: Sequence[Log]) -> Log:
    """Logs one after the other, for pictures."""
    ends = np.cumsum([0.0, *(log.time[-1] + log.interval for log in logs)])
    logs = [log._replace(time=log.time + end) for log, end in zip(logs, ends, strict=False)]
    arrays: list[Any] = [np.concatenate([getattr(log, name) for log in logs]) for name in Log._fields[:9]]
    return Log._make([*arrays, logs[0].interval, tuple(note for log in logs for note in log.notes), 1])
