"""Tune a controller: ``python -m cz_gym.baselines.tuning --controller paper-tuned --scenario puller``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cz_gym.commands import OneLineParser, between
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import find_scenario

from .goals import TUNABLE, crystals, goal_of
from .search import Search, file_name, measure


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = OneLineParser("python -m cz_gym.baselines.tuning", "Tune a controller within a budget.")
    add = parser.add_argument
    add("--controller", required=True, help=", ".join(TUNABLE))
    add("--scenario", default="randomized", help="scenario to tune on")
    add("--control-interval", type=float, default=5.0, help="time between actions [s]")
    add("--trials", type=between(1, 100_000), default=100, help="candidates to try, those of an earlier run included")
    add("--episodes", type=between(5, 5000), default=100, help="training episodes of a candidate")
    add("--out", type=Path, default=Path("results/tuning"), help="folder of histories and choices")
    return parser.run(tune, arguments, "benchmark", "the same command continues from the candidates in its history")


def tune(given: argparse.Namespace) -> None:
    """Search, choose, and print the chosen settings."""
    scenario = find_scenario(given.scenario)
    goal, scored_on = goal_of(given.controller, scenario), crystals(given.controller, scenario)
    config = make_config(scored_on, None, "measured", given.control_interval, action="direct")
    search = Search(given.controller, goal, config, given.trials, given.episodes, measure)
    chosen = search.tune(given.out / file_name(given.controller, given.scenario))
    print(f"{given.controller} on {given.scenario}: {chosen.score:.4f} {chosen.facts}")
    print(search.settings(chosen.values))


if __name__ == "__main__":
    sys.exit(main())
