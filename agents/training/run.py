"""A training run in its folder: settings and provenance, checkpoints, the best agent so far, progress."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import Logger

from cz_gym.agents.agent_file.contract import AgentFileError, Contract, agent_files, facts_of, make_contract, read_agent
from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.agents.policies.residual import Residual
from cz_gym.agents.training.export import exported
from cz_gym.atomic_files import finish_writing, write_files
from cz_gym.config import Config, make_config

from . import recipes as settings
from .callbacks import AtStart, Every, Tell
from .checkpoint import load_checkpoint, restore, to_bytes
from .learners import Training, clone, make_training
from .run_files import COLUMNS, provenance, read_rows, read_settings, to_csv, to_json
from .validation import JUDGING, PICKING, validate

Controllers = Callable[[str, Config], Any]
CHECKPOINT = "checkpoint.safetensors"
IMITATION = "imitation.onnx"
"""The agent as it was before it learned, if it began as an imitation."""
CHECKPOINT_SECONDS = 60.0
"""Longest time between checkpoints, but for a validation or an update in between [s]."""
VALIDATE_EVERY = 200_000
"""Fewest steps between validations."""
MAX_SESSIONS = 100
"""Sessions that are remembered beside the first and the present one."""


class Run:
    """One training run.

    ``controllers`` makes a classical controller from its name and an environment's settings: the teacher, and the
    paper's. The paper's controller runs the same validation episodes and is shown beside the agent. ``imitations`` is
    a folder where imitations are kept for others; ``resume`` goes on from the folder's checkpoint, saved anew every
    ``checkpoint_seconds``. Checkpoint, progress and best agent are replaced together, so that they agree whenever a
    run is killed. Raises AgentFileError if the folder cannot be used.
    """

    def __init__(
        self,
        folder: Path,
        choice: settings.Choice,
        seed: int,
        controllers: Controllers,
        resume: bool = False,
        checkpoint_seconds: float = CHECKPOINT_SECONDS,
        imitations: Path | None = None,
    ) -> None:
        self.folder, self.choice, self.seed, self.imitations = folder, choice, seed, imitations
        self.checkpoint_seconds = checkpoint_seconds
        self.validate_every = max(choice.steps // 24, VALIDATE_EVERY)
        recipe = choice.recipe
        self.config = make_config(
            recipe.scenario, observation=recipe.observation, control_interval=recipe.control_interval
        )
        measured = make_config(recipe.scenario, control_interval=recipe.control_interval)
        self.rival = controllers("paper", measured)
        self.teacher = controllers(recipe.clone.teacher, measured) if recipe.clone else None
        self.rival_rmse_mm = self._validate_rival(PICKING)
        self.best = math.inf
        self.rows: list[dict[str, Any]] = []
        self.sessions: list[dict[str, Any]] = []
        self.began = time.monotonic()
        self.unsaved: dict[Path, bytes] = {}
        if not resume:
            self.training: Training = make_training(choice, seed, str(folder / "tensorboard"), 0, self.teacher)
            self.save()
            self._write_settings(0)
            return
        if folder.is_dir():
            finish_writing(folder)
        self.sessions = self._check_settings()
        progress, tensors = load_checkpoint(folder / CHECKPOINT)
        self.began -= progress.seconds
        self.rows = read_rows(folder / "progress.csv")
        if progress.best_cost is not None and _usable(folder / "agent.onnx", self.config):
            self.best = progress.best_cost
        self.training = make_training(choice, seed, str(folder / "tensorboard"), progress.steps, self.teacher)
        restore(self.training.learner, progress, tensors, folder / CHECKPOINT)
        self._write_settings(progress.steps)

    def learn(self, bar: Any) -> None:
        """Learn to the end, validating and saving on the way; the bar counts environment steps."""
        learner = self.training.learner
        bar.update(learner.num_timesteps - bar.n)
        validate = Every(self.validate_every, None, lambda: self._validate(bar))
        checkpoint = Every(None, self.checkpoint_seconds, self.save)
        begin = AtStart(lambda: self._begin(bar))
        callbacks = [begin, *self.training.callbacks, Tell(bar), validate, checkpoint]
        left = self.choice.steps - learner.num_timesteps
        if left > 0:
            learner.learn(left, callback=callbacks, reset_num_timesteps=False, tb_log_name="run")
        else:
            learner.set_logger(Logger(None, []))
        self._validate(bar)

    def _begin(self, bar: Any) -> None:
        """Imitate the teacher, if there is one and the checkpoint holds neither its imitation nor anything after it."""
        begun = self.training.learner.num_timesteps > 0 or bool(self.rows)
        if self.choice.recipe.clone is not None and not begun:
            clone(self.training, self.teacher, self.config, self.seed, bar.set_postfix_str, self.imitations)
            contract, content, _ = self._exported()
            self.unsaved |= agent_files(self.folder / IMITATION, content, contract)
            self._validate(bar)

    def save(self) -> None:
        """Write a checkpoint, and with it what a validation left to be written."""
        best = self.best if math.isfinite(self.best) else None
        content = to_bytes(self.training.learner, time.monotonic() - self.began, best)
        write_files({**self.unsaved, self.folder / CHECKPOINT: content})
        self.unsaved = {}

    def finish(self) -> dict[str, float]:
        """Judge the best agent on episodes that did not pick it; the contents of ``summary.json``."""
        found = validate(self.best_policy(), self.config, JUDGING, self.choice.recipe.weights)
        summary = {
            "validation_episodes": len(JUDGING),
            "validation_cost": found.cost,
            "validation_rmse_mm": found.rmse_mm,
            "paper_rmse_mm": self._validate_rival(JUDGING),
            "pull_step_rms_mm_per_min": found.pull_step_rms_mm_per_min,
            "failure_rate": found.failure_rate,
            "training_steps": self.training.learner.num_timesteps,
            "seconds": time.monotonic() - self.began,
        }
        path = self.folder / "agent.onnx"
        contract, content = read_agent(path)
        judged = dataclasses.replace(contract, validation_cost=found.cost, validation_rmse_mm=found.rmse_mm)
        write_files({**agent_files(path, content, judged), self.folder / "summary.json": to_json(summary)})
        return summary

    def best_policy(self) -> Any:
        """The agent that did best on validation, as it acts."""
        return self._whole(OnnxPolicy.load(self.folder / "agent.onnx", self.config))

    def first_policy(self) -> Any:
        """The agent before it learned, as it acts; None if it began from nothing."""
        path = self.folder / IMITATION
        return self._whole(OnnxPolicy.load(path, self.config)) if self.choice.recipe.clone else None

    def present_policy(self) -> Any:
        """The agent as it stands, as it acts."""
        return self._whole(self._exported()[2])

    def _whole(self, agent: OnnxPolicy) -> Any:
        return Residual(self.teacher, agent) if self.choice.recipe.residual else agent

    def _exported(self) -> tuple[Contract, bytes, OnnxPolicy]:
        content = exported(self.training.learner)
        contract = make_contract(content, **self._facts(self.training.learner.num_timesteps))
        return contract, content, OnnxPolicy.of(contract, content, self.config)

    def _validate_rival(self, seeds: Sequence[int]) -> float:
        measured = make_config(self.config.scenario, control_interval=self.config.control_interval)
        return validate(self.rival, measured, seeds, settings.CostWeights()).rmse_mm

    def _validate(self, bar: Any) -> None:
        """Export the actor as it stands, run the file itself on validation, keep it if it is the best."""
        learner = self.training.learner
        candidate, content, agent = self._exported()
        found = validate(self._whole(agent), self.config, PICKING, self.choice.recipe.weights)
        if found.cost < self.best:
            self.best = found.cost
            contract = dataclasses.replace(candidate, validation_cost=found.cost, validation_rmse_mm=found.rmse_mm)
            self.unsaved |= agent_files(self.folder / "agent.onnx", content, contract)
        seconds = round(time.monotonic() - self.began, 1)
        cost, rmse, activity, failures = found
        row = (learner.num_timesteps, seconds, cost, rmse, self.rival_rmse_mm, activity, failures)
        self.rows.append(dict(zip(COLUMNS, row, strict=True)))
        self.unsaved[self.folder / "progress.csv"] = to_csv(self.rows)
        self.save()
        learner.logger.record("validation/cost", cost)
        learner.logger.record("validation/rmse_mm", rmse)
        learner.logger.record("validation/pull_step_rms_mm_per_min", activity)
        learner.logger.record("validation/failure_rate", failures)
        bar.set_postfix_str(f"validation RMSE {rmse:.3f} mm, paper {self.rival_rmse_mm:.3f}")

    def _facts(self, steps: int) -> dict[str, Any]:
        return {
            **facts_of(self.config),
            "algorithm": self.choice.name,
            "training_seed": self.seed,
            "training_steps": int(steps),
            "validation_cost": 0.0,
            "validation_rmse_mm": 0.0,
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
            **provenance(),
        }
        first = (self.sessions or [session])[0]
        sessions = [*self.sessions[:1], *self.sessions[1:][-MAX_SESSIONS:], session]
        facts = {**self._identity(), "steps": self.choice.steps, **first, "sessions": sessions}
        write_files({self.folder / "settings.json": to_json(facts)})

    def _check_settings(self) -> list[dict[str, Any]]:
        """The sessions of the run in this folder; AgentFileError if it is not this run."""
        path = self.folder / "settings.json"
        saved = read_settings(path)
        for name, value in self._identity().items():
            if saved.get(name) != value:
                raise AgentFileError(f"{path}: the run was begun with another {name}; resume it with the same options")
        return list(saved["sessions"])


def _usable(path: Path, config: Config) -> bool:
    try:
        OnnxPolicy.load(path, config)
    except AgentFileError:
        return False
    return True
