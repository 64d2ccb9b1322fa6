"""Choose the LQG's settings for six levels of pull activity: ``python -m cz_gym.baselines.tuning.lqg_frontier``.

The tuned LQGs are swept over their weight on pull steps on training seeds, and the weight for each wanted activity is
interpolated. Of them, the one with the smallest radius error on validation seeds is taken. Test seeds are never
touched; sweep, finals and choice are kept in results/tuning.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.baselines.lqg.settings import ACTIVITIES, SHIPPED, settings_of, with_pull_step
from cz_gym.commands import OneLineParser, between
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS

from .harness import rounded
from .lqg import figures
from .lqg_goals import FAILURE_PENALTY

BASES = ("lqg", "lqg-quiet", "lqg-active")
"""What is swept: ``randomized``'s settings where a scenario has none, but for the last."""
FACTORS = tuple(4.0**power for power in range(-3, 6))
"""Multiples of the shipped weight on pull steps that are swept."""


def sweep(base: str, scenario: str, episodes: int) -> list[dict[str, Any]]:
    """Figures on training seeds for every factor."""
    settings, found = settings_of(base, scenario), []
    for weight in rounded(factor * settings.weights.pull_step for factor in FACTORS):
        each = figures(with_pull_step(settings, weight), scenario, TRAINING_SEEDS[:episodes])
        found.append({"base": base, "pull_step_weight": weight, "figures": each._asdict()})
        print(f"{base} {weight:9.4g}  {each}", flush=True)
    return found


def weight_for(activity: float, swept: Sequence[dict[str, Any]]) -> float:
    """The weight for pull steps that large [mm/min], by interpolation in logarithms; the nearest end beyond."""
    points = sorted((entry["figures"]["pull_step"], entry["pull_step_weight"]) for entry in swept)
    activities, weights = np.log(np.array(points)).T
    return rounded([np.exp(np.interp(np.log(activity), activities, weights))])[0]


def final(base: str, scenario: str, activity: float, weight: float, episodes: int) -> dict[str, Any]:
    """Figures on validation seeds of one setting."""
    settings = with_pull_step(settings_of(base, scenario), weight)
    found = figures(settings, scenario, VALIDATION_SEEDS[:episodes])
    print(f"final {activity:g} {base} {weight:9.4g}  {found}", flush=True)
    chosen = {"activity": activity, "base": base, "pull_step_weight": weight, "hash": settings.hash}
    return chosen | {"validation": found._asdict()}


def cost(entry: dict[str, Any]) -> float:
    """What decides between the finals of an activity: losses first, then the radius error."""
    found = entry["validation"]
    return float(FAILURE_PENALTY * found["failure_rate"] + found["rmse_mm"])


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = OneLineParser(
        prog="python -m cz_gym.baselines.tuning.lqg_frontier", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--scenario", choices=sorted({scenario for _, scenario in SHIPPED}), default="randomized")
    parser.add_argument("--episodes", type=between(1, 10_000), default=50, help="training episodes a weight")
    parser.add_argument("--validation", type=between(1, 500), default=100, help="validation episodes a final")
    parser.add_argument("--output", type=Path, default=None, help="default in results/tuning")
    return parser.run(_sweep, arguments, "benchmark")


def _sweep(given: argparse.Namespace) -> None:
    output = given.output or Path("results") / "tuning" / f"lqg-frontier-{given.scenario}.json"
    check_writable(output.parent)
    bases = [base for base in BASES if base != BASES[-1] or (base, given.scenario) in SHIPPED]
    swept = {base: sweep(base, given.scenario, given.episodes) for base in bases}
    finals = [
        [final(base, given.scenario, activity, weight_for(activity, swept[base]), given.validation) for base in bases]
        for activity in ACTIVITIES
    ]
    found = {
        "scenario": given.scenario,
        "budget": {"episodes": given.episodes, "validation": given.validation},
        "chosen": [min(pair, key=cost) for pair in finals],
        "finals": [entry for pair in finals for entry in pair],
        "sweep": [entry for base in bases for entry in swept[base]],
    }
    write_files({output: (json.dumps(found, indent=1) + "\n").encode()})
    print(json.dumps(found["chosen"], indent=1))


if __name__ == "__main__":
    sys.exit(main())
