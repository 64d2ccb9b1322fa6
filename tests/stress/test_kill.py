"""Killed runs lose nothing but what came after the last checkpoint."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
KILLS = os.environ.get("CZ_GYM_KILLS", "5")


def test_runs_killed_at_random_moments_go_on() -> None:
    """CZ_GYM_KILLS sets how often."""
    command = [sys.executable, "-m", "tests.stress.kill", "--kills", KILLS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"train.py: {KILLS} kills survived" in done.stdout
