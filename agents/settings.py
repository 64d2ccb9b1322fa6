"""Every hyperparameter of every recipe, in one place."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class ActionHead:
    """How the network's two outputs become an action: skip * (v_p, Q_H applied) + scale * output."""

    skip: float = 1.0
    """1: the network moves the drives from where they are; 0: it sets them."""
    pull_scale: float = 0.05
    """Action per output, pull speed [-]."""
    heater_scale: float = 0.05
    """Action per output, heater [-]."""


@dataclass(frozen=True)
class Recipe:
    """What training shares whatever the algorithm."""

    observation: str = "history"
    scenario: str = "randomized"
    control_interval: float = 5.0
    """Time between actions [s]."""
    num_envs: int = 256
    """Slots trained on at once."""
    privileged_critic: bool = True
    """Whether the critic also sees the true state."""
    hidden: tuple[int, ...] = (128, 128)
    """Widths of actor and of critic."""
    threads: int = 1
    """Threads that torch computes on."""
    head: ActionHead = field(default_factory=ActionHead)


@dataclass(frozen=True)
class PPO:
    """Proximal policy optimisation on the native batch."""

    recipe: Recipe = field(default_factory=Recipe)
    steps: int = 10_000_000
    """Environment steps."""
    n_steps: int = 64
    """Steps a slot between updates."""
    batch_size: int = 2048
    n_epochs: int = 5
    learning_rate: float = 1e-3
    """At the start; it falls linearly to a twentieth."""
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    log_std_init: float = -3.0
    """Logarithm of the action noise's standard deviation at the start."""


@dataclass(frozen=True)
class SAC:
    """Soft actor-critic on the same batch."""

    recipe: Recipe = field(default_factory=lambda: Recipe(num_envs=16, privileged_critic=False))
    steps: int = 400_000
    """Environment steps."""
    buffer_size: int = 400_000
    learning_starts: int = 10_000
    batch_size: int = 512
    gradient_steps: int = 4
    """Updates after each step of all slots."""
    learning_rate: float = 5e-4
    gamma: float = 0.99
    tau: float = 0.01


def describe(settings: Any) -> dict[str, Any]:
    """The settings as plain data."""
    return asdict(settings)
