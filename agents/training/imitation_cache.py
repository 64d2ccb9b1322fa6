"""Imitations kept on disk, so that runs which begin with the same one need not ask the teacher again.

An imitation is what a teacher, the crystals shown, the action's head, what the network sees and a training seed make;
how it is improved afterwards does not matter. It is kept as tensors in a safetensors file, which holds nothing that
could be executed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from cz_gym.agents.agent_file.contract import AgentFileError, read_bounded
from cz_gym.atomic_files import write_files
from cz_gym.config import Config

from .checkpoint import MAX_BYTES
from .imitation import Views, set_views
from .recipes import Recipe

Tensors = dict[str, torch.Tensor]
CHANGED = ("observation", "control_interval", "hidden", "memory", "head", "clone", "residual")
"""Settings that an imitation depends on, beside crystals and seed."""


def kept_imitation(folder: Path, recipe: Recipe, config: Config, seed: int) -> Path:
    """Where the imitation of these settings is kept; ``config`` is of the wide crystals it was asked on."""
    parts = [{name: asdict(recipe)[name] for name in CHANGED}, config.hash, seed]
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
    teacher = recipe.clone.teacher if recipe.clone else "none"
    return folder / f"{teacher}-seed{seed}-{digest}.safetensors"


def imitate_once(path: Path, policy: Any, imitate: Callable[[], Views]) -> None:
    """Give the policy the imitation kept at ``path``; make and keep it first if there is none that fits."""
    kept = _read(path, policy)
    if kept is None:
        views = imitate()
        kept = {f"view/{name}": torch.as_tensor(array) for name, array in views._asdict().items()} | _weights(policy)
        kept = {name: tensor.detach().clone().contiguous() for name, tensor in kept.items()}
        write_files({path: save(kept)})
    set_views(policy, Views(*(kept[f"view/{name}"].numpy() for name in Views._fields)))
    with torch.no_grad():
        for name, tensor in _weights(policy).items():
            tensor.copy_(kept[name])


def _weights(policy: Any) -> Tensors:
    """The tensors of the actor that an imitation sets, by name."""
    extractor = policy.mlp_extractor
    parts = {"layers": extractor.actor, "direct": extractor.direct, "last": policy.action_net.linear}
    return {f"{part}/{name}": value for part, module in parts.items() for name, value in module.named_parameters()}


def _read(path: Path, policy: Any) -> Tensors | None:
    if not path.exists():
        return None
    try:
        kept: Tensors = load(read_bounded(path, MAX_BYTES))
    except (SafetensorError, AgentFileError, ValueError):
        return None
    wanted = {name: tensor.shape for name, tensor in _weights(policy).items()}
    fits = all(name in kept and kept[name].shape == shape for name, shape in wanted.items())
    sound = all(tensor.isfinite().all() for tensor in kept.values())
    return kept if fits and sound and all(f"view/{name}" in kept for name in Views._fields) else None
