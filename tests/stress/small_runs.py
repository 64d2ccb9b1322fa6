"""A small run of train.py, the points at which it is killed, and what a killed one may leave."""

import csv
import json
import threading
from pathlib import Path
from typing import Any

from tqdm import tqdm

import train
from cz_gym.agents import OnnxPolicy
from cz_gym.agents.training import run, validation
from cz_gym.agents.training.checkpoint import load_checkpoint
from cz_gym.agents.training.recipes import PPO, RECIPES
from cz_gym.atomic_files import write_files
from cz_gym.evaluation.protocol import VALIDATION_SEEDS

RUN = "cz_gym.agents.training.run:Run"
STEP = "cz_gym.vector:CzVectorEnv.step"
PHASES = {
    "rollout": ("stable_baselines3.common.buffers:RolloutBuffer.add:20", 1280),
    "update": ("stable_baselines3:PPO.train:1>torch.nn.utils:clip_grad_norm_:5", 3328),
    "checkpoint, before it counts": (f"{RUN}.save:5>os:replace:1", 3584),
    "first validation": (f"{RUN}.validate:1>{STEP}:100", 7616),
    "one after a validation, before it counts": (f"{RUN}.validate:1>os:replace:1", 9664),
    "checkpoint, as it moves": (f"{RUN}.validate:1>os:replace:2", 9664),
    "summary, as it moves": (f"{RUN}.finish:1>os:replace:2", 9664),
}
"""Where one run of PPO is killed, resumed, killed ...: the point, counted from where it goes on, and the step at which
a run stands that was killed there. Rollouts have 2,048 steps, and a validation follows every second one."""


def training(arguments: list[str]) -> int:
    """train.py on less of everything; a checkpoint at every step."""
    tqdm.set_lock(threading.RLock())  # its own is a semaphore, which a killed process leaves behind
    validation.PICKING, validation.JUDGING, run.VALIDATE_EVERY = VALIDATION_SEEDS[:2], VALIDATION_SEEDS[2:4], 4096
    RECIPES["ppo"] = PPO(
        steps=8192, num_envs=64, n_steps=32, batch_size=512, n_epochs=2, hidden=(16,), control_interval=30.0
    )
    return train.main(["--algo", "ppo", "--checkpoint-seconds", "0", *arguments])


def resume(folder: Path) -> bool:
    """Write the files of the checkpoint anew, as a resumed run does first; whether one of them was an older one."""
    if not (folder / run.CHECKPOINT).exists():
        return False
    files = {folder / name: content for name, content in load_checkpoint(folder / run.CHECKPOINT)[2].items()}
    torn = any(not file.exists() or file.read_bytes() != content for file, content in files.items())
    write_files(files)
    return torn


def check_training(out: Path) -> int:
    """The step at which a killed run stands; what it left is whole and agrees with itself."""
    if not (out / run.CHECKPOINT).exists():
        assert not (out / "settings.json").exists(), "settings without a checkpoint"
        return 0
    progress, *_ = load_checkpoint(out / run.CHECKPOINT)
    file = out / "progress.csv"
    rows: list[dict[str, Any]] = list(csv.DictReader(file.read_text().splitlines())) if file.exists() else []
    best = min((float(row["validation_cost"]) for row in rows), default=None)
    assert best == progress.best_cost
    if best is not None:
        found = {float(row["validation_rmse_mm"]) for row in rows if float(row["validation_cost"]) == best}
        if (out / "summary.json").exists():
            found.add(json.loads((out / "summary.json").read_text())["validation_rmse_mm"])
        assert OnnxPolicy.load(out / "agent.onnx").contract.validation_rmse_mm in found, "not the best agent"
    return progress.steps
