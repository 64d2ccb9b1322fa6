"""``cz-gym train``: train an agent by a recipe, or several training seeds in parallel."""

import argparse
import math
import shlex
from collections.abc import Sequence
from dataclasses import fields as dataclass_fields
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from cz_gym.agents import shipped
from cz_gym.agents.recipes import (
    CRYSTAL_ENV,
    CRYSTAL_RECIPES,
    DEFAULT_RECIPE,
    FEW_UPDATES,
    MOST,
    RECIPES,
    PPOResidual,
    TrainingConfig,
)
from cz_gym.agents.residual import Base, Residual
from cz_gym.agents.train import read_settings
from cz_gym.config import check_config
from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.episodes.scenarios import ALL
from cz_gym.puller.file import chosen_puller
from cz_gym.support.command_line import OneLineParser, between, interpreter, run_command
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.files import check_writable, locked

from .registry import make_base, make_controller


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line if it is wrong."""
    parser = OneLineParser(
        prog="cz-gym train",
        description="Train an agent by a recipe and choose it on validation episodes.",
        epilog="The run folder holds the agent with its contract, settings, checkpoints, progress and logs.",
    )
    add = parser.add_argument
    add("--algo", choices=RECIPES, help=f"recipe (default: {DEFAULT_RECIPE}, or the resumed run's)")
    add("--env", choices=ENVIRONMENTS, help="environment (default: Cz-v0, or the resumed run's)")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--seed", type=between(0, 2**63 - 1), help="training seed (default: 0, or the resumed run's)")
    about = "training seeds side by side, a processor each; with --resume those that are not finished"
    which.add_argument("--seeds", type=_seeds, metavar="FIRST-LAST", help=about)
    about = "environment steps of learning (default: the recipe's, or the resumed run's)"
    add("--steps", type=between(1, 10**12), help=about)
    parser.add_scenario("what to train on: a name, all, FILE.py:NAME, or A=0.6,B=0.4 (default: as for --steps)")
    parser.add_puller("train for it, at its control interval")
    about = "field of the recipe with another value, as learning_rate=3e-4 or hidden=128,128 (cz_gym.agents.recipes)"
    add("--set", action="append", default=[], metavar="FIELD=VALUE", help=about)
    about = "callback of stable-baselines3, or a class or function that makes one: for instance a tracker's"
    add("--callback", action="append", default=[], metavar="FILE.py:NAME", help=about)
    about = "run folder (default: runs/<algo>-seed<seed>; with --seeds runs/<algo>, with a folder for each seed)"
    add("--out", type=Path, help=about)
    parser.add_cluster()
    add("--plot", action="store_true", help="draw the progress into the run folder: progress.png")
    about = "go on from the folder's last checkpoint, not bit for bit as without a stop; sac with a new replay buffer"
    add("--resume", action="store_true", help=about)
    about = "time between checkpoints: the most that a crash loses (default: %(default)s)"
    add("--checkpoint-seconds", type=between(0, 10**6), default=60, metavar="S", help=about)
    arguments = parser.parse_args(argv)
    if arguments.cluster and not arguments.seeds:
        parser.error("--cluster shares --seeds FIRST-LAST between machines: a single seed is one task")
    suffix = "" if arguments.seeds else f"-seed{arguments.seed or 0}"
    puller = f"-{Path(arguments.puller).stem}" if arguments.puller else ""
    crystal = "-crystal" if arguments.env == CRYSTAL_ENV else ""
    arguments.out = arguments.out or Path("runs") / f"{arguments.algo or DEFAULT_RECIPE}{crystal}{puller}{suffix}"
    return arguments


def main(argv: Sequence[str]) -> int:
    """Train; returns 0 when done, 2 for bad input, 130 when interrupted."""
    arguments = parse(argv)
    words = ["-m", "cz_gym", "train", *(word for word in argv if word != "--resume"), "--resume"]
    extras = "agents,benchmark" if arguments.plot else "agents"

    def left() -> str:
        if not any(arguments.out.glob("**/settings.json")):
            return "nothing was kept yet"
        return f"{shlex.join([interpreter(), *words])} continues from the last checkpoint"

    return run_command("cz-gym train", lambda: train(arguments), extras, left)


def train(arguments: argparse.Namespace) -> int:
    """Run the training that the command line asks for."""
    if arguments.plot:
        import matplotlib  # noqa: F401  # if it is missing, say so before the training
    from tqdm import tqdm

    from cz_gym.agents.train import TrainingRun, load_callback, train_seeds

    folders = [arguments.out.resolve() / f"seed{seed}" for seed in arguments.seeds or ()] or [arguments.out]
    recipe, seed = _recipe_and_seed(arguments, folders)
    check_writable(arguments.out)
    for folder in folders:
        with locked(folder):
            pass  # if another process has it, say so before the training
    callbacks = tuple(map(_absolute, arguments.callback))
    for place in callbacks:
        load_callback(place)
    seeds = arguments.seeds or [seed]
    amount = f"{len(seeds)} seeds" if arguments.seeds else f"seed {seed}, {recipe.steps:,} steps"
    machine = f", puller {recipe.config.puller.label}" if recipe.puller else ""
    if recipe.updates < FEW_UPDATES:
        print(f"{recipe.steps:,} steps are {recipe.updates} updates of {recipe.name}: too few to learn from")
    where = f"{recipe.environment} ({', '.join(recipe.stages)}), " if recipe.environment else ""
    crystals = {ALL.name: "all"}.get(recipe.config.scenario.name, recipe.config.scenario.name)
    print(f"{recipe.name}, {amount} on {where}{crystals}{machine}, into {arguments.out}", flush=True)
    base = _base_of(recipe)  # before the work
    options = _measure_references(recipe), arguments.checkpoint_seconds, arguments.plot, callbacks, base
    runs = [TrainingRun(folder, recipe, seed, *options) for folder, seed in zip(folders, seeds, strict=True)]
    if not arguments.seeds:
        with tqdm(total=recipe.steps, unit="step", unit_scale=True, dynamic_ncols=True, disable=None) as bar:
            summary = runs[0].train(bar)
        print(f"{_summary_line(summary)}\nwrote {arguments.out / 'agent.onnx'}")
        return 0
    layout = "{percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}"
    with tqdm(total=len(runs), bar_format=layout, dynamic_ncols=True, disable=None) as bar:
        for run, summary in train_seeds(runs, bar, arguments.cluster):
            bar.write(f"seed {run.seed}: {_summary_line(summary)}")
    print(f"wrote agent.onnx into {len(runs)} folders of {arguments.out}")
    return 0


def _base_of(recipe: TrainingConfig) -> Base | None:
    """The controller that a recipe's agents add to; CzError for a wrong one, and for wrong limits."""
    if not isinstance(recipe, PPOResidual):
        return None
    base = make_base(recipe.controller, recipe.config)
    Residual(base, *recipe.limits)
    return base


