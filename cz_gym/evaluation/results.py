"""The benchmark's results: samples, which were measured, and for each case the estimates computed from them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Self

import numpy as np

from .metrics import Metrics, measured, names_of, outside
from .protocol import Case, Contender
from .rollout import Floats, Rollout
from .statistics import Estimate, Resamples, cvar, differences, means, optimality_gap, probability_of_improvement

REFERENCE = "paper"
"""Controller that paired differences are taken against."""
BOUND = "clairvoyant"
"""Controller that optimality gaps are measured from."""
SPEED = "microseconds_per_step"
"""Name of the one metric that is not per episode: time in ``predict`` per step and episode, batched [us]."""
GAPS = {"cost": 1, "rmse_mm": 2}
"""Metrics of which optimality gaps are made, with their powers."""
TAIL_METRICS = ("rmse_mm", "rmse_observable_mm", "max_error_mm")
"""Metrics whose worst 5 % are reported."""
LARGEST = 0.95
"""Level of the quantiles that are reported of :data:`LARGEST_ERRORS` [-]."""
LARGEST_ERRORS = ("crown_max_mm", "tail_max_mm", "max_error_mm")


@dataclass(frozen=True)
class Sample:
    """Metrics of a contender on some episodes of a case."""

    contender: Contender
    seeds: tuple[int, ...]
    values: Floats
    """Metrics in the order of :attr:`names`, shape (training seeds or 1, episodes, metrics)."""
    microseconds: float
    """Time in the policy per step and episode [us]."""
    example: Any = None
    """Signals of the first episode up to its end, each of shape (steps,), of the first training seed."""
    outside: Floats | None = None
    """Share of time outside the case's tolerance band [-], shape (training seeds or 1, episodes), if it has one."""
    kind: Any = Metrics
    """Type of its metrics."""

    @classmethod
    def of(cls, contender: Contender, runs: Iterable[Rollout], tolerance: float | None = None) -> Self:
        """Metrics of rollouts on the same episodes, one a training seed, and the signals of the first one."""
        example, values, times, shares = None, [], [], []
        for run in runs:
            example, seeds, figures = example or run.episode(0), run.seeds, measured(run)
            values.append(np.stack(figures, axis=-1))
            times.append(run.microseconds_per_step)
            shares += [outside(run, tolerance)] if tolerance else []
        outside_of = np.array(shares) if shares else None
        return cls(contender, seeds, np.stack(values), float(np.mean(times)), example, outside_of, type(figures))

    @classmethod
    def joined(cls, seeds: Sequence[int], parts: Sequence[Self]) -> Self:
        """Join a controller's samples, in any order, which together hold the episodes of ``seeds``."""
        rows = {seed: values for part in parts for seed, values in zip(part.seeds, part.values[0], strict=True)}
        microseconds = np.average([part.microseconds for part in parts], weights=[len(part.seeds) for part in parts])
        (first,) = (part for part in parts if part.seeds[0] == seeds[0])
        values = np.array([[rows[seed] for seed in seeds]])
        return replace(first, seeds=tuple(seeds), values=values, microseconds=float(microseconds), outside=None)

    @property
    def name(self) -> str:
        """Name of the contender."""
        return self.contender.name

    def metric(self, name: str) -> Floats:
        """One metric, shape (training seeds or 1, episodes)."""
        return self.values[:, :, self.names.index(name)]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its metrics."""
        return names_of(self.kind)

    def first(self, episodes: int) -> Self:
        """The same sample on its first episodes."""
        share = None if self.outside is None else self.outside[:, :episodes]
        return replace(self, seeds=self.seeds[:episodes], values=self.values[:, :episodes], outside=share)


Estimates = Mapping[str, Mapping[str, Estimate]]
"""Estimates by contender and metric."""


@dataclass(frozen=True)
class Result:
    """Estimates of all contenders on one case."""

    case: Case
    samples: tuple[Sample, ...]
    means: Estimates
    """Mean over crystals and training seeds, :data:`SPEED` included."""
    cvar5: Estimates
    """Mean of the worst 5 % of episodes, of :data:`TAIL_METRICS`."""
    paired: Estimates
    """Mean difference against :data:`REFERENCE` on the same crystals; no contender without it."""
    improvement: Estimates
    """Probability of a lower ``rmse_mm`` than :data:`REFERENCE` on the same crystal."""
    gaps: Estimates
    """(J - J_bound) / (J_reference - J_bound), with J the ``cost``, which the bound minimises, or the square of
    ``rmse_mm``, which is only a part of it; no contender without :data:`BOUND`."""
    rival: str | None
    """The classical controller of the lowest mean RMSE that reads sensors."""
    verdicts: Mapping[str, Estimate]
    """Mean paired difference of RMSE of each agent, agent less rival [mm]."""
    earlier_bound: Sample | None = None
    """Sample of an earlier run that gaps are measured from where :data:`BOUND` took no part."""

    @property
    def largest(self) -> Estimates:
        """Quantiles of :data:`LARGEST_ERRORS` over crystals and training seeds at :data:`LARGEST`."""
        return {sample.name: dict(_largest(sample)) for sample in self.samples}

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of its episodes; a slow controller may have met only the first of them."""
        return max((sample.seeds for sample in self.samples), key=len)

    def wins(self, agent: str) -> bool:
        """Whether the agent's RMSE is lower than the rival's: the whole interval of the difference is below zero."""
        return self.verdicts[agent].ends[1] < 0.0

    def loses(self, agent: str) -> bool:
        """Whether the rival's RMSE is lower, in the same sense."""
        return self.verdicts[agent].ends[0] > 0.0


