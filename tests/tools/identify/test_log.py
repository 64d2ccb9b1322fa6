"""The log reader: other names and units, gaps, repeats, jitter; one line for what is wrong."""

import numpy as np
import pandas
import pytest

from cz_gym.puller.file import DEFAULT
from cz_gym.support.errors import CzError
from cz_gym.tools.identify.log import check_puller, column_map, parse_times, read_log
from tests.foreign_puller import ForeignPuller, Operator, drive, write_log


def write(path, rows, separator=","):
    rows.to_csv(path, sep=separator, index=False)
    return path


def stamped(rows, form, start="2026-03-01T12:00:00"):
    times = pandas.Timestamp(start) + pandas.to_timedelta(rows["time_s"].astype(float), unit="s")
    return rows.assign(time_s=times.dt.strftime(form))


def german(rows):
    return rows.map(lambda text: text.replace(".", ","))


def every(name, value):
    """A change of a column of every row: a value, or a function of the text before."""
    return lambda rows: rows.assign(**{name: rows[name].map(value) if callable(value) else value})


def changed(name, value, at=400):
    """A change of one row."""
    return lambda rows: rows.assign(**{name: rows[name].where(rows.index != at, value)})


@pytest.fixture(scope="session")
def rows(logs):
    """The log with excitation, as text."""
    return pandas.read_csv(logs[0], dtype=str)


def test_other_names_units_and_separators_are_the_same_log(logs, rows, tmp_path):
    number = rows.astype(float)
    others = {
        "DIA": 0.2 * number.ring_radius_mm, "W": 1e3 * number.heater_power_kW, "PYRO": number.T_1_K - 273.15,
        "SPEED": 60.0 * number.pull_speed_mm_per_min,
    }  # fmt: skip
    other = german(pandas.DataFrame({name: value.map("{:.12g}".format) for name, value in others.items()}))
    other["when"] = stamped(rows, "%Y-%m-%dT%H:%M:%S+02:00").time_s
    (tmp_path / "map.toml").write_text('ring_radius_mm = "DIA:diameter cm"\npull_speed_mm_per_min = "SPEED:mm/h"\n')
    columns = column_map(["time_s=when:iso", "heater_power_kW=W:W", "T_1_K=PYRO:degC"], tmp_path / "map.toml")
    mine, other = read_log(logs[0]), read_log(write(tmp_path / "other.csv", other, ";"), columns)
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


