"""A run of an example: in a module of its own, so that other processes can be told of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from cz_gym.agents.training.validation import Validation


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


def sb3_ppo(seed: int, **settings: int) -> Validation:
    """The example of stable-baselines3."""
    from examples import sb3_ppo

    return sb3_ppo.main(seed, out=Path(f"runs/plain_tools/sb3-ppo-seed{seed}.onnx"), **settings)


def cleanrl_ppo(seed: int, **settings: int) -> Validation:
    """The example in the manner of CleanRL."""
    from examples import cleanrl_ppo

    return cleanrl_ppo.main(cleanrl_ppo.Args(seed=seed, **settings))


def rllib_ppo(seed: int, **settings: int) -> Validation:
    """RLlib's, where it is installed."""
    from examples import rllib_ppo

    return rllib_ppo.main(seed, **settings)


EXAMPLES: dict[str, Callable[..., Validation]] = {
    "sb3_ppo": sb3_ppo,
    "cleanrl_ppo": cleanrl_ppo,
    "rllib_ppo": rllib_ppo,
}


def timed(name: str, seed: int, steps: int | None) -> Row:
    """Run one training seed of an example, for so many steps; None: its own number."""
    began = time.monotonic()
    found = EXAMPLES[name](seed, **({} if steps is None else {"steps": steps}))
    minutes = (time.monotonic() - began) / 60.0
    return Row(name, seed, minutes, found.rmse_mm, found.pull_step_rms_mm_per_min, found.failure_rate)
