"""The interface between recipes and runs: what every learner can do, whatever it learns from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import torch
from stable_baselines3.common.logger import Logger

Watch = Callable[[int, str], None]
"""Called often while a learner learns, never in the middle of an update, with the environment steps so far and what it
is doing (empty: learning)."""


class Parts(NamedTuple):
    """Everything that training changes, by name: the content of a checkpoint."""

    modules: Mapping[str, torch.nn.Module]
    optimisers: Mapping[str, torch.optim.Optimizer] = {}
    variables: Mapping[str, torch.Tensor] = {}
    replay_buffer: Any = None
    """stable-baselines3's ``ReplayBuffer`` of an off-policy learner."""


class Learner(Protocol):
    """Something that learns to its end, and can be checkpointed and exported at any step."""

    logger: Logger
    """Receives figures of the training, for TensorBoard."""

    @property
    def total(self) -> int:
        """Environment steps that it learns for."""

    @property
    def steps(self) -> int:
        """Environment steps that it has learned from; a checkpoint continues from there."""

    def learn(self, watch: Watch) -> None:
        """Learn what is left to learn."""

    def parts(self) -> Parts:
        """The content of a checkpoint."""

    def exported(self) -> bytes:
        """The agent as it stands, a serialised ONNX model."""
