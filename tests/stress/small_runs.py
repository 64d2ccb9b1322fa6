"""Small runs of train.py and benchmark.py, the points at which they are killed, and what a killed one may leave."""

import csv
import json
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt  # noqa: F401  (here, so that no process of its own has to)
from tqdm import tqdm

import benchmark
import train
from cz_gym.agents import OnnxPolicy
from cz_gym.agents.training import run
from cz_gym.agents.training.checkpoint import load_checkpoint
from cz_gym.agents.training.recipes import PPO, RECIPES, Imitation
from cz_gym.atomic_files import write_files
from cz_gym.baselines import registry
from cz_gym.baselines.pid.open_loop import OpenLoop
from cz_gym.contender import Contender
from cz_gym.evaluation import runner
from cz_gym.evaluation.files import is_benchmark_json
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.report import figures, page  # noqa: F401

RUN = "cz_gym.agents.training.run:Run"
STEP = "cz_gym.vector:CzVectorEnv.step"
IMITATION = {
    "demonstrations": (f"cz_gym.agents.training.imitation:demonstrate:2>{STEP}:100", 0),
    "fit": ("cz_gym.agents.training.imitation:fit:2>torch.autograd:backward:1", 0),
    "judging": (f"{RUN}.finish:1>{STEP}:100", 2880),
}
"""Where one imitation is killed, resumed, killed ...: the point, counted from where it goes on, and the step at which a
run stands that was killed there. Its checkpoints and its summary are written as PPO's are."""
REINFORCEMENT = {
    "start-up": ("cz_gym.agents.training.run:provenance:1", 0),
    "rollout": ("stable_baselines3.common.buffers:RolloutBuffer.add:20", 1280),
    "update": ("stable_baselines3:PPO.train:1>torch.nn.utils:clip_grad_norm_:5", 3328),
    "checkpoint, before it counts": (f"{RUN}.save:5>os:replace:1", 3584),
    "first validation": (f"{RUN}._validate:1>{STEP}:100", 7616),
    "one after a validation, before it counts": (f"{RUN}._validate:1>os:replace:1", 9664),
    "checkpoint, as it moves": (f"{RUN}._validate:1>os:replace:2", 9664),
    "judging": (f"{RUN}.finish:1>{STEP}:100", 9664),
    "summary, as it moves": (f"{RUN}.finish:1>os:replace:2", 9664),
}
"""The same of PPO, of which rollouts have 2,048 steps, and a validation follows every second one."""
WRITING = "cz_gym.evaluation.report.output:write_files:1"
BENCHMARK: dict[str, tuple[str | None, str | None]] = {
    "episodes": (f"cz_gym.evaluation.runner:rollout:1>{STEP}:1000", None),
    "slow episodes": (f"cz_gym.evaluation.runner:rollout:3>{STEP}:1000", None),
    "figures": ("cz_gym.evaluation.report.figures:draw_figures:1", None),
    "first results, before benchmark.json": (f"{WRITING}>os:replace:7", None),
    "first results, not killed": (None, "open-loop"),
    "other results, before any moves": (f"{WRITING}>os:replace:1", "open-loop"),
    "other results, as they move": (f"{WRITING}>os:replace:3", "open-loop"),
}
"""Where benchmark.py is killed, one run after another into one folder, and whose benchmark.json is there then."""


def training(arguments: list[str]) -> int:
    """train.py on less of everything; a checkpoint at every step."""
    tqdm.set_lock(threading.RLock())  # its own is a semaphore, which a killed process leaves behind
    run.PICKING, run.JUDGING, run.VALIDATE_EVERY = VALIDATION_SEEDS[:2], VALIDATION_SEEDS[2:4], 4096
    small: dict[str, Any] = {"hidden": (16,), "control_interval": 30.0}
    RECIPES["ppo"] = PPO(steps=8192, num_envs=64, n_steps=32, batch_size=512, n_epochs=2, **small)
    RECIPES["imitation"] = Imitation(name="imitation", rounds=2, episodes=4, epochs=1, **small)
    return train.main(["--checkpoint-seconds", "0", *arguments])


@dataclass(frozen=True)
class Slow(OpenLoop):
    """Does nothing, and is cached as a slow controller is."""

    hash: str = "nothing"


def slow_benchmark(arguments: list[str]) -> int:
    """benchmark.py with a slow controller whose six episodes are cached, two at a time, beside the results."""
    slow = Contender("slow", lambda config: Slow(), "measured", "does nothing", default=False, slow=True)
    registry.CONTROLLERS = (*registry.CONTROLLERS, slow)
    benchmark.CACHE = Path(arguments[-1]).parent / "cache"
    runner.BLOCK = 2
    options = ["--scenarios", "randomized", "--episodes", "6", "--slow", "--overwrite", "--quiet"]
    return benchmark.main([*options, *arguments])


def resume(folder: Path) -> bool:
    """Write the files of the checkpoint anew, as a resumed run does first; whether one of them was an older one."""
    if not (folder / run.CHECKPOINT).exists():
        return False
    files = {folder / name: content for name, content in load_checkpoint(folder / run.CHECKPOINT)[2].items()}
    torn = any(not file.exists() or file.read_bytes() != content for file, content in files.items())
    write_files(files)
    return torn


def check_training(out: Path) -> int:
    """The step at which a killed run of train.py stands; what it left is whole and agrees with itself."""
    if not (out / run.CHECKPOINT).exists():
        check(not (out / "settings.json").exists(), "settings without a checkpoint")
        return 0
    progress, *_ = load_checkpoint(out / run.CHECKPOINT)
    rows = _rows(out / "progress.csv")
    best = min((float(row["validation_cost"]) for row in rows), default=None)
    check(best == progress.best_cost, f"best {progress.best_cost} in the checkpoint, {best} in the progress")
    if best is not None:
        found = {float(row["validation_rmse_mm"]) for row in rows if float(row["validation_cost"]) == best}
        if (out / "summary.json").exists():
            found.add(json.loads((out / "summary.json").read_text())["validation_rmse_mm"])
        contract = OnnxPolicy.load(out / "agent.onnx").contract
        check(contract.validation_rmse_mm in found, "the agent is not the best one of the progress")
    return progress.steps


def check_benchmark(out: Path) -> str | None:
    """The controller beside the slow one in the ``benchmark.json`` that a killed benchmark.py left, None if none."""
    check(all(file.stat().st_size > 0 for file in out.glob("*.*")), "an empty file")
    if not (out / "benchmark.json").exists():
        return None
    content = (out / "benchmark.json").read_bytes()
    check(is_benchmark_json(content), "benchmark.json is damaged")
    check((out / "report.md").read_text().endswith("benchmark.json.\n"), "report.md is damaged")
    check(len(_rows(out / "episodes.csv")) == 12, "episodes.csv is damaged")
    (other,) = set(json.loads(content)["results"]["randomized"]) - {"slow"}
    return str(other)


def _rows(file: Path) -> list[dict[str, Any]]:
    return list(csv.DictReader(file.read_text().splitlines())) if file.exists() else []


def check(condition: bool, what: object) -> None:
    """Raise RuntimeError unless it holds."""
    if not condition:
        raise RuntimeError(str(what))
