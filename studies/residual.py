"""Learning beside a given PID: ``python -m studies.residual FILE...`` compares agents with it on validation crystals.

Each agent adds to the PID that it was trained on, within its limits; that PID alone stands beside it, and the one that
is tuned for each scenario, which is told more.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import RANDOM_CASES, VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.command_line import between
from cz_gym.support.files import write_files
from cz_gym.tools.registry import load_agent, make_controller
from cz_gym.tools.report.tables import markdown

from . import StudyParser

JUDGED = VALIDATION_SEEDS[264:]
"""Seeds of crystals that no training run has chosen or judged its agent by."""
HEADS = "scenario", "controller", "cost", "of the PID's cost", "RMSE [mm]", "pull step RMS [mm/min]", "lost [%]"


def rows(files: Sequence[Path], crystals: int) -> Iterator[tuple[str, ...]]:
    """Rows of the table, in the order of :data:`HEADS`."""
    agents = [*map(load_agent, files)]
    residual: Any = agents[0].residual
    name = residual.base.label.split(" ")[0]
    for case in RANDOM_CASES:
        config = case.design_config("history")
        policies = {name: residual.controller, f"{name}, tuned for it": make_controller(name, config)}
        policies |= {f"{name} + learning, seed {each.contract.training_seed}": each for each in agents}
        alone = 0.0
        for words, policy in policies.items():
            found = metrics(rollout(policy, replace(config, action="direct"), JUDGED[:crystals]))
            cost, rmse, step, lost = (
                float(each.mean())
                for each in (found.cost, found.rmse_mm, found.pull_step_rms_mm_per_min, found.failure_rate)
            )
            alone = alone or cost
            yield (
                case.name,
                words,
                f"{cost:.4f}",
                f"{cost / alone:.2f}",
                f"{rmse:.3f}",
                f"{step:.4f}",
                f"{100 * lost:g}",
            )


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = StudyParser("residual", __doc__, "results/residual")
    parser.add_argument("files", nargs="+", type=Path, help="agent files (.onnx), one a training seed")
    parser.add_argument("--crystals", type=between(1, len(JUDGED)), default=100, help="of each scenario (%(default)s)")
    return parser.run(_main, arguments)


def _main(given: argparse.Namespace) -> None:
    contract = load_agent(given.files[0]).contract
    about = (
        f"{given.crystals} validation crystals of each scenario. The agent adds to `{contract.controller}`, whose "
        f"settings are those for `randomized`, at most {100 * contract.pull_limit:g} % of the nominal pull speed and "
        f"{contract.heater_limit:g} kW; it learned for {contract.training_steps / 1e6:g} million steps."
    )
    table = markdown(HEADS, [*rows(given.files, given.crystals)])
    write_files({given.out / "table.md": f"# Learning beside a PID\n\n{about}\n\n{table}\n".encode()})
    print(table)


if __name__ == "__main__":
    sys.exit(main())