def summarise(case: Case, samples: Sequence[Sample], earlier_bound: Sample | None = None) -> Result:
    """Means, tails, paired differences, gaps and verdicts of one case.

    Contenders that met the same episodes share their resamples; two that met different numbers are compared on those
    that both met. ``earlier_bound`` stands in for :data:`BOUND` if that is not among the samples.
    """
    resamples = cache(Resamples.draw)
    named = {sample.name: sample for sample in samples}
    reference = named.get(REFERENCE)
    if BOUND in named:
        earlier_bound = None
    bound = named.get(BOUND, earlier_bound)
    against = [sample for sample in samples if reference is not None and sample is not reference]
    return Result(
        case,
        tuple(samples),
        {sample.name: _means(sample, resamples) for sample in samples},
        {
            sample.name: {name: cvar(sample.metric(name), resamples(len(sample.seeds))) for name in TAIL_METRICS}
            for sample in samples
        },
        {sample.name: _paired(resamples, *common(sample, named[REFERENCE])) for sample in against},
        {sample.name: _improvement(resamples, *common(sample, named[REFERENCE])) for sample in against},
        {}
        if reference is None or bound is None
        else {sample.name: _gaps(resamples, *common(sample, reference, bound)) for sample in samples},
        *_verdicts(samples, resamples),
        earlier_bound,
    )


Draw = Callable[[int], Resamples]


def _largest(sample: Sample) -> Iterable[tuple[str, Estimate]]:
    for name in LARGEST_ERRORS:
        known = sample.metric(name) if name in sample.names else np.array(np.nan)
        known = known[~np.isnan(known)]
        if known.size:
            yield name, Estimate(float(np.quantile(known, LARGEST)), None, len(sample.seeds))


def common(*samples: Sample) -> tuple[Sample, ...]:
    """The samples on the episodes that all of them met, the first ones."""
    fewest = min(len(sample.seeds) for sample in samples)
    return tuple(sample.first(fewest) for sample in samples)


def _means(sample: Sample, resamples: Draw) -> dict[str, Estimate]:
    estimates = dict(zip(sample.names, means(sample.values, resamples(len(sample.seeds))), strict=True))
    return {**estimates, SPEED: Estimate(sample.microseconds, None, len(sample.seeds))}


def _paired(resamples: Draw, ours: Sample, theirs: Sample) -> dict[str, Estimate]:
    estimates = differences(ours.values, theirs.values, resamples(len(ours.seeds)))
    return dict(zip(ours.names, estimates, strict=True))


def _improvement(resamples: Draw, ours: Sample, theirs: Sample) -> dict[str, Estimate]:
    errors = ours.metric("rmse_mm"), theirs.metric("rmse_mm")
    return {"rmse_mm": probability_of_improvement(*errors, resamples(len(ours.seeds)))}


def _gaps(resamples: Draw, ours: Sample, theirs: Sample, bound: Sample) -> dict[str, Estimate]:
    gaps = {}
    for metric, power in GAPS.items():
        one, reference, best = (sample.metric(metric) ** power for sample in (ours, theirs, bound))
        if gap := optimality_gap(one, reference, best, resamples(len(ours.seeds))):
            gaps[metric] = gap
    return gaps


def _verdicts(samples: Sequence[Sample], resamples: Draw) -> tuple[str | None, dict[str, Estimate]]:
    """The rival, and the difference of each agent's RMSE from its."""
    able = [sample for sample in samples if not sample.contender.bound]
    rivals = [sample for sample in able if not sample.contender.learned]
    if not rivals:
        return None, {}
    best = min(common(*rivals), key=lambda sample: float(sample.metric("rmse_mm").mean())).name
    (rival,) = (sample for sample in rivals if sample.name == best)
    verdicts = {}
    for agent in (sample for sample in able if sample.contender.learned):
        ours, theirs = (one.metric("rmse_mm")[:, :, None] for one in common(agent, rival))
        verdicts[agent.name] = differences(ours, theirs, resamples(ours.shape[1]))[0]
    return best, verdicts
