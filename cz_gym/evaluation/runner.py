"""Running a benchmark: every contender on every row, sample by sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .cache import earlier_bound, is_cached, slow_sample
from .contenders import Contender
from .protocol import SLOW_EPISODES, Row
from .results import Benchmark, Controller, Sample, summarise
from .rollout import rollout


@dataclass(frozen=True)
class Plan:
    """What a benchmark runs."""

    contenders: tuple[Contender, ...]
    rows: tuple[Row, ...]
    episodes: int
    command: str = ""
    cache: Path | None = None
    """Folder of slow controllers' episodes; needed if there are any."""
    bounds: Path | None = None
    """Folder of an earlier benchmark whose bound serves a run without one."""

    @property
    def steps(self) -> int:
        """Environment steps of the whole run."""
        return sum(
            (len(contender.controller.training_seeds) or 1)
            * len(self.seeds(contender.controller, row))
            * row.config().steps
            for row in self.rows
            for contender in self.contenders
        )

    @property
    def agents(self) -> tuple[Mapping[str, Any], ...]:
        """Contracts of the agent files."""
        return tuple(contract for contender in self.contenders for contract in contender.contracts)

    def seeds(self, controller: Controller, row: Row) -> range:
        """The episodes of a row that a controller meets."""
        return row.seeds(min(self.episodes, SLOW_EPISODES) if controller.slow else self.episodes)

    def is_cached(self, contender: Contender) -> bool:
        """Whether every episode of a slow controller is cached, so that none would be run."""
        return all(self._row_is_cached(contender, row) for row in self.rows)

    def _row_is_cached(self, contender: Contender, row: Row) -> bool:
        controller = contender.controller
        try:
            (policy,) = contender.make(row.design_config(controller.observation))
        except ImportError:  # what it needs is not installed
            return False
        config, seeds = row.config(controller.observation, controller.action), self.seeds(controller, row)
        return self.cache is not None and is_cached(controller, policy, config, seeds, self.cache)


def run(plan: Plan, bar: Any) -> Benchmark:
    """Roll every contender out on every row and summarise; ``bar`` is tqdm's, over the steps of the run."""
    scenarios = []
    for row in plan.rows:
        samples = [_sample(plan, row, contender, bar) for contender in plan.contenders]
        bound = earlier_bound(plan.bounds, row, samples) if plan.bounds else None
        scenarios.append(summarise(row, samples, bound))
    return Benchmark(tuple(scenarios), plan.command, plan.agents)


def _sample(plan: Plan, row: Row, contender: Contender, bar: Any) -> Sample:
    controller = contender.controller
    config = row.config(controller.observation, controller.action)
    bar.set_description(f"{row.name}, {controller.name}")
    policies = contender.make(row.design_config(controller.observation))
    seeds = plan.seeds(controller, row)
    if not controller.slow:
        return Sample.of(controller, [rollout(policy, config, seeds, bar.update) for policy in policies])
    if plan.cache is None or len(policies) != 1:
        raise ValueError(f"the slow controller {controller.name!r} needs a folder for its episodes, and one policy")
    return slow_sample(controller, policies[0], config, seeds, plan.cache, bar.update)
