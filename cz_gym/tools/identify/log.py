"""Log of a puller: read from CSV or Parquet with any names and units, put on a regular grid, written.

Fields are read as text, because a line about a wrong one names its row and column as the file has them; pandas' own
conversion of a column would tell neither. The grid follows the times of the rows slowly, as a clock drifts: pandas'
``merge_asof`` on equal times would lose one reading in twelve of a log whose clock drifts by 0.1 %.
"""

import csv
import io
import re
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
"""Times that are no numbers, each with an example; ``clock``, the time of day, may run over midnight, or count on."""
TIME: Units = {"s": (1.0, 0.0), "min": (MINUTE, 0.0), "h": (HOUR, 0.0), "d": (DAY, 0.0)}
TIME |= {"ms": (1e-3, 0.0), "us": (1e-6, 0.0), "100ns": (1e-7, 0.0), "ns": (1e-9, 0.0)}
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
    "frame_time_s": TIME,
}
"""Columns of a log, with the units that each may have; the first is its own."""
REQUIRED, RECORDED = tuple(COLUMNS)[:5], tuple(COLUMNS)[:8]
"""Columns that a log must have, and those that :func:`record_log` writes."""
DRIVES = "pull_speed_mm_per_min", "heater_power_kW"
ABSENT = (
    "", "nan", "null", "none", "na", "n/a", "#n/a", "-", "--", "---", "<na>", "nat", "1.#qnan", "-1.#ind", "1.#inf",
    "-1.#inf",
)  # fmt: skip
"""Fields that hold no number."""
MEANT = "on", "off", "true", "false"
"""Words that stand for a number, so that they are not missing."""
WORDS = 0.2
"""Largest share of a column's fields that may be words in place of numbers, as historians write them."""
GOOD = "good|g|true|t|yes|y|ok|valid|normal|pass|passed|gut|ja|wahr|bon|oui|vrai|goed|vero|verdadero"
BAD = (
    "bad|b|false|f|no|n|not|nok|invalid|uncertain|questionable|substituted|abnormal|alarm|error|fail|failed|failure|"
    "schlecht|nein|falsch|mauvais|non|faux|slecht|falso"
)
"""Words of a quality; a bad one counts more, and what is uncertain is not valid."""
TOP, FOOTER = 100, 20
"""Lines of a file among which its columns are named, and most rows around its table with words in place of a time."""


def read_fields(path: Path, wanted: set[str], notes: dict[str, int]) -> Any:
    """Read a file's fields as text, by the row of the file; the line above names most of the ``wanted`` columns.

    Rows end at line feeds (carriage return or not) and nowhere else. CzError for a file that is no table.
    """
    import pandas

    try:
        if path.suffix == ".parquet":
            table = pandas.read_parquet(path)
            named = any(table.index.names) or not isinstance(table.index, pandas.RangeIndex)
            table = table.reset_index(drop=not named).astype(str)
            return table.set_axis(range(2, len(table) + 2))
        lines = _decoded(path.read_bytes()).rstrip("\0 \t\r\n").split("\n")
        wanted |= {part for name in wanted for part in name.split("+")}
        places = [(n, separator) for n in range(min(len(lines), TOP)) for separator in ",;\t|"]
        fields = {place: _fields(lines[place[0]], place[1]) for place in places}
        top, separator = max(fields, key=lambda at: (len(wanted & set(fields[at])), len(fields[at])), default=(0, ","))
        names = _fields(lines[top].rpartition("\0")[2].lstrip("# "), separator)
        whole, rows, lost = _sound_lines(lines[top:], len(names), separator)
        notes["rows are lost in NUL bytes, as after a power failure"] = lost
        asked: Any = {"dtype": str, "keep_default_na": False, "skip_blank_lines": False, "index_col": False}
        text = "\n".join(whole)
        table = pandas.read_csv(io.StringIO(text), sep=separator, lineterminator="\n", **asked)
        table = table.set_axis(names[: table.shape[1]], axis=1)
        same = len(table) == len(rows) - 1  # else a quoted field runs over several lines
        return table.set_axis(np.array(rows[1:]) + top + 1 if same else range(top + 2, len(table) + top + 2))
    except (ValueError, csv.Error) as error:  # an empty file, or rows of another length
        raise CzError(" ".join(str(error).split())) from None


