"""Episodes that need not run again: a slow controller's, cached on disk, and the bound's of an earlier benchmark.

The cache has one file an episode, in a folder named by controller, scenario and a hash of all that the results depend
on: the controller's settings, the environment's (plant, scenario, interval, horizon), the code of both, and the
packages that compute.
"""

from __future__ import annotations

import hashlib
import io
import json
import sys
import zipfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.atomic_files import write_files
from cz_gym.contender import Contender
from cz_gym.jit.cache import PACKAGE, compiled_sources
from cz_gym.jit.code_hash import hash_files

from .files import EPISODES, read_episodes, software
from .metrics import metric_names
from .protocol import Row
from .results import BOUND, Sample
from .rollout import Floats, Signals

MAX_BYTES = 64_000_000
"""Largest cached episode that is read, packed or not."""
PRINTED = 1e-4
"""Relative precision of the figures in ``episodes.csv``, five digits [-]."""
COMPUTING = ("numpy", "scipy", "numba", "casadi")
"""Packages whose version the figures may depend on."""
PICTURES = ("camera", "rendering")
"""Sub-packages that draw: no cached figure depends on them."""


class SlowEpisodes:
    """The cached episodes of a slow controller on a row; its policy has a ``hash`` of its settings."""

    def __init__(self, contender: Contender, row: Row, folder: Path) -> None:
        config = row.config(contender.observation, contender.action)
        policy = contender.make(row.design_config(contender.observation, contender.action))
        code, versions = code_behind(type(policy).__module__), software(COMPUTING)["packages"]
        parts = [contender.name, policy.hash, code, versions, config.hash, *metric_names()]
        digest = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]
        self.contender, self.place = contender, folder / f"{contender.name}-{config.scenario.name}-{digest}"

    def read(self, seeds: Sequence[int]) -> list[Sample]:
        """Samples of single episodes, of those that are there; the first counts only with its signals."""
        found = (read_episode(self.contender, self.place / f"{seed}.npz", seed == seeds[0]) for seed in seeds)
        return [sample for sample in found if sample]

    def write(self, sample: Sample) -> None:
        """Keep the episodes of a sample, and the signals of its first."""
        packed = {}
        for i, seed in enumerate(sample.seeds):
            signals = np.stack(sample.example) if sample.example and i == 0 else np.zeros((0, 0))
            file = io.BytesIO()
            np.savez_compressed(file, values=sample.values[0, i], microseconds=sample.microseconds, signals=signals)
            packed[self.place / f"{seed}.npz"] = file.getvalue()
        write_files(packed)


def read_episode(contender: Contender, path: Path, example: bool) -> Sample | None:
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
    return Sample(contender, (seed,), values[None, None], microseconds, Signals(*signals) if example else None)


def earlier_bound(folder: Path, row: Row, samples: Sequence[Sample]) -> Sample | None:
    """The bound on a row from a folder of benchmark results, which has neither its signals nor its time.

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
    classical = [sample for sample in samples if sample.name in found and not sample.contender.learned]
    agree = [_agree(sample, found[sample.name][0]) for sample in classical]
    if episodes[:, 0].tolist() != list(seeds) or not agree or not all(agree):
        return None
    contender = Contender(BOUND, _not_made, "state", "bound of an earlier run", privileged=True, slow=True)
    return Sample(contender, tuple(seeds), episodes[None, :, 1:], float("nan"))


def _not_made(config: Any) -> Any:
    raise NotImplementedError("an earlier run's bound is only read")


def _agree(sample: Sample, earlier: Floats) -> bool:
    """Whether a controller has the figures it had earlier, shape (episodes, 1 + metrics), on the same crystals."""
    both = min(len(sample.seeds), len(earlier))
    same_seeds = earlier[:both, 0].tolist() == list(sample.seeds[:both])
    return same_seeds and np.allclose(sample.values[0, :both], earlier[:both, 1:], rtol=PRINTED)


@cache
def code_behind(module: str) -> str:
    """Hash of all code that the episodes of a policy of that module come from, comments and docstrings left out."""
    return "".join(hash_files(files, root, code_only=True) for root, files in sources_behind(module).items())


def sources_behind(module: str) -> dict[Path, list[Path]]:
    """Sources that compute the figures of a policy, by the folder that they lie in.

    These are plant, environment and metrics, and the policy's module, or the whole package of it if it is ours.
    """
    plant = [file for file in compiled_sources() if file.relative_to(PACKAGE).parts[0] not in PICTURES]
    metrics = [Path(__file__).with_name(name) for name in ("rollout.py", "metrics.py")]
    package = ".".join(module.split(".")[:2]) if module.startswith("cz_gym.") else module
    file = Path(str(sys.modules[package].__file__))
    policy = sorted(file.parent.rglob("*.py")) if file.name == "__init__.py" else [file]
    return {PACKAGE: plant + metrics, file.parent: policy}