def test_gaps_repeats_jitter_and_outliers_are_counted(logs, rows, tmp_path):
    whole, rows = read_log(logs[0]), rows.copy()
    rows["time_s"] = [f"{float(time) + 0.8 * np.sin(k):.3f}" for k, time in enumerate(rows["time_s"])]
    for row, name, value in (
        (50, "ring_radius_mm", "150"), (60, "valid", "0"), (71, "heater_power_kW", ""), (70, "T_1_K", "nan"),
        (90, "T_1_K", "inf"), (80, "time_s", rows.time_s[79]),
    ):  # fmt: skip
        rows.loc[row, name] = value
    log = read_log(write(tmp_path / "log.csv", rows.drop(index=range(100, 140))))
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
        (lambda rows: rows.assign(**{" T_1_K": "1800"}), "two columns are called 'T_1_K'"),
        (lambda rows: rows[:300], "300 rows over 24.9 min are too short a log"),
        (every("T_1_K", "1800"), "T_1_K is constant"),
        (every("valid", "0"), "has only 0 good readings in 2161 rows: the column valid calls 2161 of them bad"),
        (changed("time_s", "time"), "row 402: time_s = 'time' is no time in s"),
        (lambda rows: rows.rename(columns={"T_1_K": "T1"}), "; --column T_1_K=NAME:K"),
        (changed("time_s", "1e9", 2160), "nearly all of it are gaps"),
        (lambda rows: stamped(rows, "%m/%d/%Y %H:%M:%S", "2026-03-11T23:00:00"), "did you mean time_s=time_s:mdy?"),
        (lambda rows: stamped(rows, "%d-%b-%y %H:%M:%S"), "did you mean time_s=time_s:iso"),
        (every("time_s", lambda time: f"{46082.5 + float(time) / 86400:.8f}"), "did you mean time_s=COLUMN:d?"),
        (every("time_s", lambda time: f"{int((1.7e9 + float(time)) * 1e9)}"), "did you mean time_s=COLUMN:ns?"),
        (every("time_s", lambda time: f"{int((1.7e9 + float(time)) * 1e6)}"), "did you mean time_s=COLUMN:us?"),
        (every("time_s", lambda time: f"{(13344473600 + int(time)) * 10**7}"), "did you mean time_s=COLUMN:100ns?"),
        (lambda rows: stamped(rows, "%Y%m%d%H%M%S"), "did you mean time_s=time_s:iso?"),
        (changed("T_1_K", "1785.2 K"), "row 402: T_1_K = '1785.2 K' is no number"),
        (every("T_1_K", "Bad Input"), "row 2: T_1_K = 'Bad Input' is no number"),
        (changed("valid", "maybe"), "row 402: valid = 'maybe' is no quality"),
        (
            lambda rows: rows.assign(T_1_K=rows.T_1_K.where(rows.index % 5 == 0, "")),
            "if blank means unchanged, say --hold",
        ),
    ],
)
def test_what_is_wrong_is_one_line_with_its_row(change, said, rows, tmp_path):
    with pytest.raises(CzError) as error:
        read_log(write(tmp_path / "bad.csv", change(rows)))
    assert str(error.value).startswith((f"{tmp_path / 'bad.csv'}: ", f"{tmp_path / 'bad.csv'} has no column "))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def thousands(rows):
    return every("T_1_K", lambda T_1: f"{T_1[0]}.{T_1[1:]}")(german(rows))


def inches(rows):
    rows = every("ring_radius_mm", lambda ring: f"{float(ring) / 25.4:.10g}")(rows)
    return every("T_1_K", lambda T_1: f"{1.8 * float(T_1) - 459.67:.10g}")(rows)


def summer(rows):
    parts = (rows[:1080], "01"), (rows[1080:], "00")
    return pandas.concat([stamped(part, "%F %T", f"2026-10-25T{hour}:29:57.5") for part, hour in parts])


def two_columns(rows):
    time = stamped(rows, "%d.%m.%Y %H:%M:%S", "2026-03-01T23:00:00").time_s.str
    return rows.drop(columns="time_s").assign(Date=time[:10], Time=time[11:])


def spring(rows):
    parts = (rows[:1080], "00:30:00"), (rows[1080:], "01:30:00")
    return pandas.concat([stamped(part, "%F %T", f"2026-03-29T{at}") for part, at in parts])


def serials(rows):
    return rows.assign(time_s=[f"{46082.5 + float(time) / 86400:.9f}" for time in rows.time_s])


def epochs(per):
    return every("time_s", lambda time: str((1_700_000_000 + int(time)) * per))


def noted(mark):
    return lambda rows: rows.assign(note=[f"charge{mark}done" if k == 50 else "" for k in rows.index])


def graded(good, bad):
    """Qualities in words or codes; the bad ones are those of every 50th row."""
    return lambda rows: rows.assign(valid=[bad if k % 50 == 7 else good for k in rows.index])


def phases(rows):
    """Rows of a neck before those of the body, as a production log has them."""
    neck = rows[:100].assign(ring_radius_mm="70", OPERATION="NECK", INGOT="7")
    neck["time_s"] = [f"{float(time) - 3600.0}" for time in neck.time_s]
    return pandas.concat([neck, rows.assign(OPERATION="BODY", INGOT="7")])


