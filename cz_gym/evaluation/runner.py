"""Running a benchmark: every contender on every row."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cz_gym.errors import CzError
from cz_gym.evaluation.contender import Contender
from cz_gym.support.processors import processors

from .cache import SlowEpisodes, earlier_bound
from .processes import side_by_side
from .protocol import SLOW_EPISODES, Row
from .results import Result, Sample, summarise
from .rollout import check_policy, rollout

LONG = 5_000_000
"""Number of steps from which on a run is shared between processes, which take seconds to start."""
PROCESSES = 8
"""Largest number of processes of a run, each of which needs some hundred MB."""
BLOCK = 10
"""Episodes that a slow controller runs at once, and that are cached together."""


def run_episodes(contender: Contender, row: Row, seeds: Sequence[int], progress: Callable[[int], Any]) -> Sample:
    """Roll a contender out on some episodes of a row."""
    interface = contender.observation, contender.action
    config, designed_for = row.config(*interface), row.design_config(*interface)
    policies = contender.policies(designed_for)
    runs = (rollout(policy, config, seeds, progress, designed_for) for policy in policies)
    return Sample.of(contender, runs, row.tolerance)


def check_agents(contenders: Sequence[Contender], rows: Sequence[Row]) -> None:
    """Raise CzError for an agent that was trained for another environment than a row has, its control interval say."""
    for each in contenders:
        for row in rows:
            config = row.design_config(each.observation, each.action)
            for policy in each.trained:
                try:
                    check_policy(policy, config)
                except CzError as error:
                    raise CzError(f"agent {each.name!r} on {row.name}: {error}") from None


def episodes_of(contender: Contender, row: Row, episodes: int) -> range:
    """Seeds of the episodes of a row that a contender meets."""
    return row.seeds(min(episodes, SLOW_EPISODES) if contender.slow else episodes)


def is_cached(contender: Contender, rows: Sequence[Row], episodes: int, cache: Path) -> bool:
    """Whether every episode of a slow controller is cached, so that none would be run."""
    wanted = [(row, episodes_of(contender, row, episodes)) for row in rows]
    try:
        return all(len(SlowEpisodes(contender, row, cache).read(seeds)) == len(seeds) for row, seeds in wanted)
    except ImportError:  # what it needs is not installed
        return False


@dataclass(frozen=True)
class Task:
    """A contender on a row, as a value that any process can run."""

    contender: Contender
    row: Row
    episodes: int
    cache: Path
    """Folder of slow controllers' episodes."""

    @property
    def seeds(self) -> range:
        """Seeds of its episodes."""
        return episodes_of(self.contender, self.row, self.episodes)

    @property
    def steps(self) -> int:
        """Number of steps, all training seeds together."""
        return self.row.config().steps * len(self.seeds) * max(len(self.contender.trained), 1)


def run(
    contenders: Sequence[Contender],
    rows: Sequence[Row],
    episodes: int,
    cache: Path,
    bounds: Path | None = None,
    quiet: bool = False,
    cluster: str | None = None,
) -> list[Result]:
    """Roll every contender out on every row, with a progress bar unless ``quiet``, and summarise.

    ``cache`` is the folder of slow controllers' episodes, ``bounds`` that of an earlier benchmark whose bound serves a
    run without one. A long run is shared between processes, any run between the workers of a ``cluster``.
    """
    from tqdm import tqdm

    tasks = [Task(each, row, episodes, cache.absolute()) for row in rows for each in contenders]
    total = sum(task.steps for task in tasks)
    # The first task compiles for all.
    alone = 0 if cluster else 1 if total > LONG else len(tasks)
    samples: dict[int, Sample] = {}
    with tqdm(total=total, unit="step", unit_scale=True, leave=False, disable=quiet or None) as bar:
        for number, task in enumerate(tasks[:alone]):
            bar.set_description(f"{task.row.name}, {task.contender.name}")
            samples[number] = measure(task, bar.update)
        workers = min(processors(), PROCESSES)
        for place, sample in side_by_side(measure, tasks[alone:], cluster=cluster, processes=workers):
            samples[alone + place] = replace(sample, contender=tasks[alone + place].contender)
            bar.update(tasks[alone + place].steps)
    results = []
    for row in rows:
        own = [samples[number] for number, task in enumerate(tasks) if task.row is row]
        results.append(summarise(row, own, earlier_bound(bounds, row, own) if bounds else None))
    return results


def measure(task: Task, progress: Callable[[int], Any] = lambda steps: None) -> Sample:
    """The sample of a task; a slow controller's cached episodes are read, the others run in blocks and cached."""
    each, row, seeds = task.contender, task.row, task.seeds
    if not each.slow:
        return run_episodes(each, row, seeds, progress)
    store = SlowEpisodes(each, row, task.cache)
    parts = store.read(seeds)
    left = sorted({*seeds} - {seed for part in parts for seed in part.seeds})
    progress(row.config().steps * (len(seeds) - len(left)))
    for first in range(0, len(left), BLOCK):
        parts.append(run_episodes(each, row, left[first : first + BLOCK], progress))
        store.write(parts[-1])
    return Sample.joined(seeds, parts)
