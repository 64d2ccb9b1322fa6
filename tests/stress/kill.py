"""Real runs of train.py and benchmark.py, killed in every phase and resumed: ``python -m tests.stress.kill``.

Each run is a process of its own, forked from one that has everything imported. It tells through a pipe what it is
doing, and is killed with SIGKILL at a random moment of a phase drawn beforehand. What it leaves must be whole, agree
with itself, and be no older than the checkpoint interval; a resumed run goes on from there, and ends as one that was
never killed.
"""

from __future__ import annotations

import argparse
import csv
import json
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from stable_baselines3 import PPO

import benchmark
import cz_gym.evaluation.report.figures
import cz_gym.evaluation.report.output
import cz_gym.evaluation.report.page
import cz_gym.evaluation.runner
import train
from cz_gym.agents import OnnxPolicy, shipped
from cz_gym.agents.training import recipes as settings
from cz_gym.agents.training import run
from cz_gym.agents.training.checkpoint import load_checkpoint
from cz_gym.agents.training.learners import make_training
from cz_gym.agents.training.validation import validate
from cz_gym.atomic_files import BEGUN, COMPLETE, finish_writing
from cz_gym.baselines import CompensatedPID
from cz_gym.baselines.registry import find_controller
from cz_gym.config import make_config
from cz_gym.evaluation.files import is_benchmark_json
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

from .killer import Killer, Watched, check

STEPS = 16_384
CLONE = replace(settings.RECIPES["ppo"].recipe.clone or settings.Clone("lqg"), rounds=2, episodes=4, epochs=2)
SMALL = replace(
    settings.RECIPES["ppo"],
    recipe=replace(settings.RECIPES["ppo"].recipe, num_envs=64, clone=CLONE),
    n_steps=32, batch_size=512, critic_steps=STEPS // 3,
)  # fmt: skip
"""The recipe that train.py runs by default, on less of everything."""


def _learning(work: str) -> Callable[..., str]:
    return lambda learner, *_: f"{'critic' if learner.num_timesteps <= SMALL.critic_steps else 'PPO'}, {work}"


TRAINING = (
    Watched(train, "train", "start-up"),
    Watched(run, "clone", "cloning"),
    Watched(PPO, "collect_rollouts", _learning("rollout")),
    Watched(PPO, "train", _learning("update")),
    Watched(run.Run, "_validate", "validation"),
    Watched(run.Run, "save", "checkpoint"),
    Watched(run.Run, "finish", "summary"),
)
TRAINING_PHASES = (
    "start-up", "cloning", "critic, rollout", "critic, update", "validation", "PPO, rollout", "PPO, update",
    "checkpoint", "summary",
)  # fmt: skip
"""In the order in which a run meets them first or, of what it does again and again, in which it is killed."""
BENCHMARK = (
    Watched(benchmark, "benchmark", "start-up"),
    Watched(cz_gym.evaluation.runner, "run", "episodes"),
    Watched(cz_gym.evaluation.report.figures, "draw_figures", "figures"),
    Watched(cz_gym.evaluation.report.page, "page", "page"),
    Watched(cz_gym.evaluation.report.output, "write_files", "writing"),
)
BENCHMARK_PHASES = tuple(str(watched.phase) for watched in BENCHMARK)


def settled(folder: Path) -> bool:
    """Finish what a killed writer left in a folder; whether there was anything."""
    torn = any(path.name.startswith((BEGUN, COMPLETE)) for path in folder.iterdir())
    finish_writing(folder)
    check(not list(folder.glob(f"{BEGUN}*")) and not list(folder.glob(f"{COMPLETE}*")), "leftovers")
    return torn


def check_run(out: Path, steps: int) -> int:
    """The step at which a killed run of train.py stands, not before ``steps``; what it left is whole and agrees."""
    checkpoint = out / run.CHECKPOINT
    if not checkpoint.exists():
        check(not (out / "settings.json").exists(), "settings without a checkpoint")
        return 0
    progress, _ = load_checkpoint(checkpoint)
    check(progress.steps >= steps, f"went back from step {steps} to {progress.steps}")
    rows = list(csv.DictReader((out / "progress.csv").open())) if (out / "progress.csv").exists() else []
    best = min((float(row["validation_cost"]) for row in rows), default=None)
    check(best == progress.best_cost, f"best {progress.best_cost} in the checkpoint, {best} in the progress")
    if best is not None:
        kept = OnnxPolicy.load(out / "agent.onnx").contract.validation_rmse_mm
        rmse = [float(row["validation_rmse_mm"]) for row in rows if float(row["validation_cost"]) == best]
        if (out / "summary.json").exists():
            rmse.append(json.loads((out / "summary.json").read_text())["validation_rmse_mm"])
        check(kept in rmse, "not the best agent")
    if (out / "settings.json").exists():
        json.loads((out / "settings.json").read_text())
    return progress.steps