def spiked(name, value):
    return lambda rows: pandas.concat([rows[rows.index % 400 != 200], every(name, value)(rows[200::400])]).sort_index()


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
    "beginning of summer time (opennem #622)": (spring, "time_s=time_s:iso"),
    "months by name (buckets #702)": (lambda rows: stamped(rows, "%d-%b-%y %H:%M:%S"), "time_s=time_s:dmy"),
    "months by name, with the year first": (lambda rows: stamped(rows, "%Y-%b-%d %H:%M:%S.000"), "time_s=time_s:iso"),
    "months by German name": (
        lambda rows: every("time_s", lambda time: time.replace("May", "Mai"))(
            stamped(rows, "%d. %b %Y %H:%M:%S", "2026-05-31T23:00:00")), "time_s=time_s:dmy",
    ),
    "a weekday, month first": (lambda rows: stamped(rows, "%a %b %d, %Y %I:%M:%S %p"), "time_s=time_s:iso"),
    "the year at the end, as C writes it": (
        lambda rows: stamped(rows, "%a %b %d %H:%M:%S %Y"), "time_s=time_s:iso",
    ),
    "compact times": (lambda rows: stamped(rows, "%Y%m%dT%H%M%S"), "time_s=time_s:iso"),
    "compact times in one number": (lambda rows: stamped(rows, "%Y%m%d%H%M%S"), "time_s=time_s:iso"),
    "a colon before the clock, as web servers write it": (
        lambda rows: stamped(rows, "%d/%b/%Y:%H:%M:%S +0000"), "time_s=time_s:iso",
    ),
    "a short weekday, dots and Uhr": (lambda rows: stamped(rows, "So, %d.%m.%Y %H.%M.%S Uhr"), "time_s=time_s:dmy"),
    "small letters, and a zone by name alone": (
        lambda rows: stamped(rows, "%Y-%m-%dt%H:%M:%S Europe/Berlin"), "time_s=time_s:iso",
    ),
    "elapsed hours of more than a day": (
        every("time_s", lambda time: f"{30 + int(time) // 3600}:{int(time) // 60 % 60:02}:{int(time) % 60:02}"),
        "time_s=time_s:clock",
    ),
    "differences of times, as pandas writes them": (
        every("time_s", lambda time: str(pandas.Timedelta(23 * 3600 + int(time), unit="s"))), "time_s=time_s:clock",
    ),
    "a zone by name (delorean #101)": (
        lambda rows: stamped(rows, "%Y-%m-%dT%H:%M:%S+01:00[Europe/Berlin]"), "time_s=time_s:iso",
    ),
    "AM and PM": (lambda rows: stamped(rows, "%I:%M:%S %p", "2026-03-01T11:00:00"), "time_s=time_s:clock"),
    "AM and PM behind a date": (lambda rows: stamped(rows, "%m/%d/%Y %I:%M:%S %p"), "time_s=time_s:mdy"),
    "days of a spreadsheet (duckle #104)": (serials, "time_s=time_s:d"),
    "ticks of 100 ns since 1601": (
        every("time_s", lambda time: str((13_344_473_600 + int(time)) * 10**7)), "time_s=time_s:100ns",
    ),
    "nanoseconds since 1970": (epochs(10**9), "time_s=time_s:ns"),
    "microseconds since 1970": (epochs(10**6), "time_s=time_s:us"),
    "a next line inside a field": (noted("\x85"),),
    "a line separator inside a field (gluonts PR 920)": (noted("\u2028"),),
    "a form feed inside a field": (noted("\x0c"),),
    "a line feed inside quotes": (noted("\n"),),
    "inf in a column (cta-lstchain PR 429)": (spiked("T_1_K", "-inf"),),
    "a pyrometer row 30 K off": (spiked("T_1_K", lambda T_1: f"{float(T_1) + 30.0}"),),
    "pyrometer rows at -9999": (spiked("T_1_K", "-9999"),),
    "pyrometer rows at 0 degC": (spiked("T_1_K", "273.15"),),
    "heater rows at 0": (spiked("heater_power_kW", "0"),),
    "pull rows at 0": (spiked("pull_speed_mm_per_min", "0"),),
}  # fmt: skip
"""Kinds of logs, with the tracker and number of a public report of the kind."""


