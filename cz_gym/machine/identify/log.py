"""Logs of a puller: read from CSV or Parquet with any names and units, and written."""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.body.plant import make_puller
from cz_gym.errors import CzError
from cz_gym.machine.puller import PullerFile
from cz_gym.observation import decode
from cz_gym.support.atomic_files import naming, write_files
from cz_gym.support.names import unknown
from cz_gym.support.units import KILO, MM, MM_PER_MIN

from .grid import Log, on_grid, sound_rows
from .table import COLUMNS, REQUIRED, numbers, text_table, times

BODY, CONE = 0.15, 0.02
"""Largest deviation of the ring in a body, in radii, and the share of rows beyond it that a cone has at least."""


def column_map(given: Sequence[str], file: Path | None = None) -> dict[str, tuple[str, str]]:
    """Names and units of a log's columns, by standard name, from ``NAME=COLUMN[:UNIT]`` and a TOML file.

    The file holds ``NAME = "COLUMN:UNIT"``. Raises CzError for names and units that there are not.
    """
    pairs: list[tuple[str, Any]] = []
    if file is not None:
        with naming(file):
            try:
                pairs = list(tomllib.loads(file.read_text(encoding="utf-8-sig")).items())
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

    ``columns`` gives column and unit of standard names that the file calls otherwise (:func:`column_map`); the time may
    stand in two columns, ``DATE+CLOCK``. Lines before the names of the columns, and below them those without a time,
    are left out. Repeated times count once, with their last row. Readings that are absent, infinite, not valid or
    outliers become NaN, and drives are interpolated.
    """
    import pandas

    named = {name: (name, next(iter(units))) for name, units in COLUMNS.items()} | dict(columns or {})
    try:
        with naming(path):
            file, line = text_table(Path(path), {column for column, _ in named.values()})
        if (time := named["time_s"][0]) not in file and set(parts := time.split("+")) <= set(file):
            file[time] = file[parts].fillna("").agg(" ".join, axis=1)
        for name in (*REQUIRED, *(columns or {})):
            if (column := named[name][0]) not in file:
                own = next(iter(COLUMNS[name]))
                raise CzError(f"{unknown('column', column, file)}; {name}=COLUMN:{own} says which one it is")
        present = {name: (column, unit) for name, (column, unit) in named.items() if column in file}
        for column, _ in present.values():
            if isinstance(file[column], pandas.DataFrame):
                raise CzError(f"two columns are called {column!r}: give one of them another name")
        notes, unit = dict[str, int](), present["time_s"][1]
        seconds, first = times(file[time], unit, line, notes)
        table = pandas.DataFrame(index=seconds.index, columns=list(COLUMNS), dtype=float).assign(time_s=seconds)
        for name, (column, unit) in list(present.items())[1:]:
            factor, added = COLUMNS[name][unit]
            table[name] = numbers(file[column][seconds.index], line) * factor + added
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