def kill_training(folder: Path, kills: int, chance: random.Random) -> str:
    """Kill one run after another of train.py, each several times, and let it end; what happened."""
    run.PICKING, run.JUDGING = VALIDATION_SEEDS[:2], VALIDATION_SEEDS[2:4]
    run.VALIDATE_EVERY = STEPS // 6
    settings.RECIPES["ppo"] = SMALL
    out = folder / "run"
    killer = Killer(train, TRAINING, folder / "train.log", chance)
    resumed, ended, torn, oldest = 0, 0, 0, 0.0
    targets = list(TRAINING_PHASES)
    while killer.kills.total() < kills:
        # A run is killed in some phases, in turn, and then left to end.
        chance.shuffle(targets)
        size = min(chance.randint(2, 6), kills - killer.kills.total())
        life: list[str | None] = [*sorted(targets[:size], key=TRAINING_PHASES.index), None]
        steps = 0
        while life:
            going_on = (out / "settings.json").exists()
            interval = chance.choice((0.0, 0.2))
            options = ["--steps", str(STEPS), "--out", str(out), "--checkpoint-seconds", str(interval)]
            began = time.time()
            code = killer.run(options + ["--resume"] * going_on, life.pop(0))
            stopped = time.time()
            resumed += going_on
            if code is None and out.exists():
                torn += settled(out)
                before, steps = steps, check_run(out, steps)
                written = (out / run.CHECKPOINT).stat().st_mtime if steps > before else 0.0
                if written > began:
                    oldest = max(oldest, stopped - written - interval)
            elif code == 0:
                check(check_run(out, STEPS) >= STEPS, "ended early")
                check(
                    json.loads((out / "summary.json").read_text())["training_steps"] >= STEPS, "summary of another run"
                )
                ended += 1
                break
        shutil.rmtree(out)
    return (
        f"train.py: {killer.kills.total()} kills survived ({killer.where()}), {torn} in the middle of writing; "
        f"{resumed} runs resumed, {ended} ended whole; oldest checkpoint {oldest:.2f} s beyond its interval"
    )


def kill_benchmark(folder: Path, kills: int, chance: random.Random) -> str:
    """Kill one run after another of benchmark.py, into one folder; what happened."""
    out = folder / "results"
    killer = Killer(benchmark, BENCHMARK, folder / "benchmark.log", chance)
    choices, ended, torn = ("open-loop", "paper"), 0, 0
    while killer.kills.total() < kills:
        turn = killer.kills.total() + ended
        options = ["--scenarios", "reference-b", "--controllers", choices[turn % 2], "--overwrite"]
        code = killer.run([*options, "--out", str(out), "--quiet"], BENCHMARK_PHASES[turn % len(BENCHMARK_PHASES)])
        ended += code == 0
        if code == 0 or not out.exists():
            continue
        torn += settled(out)
        if any(out.iterdir()):
            content = (out / "benchmark.json").read_bytes()
            check(is_benchmark_json(content), "benchmark.json is damaged")
            (who,) = json.loads(content)["results"]["reference-b"]
            with (out / "episodes.csv").open() as file:
                check({row["controller"] for row in csv.DictReader(file)} == {who}, "files of two runs")
            check(f"| {who} |" in (out / "report.md").read_text(), "files of two runs")
    return (
        f"benchmark.py: {killer.kills.total()} kills survived ({killer.where()}), {torn} in the middle of writing; "
        f"{ended} runs ended"
    )


def warm() -> None:
    """Import and compile here what each of the forked would."""
    import matplotlib.pyplot  # noqa: F401

    teacher = find_controller(CLONE.teacher).make(make_config("randomized"))
    learner = make_training(SMALL, 0, None, 0, teacher).learner
    learner.env.reset()
    learner.env.step(np.zeros((learner.n_envs, 2), np.float32))
    for policy, observation in ((OnnxPolicy.load(shipped()), "history"), (CompensatedPID(5.0), "measured")):
        config = make_config("randomized", observation=observation, horizon=300.0)
        validate(policy, config, VALIDATION_SEEDS[:1], settings.CostWeights())


def main(argv: list[str] | None = None) -> int:
    """Kill and resume; 0 if nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--kills", type=int, default=100, help="of train.py; a fifth of it of benchmark.py (%(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(argv)
    chance = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        warm()
        print(kill_training(folder, arguments.kills, chance), flush=True)
        print(kill_benchmark(folder, max(1, arguments.kills // 5), chance), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