@pytest.mark.parametrize("kind", FORMATS)
def test_every_kind_of_table_is_the_same_log(kind, logs, rows, tmp_path):
    change, *columns = FORMATS[kind]
    separator = "\t" if "tab" in kind else ";" if "comma" in kind else ","
    mine = read_log(logs[0])
    other = read_log(write(tmp_path / "log.csv", change(rows), separator), column_map(columns))
    good = np.isfinite(other.T_1) & (other.unsure == 0.0).all(axis=1)
    spikes = 5 if "row" in kind or "inf" in kind else 0
    assert (good.sum(), len(good)) == (2161 - spikes, 2161)
    assert len(other.notes) == (2 if "inf" in kind else 1 if spikes or "summer" in kind else 0), other.notes
    for name in ("time", "ring", "v_p", "Q_H", "T_1"):
        ours, theirs = (getattr(log, name)[good] for log in (mine, other))
        np.testing.assert_allclose(theirs, ours, rtol=1e-6, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    ("form", "words"),
    [("%d-%b-%y %H:%M:%S", {"Mar": "mrt", "Apr": "apr"}), ("%d de %B de %Y %T", {"March": "março", "April": "abril"}),
     ("%d %b %Y %H:%M:%S", {"Mar": "мар", "Apr": "апр"}), ("%Y-%m-%d %H:%M:%S UTC+01:00", {}), ("%F %T (GMT-3)", {}),
     ("%Y-%m-%d %H:%M:%S AEDT", {}), ("%Y-%m-%dT%H:%M:%SZ[UTC]", {}), ("%Y%m%d %H%M%S", {}), ("%Y%m%d-%T.000", {}),
     ("%Y-%m-%d-%H.%M.%S.000000", {}), ("%Y-%m-%d_%H-%M-%S", {}), ("%H:%M:%S %Y-%m-%d", {}),
     ("%a %b %d %Y %H:%M:%S GMT+0100 (Central European Time)", {}), ("%Y年%m月%d日 %H時%M分%S秒", {}),
     ("%Y-%m-%d %I:%M:%S %p", {"AM": "a. m.", "PM": "p. m."})],
)  # fmt: skip
def test_a_time_may_be_written_in_any_way_and_crosses_a_month(form, words):
    text = pandas.Series(pandas.date_range("2026-03-31T23:50:00", periods=300, freq="5s").strftime(form), name="when")
    for word, other in words.items():
        text = text.str.replace(word, other)
    assert parse_times(text, "iso", {}).diff()[1:].eq(5.0).all()
    with pytest.raises(CzError, match="did you mean time_s=when:iso"):
        parse_times(text, "s", {})


def test_words_that_no_list_has_need_a_log_of_one_month_and_zone():
    """A log's times count from its first: an unknown name of a month or zone that never changes adds nothing."""
    text = pandas.Series(
        pandas.date_range("2026-03-31T23:50:00", periods=240, freq="5s").strftime("%d maaliskuu %Y %T XYZ")
    )
    assert parse_times(text[:120], "iso", {}).diff()[1:].eq(5.0).all()
    for old, new in (("maalis", "huhti"), ("XYZ", "ABC")):
        other = text.where(text.index < 120, text.str.replace(old, new))
        with pytest.raises(CzError, match="is no time in iso"):
            parse_times(other, "iso", {})


@pytest.mark.parametrize("form", ["%H%M%S", "%y%m%d%H%M%S", "%Y%m%d%H%M%S", "%Y%m%d %H%M%S"])
def test_digits_of_a_clock_are_no_seconds(form):
    """From 12:00:55 to 12:01:00 they grow by 45."""
    text = pandas.Series(pandas.date_range("2026-03-01T12:00:00", periods=300, freq="5s").strftime(form))
    with pytest.raises(CzError, match="is no time in s"):
        parse_times(text, "s", {})
    for seconds in (
        range(0, 1500, 5),
        range(0, 1_500_000, 5000),
        range(1_772_366_400, 1_772_366_400 + 15_000, 50),
        range(10_000, 28_000, 60),
    ):
        assert parse_times(pandas.Series(map(str, seconds)), "s", {}).tolist() == [*map(float, seconds)]


