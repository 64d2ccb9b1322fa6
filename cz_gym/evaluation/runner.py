"""Running a benchmark: every contender on every row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from cz_gym.contender import Contender
from cz_gym.errors import CzError

from .cache import SlowEpisodes, earlier_bound
from .protocol import SLOW_EPISODES, Row
from .results import Result, Sample, summarise
from .rollout import check_policy, rollout

BLOCK = 10
"""Episodes that a slow controller runs at once, and that are cached together."""


def run_episodes(contender: Contender, row: Row, seeds: Sequence[int], progress: Callable[[int], None]) -> Sample:
    """Roll a contender out on some episodes of a row."""
    interface = contender.observation, contender.action
    config, designed_for = row.config(*interface), row.design_config(*interface)
    policies = contender.policies(designed_for)
    return Sample.of(contender, (rollout(policy, config, seeds, progress, designed_for) for policy in policies))


def run_resumed(
    contender: Contender, row: Row, seeds: Sequence[int], progress: Callable[[int], None], cache: Path
) -> Sample:
    """The same of a slow controller: cached episodes are read, the others run in blocks and cached."""
    store = SlowEpisodes(contender, row, cache)
    parts = store.read(seeds)
    left = sorted({*seeds} - {seed for part in parts for seed in part.seeds})
    progress(row.config().steps * (len(seeds) - len(left)))
    for first in range(0, len(left), BLOCK):
        parts.append(run_episodes(contender, row, left[first : first + BLOCK], progress))
        store.write(parts[-1])
    return Sample.joined(seeds, parts)


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
    pairs = [(row, each, episodes_of(each, row, episodes)) for row in rows for each in contenders]
    bar.reset(total=sum(row.config().steps * len(seeds) * max(len(each.trained), 1) for row, each, seeds in pairs))
    samples: dict[str, list[Sample]] = {row.name: [] for row in rows}
    for row, each, seeds in pairs:
        bar.set_description(f"{row.name}, {each.name}")
        rolled_out = partial(run_resumed, cache=cache) if each.slow else run_episodes
        samples[row.name].append(rolled_out(each, row, seeds, bar.update))
    return [
        summarise(row, samples[row.name], earlier_bound(bounds, row, samples[row.name]) if bounds else None)
        for row in rows
    ]