def _decoded(raw: bytes) -> str:
    """Decode text of any usual coding, with rows that end at line feeds; CzError for what is none."""
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = raw.decode("utf-16")
    elif raw[1:200:2].count(0) > 60:
        text = raw.decode("utf-16-le")
    else:
        for coding in ("utf-8-sig", "cp1252", "latin-1"):
            try:
                text = raw.decode(coding)
                break
            except UnicodeDecodeError:
                pass
    text = text.replace("\r\n", "\n")
    if re.search("[^\\0]\0[^\\0]", text) or text.strip("\0") == "":
        raise CzError("not a text file" if text.strip("\0") else "it is empty, or holds NUL bytes alone")
    return text if "\n" in text else text.replace("\r", "\n")


def _sound_lines(lines: Sequence[str], count: int, separator: str) -> tuple[list[str], list[int], int]:
    """Leave out blank lines, the names of the columns again, and what NUL bytes have cut.

    A row counts if all its fields stand behind the NUL bytes. Returns rows, their places, and how many were cut.
    """
    whole, places, lost = [], [], 0
    for place, line in enumerate(lines):
        rest = line.rpartition("\0")[2]
        if "\0" in line and len(_fields(rest, separator)) != count:
            lost += 1
        elif rest.strip() and (not place or line != lines[0]):
            whole.append(rest)
            places.append(place)
    return whole, places, lost


def _fields(line: str, separator: str) -> list[str]:
    return [field.strip() for field in next(csv.reader([line.replace("\r", " ")], delimiter=separator), [])]


def select_rows(table: Any, where: Sequence[str]) -> Any:
    """Select the rows in which each COLUMN=VALUE holds; several values of a column are alternatives.

    CzError for a column that there is not, and where no row is left.
    """
    wanted: dict[str, list[str]] = {}
    for each in where:
        column, sign, value = (part.strip() for part in each.partition("="))
        if not sign or not column:
            raise CzError(f"--where {each}: write it as COLUMN=VALUE")
        if column not in table:
            raise CzError(unknown_name_message("column", column, table))
        wanted.setdefault(column, []).append(value)
    for column, values in wanted.items():
        text = table[column].fillna("").str.strip()
        chosen = text.isin(values)
        if not chosen.any():
            held = ", ".join(f"{value!r} ({count} rows)" for value, count in text.value_counts()[:6].items())
            raise CzError(f"no row has {column} = {' or '.join(map(repr, values))}; it holds {held or 'nothing'}")
        table = table[chosen]
    return table


def parse_times(column: Any, unit: str, notes: dict[str, int]) -> Any:
    """Parse times [s] from the first to the last row that has one; CzError names a row."""
    text = column.fillna("").str.strip()
    (times, naive), absent = _read_times(text, unit), text.str.lower().isin(ABSENT)
    good = np.flatnonzero(times.notna())
    if not len(good):
        row = (~absent).idxmax() if len(text) else 0
        raise CzError(
            f"row {row}: {column.name} = {text.get(row, '')!r} is no time in {unit}"
            f"{_units_meant(text[~absent], str(column.name), unit)}"
        )
    first, end = int(good[0]), int(good[-1]) + 1
    notes["rows above or below the table have no time"] = first + len(text) - end
    outside = ~absent & times.isna()
    outside.iloc[first:end] = False
    if outside.sum() > FOOTER:
        row, hint = outside.idxmax(), _units_meant(text[~absent], str(column.name), unit)
        said = f"is no time in {unit}, as in {outside.sum()} rows before or after the others"
        raise CzError(f"row {row}: {column.name} = {text[row]!r} {said}{hint}")
    inside = times.iloc[first:end]
    if inside.isna().any():
        row = inside.isna().idxmax()
        hint = "" if absent[row] else _units_meant(text.iloc[first:end][~absent], str(column.name), unit)
        what = "the time is missing" if absent[row] else f"{column.name} = {text[row]!r} is no time in {unit}{hint}"
        raise CzError(f"row {row}: {what}")
    if unit in DATED:
        step = inside.diff()
        inside = inside + DAY * (step < -0.5 * DAY).cumsum() * (unit == "clock")
        again = (step > -HOUR) & (step <= -0.9 * HOUR)
        notes["hours are repeated, as at the end of summer time: the times below are an hour later"] = int(again.sum())
        inside = inside + HOUR * again.cumsum()
        left_out = _hours_left_out(inside) if naive else again & False
        notes["hours are left out, as at the beginning of summer time: the times below are an hour earlier"] = int(
            left_out.sum()
        )
        inside = inside - HOUR * left_out.cumsum()
    return inside


