"""The benchmark's results: typed, frozen, computed from samples."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from .metrics import metric_names, metrics
from .protocol import Row
from .rollout import Floats, Rollout, Signals
from .statistics import Estimate, Resamples, cvar, differences, means, optimality_gap, probability_of_improvement

REFERENCE = "paper"
"""Controller that paired differences are taken against."""
BOUND = "clairvoyant"
"""Controller that optimality gaps are measured from."""
SPEED = "microseconds_per_step"
"""Name of the one metric that is not per episode: time in ``predict`` per step and episode, batched [us]."""
TAIL_METRICS = ("rmse_mm", "rmse_observable_mm", "max_error_mm")
"""Metrics whose worst 5 % are reported."""
EXAMPLES = 8
"""Episodes of a sample that keep their signals, the first ones: 2 MB a sample of 3 h episodes at 5 s."""


@dataclass(frozen=True)
class Controller:
    """Who was measured."""

    name: str
    observation: str
    meaning: str
    training_seeds: tuple[int, ...] = ()
    """Training seeds of a learned controller, empty for the others."""
    privileged: bool = False
    """Whether it knows what no sensor shows."""
    slow: bool = False
    """Whether it meets only the first few episodes, and these are cached."""
    action: str = "direct"
    """What its actions mean (:func:`cz_gym.task.drives_of`)."""
    own: bool = False
    """Whether it comes from the user's own file: figures show it first."""

    @property
    def learned(self) -> bool:
        """Whether it was trained."""
        return bool(self.training_seeds)

    @property
    def bound(self) -> bool:
        """Whether it knows or reads what no sensor shows: no contender, a bound."""
        return self.privileged or self.observation == "state"


class Part(NamedTuple):
    """What some episodes of one policy come to."""

    seeds: tuple[int, ...]
    values: Floats
    """Shape (episodes, metrics), metrics in the order of :func:`metric_names`."""
    microseconds: float
    """Time in the policy per step and episode [us]."""
    signals: dict[int, Floats]
    """By seed, of those episodes that keep them: up to the episode's end, shape (signals, steps)."""

    @classmethod
    def of(cls, run: Rollout, examples: Collection[int]) -> Part:
        """Of a rollout; the episodes among ``examples`` keep their signals."""
        signals = {seed: np.stack(run.episode(i)) for i, seed in enumerate(run.seeds) if seed in examples}
        return cls(run.seeds, np.stack(metrics(run), axis=-1), run.microseconds_per_step, signals)


@dataclass(frozen=True)
class Sample:
    """One controller on one scenario."""

    controller: Controller
    seeds: tuple[int, ...]
    values: Floats
    """Shape (training seeds or 1, episodes, metrics), metrics in the order of :func:`metric_names`."""
    microseconds_per_step: float
    examples: tuple[Signals, ...]
    """Signals of the first :data:`EXAMPLES` episodes up to their ends, each of shape (steps,); those of the first
    training seed."""
    control_interval: float

    @classmethod
    def joined(
        cls, controller: Controller, seeds: Sequence[int], parts: Sequence[Sequence[Part]], control_interval: float
    ) -> Sample:
        """The sample of the parts of each training seed, in any order, which together hold the episodes."""
        values = []
        for policy in parts:
            rows = {seed: row for part in policy for seed, row in zip(part.seeds, part.values, strict=True)}
            values.append([rows[seed] for seed in seeds])
        signals = {seed: Signals(*found) for part in parts[0] for seed, found in part.signals.items()}
        every = [(part.microseconds, len(part.seeds)) for policy in parts for part in policy]
        microseconds = float(np.average([each for each, _ in every], weights=[episodes for _, episodes in every]))
        examples = tuple(signals[seed] for seed in seeds[:EXAMPLES])
        return cls(controller, tuple(seeds), np.array(values), microseconds, examples, control_interval)

    @property
    def example(self) -> Signals:
        """Signals of the first episode up to its end, each of shape (steps,)."""
        return self.examples[0]

    def metric(self, name: str) -> Floats:
        """One metric, shape (training seeds or 1, episodes)."""
        return self.values[:, :, metric_names().index(name)]

    def first(self, episodes: int) -> Sample:
        """The same sample on its first episodes."""
        seeds, values, examples = self.seeds[:episodes], self.values[:, :episodes], self.examples[:episodes]
        return replace(self, seeds=seeds, values=values, examples=examples)


@dataclass(frozen=True)
class Outcome:
    """The estimates made from a sample."""

    sample: Sample
    means: Mapping[str, Estimate]
    """By metric, :data:`SPEED` included."""
    cvar5: Mapping[str, Estimate]
    """Mean of the worst 5 % of episodes, by metric of :data:`TAIL_METRICS`."""
    paired: Mapping[str, Estimate]
    """Mean difference against :data:`REFERENCE` on the same crystals, by metric; empty without it."""
    improvement: Estimate | None
    """Probability of a lower RMSE than :data:`REFERENCE` on the same crystal."""
    gap: Estimate | None = None
    """(J - J_bound) / (J_reference - J_bound), J the cost that the bound minimises; None without :data:`BOUND`."""
    gap_radius: Estimate | None = None
    """The same with J the mean squared radius error, which is only a part of that cost."""

    @property
    def controller(self) -> Controller:
        """Who was measured."""
        return self.sample.controller


