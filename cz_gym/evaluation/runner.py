"""Running a benchmark: every contender on every row, sample by sample."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from cz_gym.config import Config
from cz_gym.errors import CzError

from .cache import BLOCK, SlowEpisodes, earlier_bound
from .contenders import Contender
from .protocol import SLOW_EPISODES, Row
from .results import EXAMPLES, Benchmark, Controller, Part, Sample, summarise
from .rollout import rollout

AT_ONCE = 500
"""Episodes that a policy runs at once."""


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
        try:
            return not any(Job(self, row, contender).pieces for row in self.rows)
        except ImportError:  # what it needs is not installed
            return False


class Piece(NamedTuple):
    """Some episodes of one policy on one row: what can run anywhere, and comes out the same."""

    label: str
    make: Callable[[Config], Any]
    """Makes the policy."""
    design: Config
    """What it is made for."""
    config: Config
    policy: int
    """Its number among its contender's."""
    seeds: tuple[int, ...]
    examples: frozenset[int]
    """Episodes that keep their signals."""

    @property
    def steps(self) -> int:
        """Environment steps of its episodes."""
        return len(self.seeds) * self.config.steps


Perform = Callable[[Sequence[Piece], Any], Iterable[tuple[int, Part]]]
"""Runs pieces, in whatever order: the number of each with its part. It moves tqdm's bar on by the steps done."""


def run_piece(piece: Piece, progress: Callable[[int], None] | None = None) -> Part:
    """Roll a piece out."""
    done = rollout(piece.make(piece.design), piece.config, piece.seeds, progress)
    return Part.of(done, piece.examples)


def in_turn(pieces: Sequence[Piece], bar: Any) -> Iterator[tuple[int, Part]]:
    """One piece after the other, here."""
    for number, piece in enumerate(pieces):
        bar.set_description(piece.label)
        yield number, run_piece(piece, bar.update)


def on_cluster(pieces: Sequence[Piece], bar: Any) -> Iterator[tuple[int, Part]]:
    """On the Ray cluster that :func:`.cluster.connect` joined."""
    from .cluster import completed

    bar.set_description(f"{len(pieces)} pieces")
    for number, part in completed(run_piece, pieces):
        yield number, part
        bar.update(pieces[number].steps)


def run(plan: Plan, bar: Any, perform: Perform = in_turn) -> Benchmark:
    """Roll every contender out on every row and summarise; ``bar`` is tqdm's, over the steps of the run."""
    jobs = [Job(plan, row, contender) for row in plan.rows for contender in plan.contenders]
    pieces = [(job, piece) for job in jobs for piece in job.pieces]
    bar.update(plan.steps - sum(piece.steps for _, piece in pieces))
    for number, part in perform([piece for _, piece in pieces], bar):
        pieces[number][0].keep(pieces[number][1], part)
    scenarios = []
    for row in plan.rows:
        samples = [job.sample() for job in jobs if job.row is row]
        bound = earlier_bound(plan.bounds, row, samples) if plan.bounds else None
        scenarios.append(summarise(row, samples, bound))
    return Benchmark(tuple(scenarios), plan.command, plan.agents)


def _only(make: Callable[[Config], Sequence[Any]], config: Config) -> Any:
    (policy,) = make(config)
    return policy


def _same(policy: Any, config: Config) -> Any:
    return policy


class Job:
    """A contender on a row: its pieces, and the sample that they make."""

    def __init__(self, plan: Plan, row: Row, contender: Contender) -> None:
        controller = contender.controller
        self.row, self.controller, self.slow = row, controller, None
        self.config = row.config(controller.observation, controller.action)
        self.seeds = plan.seeds(controller, row)
        self.parts: dict[int, list[Part]] = {number: [] for number in range(len(controller.training_seeds) or 1)}
        missing, at_once = tuple(self.seeds), AT_ONCE
        design = row.design_config(controller.observation)
        if controller.slow:
            policies = contender.make(design)
            if plan.cache is None or len(policies) != 1:
                raise CzError(
                    f"the slow controller {controller.name!r} needs a folder for its episodes, and one policy"
                )
            self.slow = SlowEpisodes(controller, policies[0], self.config, plan.cache)
            self.parts[0] += self.slow.read(self.seeds, self.seeds[:EXAMPLES])
            found = {seed for part in self.parts[0] for seed in part.seeds}
            missing, at_once = tuple(seed for seed in missing if seed not in found), BLOCK
        # A learned policy is there already; another is made where it runs, as not all can be sent.
        made = contender.make(design) if controller.learned else None
        makers = [partial(_only, contender.make)] if made is None else [partial(_same, policy) for policy in made]
        label, examples = f"{row.name}, {controller.name}", frozenset(self.seeds[:EXAMPLES])
        self.pieces = [
            Piece(label, makers[policy], design, self.config, policy, missing[first : first + at_once], examples)
            for policy in self.parts
            for first in range(0, len(missing), at_once)
        ]

    def keep(self, piece: Piece, part: Part) -> None:
        """A piece is done."""
        if self.slow is not None:
            self.slow.write(part)
        self.parts[piece.policy].append(part)

    def sample(self) -> Sample:
        """All pieces together."""
        return Sample.joined(self.controller, self.seeds, list(self.parts.values()), self.config.control_interval)
