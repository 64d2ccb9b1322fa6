"""Is a resumed run as good as one that was never stopped? ``python -m tests.stress.resume --algo ppo --seeds 0 1``.

Each training seed is run twice: once to its end, once killed with SIGKILL at the first checkpoint after each of the
given steps, and resumed. Prints what both were worth on validation.
"""

from __future__ import annotations

import argparse
import csv
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from cz_gym.agents.training.checkpoint import load_checkpoint
from cz_gym.agents.training.run import CHECKPOINT

ROOT = Path(__file__).parents[2]


def train(folder: Path, options: list[str], kills: list[int]) -> None:
    """One run of train.py, killed and resumed at each of these steps in turn."""
    command = [sys.executable, str(ROOT / "train.py"), *options, "--out", str(folder), "--checkpoint-seconds", "2"]
    for kill in [*kills, None]:
        resume = ["--resume"] * (folder / "settings.json").exists()
        child = subprocess.Popen([*command, *resume], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while kill is not None and child.poll() is None and _steps(folder) < kill:
            time.sleep(0.2)
        if kill is not None:
            child.send_signal(signal.SIGKILL)
        code = child.wait()
        if code != (0 if kill is None else -signal.SIGKILL):
            raise RuntimeError(f"train.py ended with {code}, to be killed at {kill}")
        print(f"  {'killed' if code else 'ended'} at a checkpoint of step {_steps(folder):,}", flush=True)


def _steps(folder: Path) -> int:
    path = folder / CHECKPOINT
    return load_checkpoint(path)[0].steps if path.exists() else 0


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
    parser.add_argument("--steps", type=int, help="of each run (default: the algorithm's own)")
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        options = ["--algo", arguments.algo, "--seed", str(seed)]
        options += ["--steps", str(arguments.steps)] if arguments.steps else []
        for name, kills in (("never stopped", []), ("killed and resumed", arguments.kills)):
            with tempfile.TemporaryDirectory() as folder:
                train(Path(folder) / "run", options, kills)
                print(f"{arguments.algo}, seed {seed}, {name}: {told(Path(folder) / 'run')}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
