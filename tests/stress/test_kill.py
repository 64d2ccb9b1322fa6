"""Killed runs lose nothing but what came after the last checkpoint, wherever they are killed."""

from pathlib import Path

import pytest

from tests.stress.kill_at import KILLED, ending
from tests.stress.small_runs import (
    BENCHMARK,
    IMITATION,
    REINFORCEMENT,
    check_benchmark,
    check_training,
    resume,
    slow_benchmark,
    training,
)

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("algo", "phases"), [("imitation", IMITATION), ("ppo", REINFORCEMENT)])
def test_a_training_run_killed_in_every_phase_goes_on(
    algo: str, phases: dict[str, tuple[str, int]], tmp_path: Path
) -> None:
    """One run, killed at each point in turn and resumed until nothing is left to do."""
    out, log, torn = tmp_path / "run", tmp_path / "log", []
    for phase, (point, step) in phases.items():
        again = ["--resume"] * (out / "settings.json").exists()
        code = ending(training, ["--algo", algo, "--out", str(out), *again], point, log)
        assert code == KILLED, f"{phase}: {log.read_text()[-2000:]}"
        torn += [phase] * resume(out)
        assert check_training(out) == step, phase
    assert torn == [phase for phase in phases if "moves" in phase]
    code = ending(training, ["--algo", algo, "--out", str(out), "--resume"], None, log)
    assert code == 0, log.read_text()[-2000:]
    assert check_training(out) == step
    assert (out / "summary.json").exists()
    if algo == "imitation":  # it has no checkpoint before its end
        whole = tmp_path / "whole"
        assert ending(training, ["--algo", algo, "--out", str(whole)], None, log) == 0
        assert (whole / "agent.onnx").read_bytes() == (out / "agent.onnx").read_bytes()


def test_a_benchmark_killed_in_every_phase_leaves_whole_files_and_its_numbers_last(tmp_path: Path) -> None:
    """And episodes of slow controllers, two of which are cached at a time, are not run again."""
    out, log, cached = tmp_path / "results", tmp_path / "log", {}
    for phase, (point, whose) in BENCHMARK.items():
        other = "paper" if "other" in phase else "open-loop"
        code = ending(slow_benchmark, ["--controllers", f"{other},slow", "--out", str(out)], point, log)
        assert code == (KILLED if point else 0), log.read_text()[-2000:]
        assert check_benchmark(out) == whose, phase
        cached[phase] = {file: file.stat().st_mtime_ns for file in tmp_path.glob("cache/*/*.npz")}
    assert (len(cached["episodes"]), len(cached["slow episodes"]), len(cached["figures"])) == (0, 2, 6)
    assert cached["slow episodes"].items() <= cached["figures"].items() == cached["other results, as they move"].items()
