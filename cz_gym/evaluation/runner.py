"""Running a benchmark: every contender on every case."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cz_gym.errors import CzError
from cz_gym.evaluation.contender import Contender
from cz_gym.support.processors import processors

from .cache import SlowEpisodes, earlier_bound
from .processes import side_by_side
from .protocol import SLOW_EPISODES, Case
from .results import Result, Sample, summarise
from .rollout import check_policy, rollout

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
