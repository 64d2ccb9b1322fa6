"""The command: a puller file, a report and pictures; or one line and nothing. The study, on three pullers."""

import re
from dataclasses import replace

import pytest

from cz_gym.puller.file import find_puller, read_puller, write_puller
from cz_gym.tools.identify import command
from cz_gym.tools.identify.file import puller_text
from examples import identify as example
from studies import identify as study


def test_the_command_writes_the_puller_and_its_report(logs, found, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "identify", lambda *_: found)
    out = tmp_path / "new" / "my.toml"
    assert command.main([str(logs[0]), "--out", str(out)]) == 0
    files = {file.name for file in out.parent.iterdir()}
    assert files == {"my-numbers.png", "my-readings.png", "my.md", "my.toml"}
    assert (read_puller(out).hash, read_puller(out).name) == (found.puller.hash, "my")
    text = out.with_suffix(".md").read_text()
    assert text.count("| told |") == sum(e.informed for e in (*found.estimates, *found.noise))
    assert "says nothing about it" in text
    assert "calliper" in text
    assert text.startswith("# The model fits the log")


START = """# Line 3, hall B
format = 1
name = "line 3"
[crystal]
radius_mm = 87.5 # drawing 4711
[hot_zone]
C_1_J_per_K = 57000 # graphite, 30 kg
G_2b_W_per_K = 200
"""


def test_the_file_keeps_what_was_known_and_says_where_each_number_is_from(found, tmp_path):
    (tmp_path / "start.toml").write_text(START)
    start = read_puller(tmp_path / "start.toml")
    text = puller_text(replace(found, start=start), "log.csv", "my")
    (tmp_path / "my.toml").write_text(text)
    mine = read_puller(tmp_path / "my.toml")
    assert (mine.name, mine.hash) == ("line 3", found.puller.hash)
    assert {"T_a_K", "sigma_N_per_m"} <= set(mine.missing), "a default is no fact"
    for line in (
        "# Line 3, hall B", "radius_mm = 87.5 # drawing 4711",
        "# identify: T_a_K = 350 (default, nobody has said it)",
        "# identify: sigma_N_per_m = 0.72 (default, nobody has said it; prior, standard deviation 5 % (handbooks of",
    ):  # fmt: skip
        assert f"\n{line}" in f"\n{text}"
    assert re.search(
        r"C_1_J_per_K = [\d.]+ # graphite, 30 kg; identify: estimated, 95 % interval .* start 5.7e\+04\n", text
    )
    assert re.search(r"\[melt\]\nfluctuation_sd_K = \[.*\] # identify: estimated, 95 % intervals: fast .*, slow", text)
    again = puller_text(replace(found, start=mine), "log.csv", "my")
    assert again.count("graphite, 30 kg; identify: ") == 1


def test_a_model_that_does_not_fit_is_no_result(logs, found, tmp_path, monkeypatch, capsys):
    doubted = [tuple(e._replace(trusted=False) for e in each) for each in (found.estimates, found.noise)]
    odd = replace(found, estimates=doubted[0], noise=doubted[1], misfits=("its T_1 is 1796 K where the log says 1758",))
    monkeypatch.setattr(command, "identify", lambda *_: odd)
    out = tmp_path / "my.toml"
    assert command.main([str(logs[0]), str(logs[0]), "--out", str(out)]) == command.NO_FIT
    assert capsys.readouterr().out.startswith("THE MODEL DOES NOT FIT: its T_1 is 1796 K")
    text = out.with_suffix(".md").read_text()
    assert text.startswith("# THE MODEL DOES NOT FIT: its T_1 is 1796 K")
    assert "| told |" not in text
    assert not out.exists()
    assert command.main([str(logs[0]), "--out", str(out), "--force"]) == command.NO_FIT
    assert read_puller(out).hash == found.puller.hash


def test_the_example_goes_from_a_log_to_a_controller(logs, found, tmp_path, monkeypatch):
    monkeypatch.setattr(example, "identify", lambda *_: found)
    out = tmp_path / "my.toml"
    assert 0.0 < example.main(str(logs[0]), out=str(out)) < 0.2
    assert read_puller(out).hash == found.puller.hash
    assert out.with_suffix(".md").is_file()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--out", "my.txt"], "--out must be a file NAME.toml"),
        (["--series", "my.txt"], "--series must be a file NAME.csv"),
        (["--series", "/proc/none/my.csv"], "/proc/none"),
        (["--prior", "C_1"], "--prior C_1: write it as NAME=SD"),
        (["--prior", "C1=0.1"], "did you mean 'C_1'"),
        (["--column", "T_1_K=PYRO"], ".csv has no column PYRO (it has: time_s, ring_radius_mm, "),
        (["--column", "T_1_K=PYRO"], "); --column T_1_K=NAME:K\n"),
        (["--column", "ring_mm=DIA"], "unknown column 'ring_mm': did you mean 'ring_radius_mm'"),
        (["--column", "T_1_K=PYRO:F"], "unknown unit of T_1_K 'F'; choose from K, degC, degF"),
        (["--column", "T_1_K"], "T_1_K: say which column it is"),
        (["--column", "ring_radius_mm=ring_radius_mm:cm"], "is it another puller's log?"),
        (["--puller", "none.toml"], "none.toml: No such file"),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(options, said, logs, tmp_path, refused):
    given = options if "--out" in options else [*options, "--out", str(tmp_path / "new" / "my.toml")]
    assert said in refused(command.main, [str(logs[0]), *given])
    assert not (tmp_path / "new").exists()


def test_the_file_to_start_from_is_not_written_over(logs, tmp_path, refused):
    start = tmp_path / "start.toml"
    write_puller(find_puller("default"), start)
    text = start.read_text()
    words = [str(logs[0]), "--puller", str(start), "--out", str(tmp_path / "." / "start.toml")]
    assert "is the file to start from" in refused(command.main, words)
    assert start.read_text() == text


@pytest.mark.slow
def test_the_study_identifies_pullers_that_nobody_knows(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(study, "PULLERS", 3)
    monkeypatch.setattr(study, "CRYSTALS", 4)
    assert study.main(["--out", str(tmp_path)]) == 0
    text = (tmp_path / "pullers.txt").read_text()
    assert text in capsys.readouterr().out
    assert "tell the pull speed's path: 0\n" in text
