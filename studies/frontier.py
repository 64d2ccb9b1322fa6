"""Radius errors over the LQG's at equal pull activity: ``python -m studies.frontier benchmark.json``.

The LQG's settings (:data:`cz_gym.baselines.tuned_controllers.FAMILY`) are the reference family of
:mod:`cz_gym.evaluation.statistics`. With ``episodes.csv`` beside it, each ratio has a 95 % bootstrap interval.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from cz_gym.baselines.tuned_controllers import FAMILY
from cz_gym.evaluation.statistics import Point, Resamples, frontier, intervals, ratios
from cz_gym.support.command_line import OneLineParser
from cz_gym.support.errors import CzError
from cz_gym.support.files import write_files
from cz_gym.tools.episodes import read_episodes, read_estimates, values_of
from cz_gym.tools.registry import CONTROLLERS
from cz_gym.tools.report.tables import markdown
from cz_gym.tools.run import EPISODES

ACTIVITY, RETURN = "pull_step_rms_mm_per_min", "return"
RESAMPLES = 2_000
"""Bootstrap resamples of a ratio."""
APART = 1.05
"""Two ratios further apart than this factor tell two controllers apart [-]."""
BOUNDS = frozenset(entry.name for entry in CONTROLLERS if entry.bound)


def ranking(returns: Mapping[str, float], ratio: Mapping[str, float]) -> str:
    """Sentences that say how well the return ranks the controllers that are no bounds, compared with their ratios."""
    names = [name for name in ratio if name not in BOUNDS]
    others = [name for name in names if name not in FAMILY]
    if len(others) < 3:
        return ""
    ranked, with_family = (
        -spearmanr([returns[name] for name in each], [ratio[name] for name in each]).statistic
        for each in (others, names)
    )
    apart = [pair for pair in combinations(names, 2) if abs(np.log(ratio[pair[0]] / ratio[pair[1]])) > np.log(APART)]
    alike = sum((ratio[a] > ratio[b]) == (returns[a] < returns[b]) for a, b in apart)
    return (
        f"Spearman's correlation of return and ratio, with its sign turned: {ranked:.2f} over the {len(others)} "
        f"controllers outside the reference family, {with_family:.2f} with its members, whose ratios are 1 by "
        f"definition. Of {len(apart)} pairs whose ratios are more than {APART - 1:.0%} apart, the return ranks "
        f"{alike} as the ratio does."
    )


def table(estimates: pd.DataFrame, metric: str, episodes: pd.DataFrame | None = None) -> str:
    """A Markdown table for every scenario that holds a frontier; ratios with intervals if there are episodes."""
    heads = ("controller", "pull step RMS [mm/min]", f"{metric.removesuffix('_mm')} [mm]", "of the LQG's", "return")
    sections = []
    for scenario, own in estimates.groupby("scenario", sort=False):
        means = own.pivot(index="controller", columns="metric", values="mean")
        means = means.loc[own["controller"].unique(), [ACTIVITY, metric, RETURN]]
        points = {name: (activity, error) for name, activity, error, _ in means.itertuples()}
        try:
            ratio_of = ratios(points, FAMILY)
            most = frontier([points[name] for name in FAMILY if name in points]).activity[-1]
        except CzError as error:
            sections.append(f"## {scenario}\n\n{error}.")
            continue
        spread = {} if episodes is None else _intervals(episodes[episodes["scenario"] == scenario], means, metric)
        rows = []
        for name, activity, rmse, gained in means.itertuples():
            ratio = f"{ratio_of[name]:.3f}" if name in ratio_of else "quieter than any LQG"
            ratio += " [{:.3f}, {:.3f}]".format(*spread[name]) if name in ratio_of and name in spread else ""
            ratio += f", more active than any LQG ({most:.4f})" if activity > most else ""
            rows.append((name, f"{activity:.4f}", f"{rmse:.4f}", ratio, f"{gained:.0f}"))
        text = ranking(means[RETURN].to_dict(), ratio_of)
        sections.append(f"## {scenario}\n\n{markdown(heads, rows)}\n\n{text}".rstrip())
    return "\n\n".join(sections)


def _intervals(episodes: pd.DataFrame, means: pd.DataFrame, metric: str) -> dict[str, Point]:
    """Intervals of the controllers that met all crystals; CzError if the episodes are not of that run."""
    values = {name: values_of(rows, (ACTIVITY, metric)) for name, rows in episodes.groupby("controller", sort=False)}
    for name, rmse in means[metric].items():
        if name not in values or not np.isclose(values[name][..., 1].mean(), rmse, rtol=1e-4):
            raise CzError(f"{EPISODES} is of another run: {name} on {episodes['scenario'].iloc[0]}")
    crystals = max(each.shape[1] for each in values.values())
    complete = {str(name): each for name, each in values.items() if each.shape[1] == crystals}
    return intervals(complete, FAMILY, Resamples.draw(crystals, RESAMPLES))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.frontier", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("benchmark", type=Path, help="a benchmark.json with lqg's settings among its controllers")
    parser.add_argument("--metric", choices=("rmse_mm", "rmse_observable_mm"), default="rmse_mm")
    parser.add_argument("--out", type=Path, help="write the tables into this file; they are printed all the same")
    return parser.run(_compare, arguments, "benchmark")


def _compare(given: argparse.Namespace) -> None:
    estimates, _ = read_estimates(given.benchmark, (given.metric, ACTIVITY, RETURN))
    beside = given.benchmark.with_name(EPISODES)
    episodes = read_episodes(beside, (ACTIVITY, given.metric)) if beside.exists() else None
    text = table(estimates, given.metric, episodes)
    print(text)
    if given.out is not None:
        write_files({given.out: f"# Error at equal activity\n\n{text}\n".encode()})


if __name__ == "__main__":
    sys.exit(main())
