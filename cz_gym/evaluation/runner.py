"""Running a benchmark: every contender on every row, sample by sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from cz_gym.config import Config
from cz_gym.evaluation.cache.bound import kept_bound
from cz_gym.evaluation.cache.slow_controllers import is_kept, slow_sample

from .protocol import SLOW_EPISODES, Row
from .results import Benchmark, Controller, Sample, summarise
from .rollout import rollout


@dataclass(frozen=True)
class Contender:
    """A controller and how to build it for an environment's settings: one policy a training seed."""

    controller: Controller
    make: Callable[[Config], Sequence[Any]]


@dataclass(frozen=True)
class Plan:
    """What a benchmark runs, and what is written down about it."""

    contenders: tuple[Contender, ...]
    rows: tuple[Row, ...]
    episodes: int
    agents: tuple[Mapping[str, Any], ...] = ()
    """Contracts of the agent files."""
    command: str = ""
    kept: Path | None = None
    """Folder where slow controllers' episodes are kept; needed if there are any."""
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

    def seeds(self, controller: Controller, row: Row) -> range:
        """The episodes of a row that a controller meets."""
        return row.seeds(min(self.episodes, SLOW_EPISODES) if controller.slow else self.episodes)

    def all_kept(self, contender: Contender) -> bool:
        """Whether every episode of a slow controller is kept, so that none would be run."""
        controller, folder = contender.controller, self.kept
        if folder is None:
            return False
        configs = {row: row.config(controller.observation) for row in self.rows}
        return all(
            is_kept(
                controller,
                contender.make(row.told(controller.observation))[0],
                config,
                self.seeds(controller, row),
                folder,
            )
            for row, config in configs.items()
        )


def run(plan: Plan, progress: Progress) -> Benchmark:
    """Roll every contender out on every row and summarise."""
    scenarios = []
    for row in plan.rows:
        samples = []
        for contender in plan.contenders:
            controller = contender.controller
            config = row.config(controller.observation)
            progress.say(f"{row.name}, {controller.name}")
            policies, seeds = contender.make(row.told(controller.observation)), plan.seeds(controller, row)
            if controller.slow:
                samples.append(_slow(plan, controller, policies, config, seeds, progress))
                continue
            runs = [rollout(policy, config, seeds, progress.advance) for policy in policies]
            samples.append(Sample.of(controller, runs))
        scenarios.append(summarise(row, samples, kept_bound(plan.bounds, row, samples) if plan.bounds else None))
    return Benchmark(tuple(scenarios), plan.command, plan.agents)


def _slow(
    plan: Plan, controller: Controller, policies: Sequence[Any], config: Config, seeds: range, progress: Progress
) -> Sample:
    if plan.kept is None or len(policies) != 1:
        raise ValueError(f"the slow controller {controller.name!r} needs a folder for its episodes, and one policy")
    return slow_sample(controller, policies[0], config, seeds, plan.kept, progress.advance)


class Progress:
    """A progress bar over the steps of a run, on stderr; none when quiet. Needs tqdm unless quiet."""

    def __init__(self, steps: int, quiet: bool = False) -> None:
        self._bar: Any = None
        if not quiet:
            from tqdm import tqdm

            self._bar = tqdm(total=steps, unit="step", unit_scale=True, dynamic_ncols=True, leave=False)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()

    def say(self, what: str) -> None:
        """Name what runs now."""
        if self._bar is not None:
            self._bar.set_description(what)

    def advance(self, steps: int) -> None:
        """Count steps."""
        if self._bar is not None:
            self._bar.update(steps)
