"""Checkpoints: algorithm, best agent and progress in one file, a model of stable-baselines3 with a few members more.

One file is replaced at one moment, and a resumed run writes the run's other files again from it. Only tensors are read
from the model (``torch.load`` with ``weights_only``), never pickled objects: hyperparameters are the run's settings.
"""

import io
import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, save_to_zip_file

from cz_gym.agents.agent_file.contract import AgentFileError, read_bounded
from cz_gym.sb3 import environment_steps

PROGRESS = "cz-gym-checkpoint-6.json"
"""Member that holds :class:`Progress`; its name says the format's version."""
MAX_BYTES = 64_000_000
"""Largest checkpoint that is read."""
FILES = ("agent.onnx", "agent.json", "progress.csv", "progress.png", "summary.json")
"""Files of a run that its checkpoint may hold."""


class Progress(NamedTuple):
    """The state of a training run beside its algorithm's tensors."""

    steps: int
    """Environment steps taken."""
    seconds: float
    """Time spent, over all sessions [s]."""
    best_cost: float | None
    """Least validation cost so far [-]; None before the first."""
    returns: tuple[float, ...]
    """Mean, variance and count of the returns that rewards are normalised with; empty without a VecNormalize."""


class Learned(NamedTuple):
    """The tensors of an algorithm that training changes."""

    states: dict[str, Any]
    """State of each network and optimiser, by name."""
    variables: dict[str, torch.Tensor]
    """Tensors that belong to none of them, by name."""


def to_bytes(
    algorithm: BaseAlgorithm, seconds: float, best_cost: float | None, files: Mapping[str, bytes] | None = None
) -> bytes:
    """The checkpoint of an algorithm, without its replay buffer, and the run's ``files`` by name.

    AgentFileError if it learned numbers that are not finite: no run could continue from them.
    """
    lone = algorithm._get_torch_save_params()[1]
    learned = Learned(algorithm.get_parameters(), {name: attrgetter(name)(algorithm) for name in lone})
    if not all(tensor.isfinite().all() for tensor in _tensors(learned)):
        raise AgentFileError("the training went wrong: a weight is not finite; the last checkpoint stays")
    env: Any = algorithm.get_vec_normalize_env()
    returns = (
        () if env is None else tuple(float(each) for each in (env.ret_rms.mean, env.ret_rms.var, env.ret_rms.count))
    )
    progress = Progress(environment_steps(algorithm), seconds, best_cost, returns)
    content = io.BytesIO()
    save_to_zip_file(content, params=learned.states, pytorch_variables=learned.variables)
    with zipfile.ZipFile(content, "a") as archive:
        for name, member in {PROGRESS: json.dumps(progress._asdict()).encode(), **(files or {})}.items():
            archive.writestr(name, member)
    return content.getvalue()


def load_checkpoint(path: Path) -> tuple[Progress, Learned, dict[str, bytes]]:
    """Progress, tensors and the run's files of a checkpoint; AgentFileError if it cannot be read."""
    content = io.BytesIO(read_bounded(path, MAX_BYTES))
    try:
        with zipfile.ZipFile(content) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("packed members could be larger than the file")
            progress = Progress(**json.loads(archive.read(PROGRESS)))
            numbers = (progress.steps, progress.seconds, progress.best_cost or 0.0, *progress.returns)
            if type(progress.steps) is not int or not all(map(math.isfinite, numbers)) or len(numbers) not in (3, 6):
                raise ValueError("does not say where the run stood")
            files = {name: archive.read(name) for name in FILES if name in archive.namelist()}
        _, states, variables = load_from_zip_file(content, load_data=False, device="cpu")
    except Exception:  # a damaged file makes zipfile, json and torch raise whatever they like
        raise AgentFileError(f"{path}: not a checkpoint of this release, or damaged") from None
    return progress, Learned(states, variables or {}), files


def restore(algorithm: BaseAlgorithm, progress: Progress, learned: Learned, path: Path) -> None:
    """Put a checkpoint into an algorithm made with the same settings; AgentFileError if it does not fit."""
    env: Any = algorithm.get_vec_normalize_env()
    try:
        algorithm.set_parameters(learned.states, exact_match=True, device="cpu")
        with torch.no_grad():
            for name in algorithm._get_torch_save_params()[1]:
                attrgetter(name)(algorithm).copy_(learned.variables[name])
        if env is not None:
            env.ret_rms.mean, env.ret_rms.var, env.ret_rms.count = map(np.float64, progress.returns)
    except Exception:  # torch raises whatever it likes where names, types or shapes differ
        raise AgentFileError(f"{path}: does not fit this run's settings") from None


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    """Every tensor of floats inside nested mappings and sequences."""
    if isinstance(value, torch.Tensor):
        yield from [value] if value.is_floating_point() else []
    elif isinstance(value, (Mapping, list, tuple)):
        for each in value.values() if isinstance(value, Mapping) else value:
            yield from _tensors(each)
