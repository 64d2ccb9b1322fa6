"""A training run in its folder: settings and provenance, checkpoints, the best agent so far, progress."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import platform
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cz_gym
from cz_gym.config import Config, make_config
from cz_gym.evaluation.files import write_files
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout

from . import settings
from .callbacks import Every, Tell
from .checkpoint import load_checkpoint, restore, save_checkpoint
from .contract import AgentFileError, write_agent
from .export import actor_of, to_onnx
from .onnx_policy import OnnxPolicy
from .training import Training, make_training

QUICK, FULL = 64, 200
"""Validation episodes while learning, and at the end."""
CHECKPOINT_SECONDS = 60.0
VALIDATE_EVERY = 200_000
"""Fewest steps between validations."""
PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "stable-baselines3", "torch", "onnx", "onnxruntime")


def validation_rmse(policy: Any, config: Config, episodes: int) -> tuple[float, float, float]:
    """Mean RMSE [mm], mean pull step RMS [mm/min] and failure rate on the first validation episodes."""
    result = metrics(rollout(policy, config, VALIDATION_SEEDS[:episodes]))
    values = result.rmse_mm, result.pull_step_rms_mm_per_min, result.failure_rate
    return float(values[0].mean()), float(values[1].mean()), float(values[2].mean())


class Run:
    """One training run.

    ``rival``, a policy on "measured" observations, runs the same validation episodes and is shown beside the agent;
    ``resume`` goes on from the folder's checkpoint. Raises AgentFileError if the folder cannot be used.
    """

    def __init__(
        self,
        folder: Path,
        choice: settings.PPO | settings.SAC,
        seed: int,
        rival: Any,
        resume: bool = False,
    ) -> None:
        self.folder, self.choice, self.seed, self.rival = folder, choice, seed, rival
        recipe = choice.recipe
        self.config = make_config(
            recipe.scenario, observation=recipe.observation, control_interval=recipe.control_interval
        )
        self.rival_rmse_mm = self._validate_rival(QUICK)
        self.best = math.inf
        self.rows: list[dict[str, Any]] = []
        self.sessions: list[dict[str, Any]] = []
        self.began = time.monotonic()
        checkpoint = None
        if resume:
            self.sessions = self._check_settings()
            checkpoint = load_checkpoint(folder / "checkpoint.pt")
            self.best = checkpoint.best_rmse_mm
            self.rows = _read_rows(folder / "progress.csv")
            self.began -= float(self.rows[-1]["seconds"]) if self.rows else 0.0
        done = checkpoint.steps if checkpoint else 0
        self.training: Training = make_training(choice, seed, str(folder / "tensorboard"), done)
        if checkpoint:
            restore(self.training.learner, checkpoint, folder / "checkpoint.pt")
        else:
            self.save()
        self._write_settings(done)

    def learn(self, bar: Any) -> None:
        """Learn to the end, validating and saving on the way; the bar counts environment steps."""
        learner = self.training.learner
        bar.update(learner.num_timesteps - bar.n)
        validate = Every(max(self.choice.steps // 24, VALIDATE_EVERY), None, lambda: self._validate(bar))
        checkpoint = Every(None, CHECKPOINT_SECONDS, self.save)
        callbacks = [*self.training.callbacks, Tell(bar), validate, checkpoint]
        left = self.choice.steps - learner.num_timesteps
        if left > 0:
            learner.learn(left, callback=callbacks, reset_num_timesteps=False, tb_log_name="run")
        self._validate(bar)
        self.save()

    def save(self) -> None:
        """Write a checkpoint."""
        save_checkpoint(self.folder / "checkpoint.pt", self.training.learner, self.best)

    def finish(self) -> dict[str, float]:
        """Validate the best agent on more episodes and write ``summary.json``; its contents."""
        policy = OnnxPolicy.load(self.folder / "agent.onnx", self.config)
        rmse, activity, failures = validation_rmse(policy, self.config, FULL)
        summary = {
            "validation_episodes": FULL,
            "validation_rmse_mm": rmse,
            "paper_rmse_mm": self._validate_rival(FULL),
            "pull_step_rms_mm_per_min": activity,
            "failure_rate": failures,
            "training_steps": self.training.learner.num_timesteps,
            "seconds": time.monotonic() - self.began,
        }
        _write_json(self.folder / "summary.json", summary)
        return summary

    def _validate_rival(self, episodes: int) -> float:
        measured = make_config(self.config.scenario, control_interval=self.config.control_interval)
        return validation_rmse(self.rival, measured, episodes)[0]

    def _validate(self, bar: Any) -> None:
        """Export the actor as it stands, run the file itself on validation, keep it if it is the best."""
        learner = self.training.learner
        content = to_onnx(actor_of(learner))
        candidate = self.folder / "candidate.onnx"
        facts = self._facts(learner.num_timesteps, math.inf)
        write_agent(candidate, content, **{**facts, "validation_rmse_mm": 0.0})
        rmse, activity, failures = validation_rmse(OnnxPolicy.load(candidate, self.config), self.config, QUICK)
        if rmse < self.best:
            self.best = rmse
            write_agent(self.folder / "agent.onnx", content, **self._facts(learner.num_timesteps, rmse))
        for leftover in (candidate, candidate.with_suffix(".json")):
            leftover.unlink(missing_ok=True)
        row = {
            "steps": learner.num_timesteps,
            "seconds": round(time.monotonic() - self.began, 1),
            "validation_rmse_mm": rmse,
            "paper_rmse_mm": self.rival_rmse_mm,
            "pull_step_rms_mm_per_min": activity,
            "failure_rate": failures,
        }
        self.rows.append(row)
        _write_rows(self.folder / "progress.csv", self.rows)
        learner.logger.record("validation/rmse_mm", rmse)
        learner.logger.record("validation/pull_step_rms_mm_per_min", activity)
        learner.logger.record("validation/failure_rate", failures)
        bar.set_postfix_str(f"validation RMSE {rmse:.3f} mm, best {self.best:.3f}, paper {self.rival_rmse_mm:.3f}")

    def _facts(self, steps: int, rmse: float) -> dict[str, Any]:
        config = self.config
        return {
            "observation": config.observation,
            "channels": len(cz_gym.observation.OBSERVATIONS[config.observation]),
            "control_interval": config.control_interval,
            "plant_hash": config.plant_hash,
            "scenario": config.scenario.name,
            "scenario_hash": config.scenario.hash,
            "algorithm": type(self.choice).__name__.lower(),
            "training_seed": self.seed,
            "training_steps": int(steps),
            "validation_rmse_mm": rmse,
        }

    def _identity(self) -> dict[str, Any]:
        return {
            "algorithm": type(self.choice).__name__.lower(),
            "seed": self.seed,
            "settings": json.loads(json.dumps(dataclasses.asdict(dataclasses.replace(self.choice, steps=0)))),
            "plant_hash": self.config.plant_hash,
            "scenario_hash": self.config.scenario.hash,
        }

    def _write_settings(self, done: int) -> None:
        """Write what this run is; each time it is begun or resumed adds a session."""
        session = {
            "from_step": done,
            "command": " ".join([Path(sys.executable).name, *sys.argv]),
            "git_commit": _git_commit(),
            "python": platform.python_version(),
            "packages": {name: _version(name) for name in PACKAGES},
        }
        first = (self.sessions or [session])[0]
        facts = {**self._identity(), "steps": self.choice.steps, **first, "sessions": [*self.sessions, session]}
        _write_json(self.folder / "settings.json", facts)

    def _check_settings(self) -> list[dict[str, Any]]:
        """The sessions of the run in this folder; AgentFileError if it is not this run."""
        path = self.folder / "settings.json"
        saved = _read_settings(path)
        for name, value in self._identity().items():
            if saved.get(name) != value:
                raise AgentFileError(f"{path}: the run was begun with another {name}; resume it with the same options")
        return list(saved["sessions"])


def saved_steps(folder: Path) -> int:
    """Environment steps that the run in this folder was begun with; AgentFileError if there is none."""
    return int(_read_settings(folder / "settings.json")["steps"])


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        saved = json.loads(path.read_text())
    except (OSError, ValueError):
        saved = None
    if not isinstance(saved, dict) or not isinstance(saved.get("steps"), int) or not saved.get("sessions"):
        raise AgentFileError(f"{path}: missing or damaged, so there is nothing to resume")
    return saved


def _git_commit() -> str | None:
    here = Path(__file__).parent
    try:
        asked = subprocess.run(["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, check=True)
        changed = subprocess.run(["git", "status", "--porcelain", "-uno"], cwd=here, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return asked.stdout.strip() + ("-dirty" if changed.stdout.strip() else "")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _write_json(path: Path, content: Any) -> None:
    write_files({path: (json.dumps(content, indent=2) + "\n").encode()})


def _write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    write_files({path: text.getvalue().encode()})


def _read_rows(path: Path) -> list[dict[str, Any]]:
    try:
        with path.open(newline="") as file:
            return list(csv.DictReader(file))
    except OSError:
        return []
