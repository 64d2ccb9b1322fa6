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
from typing import Any, NamedTuple

import numpy as np

import cz_gym
from cz_gym.config import Config, make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.evaluation.whole import finish_writing, write_files
from cz_gym.task import FAILURE_COST, cost_terms
from cz_gym.units import KILO, MM, MM_PER_MIN

from . import settings
from .callbacks import AtStart, Every, Tell
from .checkpoint import load_checkpoint, restore, to_bytes
from .contract import MAX_JSON_BYTES, AgentFileError, agent_files, make_contract, read_bounded, read_json
from .export import actor_of, to_onnx
from .onnx_policy import OnnxPolicy
from .training import Training, clone, make_training

QUICK, FULL = 64, 200
"""Validation episodes while learning, and at the end."""
CHECKPOINT = "checkpoint.safetensors"
CHECKPOINT_SECONDS = 60.0
"""Longest time between checkpoints, but for a validation or an update in between [s]."""
VALIDATE_EVERY = 200_000
"""Fewest steps between validations."""
MAX_SESSIONS = 100
"""Sessions that are remembered beside the first and the present one."""
COLUMNS = (
    "steps",
    "seconds",
    "validation_cost",
    "validation_rmse_mm",
    "paper_rmse_mm",
    "pull_step_rms_mm_per_min",
    "failure_rate",
)
"""Columns of ``progress.csv``."""
PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "stable-baselines3", "torch", "onnx", "onnxruntime")


class Validation(NamedTuple):
    """Mean figures over validation episodes."""

    cost: float
    """Of a step, unsaturated and weighed as in training; a lost episode costs ten a step [-]."""
    rmse_mm: float
    pull_step_rms_mm_per_min: float
    failure_rate: float


def validate(policy: Any, config: Config, episodes: int, weights: settings.CostWeights) -> Validation:
    """Run the first validation episodes."""
    found = metrics(rollout(policy, config, VALIDATION_SEEDS[:episodes]))
    error = found.rmse_observable_mm if weights.observable else found.rmse_mm
    terms = cost_terms(
        error * MM,
        found.pull_rms_mm_per_min * MM_PER_MIN,
        found.pull_step_rms_mm_per_min * MM_PER_MIN,
        found.heater_step_rms_kw * KILO,
    )
    cost = terms.radius + weights.pull * terms.pull
    cost += weights.pull_step * terms.pull_step + weights.heater_step * terms.heater_step
    cost = np.where(found.failure_rate > 0, FAILURE_COST, cost)
    figures = cost, found.rmse_mm, found.pull_step_rms_mm_per_min, found.failure_rate
    return Validation(*(float(figure.mean()) for figure in figures))


