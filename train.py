"""Train an agent on Cz-v0: ``python train.py --help``."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

from cz_gym.commands import OneLineParser, guarded


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line for anything that cannot be meant."""
    from cz_gym.agents.training.recipes import RECIPES

    parser = OneLineParser(
        prog="train.py",
        description="Train an agent with stable-baselines3 and pick it on validation episodes.",
        epilog="The run folder holds the agent with its contract, settings, checkpoints, progress and logs.",
    )
    parser.add_argument(
        "--algo", choices=tuple(RECIPES), default="ppo", help="learning algorithm (default: %(default)s)"
    )
    parser.add_argument("--seed", type=_whole(0), default=0, help="training seed (default: %(default)s)")
    parser.add_argument(
        "--steps", type=_whole(1), help="environment steps (default: the algorithm's own, or the resumed run's)"
    )
    parser.add_argument("--scenario", help="scenario to train on (default: the algorithm's own)")
    parser.add_argument("--out", type=Path, help="run folder (default: runs/<algo>-seed<seed>)")
    parser.add_argument("--resume", action="store_true", help="go on from the run folder's checkpoint")
    parser.add_argument(
        "--checkpoint-seconds",
        type=_seconds,
        default=60.0,
        metavar="S",
        help="time between checkpoints, the most that an interruption loses (default: %(default)g)",
    )
    arguments = parser.parse_args(argv)
    arguments.out = arguments.out or Path("runs") / f"{arguments.algo}-seed{arguments.seed}"
    return arguments


def main(argv: list[str] | None = None) -> int:
    """Train; 0 when done, 2 for bad input, 130 when interrupted."""
    arguments = parse(argv)
    left = f"if {arguments.out} holds a checkpoint, --resume goes on"
    return guarded("train.py", lambda: train(arguments), "agents", left)


def train(arguments: argparse.Namespace) -> int:
    """Run the training that the command line asks for."""
    from tqdm import tqdm

    from cz_gym.agents.training import recipes as settings
    from cz_gym.agents.training.run import Run
    from cz_gym.agents.training.run_files import saved_steps
    from cz_gym.atomic_files import check_writable, locked
    from cz_gym.baselines.registry import make_controller
    from cz_gym.episodes.scenarios import find_scenario

    choice = settings.RECIPES[arguments.algo]
    scenario = find_scenario(arguments.scenario or choice.recipe.scenario).name
    folder: Path = arguments.out
    if not arguments.resume and (folder / "settings.json").exists():
        raise ValueError(f"{folder} holds a run already: --resume it, or name another --out")
    choice = replace(choice, recipe=replace(choice.recipe, scenario=scenario))
    steps = arguments.steps or (saved_steps(folder) if arguments.resume else choice.steps)
    choice = replace(choice, steps=steps)
    check_writable(folder)
    with locked(folder):
        run = Run(folder, choice, arguments.seed, make_controller, arguments.resume, arguments.checkpoint_seconds)
        print(f"{arguments.algo}, seed {arguments.seed}, {choice.steps:,} steps on {scenario!r}, into {folder}")
        with tqdm(total=choice.steps, unit="step", unit_scale=True, dynamic_ncols=True, mininterval=1.0) as bar:
            try:
                run.learn(bar)
            except KeyboardInterrupt:
                run.save()
                bar.close()
                print(f"train.py: interrupted; checkpoint saved, --resume --out {folder} goes on", file=sys.stderr)
                return 130
        summary = run.finish()
    print(
        f"best agent on {summary['validation_episodes']} validation episodes: mean RMSE "
        f"{summary['validation_rmse_mm']:.3f} mm, {100 * summary['failure_rate']:.1f} % failures; "
        f"the paper's controller {summary['paper_rmse_mm']:.3f} mm"
    )
    print(f"wrote {folder / 'agent.onnx'}")
    return 0


def _whole(least: int):  # type: ignore[no-untyped-def]
    def read(text: str) -> int:
        try:
            value = int(text.replace("_", ""))
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {least}, not {text!r}")
        return value

    return read


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
