"""Checkpoints: algorithm, best agent and progress in one safetensors file, which holds nothing that could be executed.

A checkpoint fits only an algorithm like the one it was made from: every tensor must have the name, shape and type of
one that is there, so no file can ask for more memory than it has bytes. Hyperparameters are not in it; they are the
run's settings. The run's other files (best agent, progress) are in it too, as bytes: one file is replaced at one
moment, and a resumed run writes the others again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from stable_baselines3.common.base_class import BaseAlgorithm

from cz_gym.agents.agent_file.contract import AgentFileError, read_bounded
from cz_gym.sb3 import environment_steps

FORMAT = "cz-gym-checkpoint-5"
MAX_BYTES = 64_000_000
"""Largest checkpoint that is read."""
MAX_HEADER = 1_000_000
"""Largest header of a checkpoint, the list of its tensors [bytes]."""
FILES = ("agent.onnx", "agent.json", "progress.csv", "progress.png", "summary.json")
"""Files of a run that its checkpoint may hold."""
IN_FILE = "file/"
"""Prefix of a file's name among the tensors."""
MOMENTS = ("mean", "var", "count")
"""Running statistics of VecNormalize, of returns."""
COUNTS = ("step", "exp_avg_sq", "var", "count")
"""Tensors that are never negative."""

Tensors = dict[str, torch.Tensor]


@dataclass(frozen=True)
class Progress:
    """The state of a training run beside its algorithm."""

    steps: int
    """Environment steps taken."""
    seconds: float
    """Time spent, over all sessions [s]."""
    best_cost: float | None
    """Least validation cost so far [-]; None before the first."""


def to_bytes(
    algorithm: BaseAlgorithm, seconds: float, best_cost: float | None, files: Mapping[str, bytes] | None = None
) -> bytes:
    """The checkpoint of an algorithm, without its replay buffer, and the run's ``files`` by name.

    AgentFileError if it learned numbers that are not finite: no run could continue from them.
    """
    progress = Progress(environment_steps(algorithm), seconds, best_cost)
    # Modules that share a tensor each get their copy: the format knows no sharing.
    copies = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in _tensors(algorithm).items()}
    for name, tensor in copies.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise AgentFileError(f"the training went wrong: {name!r:.80} is not finite; the last checkpoint stays")
    header = {"format": FORMAT, "progress": json.dumps(asdict(progress))}
    held = {
        IN_FILE + name: torch.frombuffer(bytearray(data), dtype=torch.uint8) for name, data in (files or {}).items()
    }
    content: bytes = save(copies | held, header)
    return content


def load_checkpoint(path: Path) -> tuple[Progress, Tensors, dict[str, bytes]]:
    """Progress, tensors and the run's files of a checkpoint; AgentFileError says why it cannot be read."""
    content = read_bounded(path, MAX_BYTES)
    end = 8 + int.from_bytes(content[:8], "little")
    if end > MAX_HEADER:
        raise AgentFileError(f"{path}: not a checkpoint of this project, or damaged")
    try:
        tensors: Tensors = load(content)
        header = json.loads(content[8:end])["__metadata__"]
        progress = Progress(**json.loads(header["progress"])) if header["format"] == FORMAT else None
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError, RuntimeError, RecursionError):
        raise AgentFileError(f"{path}: not a checkpoint of this project, or damaged") from None
    if progress is None:
        raise AgentFileError(f"{path}: not a checkpoint of this release ({FORMAT})")
    best = 0.0 if progress.best_cost is None else progress.best_cost
    whole = type(progress.steps) is int and 0 <= progress.steps < 2**63
    if not whole or not all(type(each) is float and 0.0 <= each < math.inf for each in (progress.seconds, best)):
        raise AgentFileError(f"{path}: does not say where the run stood")
    held = {name: tensors.pop(name) for name in [name for name in tensors if name.startswith(IN_FILE)]}
    files = {name.removeprefix(IN_FILE): bytes(each.flatten().view(torch.uint8).numpy()) for name, each in held.items()}
    if not files.keys() <= {*FILES} or any(each.dtype != torch.uint8 for each in held.values()):
        raise AgentFileError(f"{path}: holds a file that is none of {', '.join(FILES)}")
    return progress, tensors, files


def restore(algorithm: BaseAlgorithm, tensors: Tensors, path: Path) -> None:
    """Put a checkpoint's tensors into an algorithm made with the same settings; AgentFileError if they do not fit."""
    live = _tensors(algorithm)
    if set(tensors) != set(live) or not all(_alike(live[name], tensor) for name, tensor in tensors.items()):
        raise AgentFileError(f"{path}: does not fit this run's settings")
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise AgentFileError(f"{path}: {name!r:.80} holds numbers that are not finite")
        if name.rpartition("/")[2] in COUNTS and (tensor < 0).any():
            raise AgentFileError(f"{path}: {name!r:.80} holds numbers below zero")
    with torch.no_grad():
        for name, tensor in tensors.items():
            live[name].copy_(tensor)
    for name, statistics in _statistics(algorithm).items():
        for key in MOMENTS:
            setattr(statistics, key, tensors[f"{name}/{key}"].numpy()[()])


def _tensors(algorithm: BaseAlgorithm) -> Tensors:
    """Every tensor of the algorithm that training changes, by name."""
    states, lone = algorithm._get_torch_save_params()
    tensors: Tensors = {f"{name}/": attrgetter(name)(algorithm) for name in lone}
    for name in states:
        part = attrgetter(name)(algorithm)
        if not isinstance(part, torch.optim.Optimizer):
            tensors |= {f"{name}/{key}": value for key, value in part.state_dict().items()}
            continue
        parameters = [parameter for group in part.param_groups for parameter in group["params"]]
        for index, parameter in enumerate(parameters):
            # As Adam itself initialises a parameter at its first update.
            initial = {key: torch.zeros_like(parameter) for key in ("exp_avg", "exp_avg_sq")}
            initial["step"] = torch.zeros(())
            state = part.state.setdefault(parameter, initial)
            tensors |= {f"{name}/{index}/{key}": state[key] for key in initial}
    for name, statistics in _statistics(algorithm).items():
        tensors |= {f"{name}/{key}": torch.tensor(getattr(statistics, key), dtype=torch.float64) for key in MOMENTS}
    return tensors


def _statistics(algorithm: BaseAlgorithm) -> dict[str, Any]:
    """The running means that rewards are normalised with, by name."""
    env: Any = algorithm.get_vec_normalize_env()
    return {} if env is None else {"ret_rms": env.ret_rms}


def _alike(one: torch.Tensor, other: torch.Tensor) -> bool:
    return one.shape == other.shape and one.dtype == other.dtype