def test_rows_whose_month_is_unknown_are_no_footer():
    text = pandas.Series(pandas.date_range("2026-03-31T23:50:00", periods=240, freq="5s").strftime("%d %b %Y %T"))
    assert len(parse_times(pandas.concat([text, pandas.Series(["mean of all"])]), "iso", {})) == 240
    with pytest.raises(CzError, match=r"row 120: .*'01 Nis 2026 00:00:00' is no time in iso, as in 120 rows"):
        parse_times(text.str.replace("Apr", "Nis"), "iso", {})


def test_minutes_and_seconds_are_no_hours_and_minutes():
    text = pandas.Series([f"{k // 60:02}:{k % 60:02}" for k in range(0, 2400)])
    with pytest.raises(CzError, match="is no time in clock"):
        parse_times(text, "clock", {})


@pytest.mark.parametrize(
    ("good", "bad"),
    [("1", "0"), ("1.0", "0.0"), ("TRUE", "FALSE"), ("true", "false"), ("Good", "Bad"), ("192", "0"), ("216", "24"),
     ("0", "2147483648"), ("0xC0", "0x18"), ("0x00000000", "0x80000000"), ("0x00000000", "0x40000000"), ("100", "0"),
     ("Good [Local Override]", "Uncertain"), ("OK", ""), ("G", "B"), ("0 (Good)", "1 (Bad)"), ("Q_GOOD", "Q_BAD"),
     ("192 - Good", "0 - Not Good"), ("WAHR", "FALSCH"), ("vrai", "faux"), ("0x1B0", "0x0F"), ("OK", "NOK"),
     ("0x000000C0", "0x00000008"), ("100%", "0%"), ("OPC_QUALITY_GOOD", "OPC_QUALITY_COMM_FAILURE")],
)  # fmt: skip
def test_qualities_of_any_historian_leave_out_the_same_readings(good, bad, rows, tmp_path):
    log = read_log(write(tmp_path / "log.csv", graded(good, bad)(rows)))
    assert np.flatnonzero(np.isnan(log.ring)).tolist() == (list(range(7, 2161, 50)) if bad else [])


def test_words_among_numbers_are_missing_and_counted(rows, tmp_path):
    rows = rows.assign(T_1_K=rows.T_1_K.mask(rows.index.isin([100, 101]), "Bad Input"))
    rows = changed("T_1_K", "1.#QNAN0", 102)(rows)
    log = read_log(write(tmp_path / "log.csv", changed("heater_power_kW", "I/O Timeout", 200)(rows)))
    assert np.flatnonzero(np.isnan(log.T_1)).tolist() == [100, 101, 102]
    assert np.flatnonzero(log.unsure[:, 1]).tolist() == [200]
    assert "3 fields of T_1_K are words and count as missing: 'Bad Input', '1.#QNAN0'" in log.notes
    assert "1 fields of heater_power_kW are words and count as missing: 'I/O Timeout'" in log.notes


def test_nul_bytes_of_a_power_failure_cost_their_rows_alone(logs, tmp_path):
    lines, mine = logs[0].read_bytes().split(b"\n"), read_log(logs[0])
    for head, tail in ((b"", b"\0" * 512), (b"\0" * 100, b""), (b"# ", b"")):
        (tmp_path / "log.csv").write_bytes(head + logs[0].read_bytes() + tail)
        assert read_log(tmp_path / "log.csv").notes == ()
    (tmp_path / "log.csv").write_bytes(b"\n\n".join([*lines[:400], lines[0], *lines[400:]]))
    assert read_log(tmp_path / "log.csv").notes == ()  # blank lines, and names again
    lines[400] = lines[400][:20] + b"\0" * 40
    lines[900] = lines[899][:9] + b"\0" * 40 + lines[900]
    (tmp_path / "log.csv").write_bytes(b"\n".join(lines))
    log = read_log(tmp_path / "log.csv")
    assert log.notes[0] == "1 rows are lost in NUL bytes, as after a power failure"
    assert np.flatnonzero(np.isnan(log.T_1)).tolist() == [399]
    np.testing.assert_array_equal(log.T_1[400:], mine.T_1[400:])
    lines[1000] = lines[1000].replace(b",", b",0_", 1)
    (tmp_path / "log.csv").write_bytes(b"\n".join(lines))
    with pytest.raises(CzError, match=r"row 1001: ring_radius_mm = '0_"):
        read_log(tmp_path / "log.csv")


