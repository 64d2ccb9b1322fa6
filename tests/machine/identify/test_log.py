"""The log reader: other names and units, gaps, repeats, jitter; one line for what is wrong."""

import csv
from datetime import datetime, timedelta

import numpy as np
import pandas
import pytest

from cz_gym.errors import CzError
from cz_gym.machine.identify.log import check_puller, column_map, read_log
from cz_gym.machine.puller import DEFAULT

Row = dict[str, str]


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
            "DIA": f"{0.2 * float(row['ring_radius_mm']):.12g}".replace(".", ","),
            "SPEED": f"{60.0 * float(row['pull_speed_mm_per_min']):.12g}".replace(".", ","),
            "W": f"{1e3 * float(row['heater_power_kW']):.12g}".replace(".", ","),
            "PYRO": f"{float(row['T_1_K']) - 273.15:.12g}".replace(".", ","),
            "valid": row["valid"],
        }
        for row in read(logs[0])
    ]
    (tmp_path / "map.toml").write_text('ring_radius_mm = "DIA:diameter cm"\npull_speed_mm_per_min = "SPEED:mm/h"\n')
    columns = column_map(["time_s=when:iso", "heater_power_kW=W:W", "T_1_K=PYRO:degC"], tmp_path / "map.toml")
    mine, other = read_log(logs[0]), read_log(write(tmp_path / "other.csv", rows, ";"), columns)
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
    for at, name, value in ((50, "ring_radius_mm", "150"), (60, "valid", "0"), (70, "T_1_K", "nan")):
        rows[at][name] = value
    rows[71]["heater_power_kW"] = ""
    rows[80]["time_s"] = rows[79]["time_s"]
    log = read_log(write(tmp_path / "log.csv", rows[:100] + rows[140:]))
    assert log.interval == pytest.approx(5.0, abs=0.1)
    assert abs(len(log.time) - len(whole.time)) <= 1
    assert log.notes == (
        "1 rows repeat a time", "41 rows are missing", "1 gaps are longer than 120 s",
        "1 readings of the ring are not valid", "1 readings of the ring are outliers",
    )  # fmt: skip
    assert np.flatnonzero(np.isnan(log.T_1)).tolist() == [70, 80, *range(100, 140)]
    assert np.isnan(log.ring[[50, 60, 120]]).all()
    assert np.isfinite([log.v_p, log.Q_H]).all()
    assert log.Q_H[71] == whole.Q_H[70]
    assert np.flatnonzero(log.gap).tolist() == [140]


def changed(name, value, at=400):
    return lambda rows: [row | {name: value} if k == at else row for k, row in enumerate(rows)]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (changed("heater_power_kW", "off"), "row 402: heater_power_kW = 'off' is no number"),
        (changed("time_s", "10"), "row 402: time goes back by 1985 s"),
        (lambda rows: rows[::-1], "row 3: time goes back by 5 s"),
        (changed("pull_speed_mm_per_min", "", 0), "row 2: pull_speed_mm_per_min is missing"),
        (lambda rows: rows[:300], "300 rows over 24.9 min are too short a log"),
        (lambda rows: [row | {"T_1_K": "1800"} for row in rows], "T_1_K is constant"),
        (lambda rows: [row | {"valid": "0"} for row in rows], "ring_radius_mm has only 0 good readings in 2161 rows"),
        (
            lambda rows: [{"T1" if k == "T_1_K" else k: v for k, v in row.items()} for row in rows],
            "unknown column 'T_1_K'",
        ),
        (changed("time_s", "1e9", 2160), "nearly all of it are gaps"),
    ],
)
def test_what_is_wrong_is_one_line_with_its_row(change, said, logs, tmp_path):
    with pytest.raises(CzError) as error:
        read_log(write(tmp_path / "bad.csv", change(read(logs[0]))))
    assert str(error.value).startswith(f"{tmp_path / 'bad.csv'}: ")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


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
