"""Slow controllers: their episodes run a few at a time and kept on disk, so that a run can be resumed.

One file an episode, in a folder named by controller and a hash of all that its results depend on: the controller's
settings, the environment's (plant, scenario, interval, horizon), and the code of plant, draws, metrics and controller.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.evaluation.cache.code import code_behind
from cz_gym.evaluation.files import write_files
from cz_gym.evaluation.metrics import metric_names, metrics
from cz_gym.evaluation.results import EXAMPLES, Controller, Sample
from cz_gym.evaluation.rollout import Rollout, Signals, rollout

Floats = npt.NDArray[np.float64]
BLOCK = 10
"""Episodes run at once."""
MAX_BYTES = 64_000_000
"""Largest kept episode that is read, packed or not."""


class SlowPolicy(Protocol):
    """A policy whose results are worth keeping."""

    @property
    def hash(self) -> str:
        """Hash of its settings."""
        ...

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """The seam of all policies."""
        ...


class Kept(NamedTuple):
    """What is kept of one episode."""

    values: Floats
    """Shape (metrics,)."""
    microseconds: float
    """Time in the policy per step [us]."""
    signals: Floats
    """Signals of one of the first episodes, shape (signals, steps); of the others empty."""


def slow_sample(
    controller: Controller,
    policy: SlowPolicy,
    config: Config,
    seeds: Sequence[int],
    folder: Path,
    progress: Callable[[int], None],
) -> Sample:
    """The sample of a slow controller; episodes already in ``folder`` are read, the others run and written there."""
    folder = place(controller, policy, config, folder)
    shown = seeds[:EXAMPLES]
    kept = {seed: found for seed in seeds if (found := read(folder / f"{seed}.npz", seed in shown)) is not None}
    progress(config.steps * len(kept))
    missing = [seed for seed in seeds if seed not in kept]
    for first in range(0, len(missing), BLOCK):
        block = missing[first : first + BLOCK]
        new = dict(zip(block, _kept(rollout(policy, config, block, progress), shown), strict=True))
        write_files({folder / f"{seed}.npz": _written(episode) for seed, episode in new.items()})
        kept |= new
    ordered = [kept[seed] for seed in seeds]
    values = np.array([[episode.values for episode in ordered]])
    microseconds = float(np.mean([episode.microseconds for episode in ordered]))
    examples = tuple(Signals(*episode.signals) for episode in ordered[: len(shown)])
    return Sample(controller, tuple(seeds), values, microseconds, examples, config.control_interval)


def is_kept(controller: Controller, policy: SlowPolicy, config: Config, seeds: Sequence[int], folder: Path) -> bool:
    """Whether :func:`slow_sample` would have nothing to run."""
    folder = place(controller, policy, config, folder)
    return all(read(folder / f"{seed}.npz", seed in seeds[:EXAMPLES]) is not None for seed in seeds)


def place(controller: Controller, policy: SlowPolicy, config: Config, folder: Path) -> Path:
    """Where a slow controller's episodes are kept."""
    return folder / f"{controller.name}-{config.scenario.name}-{key(controller.name, policy, config)}"


def key(name: str, policy: SlowPolicy, config: Config) -> str:
    """Hash of everything a kept episode depends on (16 hex digits)."""
    parts = [name, policy.hash, code_behind(policy), config.hash, *metric_names()]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]


def read(path: Path, example: bool) -> Kept | None:
    """A kept episode, with its signals if it is an ``example``; None if there is none that can be used."""
    try:
        with open(path, "rb") as file:
            content = file.read(MAX_BYTES + 1)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            # What is packed may be a thousand times larger than the file.
            if len(content) > MAX_BYTES or sum(part.file_size for part in archive.infolist()) > MAX_BYTES:
                return None
        with np.load(io.BytesIO(content), allow_pickle=False) as data:
            found = Kept(data["values"], float(data["microseconds"]), data["signals"])
    except Exception:  # zipfile, zlib and NumPy each raise their own for the ways a file can be broken
        return None
    if found.values.dtype != np.float64 or found.signals.dtype != np.float64 or found.signals.ndim != 2:
        return None
    logged = len(found.signals) == len(Signals._fields) and found.signals.size > 0
    return found if found.values.shape == (len(metric_names()),) and (logged or not example) else None


def _kept(run: Rollout, shown: Sequence[int]) -> list[Kept]:
    values = np.stack(metrics(run), axis=-1)
    episodes = []
    for i, seed in enumerate(run.seeds):
        signals = np.stack(run.episode(i)) if seed in shown else np.zeros((0, 0))
        episodes.append(Kept(values[i], run.microseconds_per_step, signals))
    return episodes


def _written(episode: Kept) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, values=episode.values, microseconds=episode.microseconds, signals=episode.signals)
    return file.getvalue()