def _measure_references(recipe: TrainingConfig) -> Any:
    """Measure the classical controllers that the agent is shown beside, and say so before and after."""
    from tqdm import tqdm

    from cz_gym.agents.recipes import JUDGING_SEEDS, REFERENCES, SELECTION_SEEDS, references

    names = REFERENCES[recipe.config.process.name]
    print(f"measuring {', '.join(names)} on the validation crystals", flush=True)
    crystals = len(names) * (len(SELECTION_SEEDS) + len(JUDGING_SEEDS))
    with tqdm(total=crystals, unit="crystal", leave=False, dynamic_ncols=True, disable=None) as bar:
        found = references(make_controller, recipe, bar.update)
    print(", ".join(f"{name} {rmse:.3f}" for name, (rmse, _) in found.items()), "mm; making the learner", flush=True)
    return found


def _summary_line(summary: dict[str, float]) -> str:
    ends = "_rmse_mm"
    errors = {name.removesuffix(ends): value for name, value in summary.items() if name.endswith(ends)}
    return (
        f"best agent on {summary['validation_episodes']} validation episodes: mean RMSE "
        f"{errors.pop('validation'):.3f} mm, {100 * summary['failure_rate']:.1f} % lost\n  beside it "
        + ", ".join(f"{name} {value:.3f}" for name, value in errors.items())
    )


def _saved_settings(resume: bool, folders: list[Path]) -> dict[str, Any]:
    """Settings of the first run to resume, empty for a new one; CzError if that is the other way round."""
    begun = [folder for folder in folders if (folder / "settings.json").exists()]
    if begun and not resume:
        raise CzError(f"{begun[0]} holds a run already. Use --resume to go on with it, or --out runs/NAME")
    return read_settings((begun or folders)[0] / "settings.json") if resume else {}