def test_the_index_of_a_parquet_file_is_its_time(logs, tmp_path):
    table, mine = pandas.read_csv(logs[0]), read_log(logs[0])
    stamps = pandas.Timestamp("2026-03-01 12:00:05") + pandas.to_timedelta(table.time_s, unit="s")
    for index, columns in ((table.time_s, []), (stamps.rename("when"), ["time_s=when:iso"])):
        table.drop(columns="time_s").set_index(index).to_parquet(tmp_path / "log.parquet")
        np.testing.assert_allclose(read_log(tmp_path / "log.parquet", column_map(columns)).time, mine.time)


def test_blanks_that_mean_unchanged_are_held_and_named(logs, rows, tmp_path):
    stepped = rows.assign(heater_power_kW=[rows.heater_power_kW[k // 3 * 3] for k in rows.index])
    whole = read_log(write(tmp_path / "whole.csv", stepped))
    blank = stepped.assign(heater_power_kW=stepped.heater_power_kW.where(rows.index % 3 == 0, ""))
    path = write(tmp_path / "log.csv", blank)
    held, filled = read_log(path, hold=True), read_log(path)
    np.testing.assert_array_equal(held.Q_H, whole.Q_H)
    assert not held.unsure.any()
    assert np.abs(filled.Q_H - whole.Q_H).max() > 100.0
    said = "1440 fields of heater_power_kW are blank, and all fit 'unchanged': --hold holds the last value"
    assert said in filled.notes
    assert not any("--hold" in note for note in (*whole.notes, *read_log(logs[0]).notes))


def test_the_dead_band_of_a_historian_is_named(logs, rows, tmp_path):
    last, held = -1e9, []
    for value in rows.T_1_K.astype(float):
        last = value if abs(value - last) > 0.5 else last
        held.append(f"{last:.6f}")
    log = read_log(write(tmp_path / "log.csv", rows.assign(T_1_K=held)))
    assert any("changes of T_1_K are all of 0.5 K or more, as behind the dead band" in note for note in log.notes)
    quantised = rows.assign(T_1_K=[f"{round(2.0 * float(value)) / 2.0}" for value in rows.T_1_K])
    assert not any("dead band" in note for note in read_log(write(tmp_path / "log.csv", quantised)).notes)


def test_rows_are_selected_by_what_a_column_says(logs, rows, tmp_path):
    path, mine = write(tmp_path / "log.csv", phases(rows)), read_log(logs[0])
    with pytest.raises(CzError, match="--where COLUMN=VALUE"):
        check_puller(read_log(path), DEFAULT)
    for where in (["OPERATION=BODY"], ["OPERATION = BODY", "INGOT=7"], ["OPERATION=BODY", "OPERATION=TAIL"]):
        np.testing.assert_array_equal(read_log(path, where=where).ring, mine.ring)
    for where, said in (
        ("OPERATION=BDY", r"no row has OPERATION = 'BDY'; it holds 'BODY' \(2161 rows\), 'NECK' \(100 rows\)"),
        ("PHASE=BODY", "unknown column 'PHASE'"),
        ("OPERATION", "--where OPERATION: write it as COLUMN=VALUE"),
    ):
        with pytest.raises(CzError, match=said):
            read_log(path, where=[where])
    odd = changed("heater_power_kW", "off", 401)(phases(rows).reset_index(drop=True))
    with pytest.raises(CzError, match=r"row 403: heater_power_kW = 'off'"):
        read_log(write(tmp_path / "log.csv", odd), where=["OPERATION=BODY"])


def test_the_clock_of_the_camera_is_named(rows, tmp_path):
    for late, said in ((9.0, "the camera's clock is 9 s behind"), (-5.0, "the camera's clock is 5 s ahead")):
        stamped_rows = rows.assign(frame_time_s=[f"{float(time) - late}" for time in rows.time_s])
        (note,) = read_log(write(tmp_path / "log.csv", stamped_rows)).notes
        assert note.startswith(said)


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
