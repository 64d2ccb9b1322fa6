"""Killed runs lose nothing but what came after the last checkpoint."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cz_gym.atomic_files import alone

ROOT = Path(__file__).parents[2]
KILLS = os.environ.get("CZ_GYM_KILLS", "5")


def test_runs_killed_at_random_moments_go_on() -> None:
    """CZ_GYM_KILLS sets how often."""
    command = [sys.executable, "-m", "tests.stress.kill", "--kills", KILLS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"train.py: {KILLS} kills survived" in done.stdout


def test_a_folder_is_held_by_one_process(tmp_path: Path) -> None:
    code = f"from cz_gym.atomic_files import alone\nwith alone(__import__('pathlib').Path({str(tmp_path)!r})): pass"
    with alone(tmp_path):
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
        assert "another process is at work" in done.stderr
        with pytest.raises(ValueError, match="another process"), alone(tmp_path):
            pass
    with alone(tmp_path):
        pass