@dataclass(frozen=True)
class Verdict:
    """A learned controller against the best classical one that reads sensors."""

    agent: str
    rival: str
    difference: Estimate
    """Mean paired difference of RMSE, agent less rival [mm]."""

    @property
    def wins(self) -> bool:
        """Whether the agent's RMSE is lower: the whole interval of the difference, or the one episode."""
        return self.difference.ends[1] < 0.0

    @property
    def loses(self) -> bool:
        """Whether the rival's RMSE is lower, in the same sense."""
        return self.difference.ends[0] > 0.0


@dataclass(frozen=True)
class ScenarioResult:
    """Every controller on one scenario."""

    row: Row
    outcomes: tuple[Outcome, ...]
    verdicts: tuple[Verdict, ...]
    earlier_bound: Sample | None = None
    """What gaps are measured from where :data:`BOUND` took no part in the run: its episodes of an earlier run."""

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of its episodes; a slow controller may have met only the first of them."""
        return max((outcome.sample.seeds for outcome in self.outcomes), key=len)


@dataclass(frozen=True)
class Benchmark:
    """A whole run."""

    scenarios: tuple[ScenarioResult, ...]
    command: str
    agents: tuple[Mapping[str, Any], ...]
    """Contracts of the agent files."""

    @property
    def controllers(self) -> tuple[Controller, ...]:
        """Who took part."""
        return tuple(outcome.controller for outcome in self.scenarios[0].outcomes)


def summarise(row: Row, samples: Sequence[Sample], earlier_bound: Sample | None = None) -> ScenarioResult:
    """Means, tails, paired differences, gaps and verdicts of one scenario.

    Controllers that met the same episodes share their resamples; two that met different numbers are compared on those
    that both met. ``earlier_bound`` stands in for :data:`BOUND` if that is not among the samples.
    """
    resamples = cache(Resamples.draw)
    named = {sample.controller.name: sample for sample in samples}
    earlier_bound = None if BOUND in named else earlier_bound
    bound = named.get(BOUND, earlier_bound)
    outcomes = tuple(_outcome(sample, named.get(REFERENCE), bound, resamples) for sample in samples)
    return ScenarioResult(row, outcomes, _verdicts(samples, resamples), earlier_bound)


def common(*samples: Sample) -> tuple[Sample, ...]:
    """The samples on the episodes that all of them met, the first ones."""
    fewest = min(len(sample.seeds) for sample in samples)
    return tuple(sample.first(fewest) for sample in samples)


def _outcome(
    sample: Sample, reference: Sample | None, bound: Sample | None, resamples: Callable[[int], Resamples]
) -> Outcome:
    names, own = metric_names(), resamples(len(sample.seeds))
    found = dict(zip(names, means(sample.values, own), strict=True))
    found[SPEED] = Estimate(sample.microseconds_per_step, None, len(sample.seeds))
    outcome = Outcome(sample, found, {name: cvar(sample.metric(name), own) for name in TAIL_METRICS}, {}, None)
    if reference is not None and bound is not None:
        ours, theirs, best = common(sample, reference, bound)
        shared = resamples(len(ours.seeds))
        cost, error = ([one.metric(name) for one in (ours, theirs, best)] for name in ("cost", "rmse_mm"))
        gap = optimality_gap(cost[0], cost[1], cost[2], shared)
        gap_radius = optimality_gap(error[0] ** 2, error[1] ** 2, error[2] ** 2, shared)
        outcome = replace(outcome, gap=gap, gap_radius=gap_radius)
    if reference is not None and sample is not reference:
        ours, theirs = common(sample, reference)
        shared = resamples(len(ours.seeds))
        paired = dict(zip(names, differences(ours.values, theirs.values, shared), strict=True))
        better = probability_of_improvement(ours.metric("rmse_mm"), theirs.metric("rmse_mm"), shared)
        outcome = replace(outcome, paired=paired, improvement=better)
    return outcome


def _verdicts(samples: Sequence[Sample], resamples: Callable[[int], Resamples]) -> tuple[Verdict, ...]:
    rivals = [sample for sample in samples if not (sample.controller.learned or sample.controller.bound)]
    if not rivals:
        return ()
    best = min(common(*rivals), key=lambda sample: float(sample.metric("rmse_mm").mean())).controller
    rival = next(sample for sample in rivals if sample.controller is best)
    verdicts = []
    for sample in samples:
        if sample.controller.learned and not sample.controller.bound:
            ours, theirs = (one.metric("rmse_mm")[:, :, None] for one in common(sample, rival))
            difference = differences(ours, theirs, resamples(ours.shape[1]))[0]
            verdicts.append(Verdict(sample.controller.name, best.name, difference))
    return tuple(verdicts)
