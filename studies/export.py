"""Exported C beside Python: ``python -m studies.export``.

Open loop: on the validation crystals that Python grows, the compiled C of each controller gets the same readings and
the same last setpoints, and its setpoints are compared with Python's at every sample. (Left to setpoints of its own, to
which no crystal answers, a controller of an unstable plant may run away from any rounding error.) Closed loop: the C
grows the same crystals itself, and its row of the table stands beside Python's.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.files import write_files
from cz_gym.tools.export.block import in_shares
from cz_gym.tools.export.controllers import make_block
from cz_gym.tools.export.shell import Block, BlockPolicy, Runner
from cz_gym.tools.export.text import CompiledBlock
from cz_gym.tools.report.tables import markdown

from . import StudyParser, to_json

CONTROLLERS = ("paper", "paper-tuned", "lqg-at-0.02", "gradient", "ppo")
SCENARIOS = ("randomized", "hard", "sensor-fault", "puller")
CRYSTALS = 100
"""Crystals of a row."""
LARGEST = {"double": 1e-9, "float": 1e-4}
"""Largest difference of an action that counts as the same, in shares of the drives' ranges."""


class Row(NamedTuple):
    """The C of a controller in one precision on the crystals of a scenario."""

    controller: str
    scenario: str
    real: str
    difference: float
    """Largest difference of an action from Python's on the same readings, in shares of the drives' ranges."""
    python: Sequence[float]
    """Python's row of the table: RMSE [mm] and pull step RMS [mm/min], rounded as there; crystals lost."""
    c: Sequence[float]
    """Row of the table with the C in place of Python: RMSE [mm], pull step RMS [mm/min], crystals lost."""
    rounded: Sequence[float] | None = None
    """Row, where it differs, of C in double precision whose setpoints alone are rounded to single precision."""


def rounded(runner: Runner) -> Any:
    """The runner with outputs that are rounded to single precision."""

    def run(inputs: Mapping[str, Any], memory: Any) -> Any:
        outputs, memory = runner.run(inputs, memory)
        return {name: value.astype(np.float32).astype(np.float64) for name, value in outputs.items()}, memory

    return SimpleNamespace(start=runner.start, run=run)


def with_same_readings(block: Block, others: Sequence[Runner]) -> tuple[Any, Any]:
    """Make a runner of the block that has the others act on its readings and setpoints; return it, and the array in
    which it keeps the largest difference of each one's actions.
    """
    runners, worst = (block, *others), np.zeros(len(others))

    def run(inputs: Mapping[str, Any], memory: Any) -> Any:
        done = [runner.run(inputs, its) for runner, its in zip(runners, memory, strict=True)]
        own, *rest = (in_shares(outputs, block.config) for outputs, _ in done)
        np.maximum(worst, [np.abs(each - own).max() for each in rest], out=worst)
        outputs, its = done[0]
        pairs = zip(others, done[1:], strict=True)
        return outputs, (its, *(each.held_at(memory, its.pull, its.heater) for each, (_, memory) in pairs))

    return SimpleNamespace(start=lambda n: tuple(runner.start(n) for runner in runners), run=run), worst


def study(controller: str, scenario: str, crystals: int) -> list[Row]:
    """Grow the crystals with Python, and with the C in each precision."""
    block = make_block(controller, make_config(scenario, observation="measured", action="direct"))
    compiled = [CompiledBlock(block, real == "float") for real in LARGEST]

    def grown(runner: Runner) -> Sequence[float]:
        run = rollout(BlockPolicy(block, runner), block.config, VALIDATION_SEEDS[:crystals])
        figures = metrics(run)
        rmse, step = float(np.mean(figures.rmse_mm)), float(np.mean(figures.pull_step_rms_mm_per_min))
        return round(rmse, 3), round(step, 4), int(run.failed.sum())

    watched, worst = with_same_readings(block, compiled)
    python, rows = grown(watched), list[Row]()
    for real, runner, difference in zip(LARGEST, compiled, worst.tolist(), strict=True):
        c = grown(runner)
        alone = None if c == python else grown(rounded(compiled[0]))
        rows.append(Row(controller, scenario, real, difference, python, c, alone))
    return rows


def _named(rows: Sequence[Row]) -> str:
    return ", ".join(f"{row.controller} on {row.scenario} in {row.real}" for row in rows) or "none"


def _cells(row: Row) -> tuple[str, ...]:
    *names, difference, python, c, alone = row
    triples = zip((".3f", ".4f", ""), python, c, alone or ("",) * 3, strict=True)
    cells = (value if value == "" else f"{value:{form}}" for form, *triple in triples for value in triple)
    return (*names, f"{difference:.1e}", *cells)


def report(rows: Sequence[Row], crystals: int) -> str:
    """The verdict and the table."""
    worst = {real: max(row.difference for row in rows if row.real == real) for real in LARGEST}
    said = ", ".join(f"{worst[real]:.1e} in {real} (limit {limit:.0e})" for real, limit in LARGEST.items())
    above = _named([row for row in rows if row.difference > LARGEST[row.real]])
    differing = _named([row for row in rows if row.python != row.c])
    heads = (each for name in ("RMSE [mm]", "pull step [mm/min]", "lost") for each in (name, "of C", "rounded"))
    return f"""# Exported C beside Python

{crystals} validation crystals of three hours a row. Largest difference of an action on the same readings, in shares of
the drives' ranges: {said}.

Actions above the limit: {above}.

Rows of the table that differ: {differing}.
Beside a row that differs stands, as "rounded", that of the C in double precision whose setpoints alone are rounded to
single precision: so much the loop of crystal and controller makes of the seventh digit.

{markdown(("controller", "scenario", "C", "action", *heads), map(_cells, rows))}
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return StudyParser("export", __doc__, "results/export").run(_main, arguments)


def _main(given: argparse.Namespace) -> None:
    rows = list[Row]()
    for controller in CONTROLLERS:
        for scenario in SCENARIOS:
            rows += study(controller, scenario, CRYSTALS)
            print(*rows[-1], flush=True)
    text = to_json({"crystals": CRYSTALS, "rows": [row._asdict() for row in rows]})
    write_files({given.out / "export.json": text, given.out / "report.md": report(rows, CRYSTALS).encode()})


if __name__ == "__main__":
    sys.exit(main())
