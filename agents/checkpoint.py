"""Checkpoints: tensors and numbers only, written whole, read without executing anything."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cz_gym.evaluation.files import write_files

from .contract import AgentFileError

FORMAT = "cz-gym-checkpoint-1"


@dataclass(frozen=True)
class Checkpoint:
    """Where a training run stands."""

    steps: int
    """Environment steps taken."""
    updates: int
    """Gradient updates taken."""
    best_rmse_mm: float
    """Best validation RMSE so far [mm]; infinite before the first."""
    parameters: dict[str, Any]
    """State dictionaries of networks and optimisers."""


def save_checkpoint(path: Path, learner: Any, best_rmse_mm: float) -> None:
    """Write a checkpoint of a stable-baselines3 learner (a replay buffer is not kept; it fills again)."""
    content = {
        "format": FORMAT,
        "steps": int(learner.num_timesteps),
        "updates": int(learner._n_updates),
        "best_rmse_mm": float(best_rmse_mm),
        "parameters": learner.get_parameters(),
    }
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_files({path: buffer.getvalue()})


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint; AgentFileError says why it cannot be."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise AgentFileError(f"{path}: no such file") from None
    except Exception:  # torch raises whatever its unpickler meets in a broken file
        raise AgentFileError(f"{path}: not a checkpoint of this project, or damaged") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise AgentFileError(f"{path}: not a checkpoint of this release ({FORMAT})")
    try:
        return Checkpoint(content["steps"], content["updates"], content["best_rmse_mm"], content["parameters"])
    except KeyError as missing:
        raise AgentFileError(f"{path}: {missing} is missing") from None


def restore(learner: Any, checkpoint: Checkpoint, path: Path) -> None:
    """Put a checkpoint into a learner made with the same settings; AgentFileError if it does not fit."""
    try:
        learner.set_parameters(checkpoint.parameters, exact_match=True, device="cpu")
    except (ValueError, RuntimeError, KeyError, AttributeError, TypeError):
        raise AgentFileError(f"{path}: does not fit this run's settings") from None
    learner.num_timesteps = checkpoint.steps
    learner._n_updates = checkpoint.updates
