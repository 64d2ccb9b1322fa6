"""Search the ``ppo`` recipe's hyperparameters: ``python -m studies.search --trials 30``.

Optuna's tree-structured Parzen estimator proposes, beginning with the recipe as it stands; a trial that does worse than
the median at the same step is given up. What counts is the agent's cost on validation crystals. The best few then meet
other validation crystals and other training seeds beside the recipe. Optuna's journal holds every trial, and the same
command goes on from it; ``history.csv`` is the same for people.
"""

from __future__ import annotations

import argparse
import csv
import io
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cz_gym.commands import OneLineParser, between, guarded
from studies.comparison.command import STEPS, add_folders, compare

if TYPE_CHECKING:
    from optuna import Study
    from optuna.trial import FrozenTrial

    from cz_gym.agents.training.validation import Validation

    from .space import Params

PROG = "python -m studies.search"
STARTUP, COMPLETE, VALIDATIONS = 8, 4, 6
"""Trials drawn at random first; those that must be complete before one is given up; validations on a trial's way."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    given = parser().parse_args(arguments)
    return guarded(PROG, lambda: _main(given), "agents", "the same command goes on from the trials in its journal")


def parser() -> OneLineParser:
    """The options."""
    parser = OneLineParser(prog=PROG, description=(__doc__ or "").split("\n")[0])
    for option, kind, default, meaning in (
        ("--trials", between(1, 10_000), 30, "trials in all, earlier ones included"),
        ("--steps", STEPS, 600_000, "environment steps a trial"),
        ("--finalists", between(0, 100), 2, "best trials that are confirmed"),
        ("--seeds", between(1, 100), 3, "training seeds that confirm"),
        ("--seed", between(0, 10**9), 0, "seed of the search"),
    ):
        parser.add_argument(option, type=kind, default=default, help=f"{meaning} (default: %(default)s)")
    add_folders(parser, "search")
    return parser


def _main(given: argparse.Namespace) -> int:
    from cz_gym.atomic_files import check_writable, locked

    check_writable(given.out)
    with locked(given.work):
        confirm(search(given), given)
    return 0


def objective(
    params: Params,
    seed: int,
    given: argparse.Namespace,
    report: Callable[[int, Validation], None] = lambda steps, found: None,
) -> float:
    """Mean cost of a step of the agent that these hyperparameters and this training seed make [-]."""
    from tqdm import tqdm

    from studies.comparison.results import COST, Plan
    from studies.comparison.training import trained

    from .space import recipe_of

    plan = Plan(given.out, given.work, crystals()[0])
    with tqdm(disable=True) as bar:
        recipe = recipe_of(params, given.steps, "ppo-search")
        return trained(plan, recipe, seed, bar, max(given.steps // VALIDATIONS, 1), report).mean(COST)


def crystals() -> tuple[Sequence[int], Sequence[int]]:
    """Seeds of the crystals that trials are judged on, and of those that confirm; none of them picks a run's agent."""
    from cz_gym.agents.training.validation import PICKING
    from cz_gym.evaluation.protocol import VALIDATION_SEEDS

    rest = VALIDATION_SEEDS[len(PICKING) :]
    return rest[:150], rest[150:350]


def search(given: argparse.Namespace) -> Study:
    """Try settings until there are as many trials as asked for, going on from the journal."""
    import optuna
    from optuna.storages.journal import JournalFileBackend

    from cz_gym.agents.training.recipes import PPO

    from .space import SPACE, params_of

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    given.out.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        storage=optuna.storages.JournalStorage(JournalFileBackend(str(given.out / "journal.log"))),
        study_name=f"ppo-{given.steps}-steps",
        load_if_exists=True,
        pruner=optuna.pruners.MedianPruner(n_startup_trials=COMPLETE),
    )
    recipe, done = params_of(PPO()), finished(study)
    if all(trial.params != recipe for trial in done):
        study.enqueue_trial(recipe)
    for number in range(len(done), given.trials):
        # What is asked for depends on finished trials only: one that was interrupted comes again, and its run goes on.
        study.sampler = optuna.samplers.TPESampler(seed=given.seed + number, n_startup_trials=STARTUP)
        trial = study.ask(SPACE)

        def report(steps: int, found: Validation, trial: optuna.Trial = trial) -> None:
            trial.report(found.cost, steps)
            if trial.should_prune():
                raise optuna.TrialPruned

        try:
            study.tell(trial, objective(trial.params, 0, given, report))
        except optuna.TrialPruned:
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            for folder in filter(Path.is_dir, given.work.iterdir()):
                shutil.rmtree(folder)
        except BaseException:
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
            raise
        write_history(study, given.out / "history.csv")
        print(f"trial {trial.number}: {study.trials[-1].state.name.lower()}", flush=True)
    return study


def finished(study: Study) -> list[FrozenTrial]:
    """Trials that were judged or given up."""
    return [trial for trial in study.trials if trial.state.name in ("COMPLETE", "PRUNED")]


def write_history(study: Study, path: Path) -> None:
    """Write the finished trials as CSV."""
    from cz_gym.atomic_files import write_files

    from .space import SPACE

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("trial", "state", "cost", "seconds", *SPACE))
    for trial in finished(study):
        seconds = trial.duration.total_seconds() if trial.duration else 0.0
        cost = f"{trial.value:.6g}" if trial.value is not None else ""
        values = [f"{trial.params[name]:.6g}" for name in SPACE]
        writer.writerow((trial.number, trial.state.name.lower(), cost, f"{seconds:.0f}", *values))
    write_files({path: text.getvalue().encode()})


def confirm(study: Study, given: argparse.Namespace) -> None:
    """Train the best trials once more beside the recipe, on other crystals and training seeds, and write their table.

    Training seeds begin at 1: the search used 0.
    """
    from cz_gym.agents.training.recipes import PPO
    from studies.comparison.results import Plan
    from studies.comparison.variants import Study as Comparison
    from studies.comparison.variants import Variant

    from .space import params_of, recipe_of

    complete = sorted(
        (trial for trial in finished(study) if trial.state.name == "COMPLETE"), key=lambda each: each.values
    )
    best = [trial for trial in complete if trial.params != params_of(PPO())][: given.finalists]
    variants = [Variant(PPO(), "the recipe as it stands").of(given.steps)]
    for trial in best:
        recipe = recipe_of(trial.params, given.steps, f"ppo-trial-{trial.number}")
        meaning = ", ".join(f"{name} {value:.4g}" for name, value in trial.params.items())
        variants.append(Variant(recipe, meaning, variants[0].name))
    comparison = Comparison("search", f"The best of {len(complete)} trials beside the recipe", variants, given.steps)
    if best:
        plan = Plan(given.out, given.work, crystals()[1])
        compare(comparison, plan, variants, range(1, 1 + given.seeds), 1)


if __name__ == "__main__":
    sys.exit(main())
