"""Learned controllers: training with stable-baselines3, and running what was trained without it.

Importing this package needs neither torch nor stable-baselines3; training (:mod:`agents.training`) needs both.
"""

from __future__ import annotations

from pathlib import Path

from .contract import AgentFileError, Contract
from .onnx_policy import OnnxPolicy

__all__ = ["AgentFileError", "Contract", "OnnxPolicy", "shipped"]

MODELS = Path(__file__).parent / "models"


def shipped(name: str = "ppo") -> Path:
    """Path of a trained agent that comes with the package; AgentFileError names what there is."""
    path = MODELS / f"{name}.onnx"
    if not path.is_file():
        there = ", ".join(sorted(file.stem for file in MODELS.glob("*.onnx"))) or "none"
        raise AgentFileError(f"no shipped agent {name!r}; there are: {there}")
    return path
