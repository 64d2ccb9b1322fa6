"""Is a resumed run as good as one that was never stopped? ``python -m tests.stress.resume --algo ppo --seeds 0 1``.

Each training seed is run twice: once to its end, once killed with SIGKILL at the first checkpoint at or after each of
the given steps, and resumed. Prints what both were worth on validation.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import train
from cz_gym.agents.training import run

ROOT = Path(__file__).parents[2]
NEVER = -1


def die_at(step: int, options: list[str]) -> int:
    """Run train.py here; SIGKILL ends this process when a checkpoint of that step or a later one is written."""
    save = run.Run.save

    def save_and_die(self: run.Run) -> None:
        save(self)
        if 0 <= step <= self.learner.steps:
            print(f"  killed at a checkpoint of step {self.learner.steps:,}", flush=True)
            os.kill(os.getpid(), signal.SIGKILL)

    run.Run.save = save_and_die  # type: ignore[method-assign]
    return train.main(options)


def killed_and_resumed(folder: Path, options: list[str], kills: list[int]) -> None:
    """One run of train.py, killed and resumed at each of these steps in turn."""
    for kill in [*kills, NEVER]:
        resume = ["--resume"] * (folder / "settings.json").exists()
        call = f"import sys; from tests.stress import resume; sys.exit(resume.die_at({kill}, sys.argv[1:]))"
        given = [*options, "--out", str(folder), "--checkpoint-seconds", "2", *resume]
        done = subprocess.run([sys.executable, "-c", call, *given], cwd=ROOT, stderr=subprocess.DEVNULL)
        if done.returncode != (0 if kill == NEVER else -signal.SIGKILL):
            raise RuntimeError(f"train.py ended with {done.returncode}, to be killed at {kill}")


def told(folder: Path) -> str:
    """What a run was worth: its best agent on the last, long validation, and the agent as it stood at the end."""
    summary = json.loads((folder / "summary.json").read_text())
    with (folder / "progress.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    return (
        f"best agent {summary['validation_rmse_mm']:.4f} mm on {summary['validation_episodes']} validation episodes, "
        f"cost {summary['validation_cost']:.5f}; last agent {float(last['validation_rmse_mm']):.4f} mm, "
        f"cost {float(last['validation_cost']):.5f}"
    )


def main() -> int:
    """Train and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--kills", type=int, nargs="*", default=[100_000, 400_000], help="steps (%(default)s)")
    parser.add_argument("--steps", type=int, help="of each run (default: the recipe's own)")
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        options = ["--algo", arguments.algo, "--seed", str(seed)]
        options += ["--steps", str(arguments.steps)] if arguments.steps else []
        for name, kills in (("never stopped", []), ("killed and resumed", arguments.kills)):
            with tempfile.TemporaryDirectory() as folder:
                killed_and_resumed(Path(folder) / "run", options, kills)
                print(f"{arguments.algo}, seed {seed}, {name}: {told(Path(folder) / 'run')}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
