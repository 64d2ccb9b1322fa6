"""Running a benchmark: every contender on every row, piece by piece."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cz_gym.contender import Contender
from cz_gym.errors import CzError

from .cache import SlowEpisodes, earlier_bound
from .protocol import SLOW_EPISODES, Row
from .results import Result, Sample, summarise
from .rollout import check_policy, rollout

AT_ONCE = 500
"""Episodes that a policy runs at once."""
BLOCK = 10
"""Episodes that a slow controller runs at once, and that are cached together."""


def run_episodes(contender: Contender, row: Row, seeds: Sequence[int], progress: Callable[[int], None]) -> Sample:
    """Roll out a controller, or an agent of one training seed, on some episodes of a row."""
    interface = contender.observation, contender.action
    designed_for = row.design_config(*interface)
    policy = contender.make(designed_for)
    return Sample.of(contender, rollout(policy, row.config(*interface), seeds, progress, designed_for))


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
    bar: Any,
    cache: Path,
    bounds: Path | None = None,
) -> list[Result]:
    """Roll every contender out on every row and summarise.

    ``bar`` is tqdm's, over environment steps; ``cache`` is the folder of slow controllers' episodes, ``bounds`` that of
    an earlier benchmark whose bound serves a run without one.
    """
    done: dict[tuple[str, str], list[Sample]] = {}
    stores: dict[tuple[str, str], SlowEpisodes] = {}
    pieces: list[tuple[Contender, Row, tuple[int, ...]]] = []
    for row, contender in ((row, contender) for row in rows for contender in contenders):
        key, seeds, at_once = (row.name, contender.name), tuple(episodes_of(contender, row, episodes)), AT_ONCE
        done[key] = []
        if contender.slow:
            stores[key], at_once = SlowEpisodes(contender, row, cache), BLOCK
            done[key] += stores[key].read(seeds)
            there = {seed for sample in done[key] for seed in sample.seeds}
            seeds = tuple(seed for seed in seeds if seed not in there)
        blocks = [seeds[first : first + at_once] for first in range(0, len(seeds), at_once)]
        pieces += [(copy, row, block) for copy in contender.copies() for block in blocks]
    bar.reset(total=sum(len(seeds) * row.config().steps for _, row, seeds in pieces))
    for contender, row, seeds in pieces:
        bar.set_description(f"{row.name}, {contender.name}")
        key, sample = (row.name, contender.name), run_episodes(contender, row, seeds, bar.update)
        if key in stores:
            stores[key].write(sample)
        done[key].append(sample)
    results = []
    for row in rows:
        samples = [
            Sample.joined(each, episodes_of(each, row, episodes), done[row.name, each.name]) for each in contenders
        ]
        results.append(summarise(row, samples, earlier_bound(bounds, row, samples) if bounds else None))
    return results