def _recipe_and_seed(arguments: argparse.Namespace, folders: list[Path]) -> tuple[TrainingConfig, int]:
    """Recipe and training seed of the command line, or of the first resumed run; CzError if none may resume."""
    saved = _saved_settings(arguments.resume, folders)
    settings, agents = saved.get("settings", {}), saved.get("algorithm", DEFAULT_RECIPE)
    recipes = CRYSTAL_RECIPES if (arguments.env or settings.get("environment")) == CRYSTAL_ENV else RECIPES
    name = arguments.algo or {recipe.name: key for key, recipe in recipes.items()}.get(agents, agents)
    if name not in recipes:
        raise CzError(f"{name!r} is no recipe here: name one of {', '.join(recipes)} by --algo")
    recipe = _recipe_of(recipes[name], arguments, settings, saved.get("steps"))
    chosen_puller(recipe.puller or None)
    check_config(recipe.config)
    _ = recipe.steps_before  # an agent that cannot be learned on is refused before the work
    return recipe, saved.get("seed", 0) if arguments.seed is None else arguments.seed


def _recipe_of(own: TrainingConfig, arguments: argparse.Namespace, settings: Any, steps: int | None) -> TrainingConfig:
    """A recipe with a resumed run's settings and steps, and over them those of the command line."""
    fields = {each.name for each in dataclass_fields(own)} - {"name", "steps"}
    chosen = {field: _listed(settings[field], getattr(own, field)) for field in fields & settings.keys()}
    given = {"scenario": arguments.scenario, "puller": arguments.puller}
    chosen |= {field: value for field, value in given.items() if value}
    chosen |= dict(_setting(text, own) for text in arguments.set)
    if start := chosen.get("start"):
        chosen["start"] = str(Path(start).absolute() if Path(start).suffix == ".onnx" else shipped(start))
    return replace(own.with_steps(arguments.steps or steps or own.steps), **chosen)


def _setting(text: str, recipe: TrainingConfig) -> tuple[str, Any]:
    """The field of a recipe and its value in FIELD=VALUE; CzError for a field or a value that cannot be meant."""
    name, sign, value = (part.strip() for part in text.partition("="))
    known = {each.name: each.type for each in dataclass_fields(recipe)}
    for own in ("name", "steps", "environment", "stages"):
        del known[own]
    if not sign or name not in known:
        raise CzError(f"--set {text}: {unknown_name_message('field', name, sorted(known))}")
    usual = getattr(recipe, name)
    try:
        typed = _typed(value, usual)
        if isinstance(usual, tuple) and Ellipsis not in get_args(known[name]) and len(typed) != len(usual):
            raise ValueError
        if name in MOST and not 0.0 <= np.min(typed) <= np.max(typed) <= MOST[name]:
            raise ValueError
        return name, typed
    except ValueError:
        raise CzError(f"--set {text}: {name} must be {_meant(name, usual)}, as {usual!r}") from None


def _meant(name: str, usual: Any) -> str:
    """Say which values a field can have."""
    if name in MOST:
        return f"from 0 to {MOST[name]:g}"
    kinds = {tuple: "numbers with commas between", int: "a whole number from 1 on", bool: "true or false"}
    return kinds.get(type(usual)) or ("a number from 0 on" if usual > 0 else "a finite number")


def _typed(text: str, usual: Any) -> Any:
    """A text as a value of the type of the usual one; ValueError if it is none, negative, or a count of 0."""
    if isinstance(usual, bool):
        words = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
        if text.lower() not in words:
            raise ValueError
        return words[text.lower()]
    if isinstance(usual, tuple):
        return tuple(_typed(part, usual[0]) for part in text.strip("()[]").split(",") if part)
    if isinstance(usual, str):
        return text
    number = type(usual)(float(text)) if isinstance(usual, int) and float(text).is_integer() else type(usual)(text)
    least = 1 if isinstance(usual, int) else 0
    if not math.isfinite(number) or (usual > 0 and number < least):
        raise ValueError
    return number


def _listed(value: Any, usual: Any) -> Any:
    return tuple(value) if isinstance(usual, tuple) else value


def _absolute(place: str) -> str:
    file, colon, name = place.rpartition(":")
    return f"{Path(file).absolute()}{colon}{name}" if file else place


def _seeds(text: str) -> range:
    first, _, last = text.partition("-")
    try:
        seeds = range(between(0, 2**63 - 1)(first), between(0, 2**63 - 1)(last) + 1)
    except argparse.ArgumentTypeError:
        seeds = range(0)
    if not 0 < len(seeds) <= 1000:
        raise argparse.ArgumentTypeError(f"must be FIRST-LAST, at most 1000 seeds, not {text!r}")
    return seeds
