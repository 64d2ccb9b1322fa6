"""Checkpoints: tensors and numbers in one safetensors file, which holds nothing that could be executed.

A checkpoint fits only the learner it was made from: every tensor must have the name, shape and type of one that is
there, so no file can ask for more memory than it has bytes. Hyperparameters are not in it; they are the run's settings.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from cz_gym.agents.agent_file.contract import AgentFileError, read_bounded

from .replay_buffer import PREFIX, fits, latest, refill

FORMAT = "cz-gym-checkpoint-2"
MAX_BYTES = 64_000_000
"""Largest checkpoint that is read."""
MAX_HEADER = 1_000_000
"""Largest list of its tensors [bytes]."""

Tensors = dict[str, torch.Tensor]


@dataclass(frozen=True)
class Progress:
    """Where a training run stands."""

    steps: int
    """Environment steps taken."""
    updates: int
    """Gradient updates taken."""
    seconds: float
    """Time spent, over all sessions [s]."""
    best_cost: float | None
    """Least validation cost so far [-]; None before the first."""


def to_bytes(learner: Any, seconds: float, best_cost: float | None) -> bytes:
    """The checkpoint of a stable-baselines3 learner; of a replay buffer the latest transitions."""
    progress = Progress(int(learner.num_timesteps), int(learner._n_updates), seconds, best_cost)
    # Modules that share a tensor each get their copy: the format knows no sharing.
    tensors = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in _tensors(learner).items()}
    tensors |= latest(learner)
    content: bytes = save(tensors, {"format": FORMAT, "progress": json.dumps(asdict(progress))})
    return content


def load_checkpoint(path: Path) -> tuple[Progress, Tensors]:
    """Read a checkpoint; AgentFileError says why it cannot be."""
    content = read_bounded(path, MAX_BYTES)
    end = 8 + int.from_bytes(content[:8], "little")
    if end > MAX_HEADER:
        raise AgentFileError(f"{path}: not a checkpoint of this project, or damaged")
    try:
        tensors: Tensors = load(content)
        told = json.loads(content[8:end])["__metadata__"]
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError, RuntimeError, RecursionError):
        raise AgentFileError(f"{path}: not a checkpoint of this project, or damaged") from None
    if told.get("format") != FORMAT:
        raise AgentFileError(f"{path}: not a checkpoint of this release ({FORMAT})")
    try:
        progress = Progress(**json.loads(told["progress"]))
    except (ValueError, KeyError, TypeError, RecursionError):
        raise AgentFileError(f"{path}: does not say where the run stood") from None
    numbers = (progress.steps, progress.updates), (progress.seconds, progress.best_cost or 0.0)
    whole = all(type(number) is int and 0 <= number < 2**63 for number in numbers[0])
    if not whole or not all(type(number) is float and 0.0 <= number < math.inf for number in numbers[1]):
        raise AgentFileError(f"{path}: does not say where the run stood")
    return progress, tensors


def restore(learner: Any, progress: Progress, tensors: Tensors, path: Path) -> None:
    """Put a checkpoint into a learner made with the same settings; AgentFileError if it does not fit."""
    modules, optimisers, variables = _parts(learner)
    experience = {name: tensor for name, tensor in tensors.items() if name.startswith(PREFIX)}
    fixed = {name: tensor for name, tensor in _tensors(learner).items() if name.partition("/")[0] not in optimisers}
    kept = {name: part for name, part in tensors.items() if name.partition("/")[0] not in {*optimisers, PREFIX[:-1]}}
    alike = set(fixed) == set(kept) and all(_alike(fixed[name], kept[name]) for name in fixed)
    if not alike or not fits(learner, experience):
        raise AgentFileError(f"{path}: does not fit this run's settings")
    states = {name: _optimiser_state(name, part, tensors, path) for name, part in optimisers.items()}
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise AgentFileError(f"{path}: {name!r:.80} holds numbers that are not finite")
    for name, module in modules.items():
        module.load_state_dict({key: tensors[f"{name}/{key}"] for key in module.state_dict()})
    for name, optimiser in optimisers.items():
        optimiser.load_state_dict({**optimiser.state_dict(), "state": states[name]})
    for name, variable in variables.items():
        variable.data.copy_(tensors[f"{name}/"])
    refill(learner, experience)
    learner.num_timesteps = progress.steps
    learner._n_updates = progress.updates


def _parts(learner: Any) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """What a learner learns, by name: modules, optimisers, lone variables."""
    states, lone = learner._get_torch_save_params()
    found = {name: attrgetter(name)(learner) for name in states}
    optimisers = {name: part for name, part in found.items() if isinstance(part, torch.optim.Optimizer)}
    modules = {name: part for name, part in found.items() if name not in optimisers}
    return modules, optimisers, {name: attrgetter(name)(learner) for name in lone}


def _tensors(learner: Any) -> Tensors:
    """Every tensor that training changes, by name."""
    modules, optimisers, variables = _parts(learner)
    found = {f"{name}/{key}": value for name, part in modules.items() for key, value in part.state_dict().items()}
    found |= {
        f"{name}/{index}/{field}": value
        for name, part in optimisers.items()
        for index, state in part.state_dict()["state"].items()
        for field, value in state.items()
    }
    return found | {f"{name}/": variable for name, variable in variables.items()}


def _optimiser_state(name: str, optimiser: Any, tensors: Tensors, path: Path) -> dict[int, Tensors]:
    """The state of an optimiser: of each parameter a step count and moments of its shape, or nothing at all."""
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    names = {"step": torch.zeros(()), "exp_avg": None, "exp_avg_sq": None}
    state: dict[int, Tensors] = {}
    for full, tensor in tensors.items():
        owner, _, rest = full.partition("/")
        if owner != name:
            continue
        index, _, field = rest.partition("/")
        known = index.isdecimal() and len(index) < 9 and int(index) < len(parameters) and field in names
        wanted = (parameters[int(index)] if names[field] is None else names[field]) if known else None
        if wanted is None or not _alike(wanted, tensor):
            raise AgentFileError(f"{path}: does not fit this run's settings")
        state.setdefault(int(index), {})[field] = tensor
    sound = all(set(found) == set(names) for found in state.values())
    if not sound or any((found["step"] < 0).any() or (found["exp_avg_sq"] < 0).any() for found in state.values()):
        raise AgentFileError(f"{path}: does not fit this run's settings")
    return state


def _alike(one: torch.Tensor, other: torch.Tensor) -> bool:
    return one.shape == other.shape and one.dtype == other.dtype
