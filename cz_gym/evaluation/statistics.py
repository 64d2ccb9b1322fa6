"""Uncertainty of the benchmark's figures: 95 % percentile bootstrap over episodes and training seeds.

Values have shape (training seeds, episodes, metrics); a controller that is not trained has one "seed". All meet the
same crystals, so one set of resampled episodes serves them all; training seeds are crossed with episodes, so both are
resampled on their own and their weights multiply.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

from cz_gym.support.errors import CzError

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


# Radius error at equal pull activity: a controller that moves the pull speed more can hold the radius better.
#
# A *reference family* is one controller tuned for several activities, RMS of the pull step; its members span a
# frontier of radius error: a monotone cubic (Fritsch and Carlson's PCHIP) in logarithms of both.

Point = tuple[float, float]
"""Pull activity [mm/min] and radius error [mm]."""


class Frontier(NamedTuple):
    """A family's radius error against its pull activity, from the quietest member to the most active one."""

    activity: Floats
    """Pull step RMS [mm/min], increasing, shape (members,)."""
    rmse: Floats
    """Radius error [mm], decreasing, shape (members,)."""

    def at(self, activity: float) -> float:
        """Return the family's radius error [mm] at a pull step RMS [mm/min].

        Above the most active member it is that member's error, since nobody has to use all the activity allowed.
        Raises CzError below the quietest member, where the family gives no answer.
        """
        if not activity >= self.activity[0]:
            raise CzError(f"a pull step RMS of {activity} mm/min is below the frontier's {self.activity[0]:.4g}")
        if activity >= self.activity[-1]:
            return float(self.rmse[-1])
        curve = PchipInterpolator(np.log(self.activity), np.log(self.rmse))
        return float(np.exp(curve(np.log(activity))))


def frontier(points: Sequence[Point]) -> Frontier:
    """Return the frontier of these points, without those that another one beats in both numbers.

    Raises CzError for numbers that are not positive, and if fewer than two points are left.
    """
    best: list[Point] = []
    for activity, rmse in sorted(points):
        if not (0.0 < activity < np.inf and 0.0 < rmse < np.inf):
            raise CzError(f"activity and radius error must be positive numbers, not {activity} and {rmse}")
        if not best or rmse < best[-1][1]:
            # Two activities whose logarithms are equal are one point of the curve: the better one.
            if best and not np.log(activity) > np.log(best[-1][0]):
                best.pop()
            best.append((activity, rmse))
    if len(best) < 2:
        raise CzError(f"a frontier needs two settings of which neither beats the other, found {len(best)}")
    activities, errors = np.array(best).T
    return Frontier(activities, errors)


def ratios(points: Mapping[str, Point], family: Sequence[str]) -> dict[str, float]:
    """Return each controller's radius error over the family's at the same activity [-]; below 1 it beats the family.

    ``family`` names the members; names that ``points`` lacks are passed over. Controllers quieter than every member
    are left out. Raises CzError if too few members are there.
    """
    curve = frontier([points[name] for name in family if name in points])
    return {
        name: rmse / curve.at(activity) for name, (activity, rmse) in points.items() if activity >= curve.activity[0]
    }


def intervals(episodes: Mapping[str, Floats], family: Sequence[str], resamples: Resamples) -> dict[str, Point]:
    """Return the 95 % bootstrap interval of each controller's ratio, over crystals and training seeds.

    ``episodes`` has activity [mm/min] and radius error [mm] by controller, shape (training seeds, crystals, 2). Every
    resample has a frontier of its own. A controller quieter than every member in some resample is left out.
    """
    means = {name: resampled_means(values, resamples, of) for of, (name, values) in enumerate(episodes.items())}
    by_draw = [
        ratios({name: (float(each[draw, 0]), float(each[draw, 1])) for name, each in means.items()}, family)
        for draw in range(len(resamples.episodes))
    ]
    in_all = [name for name in means if all(name in each for each in by_draw)]
    tail = (1.0 - LEVEL) / 2.0
    limits = {name: np.quantile([each[name] for each in by_draw], [tail, 1.0 - tail]) for name in in_all}
    return {name: (float(low), float(high)) for name, (low, high) in limits.items()}
