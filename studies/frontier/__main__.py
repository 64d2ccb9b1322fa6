"""What the LQG's radius error would be at another's pull activity: ``python -m studies.frontier benchmark.json``.

Radius error and pull activity are traded against each other, so controllers are fairly compared at equal activity. The
LQG's settings of :data:`cz_gym.baselines.lqg.settings.ACTIVITIES` span the trade; between them the logarithm of the
radius error is a monotone cubic (Fritsch and Carlson's PCHIP) of the logarithm of the activity. Where ``episodes.csv``
stands beside the file, each ratio has a 95 % bootstrap interval over crystals and training seeds.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from cz_gym.baselines.lqg.settings import ACTIVITIES, family_name
from cz_gym.baselines.policy import Floats
from cz_gym.commands import OneLineParser, guarded
from cz_gym.evaluation.episodes_file import Episodes, read_episodes
from cz_gym.evaluation.files import EPISODES
from cz_gym.evaluation.statistics import Resamples

PROG = "python -m studies.frontier"
ACTIVITY = "pull_step_rms_mm_per_min"
FAMILY = ("lqg", "lqg-quiet", *map(family_name, ACTIVITIES))
"""Controllers that span the frontier."""
DRAWS = 2_000
"""Bootstrap resamples of a ratio."""


class Frontier(NamedTuple):
    """The trade, from quiet to lively; the error never rises."""

    activity: Floats
    """Pull step RMS [mm/min], increasing."""
    rmse: Floats
    """Radius error [mm], not increasing."""

    def at(self, activity: float) -> float:
        """The radius error [mm] at that pull step RMS [mm/min].

        Above the liveliest setting it is the least there is: who may move more need not. ValueError below the quietest.
        """
        if not activity >= self.activity[0]:
            raise ValueError(f"a pull step RMS of {activity} mm/min is below the frontier's {self.activity[0]:.4g}")
        if activity >= self.activity[-1]:
            return float(self.rmse[-1])
        curve = PchipInterpolator(np.log(self.activity), np.log(self.rmse))
        return float(np.exp(curve(np.log(activity))))


def frontier(points: Sequence[tuple[float, float]]) -> Frontier:
    """The frontier of (activity, radius error) pairs, both positive; pairs that another beats in both are left out.

    ValueError if fewer than two are left.
    """
    kept: list[tuple[float, float]] = []
    for activity, rmse in sorted(points):
        if not (0.0 < activity < np.inf and 0.0 < rmse < np.inf):
            raise ValueError(f"activity and radius error must be positive numbers, not {activity} and {rmse}")
        if not kept or rmse < kept[-1][1]:
            # A logarithm cannot tell activities apart that are rounding errors apart: the better one stands for both.
            if kept and not np.log(activity) > np.log(kept[-1][0]):
                kept.pop()
            kept.append((activity, rmse))
    if len(kept) < 2:
        raise ValueError(f"a frontier needs two settings of which neither beats the other, found {len(kept)}")
    activities, errors = np.array(kept).T
    return Frontier(activities, errors)


def frontier_of(scenario: Mapping[str, Any], metric: str = "rmse_mm") -> Frontier:
    """The LQG's frontier in one scenario of a benchmark.json; ValueError if it has too few of its settings."""
    found = [scenario[name] for name in FAMILY if name in scenario]
    return frontier([(entry[ACTIVITY]["mean"], entry[metric]["mean"]) for entry in found])


def at_equal_activity(scenario: Mapping[str, Any], controller: str, metric: str = "rmse_mm") -> float:
    """Radius error of that controller over the LQG's at its activity [-]: below 1 it beats the frontier."""
    entry = scenario[controller]
    return float(entry[metric]["mean"]) / frontier_of(scenario, metric).at(entry[ACTIVITY]["mean"])


