"""The latest transitions of a replay buffer as tensors of a checkpoint, for off-policy learners."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

MOST = 50_000
"""Largest number of transitions in a checkpoint: 30 MB of "history" observations."""
PREFIX = "replay/"
FIELDS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
FLAGS = ("dones", "timeouts")

Tensors = dict[str, torch.Tensor]


def latest(buffer: Any) -> Tensors:
    """The latest transitions in order, each of shape (steps, slots, ...); nothing without a buffer."""
    if buffer is None:
        return {}
    steps = min(buffer.size(), MOST // buffer.n_envs)
    rows = np.arange(buffer.pos - steps, buffer.pos) % buffer.buffer_size
    return {PREFIX + name: torch.from_numpy(getattr(buffer, name)[rows]) for name in FIELDS}


def fits(buffer: Any, tensors: Tensors) -> bool:
    """Whether these transitions can be put into the buffer."""
    if buffer is None:
        return not tensors
    if set(tensors) != {PREFIX + name for name in FIELDS}:
        return False
    steps = {tensor.shape[0] if tensor.ndim else -1 for tensor in tensors.values()}
    if len(steps) != 1 or not 0 <= steps.pop() <= min(MOST // buffer.n_envs, buffer.buffer_size):
        return False
    return all(_alike(getattr(buffer, name), tensors[PREFIX + name], name in FLAGS) for name in FIELDS)


def refill(buffer: Any, tensors: Tensors) -> None:
    """Put transitions that fit into the empty buffer."""
    if not tensors:
        return
    steps = len(tensors[PREFIX + FIELDS[0]])
    for name in FIELDS:
        getattr(buffer, name)[:steps] = tensors[PREFIX + name].numpy()
    buffer.pos, buffer.full = steps % buffer.buffer_size, steps == buffer.buffer_size


def _alike(array: npt.NDArray[Any], tensor: torch.Tensor, flags: bool) -> bool:
    """Whether a tensor holds rows of this array; flags must be zero or one."""
    alike = tuple(tensor.shape[1:]) == array.shape[1:] and tensor.dtype == torch.from_numpy(array).dtype
    return alike and (not flags or bool(((tensor == 0) | (tensor == 1)).all()))
