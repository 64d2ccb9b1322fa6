"""Tune controllers: ``python -m cz_gym.baselines.tuning --controller paper-tuned --scenario puller``.

``--puller my.toml`` designs for a puller of the user's own (:mod:`.for_puller`).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cz_gym.commands import OneLineParser, between
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import find_scenario
from cz_gym.errors import CzError
from cz_gym.puller import chosen_puller

from .for_puller import design
from .goals import TUNABLE, crystals, goal_of
from .search import Search, file_name, measure


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = OneLineParser("python -m cz_gym.baselines.tuning", "Tune a controller within a budget.")
    add = parser.add_argument
    add("--controller", help=f"{', '.join(TUNABLE)} (with --puller: all that are searched for one)")
    add("--scenario", default="randomized", help="scenario to tune on")
    add("--control-interval", type=float, default=5.0, help="time between actions [s]")
    parser.add_puller("design for it: a controller of its own for each row, minutes of work")
    trials, episodes = between(1, 100_000), between(5, 5000)
    add(
        "--trials",
        type=trials,
        help="candidates to try, those of an earlier run included (100; with --puller 40 or 12)",
    )
    add("--episodes", type=episodes, help="training episodes of a candidate (100; with --puller 20)")
    add("--out", type=Path, help="folder of histories and choices (results/tuning; with --puller beside its file)")
    return parser.run(tune, arguments, "benchmark", "the same command continues from the candidates in its history")


def tune(given: argparse.Namespace) -> None:
    """Search, choose, and print the chosen settings."""
    if given.puller is not None:
        puller = chosen_puller(given.puller)
        return design(puller, given.controller, given.trials, given.episodes, given.out)
    if given.controller is None:
        raise CzError("name a --controller, or a --puller to design for")
    scenario = find_scenario(given.scenario)
    goal, scored_on = goal_of(given.controller, scenario), crystals(given.controller, scenario)
    config = make_config(scored_on, None, "measured", given.control_interval, action="direct")
    search = Search(given.controller, goal, config, given.trials or 100, given.episodes or 100, measure)
    folder = given.out or Path("results/tuning")
    chosen = search.tune(folder / file_name(given.controller, given.scenario))
    print(f"{given.controller} on {given.scenario}: {chosen.score:.4f} {chosen.facts}")
    print(search.settings(chosen.values))
    return None


if __name__ == "__main__":
    sys.exit(main())
