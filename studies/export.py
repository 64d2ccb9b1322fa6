"""Exported C beside Python: ``python -m studies.export``.

Each controller is exported, compiled, and grows validation crystals. Open loop: on the crystals that Python grows, the
C gets the same readings, and its setpoints are compared with Python's at every sample. Closed loop: the C grows the
same crystals itself, and its row of the table stands beside Python's.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.commands import OneLineParser
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.report.tables import markdown
from cz_gym.evaluation.rollout import Rollout, rollout
from cz_gym.export.__main__ import make_block
from cz_gym.export.compiled import CompiledBlock
from cz_gym.export.policy import BlockPolicy
from cz_gym.export.shell import Block, in_shares

CONTROLLERS = ("paper", "paper-tuned", "lqg-at-0.02", "gradient", "ppo")
SCENARIOS = ("randomized", "hard", "sensor-fault", "puller")
CRYSTALS, QUICK = 100, 4
"""Crystals of a row, also of a quick run."""
LARGEST = {"double": 1e-9, "float": 1e-4}
"""Largest difference of an action that counts as the same, in shares of the drives' ranges."""

FORMATS = (".3f", ".4f", "d")
"""How the table writes :class:`Figures`."""


class Figures(NamedTuple):
    """A row of the benchmark's table: means over the crystals, and crystals lost; rounded as the table is."""

    rmse_mm: float
    pull_step_rms_mm_per_min: float
    lost: int


class Row(NamedTuple):
    """The C of a controller in one precision on the crystals of a scenario."""

    controller: str
    scenario: str
    real: str
    difference: float
    """Largest difference of an action from Python's on the same readings, in shares of the drives' ranges."""
    python: Figures
    c: Figures


class Beside:
    """A block in Python that acts, and compiled ones that get the same readings; keeps the largest differences."""

    made_for = None

    def __init__(self, block: Block, compiled: Sequence[CompiledBlock]) -> None:
        self.config, self.differences = block.config, np.zeros(len(compiled))
        self.policies = [BlockPolicy(block), *(BlockPolicy(block, runner) for runner in compiled)]

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        """As of every policy; the state is that of each block."""
        states = state or [None] * len(self.policies)
        done = [block.predict(observation, of, episode_start) for block, of in zip(self.policies, states, strict=True)]
        own, *rest = (in_shares(of.outputs, self.config) for _, of in done)
        self.differences = np.maximum(self.differences, [np.abs(each - own).max() for each in rest])
        return done[0][0], [of for _, of in done]


def figures(run: Rollout) -> Figures:
    """The figures of the table."""
    found = metrics(run)
    rmse, step = float(np.mean(found.rmse_mm)), float(np.mean(found.pull_step_rms_mm_per_min))
    return Figures(round(rmse, 3), round(step, 4), int(run.failed.sum()))


def study(controller: str, scenario: str, crystals: int) -> list[Row]:
    """Grow the crystals with Python, and with the C in each precision that the controller allows."""
    config, seeds = make_config(scenario, observation="measured", action="direct"), VALIDATION_SEEDS[:crystals]
    block = make_block(controller, config)
    reals = ["double"] if block.program.needs_double else list(LARGEST)
    compiled = [CompiledBlock(block, real == "float") for real in reals]
    beside = Beside(block, compiled)
    python = figures(rollout(beside, config, seeds))
    return [
        Row(controller, scenario, real, float(difference), python, figures(rollout(policy, config, seeds)))
        for real, difference, policy in zip(reals, beside.differences, beside.policies[1:], strict=True)
    ]


def report(rows: Sequence[Row], crystals: int) -> str:
    """The verdict and the table."""
    said = [
        f"{max(row.difference for row in rows if row.real == real):.0e} in {real} (limit {limit:.0e})"
        for real, limit in LARGEST.items()
    ]
    unlike = [f"{row.controller} on {row.scenario} in {row.real}" for row in rows if row.python != row.c]
    heads = ("controller", "scenario", "C", "action", "RMSE [mm]", "of C", "pull step [mm/min]", "of C", "lost", "of C")
    lines = [
        (
            *names,
            f"{difference:.0e}",
            *(f"{value:{form}}" for form, *pair in zip(FORMATS, python, c, strict=True) for value in pair),
        )
        for *names, difference, python, c in rows
    ]
    return f"""# Exported C beside Python

{crystals} validation crystals of three hours a row. Largest difference of an action on the same readings, in shares of
the drives' ranges: {", ".join(said)}. Rows of the table that differ: {", ".join(unlike) or "none"}.

{markdown(heads, lines)}
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.export", "Exported C beside Python on validation crystals.")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} crystals a row")
    parser.add_argument("--out", type=Path, default=Path("results/export"), metavar="FOLDER", help="%(default)s")
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    check_writable(given.out)
    crystals, rows = QUICK if given.quick else CRYSTALS, []
    for controller in CONTROLLERS:
        for scenario in SCENARIOS:
            rows += study(controller, scenario, crystals)
            print(*rows[-1], flush=True)
    data = [row._asdict() | {"python": row.python._asdict(), "c": row.c._asdict()} for row in rows]
    text = json.dumps({"crystals": crystals, "rows": data}, indent=1)
    write_files({given.out / "export.json": text.encode(), given.out / "report.md": report(rows, crystals).encode()})


if __name__ == "__main__":
    sys.exit(main())
