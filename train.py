"""Train an agent on Cz-v0: ``python train.py --help``."""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

try:
    from cz_gym.commands import OneLineParser, between, guarded, interpreter
    from cz_gym.errors import CzError
    from cz_gym.names import unknown
except ModuleNotFoundError as error:
    sys.exit(f"train.py: {error}")

if TYPE_CHECKING:
    from cz_gym.agents.training.recipes import Recipe

CHECKPOINT_SECONDS = 60.0
"""Default time between checkpoints [s]."""


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line if it is wrong."""
    from cz_gym.agents.training.recipes import DEFAULT, RECIPES

    parser = OneLineParser(
        prog="train.py",
        description="Train an agent by a recipe and choose it on validation episodes.",
        epilog="The run folder holds the agent with its contract, settings, checkpoints, progress and logs.",
    )
    add = parser.add_argument
    about = f"one of {', '.join(RECIPES)} (default: {DEFAULT}, or the resumed run's)"
    add("--algo", type=_named("recipe", RECIPES), metavar="RECIPE", help=about)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--seed", type=between(0, 2**63 - 1), help="training seed (default: 0, or the resumed run's)")
    about = "training seeds side by side, a processor each; with --resume those that are not finished"
    which.add_argument("--seeds", type=_seeds, metavar="FIRST-LAST", help=about)
    about = "environment steps of learning (default: the recipe's, or the resumed run's)"
    add("--steps", type=between(1, 10**12), help=about)
    about = (
        "scenario to train on: a name, all, FILE.py:NAME, or A=0.6,B=0.4 (default: the recipe's, or the resumed run's)"
    )
    add("--scenario", help=about)
    parser.add_puller("train for it, at its control interval")
    about = (
        "run folder (default: runs/<algo>-seed<seed>); with --seeds the folder of their folders seed0, seed1 ... "
        "(default: runs/<algo>)"
    )
    add("--out", type=Path, help=about)
    add("--plot", action="store_true", help="draw the progress into the run folder: progress.png")
    add("--resume", action="store_true", help="continue from the run folder's checkpoint; sac with a new replay buffer")
    about = "time between checkpoints: the most that a crash loses (default: %(default)g)"
    add("--checkpoint-seconds", type=_seconds, default=CHECKPOINT_SECONDS, metavar="S", help=about)
    arguments = parser.parse_args(argv)
    suffix = "" if arguments.seeds else f"-seed{arguments.seed or 0}"
    puller = f"-{Path(arguments.puller).stem}" if arguments.puller else ""
    arguments.out = arguments.out or Path("runs") / f"{arguments.algo or DEFAULT}{puller}{suffix}"
    return arguments


def main(argv: list[str] | None = None) -> int:
    """Train; returns 0 when done, 2 for bad input, 130 when interrupted."""
    arguments = parse(argv)
    left = f"{_resume_command(arguments)} continues from the last checkpoint"
    extras = "agents,benchmark" if arguments.plot else "agents"
    return guarded("train.py", lambda: train(arguments), extras, left)


def train(arguments: argparse.Namespace) -> int:
    """Run the training that the command line asks for."""
    if arguments.plot:
        import matplotlib  # noqa: F401  # if it is missing, say so before the training
    from tqdm import tqdm

    from cz_gym.agents.training.fleet import train_seed, train_seeds
    from cz_gym.agents.training.run import Job
    from cz_gym.agents.training.validation import references
    from cz_gym.atomic_files import check_writable, locked
    from cz_gym.baselines.registry import make_controller
    from cz_gym.evaluation.processes import in_processes

    folders = [arguments.out.resolve() / f"seed{seed}" for seed in arguments.seeds or ()] or [arguments.out]
    saved_steps = _fill_from_resumed_run(arguments, folders)
    recipe = _recipe_from(arguments, saved_steps)
    check_writable(arguments.out)
    for folder in folders:
        with locked(folder):
            pass  # if another process has it, say so before the training
    options = references(make_controller, recipe), arguments.checkpoint_seconds, arguments.plot, sys.argv
    seeds = arguments.seeds or [arguments.seed]
    jobs = [Job(folder, recipe, seed, *options) for folder, seed in zip(folders, seeds, strict=True)]
    what = f"{len(jobs)} seeds" if arguments.seeds else f"seed {arguments.seed}, {recipe.steps:,} steps"
    machine = f", puller {recipe.config.puller.label}" if recipe.puller else ""
    print(f"{recipe.name}, {what} on {recipe.config.scenario.name}{machine}, into {arguments.out}")
    if not arguments.seeds:
        with tqdm(total=recipe.steps, unit="step", unit_scale=True, dynamic_ncols=True, mininterval=1.0) as bar:
            summary = train_seed(jobs[0], bar)
        print(f"{_summary_line(summary)}\nwrote {arguments.out / 'agent.onnx'}")
        return 0
    with tqdm(total=len(jobs), bar_format="{percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}") as bar:
        for job, summary in train_seeds(jobs, in_processes, bar):
            bar.write(f"seed {job.seed}: {_summary_line(summary)}")
    print(f"wrote agent.onnx into {len(jobs)} folders of {arguments.out}")
    return 0


def _summary_line(summary: dict[str, float]) -> str:
    references = {
        name.removesuffix("_rmse_mm"): value
        for name, value in summary.items()
        if name.endswith("_rmse_mm") and name != "validation_rmse_mm"
    }
    return (
        f"best agent on {summary['validation_episodes']} validation episodes: mean RMSE "
        f"{summary['validation_rmse_mm']:.3f} mm, {100 * summary['failure_rate']:.1f} % lost; beside it "
        + ", ".join(f"{name} {value:.3f}" for name, value in references.items())
    )


def _resume_command(arguments: argparse.Namespace) -> str:
    """The command that continues a run: the folder knows its algorithm, seed and steps."""
    words = [interpreter(), "train.py", "--resume", "--out", str(arguments.out)]
    if arguments.seeds:
        words += ["--seeds", f"{arguments.seeds[0]}-{arguments.seeds[-1]}"]
    if arguments.plot:
        words.append("--plot")
    if arguments.checkpoint_seconds != CHECKPOINT_SECONDS:
        words += ["--checkpoint-seconds", f"{arguments.checkpoint_seconds:g}"]
    return shlex.join(words)


def _fill_from_resumed_run(arguments: argparse.Namespace, folders: list[Path]) -> int | None:
    """Fill in what the command line leaves out: from the first run in the folders if it is resumed, or by default.

    Returns the steps that the resumed run was begun with. CzError if there is a run that is not to be resumed.
    """
    from cz_gym.agents.training.recipes import DEFAULT, RECIPES
    from cz_gym.agents.training.run_files import read_settings

    begun = [folder for folder in folders if (folder / "settings.json").exists()]
    if begun and not arguments.resume:
        raise CzError(f"{begun[0]} holds a run already: --resume it, or name another --out")
    saved = read_settings((begun or folders)[0] / "settings.json") if arguments.resume else {}
    settings = saved.get("settings")
    settings = settings if isinstance(settings, dict) else {}
    values = {
        "algo": (saved.get("algorithm"), DEFAULT),
        "seed": (saved.get("seed"), 0),
        "scenario": (settings.get("scenario"), ""),
        "puller": (settings.get("puller"), ""),
    }
    for name, (value, default) in values.items():
        if getattr(arguments, name) is None:
            setattr(arguments, name, value if isinstance(value, type(default)) else default)
    if arguments.algo not in RECIPES:
        raise CzError(f"{arguments.out}: begun with {arguments.algo!r}, which is no recipe here: name one by --algo")
    return saved.get("steps")


def _recipe_from(arguments: argparse.Namespace, saved_steps: int | None) -> Recipe:
    """The recipe with scenario and steps of the command line or the resumed run."""
    from cz_gym.agents.training.recipes import RECIPES
    from cz_gym.config import check_config
    from cz_gym.puller import chosen_puller

    recipe = RECIPES[arguments.algo]
    steps = arguments.steps or saved_steps or recipe.steps
    scenario = arguments.scenario or recipe.scenario
    recipe = replace(recipe, scenario=scenario, steps=steps, puller=arguments.puller or recipe.puller)
    chosen_puller(recipe.puller or None)
    check_config(recipe.config)
    return recipe


def _named(kind: str, known: Iterable[str]) -> Callable[[str], str]:
    def name(text: str) -> str:
        if text not in known:
            raise argparse.ArgumentTypeError(unknown(kind, text, known))
        return text

    return name


def _seeds(text: str) -> range:
    first, _, last = text.partition("-")
    if not (first.isdecimal() and last.isdecimal() and 0 <= int(last) - int(first) < 1000):
        raise argparse.ArgumentTypeError(f"must be FIRST-LAST, at most 1000 seeds, not {text!r}")
    return range(int(first), int(last) + 1)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number of at least 0, not {text!r}")
    return value


if __name__ == "__main__":
    sys.exit(main())
