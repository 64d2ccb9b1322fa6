"""What it costs to hold hot zones that nobody told: ``python -m studies.hot_zone``, some minutes.

Radius errors on ``randomized`` and ``hot-zone`` of three versions of a controller: *before*, with the settings that a
search on nominal hot zones chose; *after*, as it ships; *told*, as before and given each crystal's own parameters.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

from cz_gym.baselines.bounds.lqg import privileged
from cz_gym.baselines.lqg.controller import LQG
from cz_gym.baselines.lqg.designs import TOLD, adaptive
from cz_gym.baselines.mpc import WEIGHT_FACTOR
from cz_gym.baselines.registry import find_controller, make_controller
from cz_gym.baselines.tuned_for import shipped, with_values
from cz_gym.config import Config, make_config
from cz_gym.errors import CzError
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import TEST_SEEDS
from cz_gym.evaluation.report.tables import markdown
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.command_line import OneLineParser, between
from cz_gym.support.names import unknown

LQGS = {
    "lqg": (0.1556, 0.06564, 0.5706, 0.3106, 0.369, 0.0007519, 2113.0, 0.3833, 0.002862, 0.08655, 0.2398),
    "lqg-quiet": (0.05482, 0.3051, 1.168, 0.2614, 0.311, 0.0005758, 2265.0, 0.3219, 0.002207, 0.06289, 0.2513),
    "lqg-at-0.005": (0.06819, 2.177, 21.29, 0.268, 0.2347, 0.0004393, 1878.0, 0.2029, 0.001509, 0.04786, 0.186),
    "lqg-at-0.008": (0.01523, 0.456, 28.15, 0.2674, 0.2534, 0.0004875, 2724.0, 0.1891, 0.0009058, 0.04916, 0.1245),
    "lqg-at-0.013": (0.01691, 0.08806, 19.53, 0.2547, 0.2575, 0.0006169, 2070.0, 0.2052, 0.001683, 0.06757, 0.1713),
    "lqg-at-0.02": tuple(shipped(TOLD)["randomized"].values()),
    "lqg-at-0.03": (0.004128, 0.006732, 2.685, 0.251, 0.2861, 0.0005686, 2077.0, 0.1983, 0.001488, 0.05271, 0.205),
}
"""Values of the searched fields before, by LQG."""
SEARCHED = tuple(shipped("lqg")["randomized"])
BEFORE: dict[str, dict[str, float]] = {
    "paper-tuned": {},
    "pid-conventional": {},
    "industrial": {"T_f": 1.338, "heater.K": 407.2, "heater.T_i": 64.27, "heater.share": 0.8326, "heater.K_pull": 36.0,
                   "heater.T_pull": 6343.0, "heater.T_mean": 1611.0},
    **{name: dict(zip(SEARCHED, values, strict=True)) for name, values in LQGS.items()},
    "lqg-at-0.02-adaptive": dict(zip(SEARCHED, LQGS["lqg-at-0.02"], strict=True)),
    "ekf-mpc": {path: value * (WEIGHT_FACTOR if path.startswith("weights.") else 1.0)
                for path, value in zip(SEARCHED, LQGS["lqg"], strict=True)},
}  # fmt: skip
"""Values before that are not those of today, by controller and path."""
SCENARIOS, VERSIONS, SLOW = ("randomized", "hot-zone"), ("before", "after", "told"), 10
"""Scenarios, versions of a controller, and number of crystals that a slow one meets."""


def versions(name: str, config: Config) -> dict[str, Any]:
    """The controller before, after and told; PIDs and those with several filters have no version that is told."""
    after: Any = make_controller(name, config)
    if not isinstance(after, LQG):
        return {"before": with_values(after, BEFORE[name]), "after": after}
    before = replace(after, design=with_values(after.design, BEFORE[name]))
    if after.hypotheses is None:
        return {"before": before, "after": after, "told": privileged(before, knows_fluctuations=False)}
    return {"before": adaptive(before) if name.endswith("-adaptive") else before, "after": after}


def row(name: str, seeds: Sequence[int]) -> list[str]:
    """Name, and RMSE [mm] of each version on each scenario with the share of crystals lost."""
    cells = [name]
    for scenario in SCENARIOS:
        config = make_config(scenario, observation="measured", action="direct")
        found = {version: metrics(rollout(one, config, seeds)) for version, one in versions(name, config).items()}
        text = {key: f"{of.rmse_mm.mean():.3f} / {100 * of.failure_rate.mean():.0f} %" for key, of in found.items()}
        cells += [text.get(version, "-") for version in VERSIONS]
    return cells


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.hot_zone", (__doc__ or "").split("\n")[0])
    about = f"test crystals; slow controllers meet {SLOW} (default: %(default)s)"
    parser.add_argument("--episodes", type=between(1, len(TEST_SEEDS)), default=100, help=about)
    parser.add_argument("--controllers", default=",".join(BEFORE), help="joined by commas (default: %(default)s)")
    return parser.run(_main, arguments, "benchmark,mpc")


def _main(given: argparse.Namespace) -> None:
    rows = []
    for name in (wanted := given.controllers.split(",")):
        if name not in BEFORE:
            raise CzError(unknown("controller", name, BEFORE))
    for name in wanted:
        episodes = min(given.episodes, SLOW) if find_controller(name).slow else given.episodes
        rows.append(row(name, TEST_SEEDS[:episodes]))
    print(markdown(("RMSE [mm] / lost", *(", ".join(each) for each in product(SCENARIOS, VERSIONS))), rows))


if __name__ == "__main__":
    sys.exit(main())
