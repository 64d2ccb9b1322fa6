"""Killed runs lose nothing but what came after the last checkpoint, wherever they are killed."""

import csv
import functools
import importlib
import itertools
import json
import multiprocessing
import os
import signal
import threading
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace

import pytest
from tqdm import tqdm

from cz_gym.agents import OnnxPolicy, recipes
from cz_gym.agents import train as run
from cz_gym.agents.recipes import RECIPES
from cz_gym.agents.train import load_checkpoint
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.support.files import write_files
from cz_gym.tools import train
from tests.small_learners import QUICK

FRESH = multiprocessing.get_context("forkserver")
FRESH.set_forkserver_preload(["tests.stress.test_kill"])
RUN = "cz_gym.agents.train:TrainingRun"
PHASES = {
    "rollout": ("stable_baselines3.common.buffers:RolloutBuffer.add:20", 1280),
    "update": ("stable_baselines3:PPO.train:1>torch.nn.utils:clip_grad_norm_:5", 3328),
    "checkpoint, before it counts": (f"{RUN}.save:5>os:replace:1", 3584),
    "first validation": (f"{RUN}.validate:1>cz_gym.env:CzVectorEnv.step:100", 7616),
    "one after a validation, before it counts": (f"{RUN}.validate:1>os:replace:1", 9664),
    "checkpoint, as it moves": (f"{RUN}.validate:1>os:replace:2", 9664),
    "summary, as it moves": (f"{RUN}.finish:1>os:replace:2", 9664),
}
"""Points at which one run of PPO is killed and resumed in turn, and the step at which it then stands.

``os:replace:2`` is the second call of ``os.replace`` since the process began; ``>`` begins to count at another call.
Rollouts have 2,048 steps, and a validation follows every second one.
"""


def kill_at(point):
    """Have this process kill itself in place of a call."""
    here, _, later = point.partition(">")
    module, name, turn = here.split(":")
    *path, last = name.split(".")
    owner = functools.reduce(getattr, path, importlib.import_module(module))
    function, calls = getattr(owner, last), itertools.count(1)

    @functools.wraps(function)
    def counted(*given, **named):
        if next(calls) == int(turn):
            if not later:
                os.kill(os.getpid(), signal.SIGKILL)
            kill_at(later)
        return function(*given, **named)

    setattr(owner, last, counted)


def training(arguments, point, log):
    """train.py on less of everything, with a checkpoint at every step, up to a point."""
    tqdm.set_lock(threading.RLock())  # its own is a semaphore, which a killed process leaves behind
    recipes.SELECTION_SEEDS, recipes.JUDGING_SEEDS = VALIDATION_SEEDS[:2], VALIDATION_SEEDS[2:4]
    run.VALIDATE_EVERY = 4096
    RECIPES["ppo"] = replace(QUICK, steps=8192, action_repeat=1, batch_size=512, n_epochs=2, control_interval=30.0)
    if point is not None:
        kill_at(point)
    with log.open("a") as file, redirect_stdout(file), redirect_stderr(file):
        code = train.main(["--algo", "ppo", "--checkpoint-seconds", "0", *arguments])
    os._exit(code)


def ended(arguments, point, log):
    """Exit code of a training in a process of its own."""
    process = FRESH.Process(target=training, args=(arguments, point, log))
    process.start()
    process.join()
    return process.exitcode


def is_torn(folder):
    """Whether a file is older than the checkpoint; all are written anew, as a resumed run does first."""
    if not (folder / run.CHECKPOINT).exists():
        return False
    files = {folder / name: content for name, content in load_checkpoint(folder / run.CHECKPOINT).files.items()}
    torn = any(not file.exists() or file.read_bytes() != content for file, content in files.items())
    write_files(files)
    return torn


def reached(out):
    """The step at which a killed run stands; what it left is whole and agrees with itself."""
    if not (out / run.CHECKPOINT).exists():
        assert not (out / "settings.json").exists(), "settings without a checkpoint"
        return 0
    checkpoint = load_checkpoint(out / run.CHECKPOINT)
    file, summary = out / "progress.csv", out / "summary.json"
    rows = list(csv.DictReader(file.read_text().splitlines())) if file.exists() else []
    best = min((float(row["validation_cost"]) for row in rows), default=None)
    assert best == checkpoint.best_cost
    if best is not None:
        found = {float(row["validation_rmse_mm"]) for row in rows if float(row["validation_cost"]) == best}
        found |= {json.loads(summary.read_text())["validation_rmse_mm"]} if summary.exists() else set()
        assert OnnxPolicy.load(out / "agent.onnx").contract.validation_rmse_mm in found, "not the best agent"
    return checkpoint.steps


@pytest.mark.slow
def test_a_training_run_killed_in_every_phase_goes_on(tmp_path):
    """One run, killed at each point in turn and resumed until nothing is left to do."""
    out, log, torn = tmp_path / "run", tmp_path / "log", []
    for phase, (point, step) in PHASES.items():
        again = ["--resume"] * (out / "settings.json").exists()
        assert ended(["--out", str(out), *again], point, log) == -signal.SIGKILL, f"{phase}: {log.read_text()[-2000:]}"
        torn += [phase] * is_torn(out)
        assert reached(out) == step, phase
    assert torn == [phase for phase in PHASES if "moves" in phase]
    assert ended(["--out", str(out), "--resume"], None, log) == 0, log.read_text()[-2000:]
    assert reached(out) == step
    assert (out / "summary.json").exists()