def intervals(scenario: Mapping[str, Floats], resamples: Resamples) -> dict[str, tuple[float, float]]:
    """95 % interval of each controller's ratio at equal activity: crystals, and training seeds, drawn again.

    The frontier is made anew of each draw. Controllers that are quieter than it in some draw are left out.
    """
    means = {}
    for of, (name, values) in enumerate(scenario.items()):
        seeds = resamples.training_seeds(len(values), of)
        means[name] = np.einsum("rs,rsm->rm", seeds, np.stack([resamples.episodes @ copy for copy in values], axis=1))
    settings = [means[name] for name in FAMILY if name in means]
    ratios: dict[str, list[float]] = {name: [] for name in means}
    for draw in range(len(resamples.episodes)):
        curve = frontier([(float(each[draw, 0]), float(each[draw, 1])) for each in settings])
        for name, each in means.items():
            if each[draw, 0] >= curve.activity[0]:
                ratios[name].append(float(each[draw, 1]) / curve.at(float(each[draw, 0])))
    whole = {name: np.quantile(each, [0.025, 0.975]) for name, each in ratios.items() if len(each) == draw + 1}
    return {name: (float(low), float(high)) for name, (low, high) in whole.items()}


def _spread(name: str, scenario: Mapping[str, Any], metric: str, episodes: Episodes) -> dict[str, tuple[float, float]]:
    """Intervals of those who met all the crystals; ValueError if the episodes are not of that run."""
    crystals = episodes.get(name, {})
    for controller, entry in scenario.items():
        values = crystals.get(controller)
        if values is None or not np.isclose(values[..., 1].mean(), entry[metric]["mean"], rtol=1e-4):
            raise ValueError(f"{EPISODES} is of another run: {controller} on {name}")
    count = max(values.shape[1] for values in crystals.values())
    whole = {controller: values for controller, values in crystals.items() if values.shape[1] == count}
    return intervals(whole, Resamples.draw(count, DRAWS))


def table(results: Mapping[str, Any], metric: str, episodes: Episodes | None = None) -> str:
    """A line for every controller of every scenario that holds a frontier; with intervals if there are episodes."""
    lines = []
    for name, scenario in results.items():
        spread = {}
        try:
            curve = frontier_of(scenario, metric)
        except ValueError as error:
            lines.append(f"{name}: {error}")
            continue
        if episodes is not None:
            spread = _spread(name, scenario, metric, episodes)
        for controller, entry in scenario.items():
            activity, rmse = entry[ACTIVITY]["mean"], entry[metric]["mean"]
            beyond = activity < curve.activity[0]
            rival = (
                "quieter than any" if beyond else f"{curve.at(activity):.4f} mm, ratio {rmse / curve.at(activity):.3f}"
            )
            if controller in spread and not beyond:
                rival += " [{:.3f}, {:.3f}]".format(*spread[controller])
            lines.append(f"{name}: {controller} {rmse:.4f} mm at {activity:.4f} mm/min; lqg there: {rival}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = OneLineParser(prog=PROG, description=(__doc__ or "").split("\n")[0])
    parser.add_argument("benchmark", type=Path, help="a benchmark.json with lqg's settings among its controllers")
    parser.add_argument("--metric", choices=("rmse_mm", "rmse_observable_mm"), default="rmse_mm")
    given = parser.parse_args(arguments)
    return guarded(PROG, lambda: _main(given), "benchmark")


def _main(given: argparse.Namespace) -> int:
    try:
        results = json.loads(given.benchmark.read_text())["results"]
        for scenario in results.values():
            for entry in scenario.values():
                float(entry[ACTIVITY]["mean"]), float(entry[given.metric]["mean"])
    except (ValueError, KeyError, TypeError, AttributeError):
        raise ValueError(f"{given.benchmark} is no benchmark.json") from None
    beside = given.benchmark.with_name(EPISODES)
    episodes = read_episodes(beside, lambda _: (ACTIVITY, given.metric)) if beside.exists() else None
    print(table(results, given.metric, episodes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