def _hours_left_out(times: Any) -> Any:
    """Find rows before which the clock was put forward: an hour and a usual step, from the end of an hour of the night
    on a Sunday (of a time of day without date, on any day).
    """
    step, before = times.diff(), times.shift()
    most = 1.6 * step.median()
    sunday = (before < 10.0 * DAY) | ((before // DAY) % 7 == 3.0)  # the first of January 1970 was a Thursday
    at_end = ((-before) % HOUR <= most) & (before % DAY <= 3.0 * HOUR) | (before % DAY >= DAY - most)
    return (step > HOUR) & (step <= HOUR + most) & sunday & at_end


def _fit_unit(text: Any, unit: str) -> tuple[str, bool, float] | None:
    """Return a unit in which texts are times of a log, if their step is a log's, and their span [s]; None: none."""
    far = text.iloc[np.unique(np.linspace(0, len(text) - 1, 500).astype(int))]
    times, near = _read_times(far, unit)[0], _read_times(text.iloc[:500], unit)[0]
    backwards = (times.diff() < -1.1 * HOUR).sum() > (len(text) if unit == "clock" else 0)
    step = near.diff().abs().median()
    if times.notna().mean() > 0.95 and not backwards and (step <= INTERVALS[1]):
        return unit, bool(INTERVALS[0] <= step), times.max() - times.min()
    return None


def _units_meant(text: Any, name: str, given: str) -> str:
    """Hint at the units in which rows all over the column are times that grow as a log's; empty if there is none, or
    the given one is among them.
    """
    fitting = list(filter(None, (_fit_unit(text, unit) for unit in TIME))) if len(text) > 1 else []
    units = _likely_units(fitting, fitting != [] and "." in text.iloc[0][:6])
    if not units or given in units:
        return ""
    return f": did you mean {' or '.join(f'time_s={name}:{unit}' for unit in units)}?"


def _likely_units(fitting: Sequence[tuple[str, bool, float]], dotted: bool) -> list[str]:
    """The units in which rows are as far apart as a log's, if any are; of two orders of day and month the one in which
    the log is much shorter. Between dots nobody writes the month first.
    """
    best = [each for each in fitting if each[1]] or fitting
    units, spans = [unit for unit, *_ in best], {unit: span for unit, _, span in fitting if unit in ("dmy", "mdy")}
    units = [unit for unit in units if spans.get(unit, 0.0) <= 3.0 * min(spans.values(), default=0.0)]
    if "iso" in units:  # whose forms the other two read too
        units = [unit for unit in units if unit not in spans]
    if {"dmy", "mdy"} <= set(units) and dotted:
        units.remove("mdy")
    return units


MONTHS = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
MONTH = {name: n + 1 for n, name in enumerate(MONTHS)}
MONTH |= {
    "mär": 3, "mrz": 3, "mae": 3, "mai": 5, "okt": 10, "dez": 12, "fév": 2, "fev": 2, "avr": 4, "jui": 7, "aoû": 8,
    "déc": 12, "ene": 1, "abr": 4, "ago": 8, "dic": 12, "gen": 1, "mag": 5, "giu": 6, "lug": 7, "set": 9, "ott": 10,
    "mrt": 3, "mei": 5, "maj": 5, "des": 12, "out": 10, "sty": 1, "lut": 2, "kwi": 4, "cze": 6, "lip": 7, "sie": 8,
    "wrz": 9, "paź": 10, "lis": 11, "gru": 12, "янв": 1, "фев": 2, "мар": 3, "апр": 4, "май": 5, "мая": 5, "июн": 6,
    "июл": 7, "авг": 8, "сен": 9, "окт": 10, "ноя": 11, "дек": 12,
}  # fmt: skip
"""First letters of months in English, the Germanic and Romance languages, Polish and Russian."""
ZONES = {"z": 0, "utc": 0, "gmt": 0, "wet": 0, "bst": 1, "cet": 1, "mez": 1, "cest": 2, "mesz": 2, "eet": 2, "eest": 3}
ZONES |= {"est": -5, "edt": -4, "cst": -6, "cdt": -5, "mst": -7, "mdt": -6, "pst": -8, "pdt": -7, "jst": 9, "kst": 9}
"""Names of zones, hours from UTC."""
_WORD, _COMPACT = r"[^\W\d_]{3,12}", r"^((?:19|20)\d{6})[ _-]?(\d\d:?\d\d:?\d\d(?:[.,]\d+)?)"
_DATE = {
    "ymd": r"(?P<y>\d{4})(?P<s>[-/. ]?)(?P<m>\d{1,2})(?P=s)(?P<d>\d{1,2})",
    "dMy": rf"(?P<d>\d{{1,2}})[-/. ]*(?P<m>{_WORD})[-/., ]*(?P<y>\d{{4}}|\d{{2}})",
    "Mdy": rf"(?P<m>{_WORD})[-/. ]*(?P<d>\d{{1,2}})[-/., ]+(?P<y>\d{{4}}|\d{{2}})",
    "yMd": rf"(?P<y>\d{{4}})[-/. ]*(?P<m>{_WORD})[-/. ]*(?P<d>\d{{1,2}})",
    "dmy": r"(?P<d>\d{1,2})[-/. ](?P<m>\d{1,2})[-/. ](?P<y>\d{4}|\d{2})",
    "mdy": r"(?P<m>\d{1,2})[-/. ](?P<d>\d{1,2})[-/. ](?P<y>\d{4}|\d{2})",
}
_FORMS = {"iso": ("ymd", "dMy", "Mdy", "yMd"), "clock": ()}
_FORMS |= {unit: (unit, *_FORMS["iso"]) for unit in ("dmy", "mdy")}
_CLOCK = (
    r"(?P<H>\d{1,2})(?P<p>[:.-]?)(?P<M>\d{2})(?:(?P=p)(?P<S>\d{2})(?:[.,:](?P<f>\d+))?)?"
    r"\s*(?P<half>[AaPp])?(?(half)\.?\s?[Mm]\.?)\s*"
    r"(?:Uhr|\(?(?:UTC|GMT)?(?P<sign>[-+])(?P<zh>\d{1,2}):?(?P<zm>\d{2})?\)?(?: \(?[A-Za-z ]+\)?)?"
    r"|(?P<zone>[A-Za-z]{1,5})(?![A-Za-z/]))?\s*(?:\[[^\]]*\]|[A-Za-z]+/[\w/+-]+)?"
)
_SWAPS = {
    _COMPACT: r"\1T\2",
    r"^(\d{4})[年년] ?(\d{1,2})[月월] ?(\d{1,2})[日일]": r"\1-\2-\3",
    r"(\d{1,2})[時时시] ?(\d{1,2})[分분] ?(\d{1,2})[秒초]": r"\1:\2:\3",
    r"^(\d{1,2}:\d\d(?::\d\d)?(?:[.,]\d+)?(?: ?[AaPp][Mm])?),? (?=\d)(.*)$": r"\2 \1",  # 12:00:05 01.03.2026
    rf"(?<=\d) de ({_WORD}) de (?=\d)": r" \1 ",
    rf"^({_WORD}) +(\d{{1,2}}) (\d{{1,2}}:\d{{2}}:\d{{2}})((?: \w{{1,4}})?) (\d{{4}})$": r"\1 \2 \5 \3\4",
}
"""Other forms of times, each with the usual one; the last is C's: Sun Mar  1 12:00:05 2026."""


def _read_times(text: Any, unit: str) -> tuple[Any, bool]:
    """Parse times [s], NaN where a field is none; True if they are local times that do not say from where."""
    import pandas

    factor, _ = TIME[unit]
    if unit not in DATED:
        numbers = text.mask(text.str.fullmatch(_COMPACT)) if unit == "s" else text
        times = pandas.to_numeric(_plain_numbers(numbers), errors="coerce").astype(float) * factor
        return times * (np.nan if unit == "s" and _is_clock(times) else 1.0), False
    if unit == "clock":
        marked = _CLOCK.replace("[:.-]?", "[:.]").replace("2", "3", 1)
        parts = text.str.extract(rf"^(?:(?P<D>\d+) days?,? +)?{marked}$")
        naive = bool(parts[["sign", "zone"]].isna().all(axis=None))
        minutes = (parts["S"].isna() & (parts["H"].astype(float) > 24.0)).any()  # they are no hours
        times = _seconds(parts, 999.0) + DAY * parts["D"].astype(float).fillna(0.0)
        return times * (np.nan if minutes else 1.0), naive
    plain = text.str.replace(
        rf"^[^\W\d_]{{2,10}}\.?,? +(?=\d|{_WORD})",
        lambda found: found[0] if found[0][:3].lower() in MONTH else "",
        regex=True,
    )
    for form, usual in _SWAPS.items():
        plain = plain.str.replace(form, usual, regex=True)
    times, naive = pandas.Series(np.nan, text.index), True
    for form in _FORMS[unit]:
        at = times.isna()
        if not at.any():
            break
        parts = plain[at].str.extract(rf"^{_DATE[form]}(?:[Tt ,:_-]+{_CLOCK})?$")
        month = pandas.to_numeric(parts["m"], errors="coerce").fillna(_months(parts["m"]))
        year, day = parts["y"].astype(float), parts["d"].astype(float)
        year = year.where(year >= 100.0, year + np.where(year < 70.0, 2000.0, 1900.0))
        year = year.where(year.between(1800.0, 2200.0))  # pandas has no others
        dates = pandas.to_datetime(pandas.DataFrame({"year": year, "month": month, "day": day}), errors="coerce")
        days = (dates - pandas.Timestamp(0)).dt.total_seconds()
        clock = _seconds(parts).where(parts["H"].notna(), 0.0)
        times[at] = days + clock
        naive &= bool(parts[["sign", "zone"]].isna().all(axis=None))
    return times, naive


def _is_clock(times: Any) -> bool:
    """Tell whether numbers are digits of a clock, as 120005 is for 12:00:05: seconds since any time run up to 99."""
    whole = times.dropna()
    digits = [whole % 100.0, whole // 100.0 % 100.0]
    varied = max(each.nunique() for each in digits) > 2  # those of milliseconds may be 00 and 50 alone
    return len(whole) >= FEWEST and varied and whole.max() >= 1e4 and all(each.max() < 60.0 for each in digits)


def _months(words: Any) -> Any:
    """Number of the month that each word names; 1 for one that is unknown here, if the log has no other."""
    names = words.str.lower()
    numbers = names.str[:3].map(MONTH).mask(names.isin(["juin", "juni"]), 6.0)
    return numbers.fillna(1.0 if names.nunique() == 1 else np.nan)


def _seconds(parts: Any, most: float = 24.0) -> Any:
    """Seconds since midnight in UTC of the parts of times of day; NaN for one that no clock of ``most`` hours shows."""
    hour, minute = (parts[name].astype(float) for name in "HM")
    second = parts["S"].astype(float).fillna(0.0) + ("0." + parts["f"]).astype(float).fillna(0.0)
    half = parts["half"].str.lower()
    wrong = (minute >= 60.0) | (second >= 61.0) | (hour > most) | (half.notna() & ((hour < 1.0) | (hour > 12.0)))
    hour = hour.where(half.isna(), hour % 12.0 + 12.0 * (half == "p"))
    named = parts["zone"].str.lower().map(ZONES).fillna(0.0 if parts["zone"].nunique() == 1 else np.nan)
    wrong |= parts["zone"].notna() & named.isna()
    away = parts["zh"].astype(float).fillna(0.0) * HOUR + parts["zm"].astype(float).fillna(0.0) * MINUTE
    away = away * np.where(parts["sign"] == "-", -1.0, 1.0) + named.astype(float).fillna(0.0) * HOUR
    return (HOUR * hour + MINUTE * minute + second - away).mask(wrong)


def _plain_numbers(text: Any) -> Any:
    """Write numbers with a decimal point and nothing between thousands; of two signs in a field the last is decimal."""
    text = text.str.replace(r"(?<=\d)[\s'](?=\d)", "", regex=True).str.replace("\N{MINUS SIGN}", "-", regex=False)
    both = text.str.extract(r"([.,]).*([.,])")
    both = both[both[0] != both[1]].dropna()
    if len(both):
        text = text.str.replace(both[0].iloc[0], "", regex=False)
    return text.str.replace(",", ".", regex=False)


def parse_numbers(column: Any, name: str, notes: dict[str, int]) -> Any:
    """Parse a column's numbers; an absent one, or a word in its place, is NaN. CzError names the row of another field
    that is none.
    """
    import pandas

    text = column.fillna("").str.strip()
    absent = text.str.lower().isin(ABSENT)
    numbers = pandas.to_numeric(_plain_numbers(text).mask(absent), errors="coerce").astype(float)
    wrong = numbers.isna() & ~absent
    words = wrong & ~text.str.match(r"[-+]?[.,]?\d(?!\.#)") & ~text.str.lower().isin(MEANT)
    if words.sum() <= WORDS * (~absent).sum():
        said = ", ".join(repr(str(word)) for word in dict.fromkeys(text[words]))
        notes[f"fields of {name} are words and count as missing: {said:.80}"] = int(words.sum())
        wrong &= ~words
    if wrong.any():
        row = wrong.idxmax()
        raise CzError(f"row {row}: {column.name} = {text[row]!r} is no number")
    return numbers


def parse_quality(column: Any) -> Any:
    """Parse qualities: 1 where a reading is good, 0 where it is not; NaN where nothing is said.

    Words, 1 and 0, percents, codes of OPC (192 and above is good) and of OPC UA (0 is good, from 2^30 on none is), also
    hexadecimal: 0xC0 is OPC's, with eight digits too, 0x00000000 OPC UA's. CzError names a row.
    """
    import pandas

    text = column.fillna("").str.rstrip("% ").str.strip()
    says_good, says_bad = (text.str.contains(rf"(?i)(?<![^\W\d_])(?:{words})(?![^\W\d_])") for words in (GOOD, BAD))
    hexadecimal = text.where(text.str.fullmatch(r"0[xX][0-9a-fA-F]{1,8}"))
    numbers = pandas.to_numeric(_plain_numbers(text.mask(hexadecimal.notna())), errors="coerce").astype(float)
    numbers = numbers.fillna(hexadecimal.map(lambda code: int(code, 16), na_action="ignore").astype(float))
    codes, largest = numbers.to_numpy(), float(numbers.fillna(0.0).max())
    if largest >= 2**30 or (hexadecimal.str.len().eq(10).any() and not 0 < largest < 256):
        good = codes < 2**30
    elif largest in (1.0, 100.0) or largest < 1.0:
        good = codes >= max(largest, 1.0) / 2.0
    else:
        good = codes >= 192.0
    quality = pandas.Series(np.where(np.isnan(codes), np.nan, good), text.index)
    quality = quality.mask(quality.isna() & says_good, 1.0).mask(np.isnan(codes) & says_bad, 0.0)
    wrong = quality.isna() & ~text.str.lower().isin(ABSENT)
    if wrong.any():
        row = wrong.idxmax()
        raise CzError(f"row {row}: {column.name} = {text[row]!r} is no quality: 1 or 0, Good or Bad, an OPC code")
    return quality


def name_compression(table: Any, notes: dict[str, int]) -> None:
    """Note columns whose blanks fit "unchanged", and those whose changes are as behind a dead band."""
    for name in OUTLIERS:
        values = table[name].to_numpy()
        read = values[np.isfinite(values)]
        changes = np.abs(np.diff(read))
        if len(read) < FEW_CHANGES or not changes.any():
            continue
        blank, rest = 1.0 - len(read) / len(values), float(np.mean(changes == 0.0))
        own, (size, _) = next(iter(COLUMNS[name].items()))
        if blank >= BLANK and rest < 0.01:
            lost = len(values) - len(read)
            notes[f"fields of {name} are blank, and all fit 'unchanged': --hold holds the last value"] = lost
        least = float(np.quantile(changes[changes > 0.0], 0.02))
        finest = float(np.diff(np.unique(read)).min())
        if (changes > 0.0).sum() >= FEW_CHANGES and blank + rest >= BLANK and least > 4.0 * finest:
            notes[
                f"changes of {name} are all of {least / size:.2g} {own} or more, as behind the dead band of a "
                "historian's compression: export raw values"
            ] = int((changes > 0.0).sum())


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
BLANK, FEW_CHANGES = 0.2, 30
"""Share of blank or unchanged fields, and number of changes, from which on a column may be compressed."""
CLOCK_OFF = 2.0
"""Least difference of the camera's clock and the rows' that is named [s]."""
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


def sound_rows(table: Any, unit: str, notes: dict[str, int]) -> Any:
    """Select the rows from the first one with both drives on, one a time; CzError for times that go back, and for too
    short a log.
    """
    time = table["time_s"].to_numpy()
    back = np.diff(time) < 0.0
    if back.any():
        row = int(np.argmax(back)) + 1
        raise CzError(
            f"row {table.index[row]}: time goes back by {time[row - 1] - time[row]:g} s; sort the rows by time"
        )
    _check_interval(time, unit)
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


def _interval(time: Floats) -> float:
    """Usual time between rows [s]."""
    steps = np.diff(time)
    steps = steps[steps > 0.0]
    return float(steps[np.abs(steps / np.median(steps) - 1.0) <= 0.5].mean()) if len(steps) else 1.0


def _check_interval(time: Floats, unit: str) -> None:
    """Raise CzError for rows too close or too far apart, with the unit that may be meant: one of an epoch, of a
    spreadsheet's days, or the first in which the rows are as far apart as a log's.
    """
    interval = _interval(time)
    if INTERVALS[0] <= interval <= INTERVALS[1]:
        return
    now = TIME[unit][0]
    sizes = {each: size / now for each, (size, _) in TIME.items() if each not in DATED}
    meant = [each for each, size in sizes.items() if INTERVALS[0] <= interval * size <= INTERVALS[1]]
    dated = [each for each in meant if 9e8 <= time[0] * sizes[each] <= 4.2e9]
    far = {"d": 2e9, "100ns": 1e10}  # a spreadsheet's days; times since 1601 or the year 1
    meant = [each for each in meant if each in dated or time[0] * sizes[each] > far.get(each, np.inf)] or meant
    hint = f": did you mean time_s=COLUMN:{meant[0]}?" if meant and unit not in DATED else ""
    raise CzError(f"the rows are {interval:.4g} s apart{hint}")


def _slots(time: Floats, interval: float) -> npt.NDArray[np.int64]:
    """Find the row of the grid that each time belongs to; the grid follows the times slowly: jitter does not matter."""
    phases = np.exp(2j * np.pi * (time[:50] - time[0]) / interval)
    slots, at = np.zeros(len(time), np.int64), time[0] + interval * np.angle(phases.mean()) / (2.0 * np.pi)
    for k in range(1, len(time)):
        steps = round((time[k] - at) / interval)
        slots[k], at = slots[k - 1] + steps, at + steps * interval
        at += 0.05 * (time[k] - at)
    return slots


def on_grid(table: Any, notes: dict[str, int], hold: bool = False) -> Log:
    """Put the table's rows at equal times; add to the notes what was left out or filled.

    With ``hold``, drives keep their last value in rows that there are not.
    """
    time = table["time_s"].to_numpy()
    interval = _interval(time)
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
    if hold:
        grid[list(DRIVES)] = grid[list(DRIVES)].ffill()
    after_gap = present[1:][np.diff(present) * interval > LONG_GAP]
    notes[f"gaps are longer than {LONG_GAP:g} s"] = len(after_gap)
    filled = grid[list(DRIVES)].interpolate(limit_direction="both")
    unsure = np.stack([_unsure(grid[name], filled[name].to_numpy()) for name in DRIVES], axis=1)
    held = grid[["r_ref_mm", "T_1_ref_K"]].ffill()
    parts = (grid[REQUIRED[1]], *(filled[name] for name in DRIVES), grid["T_1_K"], held["r_ref_mm"], held["T_1_ref_K"])
    readings: list[Any] = [np.array(part, np.float64) for part in parts]
    gap = np.isin(np.arange(n), after_gap)
    said = tuple(what if count is True else f"{count} {what}" for what, count in notes.items() if count)
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
            bad = invalid.sum() > 0.5 * len(grid) and name == "ring_radius_mm"
            hint = "; if blank means unchanged, say --hold" if grid[name].count() else ""
            hint = f": the column valid calls {invalid.sum()} of them bad" if bad else hint
            raise CzError(f"{name} has only {grid[name].count()} good readings in {len(grid)} rows{hint}")
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


def read_log(
    path: str | Path,
    columns: Mapping[str, tuple[str, str]] | None = None,
    hold: bool = False,
    where: Sequence[str] = (),
) -> Log:
    """Read a CSV or Parquet file; CzError names the row and what is wrong with it.

    ``columns`` gives column and unit of standard names that the file calls otherwise (:func:`column_map`); the time may
    stand in two columns, ``DATE+CLOCK``, or be a Parquet file's index. ``where`` selects rows by COLUMN=VALUE. With
    ``hold`` a blank field means that its value has not changed. Lines before the names of the columns, and below them
    those without a time, are left out. Repeated times count once, with their last row. Readings that are absent,
    infinite, not valid or outliers become NaN, and drives are interpolated.
    """
    import pandas

    named = {name: (name, next(iter(units))) for name, units in COLUMNS.items()} | dict(columns or {})
    try:
        notes = dict[str, int]()
        with name_file_in_errors(path):
            file = read_fields(Path(path), {column for column, _ in named.values()}, notes)
        present = find_columns(path, file, named, [*REQUIRED, *(columns or {})], where)
        file, (time, unit) = select_rows(file, where), present.pop("time_s")
        seconds = parse_times(file[time], unit, notes)
        table = pandas.DataFrame(index=seconds.index, columns=list(COLUMNS), dtype=float).assign(time_s=seconds)
        for name, (column, own) in present.items():
            table[name] = parse_column(file[column][seconds.index], name, own, notes)
        notes["numbers are infinite"] = int(np.isinf(table.to_numpy()).sum())
        table = table.replace([np.inf, -np.inf], np.nan)
        late = (table["time_s"] - table["frame_time_s"]).median()
        if abs(late) >= CLOCK_OFF:
            told = "" if late < 0.0 else ", or its frames are that old (latency_s of the puller file)"
            notes[f"the camera's clock is {abs(late):.3g} s {'ahead' if late < 0.0 else 'behind'}{told}"] = True
        name_compression(table, notes)
        if hold:
            table = table.ffill()
        return on_grid(sound_rows(table, unit, notes), notes, hold)
    except CzError as error:
        said = str(error)
        raise CzError(said if said.startswith(str(path)) else f"{path}: {said}") from None


def find_columns(
    path: str | Path, file: Any, named: Mapping[str, tuple[str, str]], needed: Sequence[str], where: Sequence[str]
) -> dict[str, tuple[str, str]]:
    """Return column and unit of each standard name that the file of ``path`` has, and join a time in two columns.

    Raises CzError for a ``needed`` one that it lacks, and for a column that it has twice.
    """
    import pandas

    if (time := named["time_s"][0]) not in file and set(parts := time.split("+")) <= set(file):
        file[time] = file[parts].fillna("").agg(" ".join, axis=1)
    for name in needed:
        if (column := named[name][0]) not in file:
            has, example = ", ".join(map(str, file)), f"--column {name}=NAME:{next(iter(COLUMNS[name]))}"
            raise CzError(f"{path} has no column {column} (it has: {has}); {example}")
    present = {name: (column, unit) for name, (column, unit) in named.items() if column in file}
    used = [column for column, _ in present.values()] + [each.partition("=")[0].strip() for each in where]
    for column in used:
        if column in file and isinstance(file[column], pandas.DataFrame):
            raise CzError(f"two columns are called {column!r}: give one of them another name")
    return present


def parse_column(field: Any, name: str, unit: str, notes: dict[str, int]) -> Any:
    """Parse the texts of a column that is not the time as numbers in the unit of its standard name."""
    if name == "valid":
        return parse_quality(field)
    if name == "frame_time_s":
        return _read_times(field.fillna("").str.strip(), unit)[0]
    factor, added = COLUMNS[name][unit]
    return parse_numbers(field, name, notes) * factor + added


def add_log_options(parser: Any) -> None:
    """Add the options that say how a log is read to a command's parser; :func:`read_given` follows them."""
    add, named = parser.add_argument, "NAME=COLUMN[:UNIT]"
    add("--column", action="append", default=[], metavar=named, help="a log's column with another name or unit")
    add("--columns", type=Path, metavar="FILE", help='TOML file with lines NAME = "COLUMN:UNIT"')
    add("--hold", action="store_true", help="a blank field of the log means that its value has not changed")
    about = "read only the log's rows with this value, for instance OPERATION=BODY; several columns: rows with all"
    add("--where", action="append", default=[], metavar="COLUMN=VALUE", help=about)


def read_given(path: Path, given: Any) -> Log:
    """Read a log as a command's options say (:func:`add_log_options`)."""
    return read_log(path, column_map(given.column, given.columns), given.hold, given.where)


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
            f"the body's: identification fits the body alone, so cut crown and tail off, or select the body's rows: "
            "--where COLUMN=VALUE"
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
    table, path = pandas.DataFrame(rows, columns=list(RECORDED)), Path(path)
    parquet = path.suffix == ".parquet"
    text = table.to_parquet(index=False) if parquet else table.to_csv(index=False, float_format="%.10g").encode()
    write_files({path: text})
    return len(rows)
