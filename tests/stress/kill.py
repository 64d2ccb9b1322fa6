"""Small runs of train.py and benchmark.py, killed at random points: ``python -m tests.stress.kill``.

A run of train.py is resumed until it ends, then another begins; runs of benchmark.py replace each other's results.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
from pathlib import Path

from tests.stress.kill_at import KILLED, ending
from tests.stress.small_runs import check, check_benchmark, check_training, settle, slow_benchmark, training

TRAINING = {
    "cz_gym.vector:CzVectorEnv.step": 9000,
    "stable_baselines3.common.buffers:RolloutBuffer.add": 120,
    "torch.nn.utils:clip_grad_norm_": 100,
    "os:fsync": 50,
    "os:rename": 30,
    "os:replace": 50,
}
"""Functions that a run calls all the time, and up to which call of each it is killed."""
BENCHMARK = {"cz_gym.vector:CzVectorEnv.step": 9000, "os:fsync": 7, "os:rename": 1, "os:replace": 7}


def kill_training(folder: Path, kills: int, chance: random.Random) -> str:
    """Kill and resume one run after another; what happened."""
    out, log, killed, ended, torn, steps = folder / "run", folder / "log", 0, 0, 0, 0
    while killed < kills:
        resume = ["--resume"] * (out / "settings.json").exists()
        code = ending(training, ["--out", str(out), *resume], random_point(TRAINING, chance), log)
        check(code in (0, KILLED), log.read_text()[-2000:])
        torn += out.exists() and settle(out)
        before, steps = steps, check_training(out)
        check(steps >= before, f"went back from step {before} to {steps}")
        killed += code == KILLED
        if code == 0:
            ended, steps = ended + 1, 0
            shutil.rmtree(out)
    return f"train.py: {killed} kills survived, {torn} in the middle of writing; {ended} runs ended whole"


def kill_benchmark(folder: Path, kills: int, chance: random.Random) -> str:
    """Kill one run after another into one folder; what happened."""
    out, log, killed, ended, torn = folder / "results", folder / "log", 0, 0, 0
    while killed < kills:
        who = chance.choice(["open-loop,slow", "paper,slow"])
        point = random_point(BENCHMARK, chance)
        code = ending(slow_benchmark, ["--controllers", who, "--out", str(out)], point, log)
        check(code in (0, KILLED), log.read_text()[-2000:])
        torn += out.exists() and settle(out)
        check_benchmark(out)
        killed, ended = killed + (code == KILLED), ended + (code == 0)
    return f"benchmark.py: {killed} kills survived, {torn} in the middle of writing; {ended} runs ended whole"


def random_point(calls: dict[str, int], chance: random.Random) -> str:
    """A call of one of these functions."""
    function = chance.choice(list(calls))
    return f"{function}:{chance.randint(1, calls[function])}"


def main() -> int:
    """Kill and resume; 0 if nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100, help="of each program (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as name:
        for program in (kill_training, kill_benchmark):
            print(program(Path(name), arguments.kills, chance), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
