"""A training run in its folder: settings and provenance, checkpoints, the best agent so far, progress."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cz_gym.agents.agent_file.contract import AgentFileError, Contract, agent_files, facts_of, make_contract, read_agent
from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.atomic_files import write_files
from cz_gym.config import make_config

from .checkpoint import load_checkpoint, restore, to_bytes
from .learner import Learner
from .learners import Controllers, make_learner
from .recipes import Recipe, Rewarded
from .run_files import COLUMNS, REFERENCES, provenance, read_rows, read_settings, to_csv, to_json
from .validation import JUDGING, PICKING, Validation, validate

CHECKPOINT = "checkpoint.safetensors"
CHECKPOINT_SECONDS = 60.0
"""Longest time between checkpoints, but for a validation or an update in between [s]."""
VALIDATE_EVERY = 200_000
"""Fewest steps between validations."""
MAX_SESSIONS = 100
"""Sessions that are remembered beside the first and the present one."""


class Run:
    """One training run.

    ``controllers`` makes a classical controller from its name and an environment's settings: the teacher of an
    imitation, and the references, which run the same validation episodes and are shown beside the agent. ``resume``
    goes on from the folder's checkpoint, saved anew every ``checkpoint_seconds``. It holds the best agent and the
    progress (with ``plot`` a picture of it too), which are written beside it and, where a kill came between, anew when
    the run is resumed.
    Raises AgentFileError if the folder cannot be used.
    """

    def __init__(
        self,
        folder: Path,
        recipe: Recipe,
        seed: int,
        controllers: Controllers,
        resume: bool = False,
        checkpoint_seconds: float = CHECKPOINT_SECONDS,
        plot: bool = False,
    ) -> None:
        self.folder, self.recipe, self.seed, self.checkpoint_seconds = folder, recipe, seed, checkpoint_seconds
        self.plot = plot
        self.config = recipe.config
        self._measured = make_config(recipe.scenario, control_interval=recipe.control_interval)
        self._references = {name: controllers(name, self._measured) for name in REFERENCES}
        self.references = self._validate_references(PICKING)
        self.best = math.inf
        self.rows: list[dict[str, Any]] = []
        self.sessions: list[dict[str, Any]] = []
        self.began = self.saved = time.monotonic()
        self.saved_steps = -1
        self.files: dict[str, bytes] = {}
        logs = folder / "tensorboard"
        if not resume:
            self.learner: Learner = make_learner(recipe, seed, controllers, logs)
            self.save()
        else:
            self.sessions = check_settings(folder, recipe, seed)
            progress, tensors, self.files = load_checkpoint(folder / CHECKPOINT)
            write_files({folder / name: content for name, content in self.files.items()})
            self.began -= progress.seconds
            self.rows = read_rows(folder / "progress.csv")
            if progress.best_cost is not None:
                self.best = progress.best_cost
            self.learner = make_learner(recipe, seed, controllers, logs, progress.steps)
            restore(self.learner, tensors, folder / CHECKPOINT)
        self.validate_every = max(self.learner.total // 24, VALIDATE_EVERY)
        self._write_settings()

    def learn(self, bar: Any, report: Callable[[int, Validation], None] = lambda steps, found: None) -> None:
        """Learn to the end, validating and saving on the way; nothing if that is done.

        ``bar`` counts environment steps, as tqdm's does; ``report`` gets what each validation found.
        """
        bar.update(self.learner.steps - bar.n)
        due = self.learner.steps + self.validate_every

        def watch(steps: int, doing: str) -> None:
            nonlocal due
            bar.update(steps - bar.n)
            if doing:
                bar.set_postfix_str(doing)
            if self.learner.steps >= due:
                report(self.learner.steps, self._validate(bar))
                due = self.learner.steps + self.validate_every
            elif self.learner.steps > self.saved_steps and time.monotonic() >= self.saved + self.checkpoint_seconds:
                self.save()

        self.learner.learn(watch)
        if math.isinf(self.best) or not self.rows or int(self.rows[-1]["steps"]) < self.learner.steps:
            report(self.learner.steps, self._validate(bar))

    def save(self) -> None:
        """Write a checkpoint, then the files that it holds."""
        best = self.best if math.isfinite(self.best) else None
        content = to_bytes(self.learner, time.monotonic() - self.began, best, self.files)
        write_files({self.folder / name: content for name, content in {CHECKPOINT: content, **self.files}.items()})
        self.saved, self.saved_steps = time.monotonic(), self.learner.steps

    def _hold(self, files: Mapping[Path, bytes]) -> None:
        """Take files of the folder into the next checkpoint."""
        self.files |= {path.name: content for path, content in files.items()}

    def finish(self) -> dict[str, float]:
        """Judge the best agent on episodes that did not pick it; the contents of ``summary.json``."""
        found = validate(self.best_policy(), self.config, JUDGING, self.recipe.weights)
        path = self.folder / "agent.onnx"
        contract, content = read_agent(path)
        summary = {
            "validation_episodes": len(JUDGING),
            "validation_cost": found.cost,
            "validation_rmse_mm": found.rmse_mm,
            **{f"{name}_rmse_mm": rmse for name, rmse in self._validate_references(JUDGING).items()},
            "pull_step_rms_mm_per_min": found.pull_step_rms_mm_per_min,
            "failure_rate": found.failure_rate,
            "training_steps": contract.training_steps,
            "steps": self.learner.steps,
            "seconds": time.monotonic() - self.began,
        }
        judged = dataclasses.replace(contract, validation_cost=found.cost, validation_rmse_mm=found.rmse_mm)
        self._hold({**agent_files(path, content, judged), self.folder / "summary.json": to_json(summary)})
        self.save()
        return summary

    def best_policy(self) -> OnnxPolicy:
        """The agent that did best on validation."""
        return OnnxPolicy.load(self.folder / "agent.onnx", self.config)

    def _validate(self, bar: Any) -> Validation:
        """Export the actor as it stands, run the file itself on validation, save it if it is the best."""
        learner = self.learner
        content = learner.exported()
        contract = self._contract(content)
        found = validate(OnnxPolicy.of(contract, content, self.config), self.config, PICKING, self.recipe.weights)
        if found.cost < self.best:
            self.best = found.cost
            contract = dataclasses.replace(contract, validation_cost=found.cost, validation_rmse_mm=found.rmse_mm)
            self._hold(agent_files(self.folder / "agent.onnx", content, contract))
        seconds = round(time.monotonic() - self.began, 1)
        row = (learner.steps, seconds, *found, *self.references.values())
        self.rows.append(dict(zip(COLUMNS, row, strict=True)))
        self._hold({self.folder / "progress.csv": to_csv(self.rows)})
        if self.plot:
            from .plot import progress

            self._hold({self.folder / "progress.png": progress(self.rows, f"{self.recipe.name}, seed {self.seed}")})
        self.save()
        for name, figure in found._asdict().items():
            learner.logger.record(f"validation/{name}", figure)
        beside = ", ".join(f"{name} {rmse:.3f}" for name, rmse in self.references.items())
        bar.set_postfix_str(f"RMSE {found.rmse_mm:.3f} mm, {found.failure_rate:.0%} lost ({beside})")
        return found

    def _validate_references(self, seeds: Sequence[int]) -> dict[str, float]:
        return {name: validate(each, self._measured, seeds).rmse_mm for name, each in self._references.items()}

    def _contract(self, content: bytes) -> Contract:
        rewarded = isinstance(self.recipe, Rewarded)
        return make_contract(
            content,
            **facts_of(self.config),
            algorithm=self.recipe.name,
            training_seed=self.seed,
            training_steps=self.learner.steps if rewarded else 0,
            validation_cost=0.0,
            validation_rmse_mm=0.0,
        )

    def _write_settings(self) -> None:
        """Write what this run is; each time it is begun or resumed adds a session."""
        session = {"from_step": self.learner.steps, **provenance()}
        first = (self.sessions or [session])[0]
        self.sessions = [*self.sessions[:1], *self.sessions[1:][-MAX_SESSIONS:], session]
        facts = {**_identity(self.recipe, self.seed), "steps": self.learner.total, **first, "sessions": self.sessions}
        write_files({self.folder / "settings.json": to_json(facts)})


def _identity(recipe: Recipe, seed: int) -> dict[str, Any]:
    """What a run must be resumed with; it may be longer."""
    settings = {name: value for name, value in dataclasses.asdict(recipe).items() if name != "steps"}
    config = recipe.config
    return {
        "algorithm": recipe.name,
        "seed": seed,
        "settings": json.loads(json.dumps(settings)),
        "plant_hash": config.plant_hash,
        "scenario_hash": config.scenario.hash,
    }


def check_settings(folder: Path, recipe: Recipe, seed: int) -> list[dict[str, Any]]:
    """The sessions of the run in this folder; AgentFileError if it is not this run."""
    path = folder / "settings.json"
    saved = read_settings(path)
    for name, value in _identity(recipe, seed).items():
        if saved.get(name) != value:
            raise AgentFileError(f"{path}: the run was begun with another {name}; resume it with the same options")
    return list(saved["sessions"])
