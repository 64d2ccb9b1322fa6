"""Running a benchmark: every contender on every row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from cz_gym.errors import CzError
from cz_gym.evaluation.contender import Contender
from cz_gym.support.processors import processors

from .cache import SlowEpisodes, earlier_bound
from .processes import in_processes
from .protocol import SLOW_EPISODES, Row
from .results import Result, Sample, summarise
from .rollout import check_policy, rollout

LONG = 5_000_000
"""Number of steps from which on a run is shared between processes, which take seconds to start."""
PROCESSES = 8
"""Largest number of processes of a run, each of which needs some hundred MB."""
BLOCK = 10
"""Episodes that a slow controller runs at once, and that are cached together."""


def run_episodes(contender: Contender, row: Row, seeds: Sequence[int], progress: Callable[[int], None]) -> Sample:
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


def run(
    contenders: Sequence[Contender],
    rows: Sequence[Row],
    episodes: int,
    cache: Path,
    bounds: Path | None = None,
    again: Callable[[], tuple[Sequence[Contender], Sequence[Row]]] | None = None,
    quiet: bool = False,
) -> list[Result]:
    """Roll every contender out on every row, with a progress bar unless ``quiet``, and summarise.

    ``cache`` is the folder of slow controllers' episodes, ``bounds`` that of an earlier benchmark whose bound serves a
    run without one. A long run is shared between processes if ``again`` makes contenders and rows anew in each.
    """
    from tqdm import tqdm

    pairs = [(row, each) for row in rows for each in contenders]
    seeds = [len(episodes_of(each, row, episodes)) for row, each in pairs]
    steps = [row.config().steps * n * max(len(each.trained), 1) for n, (row, each) in zip(seeds, pairs, strict=True)]
    # The first pair compiles for all.
    alone = 1 if again and sum(steps) > LONG else len(pairs)
    measured = {}
    with tqdm(total=sum(steps), unit="step", unit_scale=True, leave=False, disable=quiet or None) as bar:
        for number, (row, each) in enumerate(pairs[:alone]):
            bar.set_description(f"{row.name}, {each.name}")
            measured[number] = _measure((row, each), episodes, cache, bar.update)
        apart, left = partial(_apart, again, episodes, cache), range(alone, len(pairs))
        for place, found in in_processes(apart, left, processes=min(processors(), PROCESSES)):
            measured[left[place]] = Sample(pairs[left[place]][1], *found)
            bar.update(steps[left[place]])
    results = []
    for row in rows:
        samples = [measured[number] for number, pair in enumerate(pairs) if pair[0] is row]
        results.append(summarise(row, samples, earlier_bound(bounds, row, samples) if bounds else None))
    return results


def _measure(pair: tuple[Row, Contender], episodes: int, cache: Path, progress: Callable[[int], None]) -> Sample:
    """The sample of a pair; of a slow controller cached episodes are read, the others run in blocks and cached."""
    row, each = pair
    seeds = episodes_of(each, row, episodes)
    if not each.slow:
        return run_episodes(each, row, seeds, progress)
    store = SlowEpisodes(each, row, cache)
    parts = store.read(seeds)
    left = sorted({*seeds} - {seed for part in parts for seed in part.seeds})
    progress(row.config().steps * (len(seeds) - len(left)))
    for first in range(0, len(left), BLOCK):
        parts.append(run_episodes(each, row, left[first : first + BLOCK], progress))
        store.write(parts[-1])
    return Sample.joined(seeds, parts)


def _apart(again: Any, episodes: int, cache: Path, number: int) -> tuple[Any, ...]:
    """In another process: the sample of a pair without its contender, which would not pass between processes."""
    contenders, rows = again()
    pair = rows[number // len(contenders)], contenders[number % len(contenders)]
    sample = _measure(pair, episodes, cache, lambda steps: None)
    return sample.seeds, sample.values, sample.microseconds, sample.example, sample.outside
