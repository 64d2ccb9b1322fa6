"""The command: a puller file, a report and pictures; or one line and nothing."""

from pathlib import Path

import pytest

from cz_gym.identify.__main__ import main
from cz_gym.puller import read_puller
from tests.identify.puller import TRUTH


def test_the_command_writes_the_puller_and_its_report(logs: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "new" / "my.toml"
    assert main([str(logs[0]), "--out", str(out)]) == 0
    assert sorted(file.name for file in out.parent.iterdir()) == [
        "my-numbers.png", "my-readings.png", "my.md", "my.toml",
    ]  # fmt: skip
    assert abs(read_puller(out).parameters.C_1 / TRUTH.C_1 - 1.0) < 0.05
    text = out.with_suffix(".md").read_text()
    assert text.count("| told |") >= 8
    assert "says nothing about it" in text
    assert "calliper" in text


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--out", "my.txt"], "--out must be a file NAME.toml"),
        (["--prior", "C_1"], "--prior C_1: write it as NAME=SD"),
        (["--prior", "C1=0.1"], "did you mean 'C_1'"),
        (["--column", "T_1_K=PYRO"], "unknown column 'PYRO'"),
        (["--column", "ring_radius_mm=ring_radius_mm:cm"], "is it another puller's log?"),
        (["--puller", "none.toml"], "none.toml: No such file"),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(
    options: list[str], said: str, logs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = options if "--out" in options else [*options, "--out", str(tmp_path / "new" / "my.toml")]
    assert main([str(logs[0]), *given]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "new").exists()
