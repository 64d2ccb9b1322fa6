"""Controllers of whole crystals on the same crystals: ``python -m studies.crystal [STAGE ...]``, in minutes.

The crystals are training ones: the settings were chosen by hand on the first of them.
"""

import argparse
from collections.abc import Sequence

import numpy as np

from cz_gym.baselines.registry import CRYSTAL_CONTROLLERS
from cz_gym.crystal.parameters import STAGES
from cz_gym.crystal.process import CRYSTAL
from cz_gym.evaluation.crystal_metrics import PARTS, CrystalMetrics, crystal_metrics
from cz_gym.evaluation.protocol import TRAINING_SEEDS, Row
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.command_line import OneLineParser, between

HEAD = (
    "| controller | completed | crown mm | body mm | within 0.5 mm | tail mm | v/G 3 % | v/G 10 % | h | kWh/kg | lost |"
)
RULE = "|---|---|---|---|---|---|---|---|---|---|---|"


def line(name: str, m: CrystalMetrics) -> str:
    """A row of the table: medians, and 95 % of the largest errors."""
    lost = ", ".join(f"{(m.lost_in == part).sum()} {what}" for part, what in enumerate(PARTS) if part in m.lost_in)
    cells = (
        f"{m.completed.sum():.0f} of {len(m.completed)}", _largest(m.crown_max_mm), _mean(m.body_rmse_mm, 2),
        _mean(100 * m.body_within_half, 0, " %"), _largest(m.tail_max_mm), _mean(100 * m.v_over_G_within_3pct, 0, " %"),
        _mean(100 * m.v_over_G_within_10pct, 0, " %"), _mean(m.hours, 1), _mean(m.kwh_per_kg, 1), lost or "none",
    )  # fmt: skip
    return f"| `{name}` | {' | '.join(cells)} |"


def _mean(values: np.ndarray, digits: int, unit: str = "") -> str:
    return "-" if np.isnan(values).all() else f"{np.nanmean(values):.{digits}f}{unit}"


def _largest(values: np.ndarray) -> str:
    known = values[~np.isnan(values)]
    return f"{np.median(known):.2f} / {np.quantile(known, 0.95):.2f}" if len(known) else "-"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.crystal", "Compare controllers on whole crystals, or parts of them.")
    parser.add_argument("stages", nargs="*", default=["crown"], metavar="STAGE", help=", ".join(STAGES))
    parser.add_argument("--scenario", default="randomized")
    parser.add_argument("--crystals", type=between(1, 500), default=30, metavar="N")
    parser.add_argument("--controllers", metavar="A,B", help="by name; all by default")
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    names = given.controllers.split(",") if given.controllers else [each.name for each in CRYSTAL_CONTROLLERS]
    for stage in given.stages:
        row = Row(stage, given.scenario, stage, process=CRYSTAL, stage=stage)
        print(f"\n{stage} on {given.scenario}\n\n{HEAD}\n{RULE}", flush=True)
        for contender in (each for each in CRYSTAL_CONTROLLERS if each.name in names):
            config = row.config(contender.observation, contender.action)
            run = rollout(contender.make(config), config, TRAINING_SEEDS[: given.crystals])
            print(line(contender.name, crystal_metrics(run)), flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
