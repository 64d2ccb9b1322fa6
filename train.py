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
"""Time between checkpoints, unless another is asked for [s]."""


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line for anything that cannot be meant."""
    from cz_gym.agents.training.recipes import DEFAULT, RECIPES

    parser = OneLineParser(
        prog="train.py",
        description="Train an agent by a recipe and pick it on validation episodes.",
        epilog="The run folder holds the agent with its contract, settings, checkpoints, progress and logs.",
    )
    about = f"one of {', '.join(RECIPES)} (default: {DEFAULT}, or the resumed run's)"
    parser.add_argument("--algo", type=_named("recipe", RECIPES), metavar="RECIPE", help=about)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--seed", type=between(0, 2**63 - 1), help="training seed (default: 0, or the resumed run's)")
    which.add_argument(
        "--seeds",
        type=_seeds,
        metavar="FIRST-LAST",
        help="training seeds side by side, a processor each; with --resume those that are not finished",
    )
    parser.add_argument(
        "--ray",
        nargs="?",
        const="",
        metavar="HOST:PORT",
        help="train --seeds on a Ray cluster, without an address on this machine's; all its machines must share --out",
    )
    parser.add_argument(
        "--steps",
        type=between(1, 10**12),
        help="environment steps of learning from reward (default: the recipe's, or the resumed run's)",
    )
    parser.add_argument(
        "--from",
        dest="start",
        type=lambda path: str(Path(path).resolve()),
        metavar="PATH",
        help="agent that a gradient recipe continues from: its file, or a folder of --seeds",
    )
    parser.add_argument("--scenario", help="scenario to train on (default: the recipe's, or the resumed run's)")
    parser.add_argument(
        "--out",
        type=Path,
        help="run folder (default: runs/<algo>-seed<seed>); of --seeds the folder of theirs, seed0, seed1 ... "
        "(default: runs/<algo>)",
    )
    parser.add_argument("--plot", action="store_true", help="draw the progress into the run folder: progress.png")
    parser.add_argument("--resume", action="store_true", help="go on from the run folder's checkpoint")
    parser.add_argument(
        "--checkpoint-seconds",
        type=_seconds,
        default=CHECKPOINT_SECONDS,
        metavar="S",
        help="time between checkpoints, the most that an interruption loses; an imitation begins again "
        "(default: %(default)g)",
    )
    arguments = parser.parse_args(argv)
    if arguments.ray is not None and not arguments.seeds:
        parser.error("--ray needs --seeds")
    if arguments.start and not arguments.resume and not hasattr(RECIPES[arguments.algo or DEFAULT], "start"):
        parser.error("--from goes with gradient recipes only: --algo gradient")
    if arguments.algo == "gradient" and not arguments.start and not arguments.resume:
        parser.error("gradient continues from an agent of gradient-start: train that first, then add --from PATH")
    one = "" if arguments.seeds else f"-seed{arguments.seed or 0}"
    arguments.out = arguments.out or Path("runs") / f"{arguments.algo or DEFAULT}{one}"
    return arguments


def main(argv: list[str] | None = None) -> int:
    """Train; 0 when done, 2 for bad input, 130 when interrupted."""
    arguments = parse(argv)
    left = f"if {arguments.out} holds a checkpoint, {_resume(arguments)} goes on"
    extras = "agents,benchmark" if arguments.plot else "agents"
    return guarded("train.py", lambda: train(arguments), extras, left)


def _resume(arguments: argparse.Namespace) -> str:
    """The command that goes on with a run: the folder knows its algorithm, seed and steps."""
    words = [interpreter(), "train.py", "--resume", "--out", str(arguments.out)]
    if arguments.seeds:
        words += ["--seeds", f"{arguments.seeds[0]}-{arguments.seeds[-1]}"]
    if arguments.ray is not None:
        words += filter(None, ["--ray", arguments.ray])
    if arguments.plot:
        words.append("--plot")
    if arguments.checkpoint_seconds != CHECKPOINT_SECONDS:
        words += ["--checkpoint-seconds", f"{arguments.checkpoint_seconds:g}"]
    return shlex.join(words)


def train(arguments: argparse.Namespace) -> int:
    """Run the training that the command line asks for."""
    from tqdm import tqdm

    if arguments.plot:
        import matplotlib  # noqa: F401  # say at once if it is missing
    from cz_gym.agents.training.recipes import RECIPES
    from cz_gym.agents.training.run import Run
    from cz_gym.atomic_files import check_writable, locked
    from cz_gym.baselines.registry import make_controller

    folder: Path = arguments.out
    folders = {seed: folder.resolve() / f"seed{seed}" for seed in arguments.seeds or ()}
    saved_steps = _take_up(arguments, list(folders.values()) or [folder])
    recipe = _asked_for(RECIPES[arguments.algo], arguments, saved_steps)
    check_writable(folder)
    if folders:
        return _train_seeds(arguments, recipe, folders)
    with locked(folder):
        run = Run(
            folder,
            recipe,
            arguments.seed,
            make_controller,
            arguments.resume,
            arguments.checkpoint_seconds,
            arguments.plot,
        )
        total = run.learner.total
        print(f"{recipe.name}, seed {arguments.seed}, {total:,} steps on {_crystals(recipe)}, into {folder}")
        with tqdm(total=total, unit="step", unit_scale=True, dynamic_ncols=True, mininterval=1.0) as bar:
            try:
                run.learn(bar)
            except KeyboardInterrupt:
                run.save()
                bar.close()
                print(f"train.py: interrupted; checkpoint saved, {_resume(arguments)} goes on", file=sys.stderr)
                return 130
        summary = run.finish()
    print(_said(summary))
    print(f"wrote {folder / 'agent.onnx'}")
    return 0


def _train_seeds(arguments: argparse.Namespace, recipe: Recipe, folders: dict[int, Path]) -> int:
    """Train several seeds, each into its folder: on this machine, or on a cluster."""
    from tqdm import tqdm

    from cz_gym.agents.training.fleet import Job, train_seeds
    from cz_gym.atomic_files import locked
    from cz_gym.baselines.registry import make_controller
    from cz_gym.evaluation.cluster import check_shared, completed, connect, in_processes

    options = make_controller, arguments.checkpoint_seconds, arguments.plot, sys.argv
    jobs = [Job(folder, recipe, seed, *options) for seed, folder in folders.items()]
    for job in jobs:
        with locked(job.folder):
            pass  # say at once if another process has it
    if arguments.ray is not None:
        connect(arguments.ray)
        check_shared(jobs[0].folder)
    print(f"{recipe.name}, {len(jobs)} seeds on {_crystals(recipe)}, into {arguments.out}")
    with tqdm(total=len(jobs), bar_format="{percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}") as bar:
        for job, summary in train_seeds(jobs, in_processes if arguments.ray is None else completed, bar):
            bar.write(f"seed {job.seed}: {_said(summary)}")
    print(f"wrote agent.onnx into {len(jobs)} folders of {arguments.out}")
    return 0


def _crystals(recipe: Recipe) -> str:
    from cz_gym.agents.training.run_files import trained_on

    return trained_on(recipe.name, recipe.scenario)


def _said(summary: dict[str, float]) -> str:
    from cz_gym.agents.training.run_files import REFERENCES

    return (
        f"best agent on {summary['validation_episodes']} validation episodes: mean RMSE "
        f"{summary['validation_rmse_mm']:.3f} mm, {100 * summary['failure_rate']:.1f} % lost; beside it "
        + ", ".join(f"{name} {summary[f'{name}_rmse_mm']:.3f}" for name in REFERENCES)
    )


def _take_up(arguments: argparse.Namespace, folders: list[Path]) -> int | None:
    """Fill in what the command line leaves out: from the first run in the folders if it is resumed, or by default.

    Returns the steps that the resumed run was begun with. ValueError if there is a run that is not to be resumed.
    """
    from cz_gym.agents.training.recipes import DEFAULT, RECIPES
    from cz_gym.agents.training.run_files import read_settings

    begun = [folder for folder in folders if (folder / "settings.json").exists()]
    if begun and not arguments.resume:
        raise CzError(f"{begun[0]} holds a run already: --resume it, or name another --out")
    saved = read_settings((begun or folders)[0] / "settings.json") if arguments.resume else {}
    settings = saved.get("settings")
    scenario = settings.get("scenario") if isinstance(settings, dict) else None
    start = settings.get("start") if isinstance(settings, dict) else None
    said = {
        "algo": (saved.get("algorithm"), DEFAULT),
        "seed": (saved.get("seed"), 0),
        "scenario": (scenario, ""),
        "start": (start, ""),
    }
    for name, (value, default) in said.items():
        if getattr(arguments, name) is None:
            setattr(arguments, name, value if isinstance(value, type(default)) else default)
    if arguments.algo not in RECIPES:
        raise CzError(f"{arguments.out}: begun with {arguments.algo!r}, which is no recipe here: name one by --algo")
    return saved.get("steps")


def _asked_for(recipe: Recipe, arguments: argparse.Namespace, saved_steps: int | None) -> Recipe:
    """The recipe with the scenario and the steps that the command line, or the resumed run, asks for."""
    from cz_gym.agents.training.recipes import Gradient, Rewarded
    from cz_gym.episodes.scenarios import find_scenario

    recipe = replace(recipe, scenario=find_scenario(arguments.scenario or recipe.scenario).name)
    if isinstance(recipe, Gradient):
        recipe = replace(recipe, start=arguments.start or recipe.start)
    if isinstance(recipe, Rewarded):
        return replace(recipe, steps=arguments.steps or saved_steps or recipe.steps)
    if arguments.steps:
        raise CzError(f"{recipe.name} takes no --steps: its length is that of its demonstrations")
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
