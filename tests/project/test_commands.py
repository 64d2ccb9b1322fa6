"""Every command: one line for options that cannot be meant, one line for Ctrl-C, and nothing left behind."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest

import benchmark
from cz_gym.baselines.tuning import lqg as lqg_tune
from cz_gym.baselines.tuning import pid as tune
from cz_gym.commands import OneLineParser, guarded, interrupted
from cz_gym.play import __main__ as play
from studies.design_table import __main__ as design_table
from studies.film import __main__ as film
from studies.industrial import __main__ as industrial_check
from studies.paper import __main__ as paper
from studies.speed import __main__ as speed
from studies.young_laplace import __main__ as young_laplace_build

COMMANDS = [
    (benchmark, "--episode"),
    (paper, "--ou"),
    (tune, "--trial"),
    (lqg_tune, "--hist"),
    (design_table, "--puller"),
    (industrial_check, "--episode"),
    (speed, "--qui"),
    (young_laplace_build, "--wri"),
    (play, "--minute"),
    (film, "--frame"),
]
"""Each with the beginning of one of its options."""
WORK = [
    (paper, "contents", ["--out", "new/folder"]),
    (tune, "search", ["--controller", "industrial", "--out", "new/folder"]),
    (lqg_tune, "search", ["--output", "new/folder/lqg.json"]),
    (design_table, "table", ["--out", "new/folder"]),
    (industrial_check, "rollout", []),
    (speed, "run", ["--quick"]),
    (young_laplace_build, "build", ["--write"]),
    (play, "settings", []),
    (film, "film", ["--out", "new/film.gif"]),
]
"""Each with the function that does its work, and arguments that would write a file."""


def interrupt(*arguments: Any, **named: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("wrong", ["--frobnicate", "abbreviation"])
@pytest.mark.parametrize(("module", "beginning"), COMMANDS, ids=lambda part: getattr(part, "__name__", None))
def test_bad_options_get_one_line(module: Any, beginning: str, wrong: str, capsys: pytest.CaptureFixture[str]) -> None:
    required = ["--controller", "industrial"] if module is tune else []
    with pytest.raises(SystemExit) as stop:
        module.main([*required, beginning if wrong == "abbreviation" else wrong])
    assert stop.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert "unrecognized arguments" in captured.err


@pytest.mark.parametrize(("module", "work", "arguments"), WORK, ids=lambda part: getattr(part, "__name__", None))
def test_an_interrupt_is_one_line_and_leaves_nothing(
    module: Any, work: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, work, interrupt)
    if module is young_laplace_build:
        monkeypatch.setattr(module, "TABLE", tmp_path / "new" / "table.py")
    assert module.main(arguments) == 130
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert "interrupted" in captured.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("module", "work", "arguments"),
    [(*row[:2], [str(part).replace("new/", "file/") for part in row[2]]) for row in WORK if "new/" in str(row[2])]
    + [(speed, "run", ["--quick", "--json", "file/speed.json"])],
    ids=lambda part: getattr(part, "__name__", None),
)
def test_a_place_that_cannot_be_written_is_refused_before_the_work(
    module: Any, work: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, work, interrupt)
    (tmp_path / "file").write_text("not a folder")
    assert module.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert "file is not a folder" in captured.err


def test_help_of_the_meniscus_writes_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(young_laplace_build, "TABLE", tmp_path / "table.py")
    monkeypatch.setattr(young_laplace_build, "build", interrupt)
    with pytest.raises(SystemExit) as stop:
        young_laplace_build.main(["--help"])
    assert stop.value.code == 0
    assert not list(tmp_path.iterdir())


def test_the_meniscus_is_written_only_when_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = importlib.import_module("cz_gym.physics.young_laplace_table")
    shipped = young_laplace_build.Tables(table.SLOPE, table.RING, table.TAIL)
    monkeypatch.setattr(young_laplace_build, "TABLE", tmp_path / "table.py")
    monkeypatch.setattr(young_laplace_build, "build", lambda: shipped)
    assert young_laplace_build.main([]) == 0
    assert "nothing written" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
    assert young_laplace_build.main(["--write"]) == 0
    assert (tmp_path / "table.py").read_bytes() == Path(table.__file__).read_bytes()


def test_a_message_of_several_lines_becomes_one(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        OneLineParser("it").parse_args(["two\nlines"])
    assert capsys.readouterr().err == "it: unrecognized arguments: two lines\n"
    assert interrupted("it") == 130


def _missing() -> int:
    raise ModuleNotFoundError("No module named 'absent'", name="absent")


def _other_version() -> int:
    raise ImportError("cannot import name 'one' from 'present'", name="present")


def _wrong() -> int:
    raise ValueError("first line\nsecond line")


def _gone() -> int:
    raise FileNotFoundError(2, "No such file or directory", "there.csv")


def _stopped() -> int:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("body", "code", "said"),
    [
        (lambda: 0, 0, ""),
        (_missing, 2, 'prog: absent is missing: pip install "cz-gym[agents]"\n'),
        (_other_version, 2, "prog: cannot import name 'one' from 'present'\n"),
        (_wrong, 2, "prog: first line second line\n"),
        (_gone, 2, "prog: there.csv: No such file or directory\n"),
        (_stopped, 130, "prog: interrupted; runs are kept\n"),
    ],
)
def test_whatever_ends_a_command_is_one_line(
    body: Any, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert guarded("prog", body, "agents", "runs are kept") == code
    assert capsys.readouterr().err == said
