"""Radius errors over the LQG's at equal pull activity: ``python -m studies.frontier benchmark.json``.

The LQG's settings (:data:`cz_gym.baselines.tuned_controllers.FAMILY`) are the reference family of
:mod:`cz_gym.evaluation.statistics`. With ``episodes.csv`` beside it, each ratio has a 95 % bootstrap interval.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from cz_gym.baselines.tuned_controllers import FAMILY
from cz_gym.evaluation.statistics import Estimate, Point, Resamples, frontier, intervals, ratios
from cz_gym.support.command_line import OneLineParser
from cz_gym.support.errors import CzError
from cz_gym.support.files import write_files
from cz_gym.tools.files import EPISODES, Episodes, read_episodes, read_results
from cz_gym.tools.registry import CONTROLLERS
from cz_gym.tools.report.tables import markdown

ACTIVITY, RETURN = "pull_step_rms_mm_per_min", "return"
RESAMPLES = 2_000
"""Bootstrap resamples of a ratio."""
APART = 1.05
"""Two ratios further apart than this factor tell two controllers apart [-]."""
Points = Mapping[str, Point]
"""Mean activity [mm/min] and radius error [mm] by controller."""
BOUNDS = frozenset(entry.name for entry in CONTROLLERS if entry.bound)
Means = Mapping[str, Mapping[str, Estimate]]
"""Estimates of the benchmark by controller and metric."""


def ranking(means: Means, ratio: Mapping[str, float]) -> str:
    """Sentences that say how well the return ranks the controllers that are no bounds, compared with their ratios."""
    names = [name for name in ratio if name not in BOUNDS]
    others = [name for name in names if name not in FAMILY]
    if len(others) < 3:
        return ""
    ranked, with_family = (
        -spearmanr([means[name][RETURN].mean for name in each], [ratio[name] for name in each]).statistic
        for each in (others, names)
    )
    apart = [pair for pair in combinations(names, 2) if abs(np.log(ratio[pair[0]] / ratio[pair[1]])) > np.log(APART)]
    alike = sum((ratio[a] > ratio[b]) == (means[a][RETURN].mean < means[b][RETURN].mean) for a, b in apart)
    return (
        f"Spearman's correlation of return and ratio, with its sign turned: {ranked:.2f} over the {len(others)} "
        f"controllers outside the reference family, {with_family:.2f} with its members, whose ratios are 1 by "
        f"definition. Of {len(apart)} pairs whose ratios are more than {APART - 1:.0%} apart, the return ranks "
        f"{alike} as the ratio does."
    )


def table(results: Mapping[str, Means], metric: str, episodes: Episodes | None = None) -> str:
    """A Markdown table for every scenario that holds a frontier; ratios with intervals if there are episodes."""
    heads = ("controller", "pull step RMS [mm/min]", f"{metric.removesuffix('_mm')} [mm]", "of the LQG's", "return")
    sections = []
    for scenario, means in results.items():
        points = {name: (figures[ACTIVITY].mean, figures[metric].mean) for name, figures in means.items()}
        try:
            ratio_of = ratios(points, FAMILY)
            most = frontier([points[name] for name in FAMILY if name in points]).activity[-1]
        except CzError as error:
            sections.append(f"## {scenario}\n\n{error}.")
            continue
        spread = {} if episodes is None else _intervals(scenario, points, episodes.get(scenario, {}))
        rows = []
        for name, (activity, rmse) in points.items():
            ratio = f"{ratio_of[name]:.3f}" if name in ratio_of else "quieter than any LQG"
            ratio += " [{:.3f}, {:.3f}]".format(*spread[name]) if name in ratio_of and name in spread else ""
            ratio += f", more active than any LQG ({most:.4f})" if activity > most else ""
            rows.append((name, f"{activity:.4f}", f"{rmse:.4f}", ratio, f"{means[name][RETURN].mean:.0f}"))
        sections.append(f"## {scenario}\n\n{markdown(heads, rows)}\n\n{ranking(means, ratio_of)}".rstrip())
    return "\n\n".join(sections)


def _intervals(scenario: str, points: Points, episodes: Mapping[str, Any]) -> dict[str, Point]:
    """Intervals of the controllers that met all crystals; CzError if the episodes are not of that run."""
    for name, (_, rmse) in points.items():
        if name not in episodes or not np.isclose(episodes[name][..., 1].mean(), rmse, rtol=1e-4):
            raise CzError(f"{EPISODES} is of another run: {name} on {scenario}")
    crystals = max(values.shape[1] for values in episodes.values())
    complete = {name: values for name, values in episodes.items() if values.shape[1] == crystals}
    return intervals(complete, FAMILY, Resamples.draw(crystals, RESAMPLES))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.frontier", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("benchmark", type=Path, help="a benchmark.json with lqg's settings among its controllers")
    parser.add_argument("--metric", choices=("rmse_mm", "rmse_observable_mm"), default="rmse_mm")
    parser.add_argument("--out", type=Path, help="write the tables into this file; they are printed all the same")
    return parser.run(_compare, arguments, "benchmark")


def _compare(given: argparse.Namespace) -> None:
    results, _ = read_results(given.benchmark, (given.metric, ACTIVITY, RETURN))
    beside = given.benchmark.with_name(EPISODES)
    episodes = read_episodes(beside, (ACTIVITY, given.metric)) if beside.exists() else None
    text = table(results, given.metric, episodes)
    print(text)
    if given.out is not None:
        write_files({given.out: f"# Error at equal activity\n\n{text}\n".encode()})


if __name__ == "__main__":
    sys.exit(main())
