"""A whole-crystal controller that reads each sensor alone, and several: ``python -m studies.sensors``.

``lqg-along`` as it ships grows the same training crowns with every choice of ring, edge and weight; the pyrometer is
always read.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from cz_gym.baselines.crystal import CrystalLQG
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.evaluation.metrics import crystal_metrics
from cz_gym.evaluation.protocol import TRAINING_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.command_line import between
from cz_gym.support.errors import require_type
from cz_gym.support.files import write_files
from cz_gym.tools.registry import make_controller
from cz_gym.tools.report.tables import markdown

from . import StudyParser

CONTROLLER, SENSORS = "lqg-along", ("ring", "edge", "weight")
CHOICES = [choice for count in range(1, len(SENSORS) + 1) for choice in combinations(SENSORS, count)]


def row_of(sensors: Sequence[str], crystals: int) -> tuple[str, ...]:
    """Sensors, lost crowns [%], and median and 95 % quantile of each crown's largest error [mm]; lost ones are 12."""
    config = make_config("randomized", observation="measured", action="direct", process=CRYSTAL, stage="crown")
    whole = require_type(CrystalLQG, make_controller(CONTROLLER, config), "a controller with a choice of sensors")
    controller = replace(whole, sensors=("pyrometer", *sensors))
    found = crystal_metrics(rollout(controller, config, TRAINING_SEEDS[:crystals]))
    middle, most = np.quantile(found.crown_max_mm, (0.5, 0.95))
    lost = f"{100.0 * (1.0 - found.completed.mean()):.0f}"
    return ", ".join(sensors), lost, f"{middle:.2f} / {most:.2f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = StudyParser("sensors", __doc__, "results/sensors")
    parser.add_argument("--crystals", type=between(1, 500), default=100, help="number of training crowns (%(default)s)")
    return parser.run(_main, arguments)


def _main(given: argparse.Namespace) -> None:
    rows = []
    for sensors in CHOICES:
        rows.append(row_of(sensors, given.crystals))
        print(*rows[-1], flush=True)
    heads = "reads", "crowns lost [%]", "largest error, median / 95 % [mm]"
    text = f"""# Sensors of a whole crystal

`{CONTROLLER}` with these sensors beside the pyrometer, on {given.crystals} training crowns of `randomized`; a lost one
counts 12 mm.

{markdown(heads, rows)}
"""
    write_files({given.out / "table.md": text.encode()})


if __name__ == "__main__":
    sys.exit(main())
