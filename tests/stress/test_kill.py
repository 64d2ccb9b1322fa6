"""Killed runs lose nothing but what came after the last checkpoint, wherever they are killed."""

from pathlib import Path

import pytest

from tests.stress.kill_at import KILLED, ending
from tests.stress.small_runs import PHASES, check_training, resume, training

pytestmark = pytest.mark.slow


def test_a_training_run_killed_in_every_phase_goes_on(tmp_path: Path) -> None:
    """One run, killed at each point in turn and resumed until nothing is left to do."""
    out, log, torn = tmp_path / "run", tmp_path / "log", []
    for phase, (point, step) in PHASES.items():
        again = ["--resume"] * (out / "settings.json").exists()
        code = ending(training, ["--out", str(out), *again], point, log)
        assert code == KILLED, f"{phase}: {log.read_text()[-2000:]}"
        torn += [phase] * resume(out)
        assert check_training(out) == step, phase
    assert torn == [phase for phase in PHASES if "moves" in phase]
    assert ending(training, ["--out", str(out), "--resume"], None, log) == 0, log.read_text()[-2000:]
    assert check_training(out) == step
    assert (out / "summary.json").exists()
