"""The log reader: other names and units, gaps, repeats, jitter; one line for what is wrong."""

import csv
from datetime import datetime, timedelta

import numpy as np
import pandas
import pytest

from cz_gym.puller.file import DEFAULT
from cz_gym.support.errors import CzError
from cz_gym.tools.identify.log import check_puller, column_map, read_log
from tests.foreign_puller import ForeignPuller, Operator, drive, write_log


def read(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def write(path, rows, delimiter=","):
    lines = [delimiter.join(rows[0]), *(delimiter.join(row.values()) for row in rows)]
    path.write_text("\n".join(lines) + "\n\n")
    return path


def test_other_names_units_and_separators_are_the_same_log(logs, tmp_path):
    start = datetime.fromisoformat("2024-05-01T23:00:00+02:00")
    rows = [
        {
            "when": (start + timedelta(seconds=float(row["time_s"]))).isoformat(),
            "DIA": f"{0.2 * float(row['ring_radius_mm']):.12g}", "W": f"{1e3 * float(row['heater_power_kW']):.12g}",
            "SPEED": f"{60.0 * float(row['pull_speed_mm_per_min']):.12g}",
            "PYRO": f"{float(row['T_1_K']) - 273.15:.12g}", "valid": row["valid"],
        }
        for row in read(logs[0])
    ]  # fmt: skip
    (tmp_path / "map.toml").write_text('ring_radius_mm = "DIA:diameter cm"\npull_speed_mm_per_min = "SPEED:mm/h"\n')
    columns = column_map(["time_s=when:iso", "heater_power_kW=W:W", "T_1_K=PYRO:degC"], tmp_path / "map.toml")
    mine, other = read_log(logs[0]), read_log(write(tmp_path / "other.csv", german(rows), ";"), columns)
    for name in ("time", "ring", "v_p", "Q_H", "T_1"):
        np.testing.assert_allclose(getattr(other, name), getattr(mine, name), rtol=1e-9, err_msg=name)
    assert np.isnan(other.r_ref).all()
    assert (mine.interval, mine.notes) == (5.0, ())


def test_a_parquet_file_is_the_same_log(logs, tmp_path):
    table = pandas.read_csv(logs[0])
    table["valid"] = table["valid"] > 0.5
    table["time_s"] = pandas.Timestamp("2024-05-01T23:00:00+02:00") + pandas.to_timedelta(table["time_s"], unit="s")
    table.loc[70, "T_1_K"] = np.nan
    table.to_parquet(tmp_path / "log.parquet")
    mine, other = read_log(logs[0]), read_log(tmp_path / "log.parquet", column_map(["time_s=time_s:iso"]))
    for name in ("time", "ring", "v_p", "Q_H", "r_ref", "T_1_ref"):
        np.testing.assert_allclose(getattr(other, name), getattr(mine, name), rtol=1e-12, err_msg=name)
    assert np.flatnonzero(np.isnan(other.T_1)).tolist() == [70]
    (tmp_path / "log.parquet").write_text("time_s\n1\n")
    with pytest.raises(CzError, match=r"log\.parquet: "):
        read_log(tmp_path / "log.parquet")


def test_gaps_repeats_jitter_and_outliers_are_counted(logs, tmp_path):
    whole, rows = read_log(logs[0]), read(logs[0])
    for k, row in enumerate(rows):
        row["time_s"] = f"{float(row['time_s']) + 0.8 * np.sin(k):.3f}"
    rows[50]["ring_radius_mm"], rows[60]["valid"], rows[71]["heater_power_kW"] = "150", "0", ""
    rows[70]["T_1_K"], rows[90]["T_1_K"], rows[80]["time_s"] = "nan", "inf", rows[79]["time_s"]
    log = read_log(write(tmp_path / "log.csv", rows[:100] + rows[140:]))
    assert log.interval == pytest.approx(5.0, abs=0.1)
    assert abs(len(log.time) - len(whole.time)) <= 1
    assert log.notes == (
        "1 numbers are infinite", "1 rows repeat a time", "41 rows are missing", "1 readings of the ring are not valid",
        "1 readings of ring_radius_mm are outliers", "2 readings of T_1_K are missing",
        "1 readings of heater_power_kW are missing", "1 gaps are longer than 20 s",
    )  # fmt: skip
    assert np.flatnonzero(np.isnan(log.T_1)).tolist() == [70, 80, 90, *range(100, 140)]
    assert np.isnan(log.ring[[50, 60, 120]]).all()
    assert np.isfinite([log.v_p, log.Q_H]).all()
    assert log.Q_H[71] == pytest.approx((whole.Q_H[70] + whole.Q_H[72]) / 2.0)
    assert np.flatnonzero(log.unsure[:, 1]).tolist() == [71, 80, *range(100, 140)]
    assert np.flatnonzero(log.gap).tolist() == [140]


def changed(name, value, at=400):
    return lambda rows: [row | {name: value} if k == at else row for k, row in enumerate(rows)]


def every(name, value):
    """A change of a column of every row: a value, or a function of the text before."""
    return lambda rows: [row | {name: value(row[name]) if callable(value) else value} for row in rows]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (changed("heater_power_kW", "off"), "row 402: heater_power_kW = 'off' is no number"),
        (changed("time_s", "10"), "row 402: time goes back by 1985 s"),
        (lambda rows: rows[::-1], "row 3: time goes back by 5 s"),
        (every("heater_power_kW", "n/a"), "heater_power_kW is empty"),
        (every("time_s", lambda time: f"{1e3 * float(time):.0f}"), "time_s=COLUMN:ms"),
        (lambda rows: every("time_s", lambda time: time[:-1] + "0")(rows[:390]), "195 rows"),
        (every("time_s", "01.03.2026 12:00:05"), "did you mean time_s=time_s:dmy?"),
        (every("time_s", "12:00:05"), "did you mean time_s=time_s:clock?"),
        (lambda rows: [row | {" T_1_K": "1800"} for row in rows], "two columns are called 'T_1_K'"),
        (lambda rows: rows[:300], "300 rows over 24.9 min are too short a log"),
        (every("T_1_K", "1800"), "T_1_K is constant"),
        (every("valid", "0"), "ring_radius_mm has only 0 good readings in 2161 rows"),
        (lambda rows: [{k.replace("T_1_K", "T1"): v for k, v in row.items()} for row in rows], "column 'T_1_K'"),
        (changed("time_s", "1e9", 2160), "nearly all of it are gaps"),
    ],
)
def test_what_is_wrong_is_one_line_with_its_row(change, said, logs, tmp_path):
    with pytest.raises(CzError) as error:
        read_log(write(tmp_path / "bad.csv", change(read(logs[0]))))
    assert str(error.value).startswith(f"{tmp_path / 'bad.csv'}: ")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def stamped(rows, form, start="2026-03-01T12:00:00"):
    at = datetime.fromisoformat(start)
    return [row | {"time_s": (at + timedelta(seconds=float(row["time_s"]))).strftime(form)} for row in rows]


