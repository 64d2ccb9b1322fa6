"""Cached episodes of slow controllers, and the bound of an earlier benchmark: neither needs to run again.

The cache has one file an episode, in a folder named by controller, scenario and a hash of all that the results depend
on: settings and code of controller and environment, and the packages that compute.
"""

import hashlib
import io
import json
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from cz_gym.body.signals import Logged
from cz_gym.evaluation.contender import Contender
from cz_gym.jit.cache import PACKAGE, compiled_sources, hash_files
from cz_gym.support.atomic_files import write_files

from .files import EPISODES, read_episodes, software
from .metrics import metric_names
from .protocol import Case
from .results import BOUND, GAPS, Sample
from .rollout import Floats

PRINTED = 1e-4
"""Relative precision of the figures in ``episodes.csv``, five digits [-]."""
COMPUTING = ("numpy", "scipy", "numba")
"""Packages whose version the figures may depend on."""
PICTURES = ("camera", "rendering")
"""Sub-packages that draw: no cached figure depends on them."""


class SlowEpisodes:
    """The cached episodes of a slow controller on a case; its policy has a ``hash`` of its settings."""

    def __init__(self, contender: Contender, case: Case, folder: Path) -> None:
        config = case.config(contender.observation, contender.action)
        policy = contender.make(case.design_config(contender.observation, contender.action))
        code, versions = code_behind(type(policy).__module__), software(COMPUTING)["packages"]
        parts = [contender.name, policy.hash, code, versions, config.hash, *metric_names()]
        digest = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]
        self.contender, self.place = contender, folder / f"{contender.name}-{config.scenario.name}-{digest}"

    def read(self, seeds: Sequence[int]) -> list[Sample]:
        """Samples of the cached episodes, one an episode; the first is left out if its signals were not kept."""
        return [
            sample for sample in map(self._read, seeds) if sample and (sample.example or sample.seeds[0] != seeds[0])
        ]

    def _read(self, seed: int) -> Sample | None:
        """An episode with the signals that were kept; None if it is not there, or damaged."""
        try:
            with np.load(io.BytesIO((self.place / f"{seed}.npz").read_bytes())) as data:
                example = Logged(*data["signals"]) if len(data["signals"]) else None
                values, microseconds = data["values"][None, None], float(data["microseconds"])
                return Sample(self.contender, (seed,), values, microseconds, example)
        except Exception:  # zipfile, zlib and NumPy each raise their own for a file cut short
            return None

    def write(self, sample: Sample) -> None:
        """Keep the episodes of a sample, and the signals of its first."""
        packed = {}
        for i, seed in enumerate(sample.seeds):
            signals = sample.example if sample.example and i == 0 else ()
            file = io.BytesIO()
            np.savez_compressed(file, values=sample.values[0, i], microseconds=sample.microseconds, signals=signals)
            packed[self.place / f"{seed}.npz"] = file.getvalue()
        write_files(packed)


def earlier_bound(folder: Path, case: Case, samples: Sequence[Sample]) -> Sample | None:
    """The bound on a case from a folder of benchmark results, which has neither its signals nor its time.

    None unless that bound met the case's first episodes, and a classical controller had the same figures then and now.
    """
    try:
        earlier = read_episodes(folder / EPISODES, ("seed", *GAPS))[case.name]
        (episodes,) = earlier[BOUND]
    except (ValueError, KeyError):
        return None
    seeds = case.seeds(len(episodes))
    classical = [sample for sample in samples if sample.name in earlier and not sample.contender.learned]
    agree = [_agree(sample, earlier[sample.name][0]) for sample in classical]
    if episodes[:, 0].tolist() != list(seeds) or not agree or not all(agree):
        return None
    contender = Contender(BOUND, lambda config: None, "state", "bound of an earlier run", privileged=True, slow=True)
    values = np.full((1, len(episodes), len(metric_names())), np.nan)
    values[..., [metric_names().index(name) for name in GAPS]] = episodes[:, 1:]
    return Sample(contender, tuple(seeds), values, float("nan"))


def _agree(sample: Sample, earlier: Floats) -> bool:
    """Whether a controller has the figures it had earlier: seeds and GAPS, shape (episodes, 1 + metrics)."""
    both = min(len(sample.seeds), len(earlier))
    same_seeds = earlier[:both, 0].tolist() == list(sample.seeds[:both])
    now = np.stack([sample.metric(name)[0, :both] for name in GAPS], axis=1)
    return same_seeds and np.allclose(now, earlier[:both, 1:], rtol=PRINTED)


@cache
def code_behind(module: str) -> str:
    """Hash of all code that the episodes of a policy of that module come from, comments and docstrings left out."""
    return hash_files(sources_behind(module))


def sources_behind(module: str) -> list[Path]:
    """Sources of a policy's figures: plant, environment, metrics, and its module, or its package if that is ours."""
    plant = [file for file in compiled_sources() if file.relative_to(PACKAGE).parts[0] not in PICTURES]
    metrics = [Path(__file__).with_name(name) for name in ("rollout.py", "metrics.py")]
    package = ".".join(module.split(".")[:2]) if module.startswith("cz_gym.") else module
    file = Path(str(sys.modules[package].__file__))
    return plant + metrics + (sorted(file.parent.rglob("*.py")) if file.name == "__init__.py" else [file])
