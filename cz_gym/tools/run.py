"""Cached episodes of slow controllers, and the bound of an earlier benchmark: neither needs to run again.

The cache has one file an episode, in a folder named by controller, scenario and a hash of all that the results depend
on: settings and code of controller and environment, and the packages that compute.
"""

import hashlib
import io
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.body.signals import Logged
from cz_gym.engine.batch import processors
from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.parallel import side_by_side
from cz_gym.evaluation.protocol import SLOW_EPISODES, Case, Contender
from cz_gym.evaluation.results import BOUND, GAPS, Result, Sample, summarise
from cz_gym.evaluation.rollout import Floats, check_policy, rollout
from cz_gym.jit import PACKAGE, compiled_sources, hash_files
from cz_gym.support.errors import CzError
from cz_gym.support.files import write_files
from cz_gym.support.names import software

from .files import EPISODES, read_episodes

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
    metrics = [PACKAGE / "evaluation" / name for name in ("rollout.py", "metrics.py")]
    package = ".".join(module.split(".")[:2]) if module.startswith("cz_gym.") else module
    file = Path(str(sys.modules[package].__file__))
    return plant + metrics + (sorted(file.parent.rglob("*.py")) if file.name == "__init__.py" else [file])


# Running a benchmark: every contender on every case.

LONG = 5_000_000
"""Number of steps from which on a run is shared between processes, which take seconds to start."""
PROCESSES = 8
"""Largest number of processes of a run, each of which needs some hundred MB."""
BLOCK = 10
"""Episodes that a slow controller runs at once, and that are cached together."""


def run_episodes(contender: Contender, case: Case, seeds: Sequence[int], progress: Callable[[int], Any]) -> Sample:
    """Roll a contender out on some episodes of a case."""
    interface = contender.observation, contender.action
    config, designed_for = case.config(*interface), case.design_config(*interface)
    policies = contender.policies(designed_for)
    runs = (rollout(policy, config, seeds, progress, designed_for) for policy in policies)
    return Sample.of(contender, runs, case.tolerance)


def check_agents(contenders: Sequence[Contender], cases: Sequence[Case]) -> None:
    """Raise CzError for an agent that was trained for another environment than a case has, its control interval say."""
    for each in contenders:
        for case in cases:
            config = case.design_config(each.observation, each.action)
            for policy in each.trained:
                try:
                    check_policy(policy, config)
                except CzError as error:
                    raise CzError(f"agent {each.name!r} on {case.name}: {error}") from None


def episodes_of(contender: Contender, case: Case, episodes: int) -> range:
    """Seeds of the episodes of a case that a contender meets."""
    return case.seeds(min(episodes, SLOW_EPISODES) if contender.slow else episodes)


def is_cached(contender: Contender, cases: Sequence[Case], episodes: int, cache: Path) -> bool:
    """Whether every episode of a slow controller is cached, so that none would be run."""
    wanted = [(case, episodes_of(contender, case, episodes)) for case in cases]
    try:
        return all(len(SlowEpisodes(contender, case, cache).read(seeds)) == len(seeds) for case, seeds in wanted)
    except ImportError:  # what it needs is not installed
        return False


@dataclass(frozen=True)
class Task:
    """A contender on a case, as a value that any process can run."""

    contender: Contender
    case: Case
    episodes: int
    cache: Path
    """Folder of slow controllers' episodes."""

    @property
    def seeds(self) -> range:
        """Seeds of its episodes."""
        return episodes_of(self.contender, self.case, self.episodes)

    @property
    def steps(self) -> int:
        """Number of steps, all training seeds together."""
        return self.case.config().steps * len(self.seeds) * max(len(self.contender.trained), 1)


def run(
    contenders: Sequence[Contender],
    cases: Sequence[Case],
    episodes: int,
    cache: Path,
    bounds: Path | None = None,
    quiet: bool = False,
    cluster: str | None = None,
) -> list[Result]:
    """Roll every contender out on every case, with a progress bar unless ``quiet``, and summarise.

    ``cache`` is the folder of slow controllers' episodes, ``bounds`` that of an earlier benchmark whose bound serves a
    run without one. A long run is shared between processes, any run between the workers of a ``cluster``.
    """
    from tqdm import tqdm

    tasks = [Task(each, case, episodes, cache.absolute()) for case in cases for each in contenders]
    total = sum(task.steps for task in tasks)
    # The first task compiles for all.
    alone = 0 if cluster else 1 if total > LONG else len(tasks)
    samples: dict[int, Sample] = {}
    with tqdm(total=total, unit="step", unit_scale=True, leave=False, disable=quiet or None) as bar:
        for number, task in enumerate(tasks[:alone]):
            bar.set_description(f"{task.case.name}, {task.contender.name}")
            samples[number] = measure(task, bar.update)
        workers = min(processors(), PROCESSES)
        for place, sample in side_by_side(measure, tasks[alone:], cluster=cluster, processes=workers):
            samples[alone + place] = replace(sample, contender=tasks[alone + place].contender)
            bar.update(tasks[alone + place].steps)
    results = []
    for case in cases:
        own = [samples[number] for number, task in enumerate(tasks) if task.case is case]
        results.append(summarise(case, own, earlier_bound(bounds, case, own) if bounds else None))
    return results


def measure(task: Task, progress: Callable[[int], Any] = lambda steps: None) -> Sample:
    """The sample of a task; a slow controller's cached episodes are read, the others run in blocks and cached."""
    each, case, seeds = task.contender, task.case, task.seeds
    if not each.slow:
        return run_episodes(each, case, seeds, progress)
    store = SlowEpisodes(each, case, task.cache)
    parts = store.read(seeds)
    left = sorted({*seeds} - {seed for part in parts for seed in part.seeds})
    progress(case.config().steps * (len(seeds) - len(left)))
    for first in range(0, len(left), BLOCK):
        parts.append(run_episodes(each, case, left[first : first + BLOCK], progress))
        store.write(parts[-1])
    return Sample.joined(seeds, parts)
