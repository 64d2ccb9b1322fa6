"""Real runs of train.py and benchmark.py, killed at random moments and resumed: ``python -m tests.kill --kills 100``.

Each run is a process of its own, forked from one that has everything imported, and killed with SIGKILL. What it
leaves must be whole, agree with itself, and be no older than the checkpoint interval; a resumed run goes on from there.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import benchmark
import train
from agents import OnnxPolicy, run, settings, shipped
from agents.checkpoint import load_checkpoint
from agents.training import make_training
from agents.validation import validate
from baselines import CompensatedPID
from cz_gym.config import make_config
from cz_gym.evaluation.files import is_benchmark_json
from cz_gym.evaluation.whole import BEGUN, COMPLETE, finish_writing

STEPS = 60_000


class Killed:
    """A command in a process of its own."""

    def __init__(self, command: object, arguments: list[str], log: Path) -> None:
        self.child = os.fork()
        if self.child == 0:
            handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(handle, 1)
            os.dup2(handle, 2)
            try:
                code = command.main(arguments)  # type: ignore[attr-defined]
            except BaseException as error:
                print(repr(error), flush=True)
                code = 99
            sys.stdout.flush()
            os._exit(code)

    def after(self, seconds: float) -> int | None:
        """Kill it after a time; its exit code if it ended before that."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found, status = os.waitpid(self.child, os.WNOHANG)
            if found:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.001)
        os.kill(self.child, signal.SIGKILL)
        os.waitpid(self.child, 0)
        return None


def check(condition: bool, what: object) -> None:
    """Raise RuntimeError unless it holds."""
    if not condition:
        raise RuntimeError(str(what))


def kill_training(folder: Path, kills: int, chance: random.Random) -> str:
    """Kill one run after another of train.py; what happened."""
    run.QUICK = run.FULL = 2
    out, log = folder / "run", folder / "train.log"
    longest, resumed, finished, torn, steps, oldest = 20.0, 0, 0, 0, 0, 0.0
    done = 0
    while done < kills:
        going_on = (out / "settings.json").exists()
        interval = chance.choice((0.0, 0.2))
        options = ["--algo", "ppo-scratch", "--steps", str(STEPS), "--out", str(out)]
        options += ["--checkpoint-seconds", str(interval)]
        began = time.time()
        code = Killed(train, options + ["--resume"] * going_on, log).after(chance.uniform(0.0, longest))
        ended = time.time()
        if code is not None:
            check(code == 0, f"train.py exits with {code}: {log.read_text()[-2000:]}")
            longest = max(1.0, 0.9 * (ended - began) + 0.1 * longest)
            shutil.rmtree(out)
            finished, steps = finished + 1, 0
            continue
        done += 1
        resumed += going_on
        if not out.exists():
            continue
        torn += any(path.name.startswith((BEGUN, COMPLETE)) for path in out.iterdir())
        finish_writing(out)
        check(not list(out.glob(f"{BEGUN}*")) and not list(out.glob(f"{COMPLETE}*")), "leftovers")
        checkpoint = out / run.CHECKPOINT
        if not checkpoint.exists():
            check(not (out / "settings.json").exists(), "settings without a checkpoint")
            continue
        progress, _ = load_checkpoint(checkpoint)
        check(progress.steps >= steps, f"went back from step {steps} to {progress.steps}")
        if progress.steps > steps and checkpoint.stat().st_mtime > began:
            oldest = max(oldest, ended - checkpoint.stat().st_mtime - interval)
        steps = progress.steps
        rows = list(csv.DictReader((out / "progress.csv").open())) if (out / "progress.csv").exists() else []
        best = min((float(row["validation_cost"]) for row in rows), default=None)
        check(best == progress.best_cost, f"best {progress.best_cost} in the checkpoint, {best} in the progress")
        if best is not None:
            kept = OnnxPolicy.load(out / "agent.onnx").contract.validation_rmse_mm
            rmse = [float(row["validation_rmse_mm"]) for row in rows if float(row["validation_cost"]) == best]
            check(kept in rmse, "not the best agent")
        if (out / "settings.json").exists():
            json.loads((out / "settings.json").read_text())
    return (
        f"train.py: {done} kills survived, {resumed} of them of resumed runs; {torn} in the middle of writing; "
        f"{finished} runs ended; oldest checkpoint {oldest:.2f} s beyond its interval"
    )


def kill_benchmark(folder: Path, kills: int, chance: random.Random) -> str:
    """Kill one run after another of benchmark.py, into one folder; what happened."""
    out, log = folder / "results", folder / "benchmark.log"
    choices, longest, finished, torn = ("open-loop", "paper"), 20.0, 0, 0
    done = 0
    while done < kills:
        options = ["--scenarios", "reference-b", "--controllers", choices[(done + finished) % 2], "--overwrite"]
        began = time.time()
        code = Killed(benchmark, [*options, "--out", str(out), "--quiet"], log).after(chance.uniform(0.0, longest))
        if code is not None:
            check(code == 0, f"benchmark.py exits with {code}: {log.read_text()[-2000:]}")
            finished, longest = finished + 1, max(1.0, 1.05 * (time.time() - began))
            continue
        done += 1
        if not out.exists():
            continue
        torn += any(path.name.startswith((BEGUN, COMPLETE)) for path in out.iterdir())
        finish_writing(out)
        check(not list(out.glob(f"{BEGUN}*")) and not list(out.glob(f"{COMPLETE}*")), "leftovers")
        if any(out.iterdir()):
            content = (out / "benchmark.json").read_bytes()
            check(is_benchmark_json(content), "benchmark.json is damaged")
            (who,) = json.loads(content)["results"]["reference-b"]
            with (out / "episodes.csv").open() as file:
                check({row["controller"] for row in csv.DictReader(file)} == {who}, "files of two runs")
            check(f"| {who} |" in (out / "report.md").read_text(), "files of two runs")
    return f"benchmark.py: {done} kills survived, {torn} in the middle of writing; {finished} runs ended"


def warm() -> None:
    """Import and compile here what each of the forked would."""
    import matplotlib.pyplot  # noqa: F401

    learner = make_training(settings.SCRATCH, 0, None).learner
    learner.env.reset()
    learner.env.step(np.zeros((learner.n_envs, 2), np.float32))
    for policy, observation in ((OnnxPolicy.load(shipped()), "history"), (CompensatedPID(5.0), "measured")):
        config = make_config("randomized", observation=observation, horizon=300.0)
        validate(policy, config, 1, settings.CostWeights())


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