def german(rows):
    return [{name: value.replace(".", ",") for name, value in row.items()} for row in rows]


def thousands(rows):
    return every("T_1_K", lambda T_1: f"{T_1[0]}.{T_1[1:]}")(german(rows))


def inches(rows):
    rows = every("ring_radius_mm", lambda ring: f"{float(ring) / 25.4:.10g}")(rows)
    return every("T_1_K", lambda T_1: f"{1.8 * float(T_1) - 459.67:.10g}")(rows)


def summer(rows):
    parts = (rows[:1080], "01"), (rows[1080:], "00")
    return [row for part, hour in parts for row in stamped(part, "%F %T", f"2026-10-25T{hour}:29:57.5")]


def two_columns(rows):
    return [
        {"Date": row["time_s"][:10], "Time": row["time_s"][11:]} | {k: v for k, v in row.items() if k != "time_s"}
        for row in stamped(rows, "%d.%m.%Y %H:%M:%S", "2026-03-01T23:00:00")
    ]


def spiked(name, value):
    return lambda rows: [row if k % 400 != 200 else every(name, value)([row])[0] for k, row in enumerate(rows)]


FORMATS = {
    "dates of Germany (pandas #14367)": (lambda rows: stamped(rows, "%d.%m.%Y %H:%M:%S"), "time_s=time_s:dmy"),
    "dates of America": (lambda rows: stamped(rows, "%m/%d/%Y %H:%M:%S"), "time_s=time_s:mdy"),
    "time of day over midnight": (lambda rows: stamped(rows, "%T", "2026-03-01T23:00:00"), "time_s=time_s:clock"),
    "end of summer time (emhass PR 779)": (summer, "time_s=time_s:iso"),
    "date beside clock (pangaeapy #58)": (two_columns, "time_s=Date+Time:dmy"),
    "milliseconds since 1970 (graph-cli #44)": (
        every("time_s", lambda time: str(1772366400000 + round(1e3 * float(time)))), "time_s=time_s:ms",
    ),
    "tabs and decimal comma": (german,),
    "thousands and decimal comma": (thousands,),
    "inches and degF": (inches, "ring_radius_mm=ring_radius_mm:in", "T_1_K=T_1_K:degF"),
    "inf in a column (cta-lstchain PR 429)": (spiked("T_1_K", "-inf"),),
    "a pyrometer row 30 K off": (spiked("T_1_K", lambda T_1: f"{float(T_1) + 30.0}"),),
    "pyrometer rows at -9999": (spiked("T_1_K", "-9999"),),
    "pyrometer rows at 0 degC": (spiked("T_1_K", "273.15"),),
    "heater rows at 0": (spiked("heater_power_kW", "0"),),
    "pull rows at 0": (spiked("pull_speed_mm_per_min", "0"),),
}  # fmt: skip
"""Kinds of logs, with the tracker and number of a public report of the kind."""


