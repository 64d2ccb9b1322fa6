"""Search the ``ppo`` recipe's hyperparameters: ``python -m studies.search --trials 30`` (docs/ablation.md)."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from cz_gym.atomic_files import check_writable, locked
from cz_gym.commands import OneLineParser, between
from studies.comparison.command import STEPS, add_folders, add_ray, join


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
    from studies.comparison.results import Plan

    check_writable(given.out)
    with locked(given.work):
        plan = join(given.ray, Plan(given.out, given.work, ()))
        from .trials import JUDGED, Search, confirm, run

        search = Search(plan._replace(crystals=JUDGED), given.steps, given.trials, given.seed)
        confirm(run(search), search, given.finalists, given.seeds)


if __name__ == "__main__":
    sys.exit(main())
