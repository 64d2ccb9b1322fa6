"""A run of an example: in a module of its own, which other processes find."""

from __future__ import annotations

import time
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from cz_gym.units import MINUTE


class Row(NamedTuple):
    """What one training seed of an example reached on 100 validation crystals."""

    example: str
    seed: int
    minutes: float
    """From start to judged agent."""
    rmse_mm: float
    pull_step_rms_mm_per_min: float
    lost: float
    """Share of lost crystals [-]."""


def timed(name: str, seed: int, steps: int | None) -> Row:
    """Run one training seed of an example, for so many steps; None: its own number."""
    began, example, given = time.monotonic(), import_module(f"examples.{name}"), dict[str, Any](seed=seed)
    if steps is not None:
        given["steps"] = steps
    if name == "sb3_ppo":
        given["out"] = Path(f"runs/plain_tools/sb3-ppo-seed{seed}.onnx")
    found = example.main(example.Args(**given)) if name == "cleanrl_ppo" else example.main(**given)
    minutes = (time.monotonic() - began) / MINUTE
    return Row(name, seed, minutes, found.rmse_mm, found.pull_step_rms_mm_per_min, found.failure_rate)