class Run:
    """One training run.

    ``rival``, a policy on "measured" observations, runs the same validation episodes and is shown beside the agent;
    ``teacher`` is the controller that the settings clone;
    ``resume`` goes on from the folder's checkpoint, saved anew every ``checkpoint_seconds``. Checkpoint, progress and
    best agent are replaced together, so that they agree whenever a run is killed. Raises AgentFileError if the folder
    cannot be used.
    """

    def __init__(
        self,
        folder: Path,
        choice: settings.PPO | settings.SAC,
        seed: int,
        rival: Any,
        resume: bool = False,
        checkpoint_seconds: float = CHECKPOINT_SECONDS,
        teacher: Any = None,
    ) -> None:
        self.folder, self.choice, self.seed, self.rival = folder, choice, seed, rival
        self.teacher = teacher
        self.checkpoint_seconds = checkpoint_seconds
        recipe = choice.recipe
        self.config = make_config(
            recipe.scenario, observation=recipe.observation, control_interval=recipe.control_interval
        )
        self.rival_rmse_mm = self._validate_rival(QUICK)
        self.best = math.inf
        self.rows: list[dict[str, Any]] = []
        self.sessions: list[dict[str, Any]] = []
        self.began = time.monotonic()
        self.unsaved: dict[Path, bytes] = {}
        if not resume:
            self.training: Training = make_training(choice, seed, str(folder / "tensorboard"), 0, teacher)
            self.save()
            self._write_settings(0)
            return
        if folder.is_dir():
            finish_writing(folder)
        self.sessions = self._check_settings()
        progress, tensors = load_checkpoint(folder / CHECKPOINT)
        self.began -= progress.seconds
        self.rows = _read_rows(folder / "progress.csv")
        if progress.best_cost is not None and _usable(folder / "agent.onnx", self.config):
            self.best = progress.best_cost
        self.training = make_training(choice, seed, str(folder / "tensorboard"), progress.steps, teacher)
        restore(self.training.learner, progress, tensors, folder / CHECKPOINT)
        self._write_settings(progress.steps)

    def learn(self, bar: Any) -> None:
        """Learn to the end, validating and saving on the way; the bar counts environment steps."""
        learner = self.training.learner
        bar.update(learner.num_timesteps - bar.n)
        validate = Every(max(self.choice.steps // 24, VALIDATE_EVERY), None, lambda: self._validate(bar))
        checkpoint = Every(None, self.checkpoint_seconds, self.save)
        begin = AtStart(lambda: self._begin(bar))
        callbacks = [begin, *self.training.callbacks, Tell(bar), validate, checkpoint]
        left = self.choice.steps - learner.num_timesteps
        if left > 0:
            learner.learn(left, callback=callbacks, reset_num_timesteps=False, tb_log_name="run")
        self._validate(bar)

    def _begin(self, bar: Any) -> None:
        """Imitate the teacher, if there is one and nothing has been learned yet."""
        if self.training.learner.num_timesteps == 0 and self.choice.recipe.clone is not None:
            clone(self.training, self.teacher, self.config, self.seed, bar.set_postfix_str)
            self._validate(bar)

    def save(self) -> None:
        """Write a checkpoint, and with it what a validation left to be written."""
        best = self.best if math.isfinite(self.best) else None
        content = to_bytes(self.training.learner, time.monotonic() - self.began, best)
        write_files({**self.unsaved, self.folder / CHECKPOINT: content})
        self.unsaved = {}

    def finish(self) -> dict[str, float]:
        """Validate the best agent on more episodes and write ``summary.json``; its contents."""
        policy = OnnxPolicy.load(self.folder / "agent.onnx", self.config)
        found = validate(policy, self.config, FULL, self.choice.recipe.weights)
        summary = {
            "validation_episodes": FULL,
            "validation_cost": found.cost,
            "validation_rmse_mm": found.rmse_mm,
            "paper_rmse_mm": self._validate_rival(FULL),
            "pull_step_rms_mm_per_min": found.pull_step_rms_mm_per_min,
            "failure_rate": found.failure_rate,
            "training_steps": self.training.learner.num_timesteps,
            "seconds": time.monotonic() - self.began,
        }
        _write_json(self.folder / "summary.json", summary)
        return summary

    def _validate_rival(self, episodes: int) -> float:
        measured = make_config(self.config.scenario, control_interval=self.config.control_interval)
        return validate(self.rival, measured, episodes, settings.CostWeights()).rmse_mm

    def _validate(self, bar: Any) -> None:
        """Export the actor as it stands, run the file itself on validation, keep it if it is the best."""
        learner = self.training.learner
        content = to_onnx(actor_of(learner))
        candidate = make_contract(content, **self._facts(learner.num_timesteps, 0.0))
        policy = OnnxPolicy.of(candidate, content, self.config)
        found = validate(policy, self.config, QUICK, self.choice.recipe.weights)
        if found.cost < self.best:
            self.best = found.cost
            contract = dataclasses.replace(candidate, validation_rmse_mm=found.rmse_mm)
            self.unsaved |= agent_files(self.folder / "agent.onnx", content, contract)
        seconds = round(time.monotonic() - self.began, 1)
        cost, rmse, activity, failures = found
        row = (learner.num_timesteps, seconds, cost, rmse, self.rival_rmse_mm, activity, failures)
        self.rows.append(dict(zip(COLUMNS, row, strict=True)))
        self.unsaved[self.folder / "progress.csv"] = _csv(self.rows)
        self.save()
        learner.logger.record("validation/cost", cost)
        learner.logger.record("validation/rmse_mm", rmse)
        learner.logger.record("validation/pull_step_rms_mm_per_min", activity)
        learner.logger.record("validation/failure_rate", failures)
        bar.set_postfix_str(f"validation RMSE {rmse:.3f} mm, paper {self.rival_rmse_mm:.3f}")

    def _facts(self, steps: int, rmse: float) -> dict[str, Any]:
        config = self.config
        return {
            "observation": config.observation,
            "channels": len(cz_gym.observation.OBSERVATIONS[config.observation]),
            "control_interval": config.control_interval,
            "plant_hash": config.plant_hash,
            "scenario": config.scenario.name,
            "scenario_hash": config.scenario.hash,
            "algorithm": self.choice.name,
            "training_seed": self.seed,
            "training_steps": int(steps),
            "validation_rmse_mm": rmse,
        }

    def _identity(self) -> dict[str, Any]:
        return {
            "algorithm": self.choice.name,
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
        sessions = [*self.sessions[:1], *self.sessions[1:][-MAX_SESSIONS:], session]
        facts = {**self._identity(), "steps": self.choice.steps, **first, "sessions": sessions}
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
        saved = read_json(path)
    except AgentFileError:
        saved = None
    steps, sessions = (saved.get("steps"), saved.get("sessions")) if isinstance(saved, dict) else (None, None)
    whole = type(steps) is int and 0 < steps < 2**63 and isinstance(sessions, list)
    if not whole or not sessions or not all(isinstance(session, dict) for session in sessions):
        raise AgentFileError(f"{path}: missing or damaged, so there is nothing to resume")
    return dict(saved)


def _usable(path: Path, config: Config) -> bool:
    try:
        OnnxPolicy.load(path, config)
    except AgentFileError:
        return False
    return True


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


def _csv(rows: list[dict[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=COLUMNS)
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def _read_rows(path: Path) -> list[dict[str, Any]]:
    """The validations before this session; AgentFileError if the file is not one that a run wrote."""
    if not path.exists():
        return []
    try:
        rows = list(csv.DictReader(io.StringIO(read_bounded(path, MAX_JSON_BYTES).decode(), newline="")))
        for row in rows:
            if list(row) != list(COLUMNS) or not all(math.isfinite(float(value)) for value in row.values()):
                raise ValueError("a row is not one of numbers")
    except (ValueError, TypeError, csv.Error):
        raise AgentFileError(f"{path}: damaged; without it the run can be resumed") from None
    return rows
