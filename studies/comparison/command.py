"""The command of a comparison: train what is missing, and write the table and the figures anew after each run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cz_gym.atomic_files import check_writable, locked, write_files
from cz_gym.commands import OneLineParser, between
from cz_gym.evaluation import cluster

from .variants import Study, Variant

if TYPE_CHECKING:
    from .results import Plan, Result
    from .training import Perform

STEPS = between(1, 10**9)
"""The type of an option that counts environment steps."""
ABOUT = """
Agents are judged on {crystals} validation crystals of `{scenario}` that did not choose a run's agent, and on those of
`{transfer}` with the same seeds; of each run the agent of least cost on the validation that selects. In brackets:
95 % intervals, bootstrap over training seeds and crystals; with few training seeds they are somewhat too narrow.
Differences are taken on the same crystals and training seeds, negative is better. Cost: of a step, as the
environment's reward counts it; a lost crystal counts ten there, and 8 mm.
"""


def main(study: Study, arguments: Sequence[str] | None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(f"python -m studies.{study.name}", study.title)
    parser.add_argument("--rows", help="rows to run, joined by commas (default: all)")
    parser.add_argument("--seeds", type=between(1, 100), default=3, help="training seeds a row (default: %(default)s)")
    about = f"environment steps of what learns from reward (default: {study.steps or 'those of its recipe'})"
    parser.add_argument("--steps", type=STEPS, default=study.steps, help=about)
    parser.add_argument("--jobs", type=between(1, 64), default=2, help="runs at once here (default: %(default)s)")
    add_ray(parser, "without an address on this machine's")
    add_folders(parser, study.name)
    parser.add_argument("--list", action="store_true", help="say what the rows are and how many of their runs are done")
    left = "finished runs are kept, and the same command goes on from the others' checkpoints"
    return parser.run(partial(_main, study), arguments, "agents,benchmark", left)


def add_folders(parser: OneLineParser, name: str) -> None:
    """The options --out and --work."""
    for option, folder, meaning in (("--out", "results", "results"), ("--work", "runs", "unfinished runs")):
        default = Path(folder) / name
        parser.add_argument(option, type=Path, default=default, help=f"{meaning} (default: %(default)s)")


def add_ray(parser: OneLineParser, otherwise: str) -> None:
    """The option --ray."""
    about = f"run on a Ray cluster, {otherwise}; all its machines must share --out and --work"
    parser.add_argument("--ray", nargs="?", const="", metavar="HOST:PORT", help=about)


def join(address: str, plan: Plan) -> Plan:
    """Join a Ray cluster whose machines share the plan's folders: the plan with their full paths."""
    cluster.connect(address, "studies")
    for folder in (plan.out, plan.work):
        folder.mkdir(parents=True, exist_ok=True)
        cluster.check_shared(folder)
    return plan._replace(out=plan.out.resolve(), work=plan.work.resolve())


def _main(study: Study, given: argparse.Namespace) -> None:
    from cz_gym.agents.training import validation

    from .results import Plan
    from .training import in_turn, is_finished

    plan, seeds = Plan(given.out, given.work, validation.JUDGING), range(given.seeds)
    variants = [variant.of(given.steps) for variant in study.variants]
    chosen = [variant for variant in variants if variant.name in study.names(given.rows)]
    if given.list:
        for variant in chosen:
            done = sum(is_finished(plan, (variant, seed)) for seed in seeds)
            print(f"{variant.name:24} {done}/{given.seeds}  {variant.meaning}")
        return
    check_writable(plan.out)
    with locked(plan.work):
        perform: Perform = in_turn if given.jobs == 1 else partial(cluster.in_processes, processes=given.jobs)
        if given.ray is not None:
            plan, perform = join(given.ray, plan), cluster.completed
        compare(study._replace(variants=variants), plan, chosen, seeds, perform)


def compare(study: Study, plan: Plan, chosen: Sequence[Variant], seeds: Sequence[int], perform: Perform) -> None:
    """Train the chosen variants for each training seed, and write the table of all that is finished."""
    from .training import train_all

    # Seed by seed, so that a stopped comparison holds every variant.
    tasks = [(variant, seed) for seed in seeds for variant in chosen]
    train_all(plan, tasks, perform, lambda: _write(study, plan, seeds))
    _write(study, plan, seeds)
    print(f"wrote {plan.out / 'table.md'}")


def _write(study: Study, plan: Plan, seeds: Sequence[int]) -> None:
    """Write table and figures from everything that is finished."""
    from .figures import curves, forest
    from .results import SCENARIO, TRANSFER
    from .table import tabulate, to_csv, to_markdown
    from .training import is_finished, result_of

    runs: dict[str, dict[int, Result]] = {}
    for task in ((variant, seed) for variant in study.variants for seed in seeds):
        if is_finished(plan, task):
            runs.setdefault(task[0].name, {})[task[1]] = result_of(plan, task)
    lines = tabulate(study.variants, runs)
    about = ABOUT.strip().format(crystals=len(plan.crystals), scenario=SCENARIO, transfer=TRANSFER)
    meanings = [f"- **{variant.name}**: {variant.meaning}" for variant in study.variants if variant.name in runs]
    text = [f"# {study.title}", "", about, "", to_markdown(lines), "", *meanings, ""]
    files = {"table.md": "\n".join(text).encode(), "table.csv": to_csv(lines).encode()}
    files |= {"forest.png": forest(lines), "curves.png": curves(lines)}
    write_files({plan.out / name: content for name, content in files.items()})
