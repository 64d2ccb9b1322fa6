"""The files of a run's folder beside its checkpoint: settings with provenance, and the progress of validations."""

import csv
import io
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cz_gym.agents.agent_file.contract import MAX_JSON_BYTES, AgentFileError, read_bounded, read_json
from cz_gym.evaluation.files import software

from .recipes import Recipe
from .validation import COLUMNS

PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "stable-baselines3", "torch", "onnx", "onnxruntime")
SETTINGS = {"algorithm": str, "seed": int, "settings": dict, "steps": int, "sessions": list}
"""Fields of ``settings.json`` that a resumed run reads, and their types."""


def check_settings(folder: Path, recipe: Recipe, seed: int) -> list[dict[str, Any]]:
    """The sessions of the run in this folder; AgentFileError if it is another run."""
    path = folder / "settings.json"
    saved = read_settings(path)
    for name, value in identity(recipe, seed).items():
        if saved.get(name) != value:
            raise AgentFileError(f"{path}: the run was begun with another {name}; resume it with the same options")
    return list(saved["sessions"])


def identity(recipe: Recipe, seed: int) -> dict[str, Any]:
    """The settings that a resumed run must share with the one that was begun; it may be longer."""
    settings = {name: value for name, value in asdict(recipe).items() if name != "steps" and value not in ("", ())}
    return {
        "algorithm": recipe.name,
        "seed": seed,
        "settings": json.loads(json.dumps(settings)),
        "plant_hash": recipe.config.plant_hash,
        "scenario_hash": recipe.config.scenario.hash,
    }


def read_settings(path: Path) -> dict[str, Any]:
    """The contents of ``settings.json``; AgentFileError unless a run wrote it."""
    try:
        saved = read_json(path)
        sound = all(type(saved[name]) is kind for name, kind in SETTINGS.items()) and 0 < saved["steps"] < 2**63
        if not sound or not saved["sessions"] or not all(isinstance(session, dict) for session in saved["sessions"]):
            raise KeyError
    except (AgentFileError, KeyError, TypeError, IndexError):
        raise AgentFileError(f"{path}: missing or damaged, so there is nothing to resume") from None
    return dict(saved)


def provenance() -> dict[str, Any]:
    """The command, and the software it runs on: git commit, Python, packages."""
    command = " ".join([Path(sys.executable).name, Path(sys.argv[0]).name, *sys.argv[1:]])
    return {"command": command, "git_commit": _git_commit(), **software(PACKAGES)}


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


def to_csv(rows: Sequence[dict[str, Any]]) -> bytes:
    """The contents of a CSV file, as ``progress.csv``: a line a validation."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of ``progress.csv``; none without a file. AgentFileError if no run wrote it."""
    if not path.exists():
        return []
    try:
        rows = list(csv.DictReader(io.StringIO(read_bounded(path, MAX_JSON_BYTES).decode(), newline="")))
        named = all(list(row)[: len(COLUMNS)] == list(COLUMNS) for row in rows)
        if not named or not all(math.isfinite(float(value)) for row in rows for value in row.values()):
            raise ValueError
    except (ValueError, TypeError, csv.Error):
        raise AgentFileError(f"{path}: damaged; without it the run can be resumed") from None
    return rows
