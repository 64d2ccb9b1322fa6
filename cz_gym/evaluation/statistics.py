"""Uncertainty of the benchmark's figures: 95 % percentile bootstrap over episodes and training seeds.

Values have shape (training seeds, episodes, metrics); a controller that is not trained has one "seed". All meet the
same crystals, so one set of resampled episodes serves them all; training seeds are crossed with episodes, so both are
resampled on their own and their weights multiply.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from cz_gym.errors import CzError

Floats = npt.NDArray[np.float64]
RESAMPLES = 10_000
"""Bootstrap resamples."""
SEED = 1895
"""Seed of the resamples: the same data always gives the same intervals."""
LEVEL = 0.95
"""Level of the intervals [-]."""
TAIL = 0.05
"""Share of the worst episodes whose mean is the CVaR [-]."""
_BLOCK = 500


class Estimate(NamedTuple):
    """A mean, its 95 % interval (None for a single deterministic episode) and the number of episodes."""

    mean: float
    ci95: tuple[float, float] | None
    n: int

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the interval; the mean twice where there is none."""
        return self.ci95 or (self.mean, self.mean)

    def text(self, form: str, unit: float = 1.0) -> str:
        """Return the mean in a unit, with its interval if it has one."""
        mean, *ends = (f"{value / unit:{form}}" for value in (self.mean, *(self.ci95 or ())))
        return f"{mean} [{', '.join(ends)}]" if ends else mean


@dataclass(frozen=True)
class Resamples:
    """Weights of the episodes in each resample, shape (resamples, episodes); each row sums to 1."""

    episodes: Floats

    @classmethod
    def draw(cls, episodes: int, count: int = RESAMPLES) -> Self:
        """Draw multinomial counts over ``episodes``, ``count`` times. Raises CzError without episodes."""
        return cls(_weights(episodes, count, np.random.default_rng(SEED)))

    def training_seeds(self, number: int, of: int = 0) -> Floats:
        """Draw weights of ``number`` training seeds, shape (resamples, number), anew for each controller ``of``."""
        return _weights(number, len(self.episodes), np.random.default_rng([SEED, 1 + of]))


def _weights(items: int, count: int, random: np.random.Generator) -> Floats:
    if items < 1:
        raise CzError(f"a bootstrap needs at least one item, not {items}")
    return random.multinomial(items, np.full(items, 1.0 / items), size=count) / items


def means(values: Floats, resamples: Resamples) -> tuple[Estimate, ...]:
    """Estimate the mean of each metric over seeds and episodes; where it is NaN it does not apply, and is left out."""
    known = np.isfinite(values)
    if known.all():
        return _estimates(values.mean(axis=(0, 1)), resampled_means(values, resamples), values.shape[:2])
    numbers, counted = np.where(known, values, 0.0), known.astype(np.float64)
    with np.errstate(invalid="ignore"):
        point = numbers.sum(axis=(0, 1)) / counted.sum(axis=(0, 1))
        spread = resampled_means(numbers, resamples) / resampled_means(counted, resamples)
    return _estimates(point, spread, values.shape[:2])


def differences(values: Floats, reference: Floats, resamples: Resamples) -> tuple[Estimate, ...]:
    """Estimate the difference of each metric's mean from the reference's on the same crystals."""
    point = values.mean(axis=(0, 1)) - reference.mean(axis=(0, 1))
    spread = resampled_means(values, resamples) - resampled_means(reference, resamples, of=1)
    shape = max(len(values), len(reference)), values.shape[1]
    return _estimates(point, spread, shape)


def probability_of_improvement(values: Floats, reference: Floats, resamples: Resamples) -> Estimate:
    """Estimate how often a metric, shape (seeds, episodes), is lower than the reference's on a crystal, ties half."""
    ours, theirs = values[:, None], reference[None]
    wins = ((ours < theirs) + 0.5 * (ours == theirs)).mean(axis=1)[:, :, None]
    return means(wins, resamples)[0]


def cvar(values: Floats, resamples: Resamples) -> Estimate:
    """Estimate the mean of the worst (largest) TAIL of one metric, shape (training seeds, episodes).

    Rockafellar and Uryasev's conditional value at risk: where the tail is no whole number of episodes, the last one
    counts in part; with fewer than 1/TAIL episodes it is the maximum.
    """
    flat = values.ravel()
    order = np.argsort(-flat, kind="stable")
    point = _tail_mean(flat[order], np.full((1, flat.size), 1.0 / flat.size))
    seeds = resamples.training_seeds(len(values))
    spread = np.empty(len(resamples.episodes))
    for first in range(0, len(spread), _BLOCK):
        part = slice(first, first + _BLOCK)
        weights = (seeds[part, :, None] * resamples.episodes[part, None, :]).reshape(-1, flat.size)
        spread[part] = _tail_mean(flat[order], weights[:, order])
    return _estimates(point, spread[:, None], values.shape)[0]


def optimality_gap(costs: Floats, reference: Floats, bound: Floats, resamples: Resamples) -> Estimate | None:
    """Estimate (J - J_bound) / (J_reference - J_bound), J the mean of losses of shape (training seeds, episodes).

    0 is the bound, 1 the reference; None where the two are equal.
    """
    three = costs, reference, bound
    ours, theirs, least = (values.mean() for values in three)
    if theirs <= least:
        return None
    spread = [resampled_means(values[:, :, None], resamples, of)[:, 0] for of, values in enumerate(three)]
    ratio = np.array([(ours - least) / (theirs - least)])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = (spread[0] - spread[2]) / (spread[1] - spread[2])
    return _estimates(ratio, ratios[np.isfinite(ratios), None], costs.shape)[0]


def _tail_mean(descending: Floats, weights: Floats) -> Floats:
    """Mean of the first TAIL of the weight, one a row of ``weights``."""
    taken = np.diff(np.minimum(np.cumsum(weights, axis=1), TAIL), axis=1, prepend=0.0)
    return taken @ descending / TAIL


def resampled_means(values: Floats, resamples: Resamples, of: int = 0) -> Floats:
    """Return the means of every resample, shape (resamples, metrics); ``of`` numbers the controller."""
    seeds = resamples.training_seeds(len(values), of)
    total = np.zeros((len(seeds), values.shape[2]))
    for weight, copy in zip(seeds.T, values, strict=True):
        total += weight[:, None] * (resamples.episodes @ copy)
    return total


def _estimates(point: Floats, spread: Floats, shape: tuple[int, ...]) -> tuple[Estimate, ...]:
    seeds, episodes = shape
    if seeds * episodes == 1:
        return tuple(Estimate(float(value), None, 1) for value in point)
    low, high = np.quantile(spread, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0], axis=0)
    return tuple(
        Estimate(float(value), (float(below), float(above)), episodes)
        for value, below, above in zip(point, low, high, strict=True)
    )