@pytest.mark.parametrize("kind", FORMATS)
def test_every_kind_of_table_is_the_same_log(kind, logs, tmp_path):
    change, *columns = FORMATS[kind]
    separator = "\t" if "tab" in kind else ";" if "comma" in kind else ","
    mine = read_log(logs[0])
    other = read_log(write(tmp_path / "log.csv", change(read(logs[0])), separator), column_map(columns))
    good = np.isfinite(other.T_1) & (other.unsure == 0.0).all(axis=1)
    spikes = 5 if "row" in kind or "inf" in kind else 0
    assert (good.sum(), len(good)) == (2161 - spikes, 2161)
    assert len(other.notes) == (2 if "inf" in kind else 1 if spikes or "summer" in kind else 0)
    for name in ("time", "ring", "v_p", "Q_H", "T_1"):
        ours, theirs = (getattr(log, name)[good] for log in (mine, other))
        np.testing.assert_allclose(theirs, ours, rtol=1e-6, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("coding", ["latin-1", "utf-16", "utf-8-sig"])
def test_encodings_titles_units_and_footers_are_passed_over(coding, logs, tmp_path):
    lines = logs[0].read_text().splitlines()
    top, units = ("Öfen; Züge, 3", "Schicht: früh", ""), "s,mm,mm/min,kW,K,,mm,K"
    table = [*top, lines[0], units, *lines[1:], "Mittelwert,1,2,3,4", "Ende"]
    (tmp_path / "log.csv").write_bytes("\n".join(table).encode(coding))
    mine, other = read_log(logs[0]), read_log(tmp_path / "log.csv")
    np.testing.assert_array_equal(other.T_1, mine.T_1)
    assert other.notes == ("3 rows above or below the table have no time",)


def test_jitter_is_no_repeat_and_whole_seconds_do_no_harm(tmp_path):
    puller = ForeignPuller(interval=1.0)
    rows = drive(puller, Operator(puller).setpoints, hours=0.6)
    for options in ({"jitter": 0.3}, {"second": 1.0, "jitter": 0.2}):
        log = read_log(write_log(tmp_path / "log.csv", rows, **options))
        assert not log.notes
        np.testing.assert_allclose(log.T_1, [row["T_1_K"] for row in rows])


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        ({"ring": 2.0}, 'did you mean ring_radius_mm="COLUMN:diameter mm"'),
        ({"v_p": 60.0}, 'did you mean pull_speed_mm_per_min="COLUMN:mm/h"'),
        ({"Q_H": 1e3}, 'did you mean heater_power_kW="COLUMN:W"'),
        ({"T_1": 1.0 - 273.15 / 1785.0}, 'did you mean T_1_K="COLUMN:degC"'),
        ({"ring": 1.4}, "is it another puller's log?"),
    ],
)
def test_wrong_units_and_other_pullers_are_noticed(factor, said, logs):
    log = read_log(logs[0])
    check_puller(log, DEFAULT)
    wrong = log._replace(**{name: getattr(log, name) * by for name, by in factor.items()})
    with pytest.raises(CzError, match=said.replace("(", r"\(")):
        check_puller(wrong, DEFAULT)


def test_a_log_of_a_cone_is_refused(logs):
    log = read_log(logs[0])
    crown = np.linspace(0.3, 2.0, len(log.ring)).clip(max=1.0)
    for shape in (crown, crown[::-1]):
        with pytest.raises(CzError, match=r"more than 13 mm from the body's: .* cut crown and tail off"):
            check_puller(log._replace(ring=log.ring * shape), DEFAULT)
