"""Search the ``ppo`` recipe's hyperparameters: ``python -m studies.search --trials 30``.

Ray Tune runs the trials, on this machine's processors or on a cluster's. Optuna's tree-structured Parzen estimator
proposes, beginning with the recipe as it stands; a trial whose validations are worse than the others' median is given
up. What counts is the agent's cost on validation crystals. The best few then meet other validation crystals and other
training seeds beside the recipe. Optuna's journal holds every trial, and the same command goes on from it;
``history.csv`` is the same for people.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from cz_gym.commands import OneLineParser, between
from studies.comparison.command import STEPS, add_folders, add_ray, compare, join

if TYPE_CHECKING:
    from optuna import Study

    from .trials import Search


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.search", (__doc__ or "").split("\n")[0])
    for option, kind, default, meaning in (
        ("--trials", between(1, 10_000), 30, "trials in all, earlier ones included"),
        ("--steps", STEPS, 600_000, "environment steps a trial"),
        ("--finalists", between(0, 100), 2, "best trials that are confirmed"),
        ("--seeds", between(1, 100), 3, "training seeds that confirm"),
        ("--seed", between(0, 10**9), 0, "seed of the search"),
    ):
        parser.add_argument(option, type=kind, default=default, help=f"{meaning} (default: %(default)s)")
    add_ray(parser, "by default this machine's")
    parser.set_defaults(ray="")
    add_folders(parser, "search")
    return parser.run(_main, arguments, "agents,ray", "the same command goes on from the trials in its journal")


def _main(given: argparse.Namespace) -> None:
    from cz_gym.atomic_files import check_writable, locked
    from studies.comparison.results import Plan

    check_writable(given.out)
    with locked(given.work):
        plan = join(given.ray, Plan(given.out, given.work, crystals()[0]))
        from .trials import Search, run

        search = Search(plan, given.steps, given.trials, given.seed)
        confirm(run(search), search, given)


def crystals() -> tuple[Sequence[int], Sequence[int]]:
    """Seeds of the crystals that trials are judged on, and of those that confirm; none of them picks a run's agent."""
    from cz_gym.agents.training.validation import PICKING
    from cz_gym.evaluation.protocol import VALIDATION_SEEDS

    rest = VALIDATION_SEEDS[len(PICKING) :]
    return rest[:150], rest[150:350]


def confirm(study: Study, search: Search, given: argparse.Namespace) -> None:
    """Train the best trials once more beside the recipe, on other crystals and training seeds, and write their table.

    Training seeds begin at 1: the search used 0.
    """
    from cz_gym.agents.training.recipes import PPO
    from cz_gym.evaluation.cluster import completed
    from studies.comparison.variants import Study as Comparison
    from studies.comparison.variants import Variant

    from .trials import finished, params_of, recipe_of

    complete = sorted(filter(search.is_complete, finished(study)), key=lambda each: each.values)
    best = [trial for trial in complete if trial.params != params_of(PPO())][: given.finalists]
    variants = [Variant(PPO(), "the recipe as it stands").of(given.steps)]
    for trial in best:
        recipe = recipe_of(trial.params, given.steps, f"ppo-trial-{trial.number}")
        meaning = ", ".join(f"{name} {value:.4g}" for name, value in trial.params.items())
        variants.append(Variant(recipe, meaning, variants[0].name))
    comparison = Comparison("search", f"The best of {len(complete)} trials beside the recipe", variants, given.steps)
    if best:
        plan = search.plan._replace(crystals=crystals()[1])
        compare(comparison, plan, variants, range(1, 1 + given.seeds), completed)


if __name__ == "__main__":
    sys.exit(main())
