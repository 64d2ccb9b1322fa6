"""Radius error at equal pull activity: a controller that moves the pull speed more can hold the radius better.

A *reference family* is one controller tuned for several activities, RMS of the pull step; its members span a frontier
of radius error: a monotone cubic (Fritsch and Carlson's PCHIP) in logarithms of both.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from cz_gym.errors import CzError

from .statistics import LEVEL, Floats, Resamples, resampled_means

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
