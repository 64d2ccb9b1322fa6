"""The files of a run's folder but for its checkpoint: settings with provenance, and the progress of validations."""

from __future__ import annotations

import csv
import io
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

from cz_gym.agents.agent_file.contract import MAX_JSON_BYTES, AgentFileError, read_bounded, read_json
from cz_gym.errors import CzError
from cz_gym.evaluation.files import software

from .recipes import RECIPES

REFERENCES = ("paper", "paper-tuned", "lqg")
"""Classical controllers that an agent is shown beside while it learns."""
COLUMNS = (
    "steps",
    "seconds",
    "validation_cost",
    "validation_rmse_mm",
    "pull_step_rms_mm_per_min",
    "failure_rate",
    *(f"{name}_rmse_mm" for name in REFERENCES),
)
"""Columns of ``progress.csv``; the references' figures are the same in every row."""
PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "stable-baselines3", "torch", "onnx", "onnxruntime")


def trained_on(algorithm: str, scenario: str) -> str:
    """The scenarios, in words, whose crystals an agent of that recipe and scenario learned on."""
    also = (name for name, *_ in getattr(RECIPES.get(algorithm), "also", ()) if name)
    *others, last = dict.fromkeys((scenario, *also))
    return f"{', '.join(others)} and {last}" if others else last


def read_settings(path: Path) -> dict[str, Any]:
    """What ``settings.json`` says of a run; AgentFileError unless a run wrote it."""
    try:
        saved = read_json(path)
    except AgentFileError:
        saved = None
    steps, sessions = (saved.get("steps"), saved.get("sessions")) if isinstance(saved, dict) else (None, None)
    whole = type(steps) is int and 0 < steps < 2**63 and isinstance(sessions, list)
    if not whole or not sessions or not all(isinstance(session, dict) for session in sessions):
        raise AgentFileError(f"{path}: missing or damaged, so there is nothing to resume")
    return dict(saved)


def provenance() -> dict[str, Any]:
    """The command, and what it runs on: git commit, Python, packages."""
    return {
        "command": " ".join([Path(sys.executable).name, *_program(), *sys.argv[1:]]),
        "git_commit": _git_commit(),
        **software(PACKAGES),
    }


def _program() -> list[str]:
    """What Python runs, as its command says it: a module of this checkout, or a program's name."""
    path = Path(sys.argv[0])
    here = Path(__file__).resolve().parents[2]
    if path.is_absolute() and path.is_relative_to(here):
        path = path.relative_to(here)
        module = ".".join(path.with_suffix("").parts).removesuffix(".__main__")
        return ["-m", module] if len(path.parts) > 1 else [str(path)]
    return [path.name if path.is_absolute() else str(path)]


def _git_commit() -> str | None:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def to_json(content: Any) -> bytes:
    """The contents of a JSON file."""
    return (json.dumps(content, indent=2) + "\n").encode()


def to_csv(rows: list[dict[str, Any]]) -> bytes:
    """``progress.csv``: a line a validation."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=COLUMNS)
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The validations before this session; AgentFileError if the file is not one that a run wrote."""
    if not path.exists():
        return []
    try:
        rows = list(csv.DictReader(io.StringIO(read_bounded(path, MAX_JSON_BYTES).decode(), newline="")))
        for row in rows:
            if list(row) != list(COLUMNS) or not all(math.isfinite(float(value)) for value in row.values()):
                raise CzError("a row is not one of numbers")
    except (ValueError, TypeError, csv.Error):
        raise AgentFileError(f"{path}: damaged; without it the run can be resumed") from None
    return rows
