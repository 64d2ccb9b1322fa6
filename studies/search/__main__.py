"""Search the ``ppo`` recipe's hyperparameters: ``python -m studies.search --trials 30``.

Optuna's tree-structured Parzen estimator proposes, beginning with the settings that ship; a trial learns from a kept
imitation, and one whose actor has learned and does worse than most at the same step is given up. What counts is the
last agent's cost on validation crystals, less that of the imitation it began as. The best few then meet other
validation crystals and other training seeds beside the settings that ship. Every trial is kept in ``history.csv``; the
same command goes on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from cz_gym.commands import OneLineParser, guarded

PROG = "python -m studies.search"
STARTUP, RIVALS = 8, 4
"""Trials that are drawn at random first, and those that must have come as far before one is given up."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    args = _parser().parse_args(arguments)
    left = "the same command goes on from the trials in its history"
    return guarded(PROG, lambda: _main(args), "agents", left)


def _parser() -> OneLineParser:
    parser = OneLineParser(prog=PROG, description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--trials", type=int, default=30, help="trials in all, kept ones included (default: %(default)s)"
    )
    parser.add_argument("--steps", type=int, default=600_000, help="environment steps a trial (default: %(default)s)")
    parser.add_argument(
        "--finalists", type=int, default=2, help="best trials that are confirmed (default: %(default)s)"
    )
    parser.add_argument("--seeds", type=int, default=3, help="training seeds that confirm (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the search (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("results/search"), help="results (default: %(default)s)")
    parser.add_argument("--work", type=Path, default=Path("runs/search"), help="imitations (default: %(default)s)")
    return parser


def _main(args: argparse.Namespace) -> int:
    for name, least, most in (("trials", 1, 10_000), ("steps", 1, 10**9), ("finalists", 0, 100), ("seeds", 1, 100)):
        if not least <= getattr(args, name) <= most:
            raise ValueError(f"--{name} must be between {least} and {most}, not {getattr(args, name)}")
    from cz_gym.atomic_files import check_writable, locked, write_files

    from .report import confirm, report
    from .space import read_history

    check_writable(args.out)
    history = args.out / "history.csv"
    read_history(history, args.steps)
    with locked(args.work):
        trials = search(history, args.trials, args.steps, args.work, args.seed)
        confirmed = confirm(trials, args.finalists, args.seeds, args.steps, args.out / "confirmed", args.work)
        write_files({args.out / "report.md": report(trials, confirmed, args.steps).encode()})
    print(f"wrote {args.out / 'report.md'}")
    return 0


def search(history: Path, count: int, steps: int, work: Path, seed: int = 0) -> list[Any]:
    """Try settings until there are that many trials in all, going on from the history."""
    import optuna

    from cz_gym.agents.training.recipes import PPO

    from .space import KNOBS, Trial, read_history, rounded, settings_of, values_of, write_history
    from .trial import CHOOSE, LOOKS, Given, attempt

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    done = read_history(history, steps)
    ranges = {knob.name: _distribution(optuna, knob) for knob in KNOBS}
    sampler = optuna.samplers.TPESampler(seed=seed + len(done), n_startup_trials=STARTUP)
    study = optuna.create_study(sampler=sampler)
    for trial in done:
        _tell(optuna, study, ranges, trial)
    for number in range(len(done), count):
        asked = study.ask(ranges)
        values = rounded(values_of(PPO()) if number == 0 else [asked.params[knob.name] for knob in KNOBS])
        choice = settings_of(values, steps)
        course: list[float] = []

        def look(step: int, cost: float, share: float = choice.critic_steps / steps, course: Any = course) -> None:
            course.append(cost)
            if step / LOOKS > share and behind(course, done):
                raise Given

        try:
            found = attempt(choice, 0, CHOOSE, work, look)
            cost, rmse = (found.last - found.start).mean(axis=0)
            trial = Trial(values, False, float(cost), 1e3 * float(rmse), found.seconds, found.course, steps)
        except Given:
            trial = Trial(values, True, course[-1], float("nan"), 0.0, tuple(course), steps)
        study.tell(asked, state=optuna.trial.TrialState.FAIL)  # what is told is the rounded setting
        _tell(optuna, study, ranges, trial)
        done.append(trial)
        write_history(history, done)
        print(f"trial {number}: cost {trial.cost:+.5f}{', given up' if trial.pruned else ''}", flush=True)
    return done


def behind(course: Sequence[float], others: Sequence[Any]) -> bool:
    """Whether a trial's present cost is above the median of those that came as far; ``course`` is never empty."""
    reached = [other.course[len(course) - 1] for other in others if len(other.course) >= len(course)]
    return len(reached) >= RIVALS and course[-1] > median(reached)


def _distribution(optuna: Any, knob: Any) -> Any:
    if knob.whole:
        return optuna.distributions.IntDistribution(int(knob.low), int(knob.high))
    return optuna.distributions.FloatDistribution(knob.low, knob.high, log=knob.log)


def _tell(optuna: Any, study: Any, ranges: Any, trial: Any) -> None:
    kind = optuna.trial.TrialState
    params = {
        name: (round if isinstance(at, optuna.distributions.IntDistribution) else float)(min(max(v, at.low), at.high))
        for (name, at), v in zip(ranges.items(), trial.values, strict=True)
    }
    study.add_trial(
        optuna.trial.create_trial(
            params=params,
            distributions=ranges,
            value=trial.cost,
            intermediate_values=dict(enumerate(trial.course, 1)),
            state=kind.PRUNED if trial.pruned else kind.COMPLETE,
        )
    )


if __name__ == "__main__":
    sys.exit(main())
