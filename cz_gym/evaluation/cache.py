"""Episodes that need not run again: a slow controller's, cached on disk, and the bound's of an earlier benchmark.

The cache has one file an episode, in a folder named by controller, scenario and a hash of all that its results depend
on: the controller's settings, the environment's (plant, scenario, interval, horizon), and the code of both.
"""

from __future__ import annotations

import ast
import hashlib
import io
import json
import sys
import zipfile
from collections.abc import Collection, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.atomic_files import write_files
from cz_gym.config import Config
from cz_gym.jit.cache import compiled_sources

from .files import EPISODES, read_episodes
from .metrics import metric_names
from .protocol import Row
from .results import BOUND, Controller, Part, Sample
from .rollout import Floats, Signals

BLOCK = 10
"""Episodes run at once."""
MAX_BYTES = 64_000_000
"""Largest cached episode that is read, packed or not."""
PRINTED = 1e-4
"""Relative precision of the figures in ``episodes.csv``, five digits [-]."""


class SlowEpisodes:
    """The cached episodes of a slow controller, whose ``policy`` has a ``hash`` of its settings."""

    def __init__(self, controller: Controller, policy: Any, config: Config, folder: Path) -> None:
        parts = [controller.name, policy.hash, code_behind(type(policy).__module__), config.hash, *metric_names()]
        digest = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]
        self.place = folder / f"{controller.name}-{config.scenario.name}-{digest}"

    def read(self, seeds: Sequence[int], examples: Collection[int]) -> list[Part]:
        """Those of some seeds that are there, each a part; of the ``examples`` those that have their signals."""
        found = (read_episode(self.place / f"{seed}.npz", seed in examples) for seed in seeds)
        return [part for part in found if part]

    def write(self, part: Part) -> None:
        """Keep a part."""
        none, packed = np.zeros((0, 0)), {}
        for seed, row in zip(part.seeds, part.values, strict=True):
            file, signals = io.BytesIO(), part.signals.get(seed, none)
            np.savez_compressed(file, values=row, microseconds=part.microseconds, signals=signals)
            packed[self.place / f"{seed}.npz"] = file.getvalue()
        write_files(packed)


def read_episode(path: Path, example: bool) -> Part | None:
    """A cached episode, with its signals if it is an ``example``; None if there is none that can be used."""
    try:
        with open(path, "rb") as file:
            content = file.read(MAX_BYTES + 1)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            # What is packed may be a thousand times larger than the file.
            if len(content) > MAX_BYTES or sum(part.file_size for part in archive.infolist()) > MAX_BYTES:
                return None
        with np.load(io.BytesIO(content), allow_pickle=False) as data:
            seed, microseconds = int(path.stem), float(data["microseconds"])
            values, signals = data["values"], data["signals"]
    except Exception:  # zipfile, zlib and NumPy each raise their own for the ways a file can be broken
        return None
    logged = signals.ndim == 2 and len(signals) == len(Signals._fields) and signals.size > 0
    sound = values.dtype == signals.dtype == np.float64 and values.shape == (len(metric_names()),)
    if not sound or (example and not logged):
        return None
    return Part((seed,), values[None], microseconds, {seed: signals} if example else {})


def earlier_bound(folder: Path, row: Row, samples: Sequence[Sample]) -> Sample | None:
    """The bound on that row from a folder of benchmark results, which has neither its signals nor its time.

    None unless the folder has the row's first test episodes, and each classical controller that ran then and now, one
    at least, has the same figures on them: another plant or scenario, and other code, make other figures.
    """
    columns = ("seed", *metric_names())
    try:
        found = read_episodes(folder / EPISODES, lambda scenario: columns if scenario == row.name else ())[row.name]
        (episodes,) = found[BOUND]
    except (ValueError, KeyError):
        return None
    seeds = row.seeds(len(episodes))
    agree = [
        _agree(sample, found[sample.controller.name][0])
        for sample in samples
        if sample.controller.name in found and not sample.controller.learned
    ]
    if episodes[:, 0].tolist() != list(seeds) or not agree or not all(agree):
        return None
    controller = Controller(BOUND, "state", "bound of an earlier run", privileged=True, slow=True)
    return Sample(controller, tuple(seeds), episodes[None, :, 1:], float("nan"), (), row.control_interval)


def _agree(sample: Sample, earlier: Floats) -> bool:
    """Whether a controller has the figures it had earlier, shape (episodes, 1 + metrics), on the same crystals."""
    both = min(len(sample.seeds), len(earlier))
    same_seeds = earlier[:both, 0].tolist() == list(sample.seeds[:both])
    return same_seeds and np.allclose(sample.values[0, :both], earlier[:both, 1:], rtol=PRINTED)


@cache
def code_behind(module: str) -> str:
    """Hash of all code that the episodes of a policy of that module come from."""
    return hash_sources(sources_behind(module))


def sources_behind(module: str) -> list[Path]:
    """Sources of plant, environment and metrics, and the policy's module, or the whole package of it if it is ours."""
    package = ".".join(module.split(".")[:2]) if module.startswith("cz_gym.") else module
    file = Path(str(sys.modules[package].__file__))
    policy = sorted(file.parent.rglob("*.py")) if file.name == "__init__.py" else [file]
    return [*compiled_sources(), *(Path(__file__).with_name(name) for name in ("rollout.py", "metrics.py")), *policy]


def hash_sources(files: Iterable[Path]) -> str:
    """SHA-256 of what these Python files say but for comments, docstrings and line breaks (16 hex digits)."""
    digest = hashlib.sha256()
    for file in files:
        tree = ast.parse(file.read_bytes())
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                node.body = [
                    part
                    for part in node.body
                    if not (isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant))
                ]
        digest.update(file.name.encode() + b"\0" + ast.dump(tree).encode() + b"\0")
    return digest.hexdigest()[:16]
