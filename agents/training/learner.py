"""What every learner can do, whatever it learns from: the interface between recipes and runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import torch
from stable_baselines3.common.logger import Logger

Watch = Callable[[int, str], None]
"""Called often while a learner learns, with the environment steps so far and what it is doing (empty: learning)."""


class Parts(NamedTuple):
    """What training changes, by name: all that a checkpoint holds."""

    modules: Mapping[str, torch.nn.Module]
    optimisers: Mapping[str, torch.optim.Optimizer] = {}
    variables: Mapping[str, torch.Tensor] = {}
    replay_buffer: Any = None
    """Of an off-policy learner: stable-baselines3's ``ReplayBuffer``."""


class Learner(Protocol):
    """Something that learns to its end, and can be checkpointed and exported at any step."""

    logger: Logger
    """Where figures of the training go, for TensorBoard."""

    @property
    def total(self) -> int:
        """Environment steps that it learns for."""

    @property
    def steps(self) -> int:
        """Environment steps behind what it has learned, from which a checkpoint goes on."""

    def learn(self, watch: Watch) -> None:
        """Learn what is left to learn."""

    def parts(self) -> Parts:
        """What a checkpoint holds."""

    def exported(self) -> bytes:
        """The agent as it stands, a serialised ONNX model."""
