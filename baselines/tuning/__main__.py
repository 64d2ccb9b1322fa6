"""Tune a controller: ``python -m cz_gym.baselines.tuning --controller paper-tuned --scenario puller``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cz_gym.commands import OneLineParser, between
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

from .goals import TUNABLE, goal_of
from .search import Search, file_name, measure

BUDGET = "trials", "episodes", "survive", "finalists", "validation", "finals", "seed"
"""Options that the history keeps."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = OneLineParser("python -m cz_gym.baselines.tuning", "Tune a controller within a budget.")
    add = parser.add_argument
    add("--controller", required=True, help=", ".join(TUNABLE))
    add("--scenario", default="randomized", help="scenario to tune on")
    add("--control-interval", type=float, default=5.0, help="time between actions [s]")
    add("--trials", type=between(1, 100_000), default=100, help="candidates to try, those of an earlier run included")
    add("--episodes", type=between(1, 10_000), default=100, help="training episodes of a candidate")
    add("--survive", type=between(0, 10_000), default=20, help="training episodes of harder scenarios to survive")
    add("--finalists", type=between(1, 1000), default=3, help="candidates that are scored on validation seeds")
    add("--validation", type=between(1, len(VALIDATION_SEEDS)), default=200, help="validation episodes of a finalist")
    add("--finals", type=between(0, 10_000), default=200, help="training episodes that a finalist must survive")
    add("--seed", type=int, default=0, help="seed of the exploration")
    add("--out", type=Path, default=Path("results/tuning"), help="folder of histories and choices")
    return parser.run(tune, arguments, "agents", "the same command continues from the candidates in its history")


def tune(given: argparse.Namespace) -> None:
    """Search, choose, and print the chosen settings."""
    config = make_config(given.scenario, control_interval=given.control_interval)
    goal = goal_of(given.controller, config.scenario)
    search = Search(given.controller, goal, config, {name: getattr(given, name) for name in BUDGET}, measure)
    chosen = search.tune(given.out / file_name(given.controller, given.scenario))
    print(f"{given.controller} on {given.scenario}: {chosen.score:.4f} {chosen.facts}")
    print(search.settings(chosen.values))


if __name__ == "__main__":
    sys.exit(main())
