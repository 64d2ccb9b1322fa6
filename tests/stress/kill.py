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
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO

import benchmark
import cz_gym.evaluation.files
import cz_gym.evaluation.report.figures
import cz_gym.evaluation.report.page
import cz_gym.evaluation.runner
import train
from cz_gym.agents import OnnxPolicy, shipped
from cz_gym.agents.training import imitation, run
from cz_gym.agents.training.checkpoint import load_checkpoint
from cz_gym.agents.training.learners import make_learner
from cz_gym.agents.training.recipes import PPO as PPORecipe
from cz_gym.agents.training.recipes import RECIPES, CostWeights, Imitation
from cz_gym.agents.training.validation import validate
from cz_gym.atomic_files import BEGUN, COMPLETE, finish_writing
from cz_gym.baselines import CompensatedPID
from cz_gym.baselines.registry import make_controller
from cz_gym.config import make_config
from cz_gym.evaluation.files import is_benchmark_json
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

from .killer import Killer, Watched, check

STEPS = 16_384
SMALL = {
    "ppo": PPORecipe(num_envs=64, n_steps=32, batch_size=512),
    "imitation": Imitation(name="imitation", teacher="lqg", rounds=2, episodes=4, epochs=2, control_interval=30.0),
}
"""Recipes of train.py on less of everything."""
LENGTH = {"ppo": STEPS, "imitation": 2 * 4 * 360}
"""Environment steps of each."""
TRAINING = (
    Watched(train, "train", "start-up"),
    Watched(imitation, "demonstrate", "demonstrations"),
    Watched(imitation, "fit", "fit"),
    Watched(PPO, "collect_rollouts", "rollout"),
    Watched(PPO, "train", "update"),
    Watched(run.Run, "_validate", "validation"),
    Watched(run.Run, "save", "checkpoint"),
    Watched(run.Run, "finish", "summary"),
)
TRAINING_PHASES = {
    "ppo": ("start-up", "validation", "rollout", "update", "checkpoint", "summary"),
    "imitation": ("start-up", "demonstrations", "fit", "validation", "checkpoint", "summary"),
}
"""In the order in which a run meets them first or, of what it does again and again, in which it is killed."""
BENCHMARK = (
    Watched(benchmark, "benchmark", "start-up"),
    Watched(cz_gym.evaluation.runner, "run", "episodes"),
    Watched(cz_gym.evaluation.report.figures, "draw_figures", "figures"),
    Watched(cz_gym.evaluation.report.page, "page", "page"),
    Watched(cz_gym.evaluation.files, "write_files", "writing"),
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
    RECIPES.update(SMALL)
    out = folder / "run"
    killers = {algorithm: Killer(train, TRAINING, folder / "train.log", chance) for algorithm in SMALL}
    resumed, ended, torn, oldest, survived, turns = 0, 0, 0, 0.0, 0, cycle(SMALL)
    while survived < kills:
        # A run is killed in some phases, in turn, and then left to end.
        algorithm = next(turns)
        killer, phases = killers[algorithm], TRAINING_PHASES[algorithm]
        size = min(chance.randint(2, 6), kills - survived)
        life: list[str | None] = [*sorted(chance.sample(phases, size), key=phases.index), None]
        steps = 0
        while life:
            going_on = (out / "settings.json").exists()
            interval = chance.choice((0.0, 0.2))
            options = ["--algo", algorithm, "--out", str(out), "--checkpoint-seconds", str(interval)]
            options += ["--steps", str(STEPS)] if algorithm == "ppo" else []
            began = time.time()
            code = killer.run(options + ["--resume"] * going_on, life.pop(0))
            stopped = time.time()
            resumed += going_on
            survived += code is None
            if code is None and out.exists():
                torn += settled(out)
                before, steps = steps, check_run(out, steps)
                written = (out / run.CHECKPOINT).stat().st_mtime if steps > before else 0.0
                if written > began:
                    oldest = max(oldest, stopped - written - interval)
            elif code == 0:
                check(check_run(out, LENGTH[algorithm]) >= LENGTH[algorithm], "ended early")
                learned = json.loads((out / "summary.json").read_text())["training_steps"]
                check(learned >= STEPS if algorithm == "ppo" else learned == 0, "summary of another run")
                ended += 1
                break
        shutil.rmtree(out)
    where = "; ".join(f"{algorithm}: {killer.where()}" for algorithm, killer in killers.items())
    return (
        f"train.py: {survived} kills survived ({where}), {torn} in the middle of writing; "
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

    learner: Any = make_learner(SMALL["ppo"], 0, make_controller)
    learner.algorithm.env.reset()
    learner.algorithm.env.step(np.zeros((SMALL["ppo"].num_envs, 2), np.float32))
    for policy, observation in ((OnnxPolicy.load(shipped()), "history"), (CompensatedPID(5.0), "measured")):
        config = make_config("randomized", observation=observation, horizon=300.0)
        validate(policy, config, VALIDATION_SEEDS[:1], CostWeights())


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
