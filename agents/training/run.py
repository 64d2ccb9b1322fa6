"""A training run in its folder: settings and provenance, checkpoints, the best agent so far, progress."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from cz_gym.agents.agent_file.contract import Contract, agent_files, facts_of, make_contract, read_agent
from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.atomic_files import write_files
from cz_gym.config import Config, make_config

from .checkpoint import load_checkpoint, restore, to_bytes
from .learners import make_learner
from .recipes import Imitation, Recipe
from .run_files import check_settings, identity, provenance, read_rows, to_csv, to_json
from .validation import COLUMNS, JUDGING, PICKING, REFERENCES, Validation, validate

CHECKPOINT = "checkpoint.safetensors"
CHECKPOINT_SECONDS = 60.0
"""Longest time between checkpoints, apart from validations and updates in between [s]."""
VALIDATE_EVERY = 200_000
"""Least number of steps between validations."""
MAX_SESSIONS = 100
"""Number of sessions that settings list, beside the first and the present one."""

MakeController = Callable[[str, Config], Any]
"""Makes a classical controller from its name and an environment's settings."""


class Run:
    """One training run.

    ``make_controller`` makes the teacher of an imitation, and the references: classical controllers whose validation
    RMSE is shown beside the agent's. ``resume`` continues from the folder's checkpoint, which is saved every
    ``checkpoint_seconds``. It holds the run's other files too: best agent, progress and, with ``plot``, a picture of
    it. Raises AgentFileError if the folder cannot be used.
    """

    def __init__(
        self,
        folder: Path,
        recipe: Recipe,
        seed: int,
        make_controller: MakeController,
        resume: bool = False,
        checkpoint_seconds: float = CHECKPOINT_SECONDS,
        plot: bool = False,
    ) -> None:
        self.folder, self.recipe, self.seed, self.plot = folder, recipe, seed, plot
        self.checkpoint_seconds = checkpoint_seconds
        self.config = recipe.config
        self._measured = make_config(recipe.scenario, control_interval=recipe.control_interval)
        self._references = {name: make_controller(name, self._measured) for name in REFERENCES}
        self.references = self._validate_references(PICKING)
        teacher = make_controller(recipe.teacher, self._measured) if isinstance(recipe, Imitation) else None
        logs = folder / "tensorboard"
        self.files: dict[str, bytes] = {}
        self.rows: list[dict[str, Any]] = []
        self.best: float | None = None
        sessions: list[dict[str, Any]] = []
        self.began = time.monotonic()
        if resume:
            sessions = check_settings(folder, recipe, seed)
            progress, tensors, self.files = load_checkpoint(folder / CHECKPOINT)
            write_files({folder / name: content for name, content in self.files.items()})
            self.rows, self.best = read_rows(folder / "progress.csv"), progress.best_cost
            self.began -= progress.seconds
            self.learner = make_learner(recipe, seed, teacher, logs, progress.steps)
            restore(self.learner, tensors, folder / CHECKPOINT)
            self.saved, self.saved_steps = time.monotonic(), self.learner.steps
        else:
            self.learner = make_learner(recipe, seed, teacher, logs)
            self.save()
        self.validate_every = max(self.learner.total // 24, VALIDATE_EVERY)
        self._write_settings(sessions)

    def learn(self, bar: Any, report: Callable[[int, Validation], None] = lambda steps, figures: None) -> None:
        """Learn to the end, validating and saving on the way; nothing if that is done.

        ``bar`` counts environment steps, as tqdm's does; ``report`` receives each validation. Ctrl-C ends the run
        between two updates, with a checkpoint, by KeyboardInterrupt.
        """
        bar.update(self.learner.steps - bar.n)
        due = self.learner.steps + self.validate_every
        with deferred_interrupt() as interrupted:

            def watch(steps: int, doing: str) -> None:
                nonlocal due
                bar.update(steps - bar.n)
                if doing:
                    bar.set_postfix_str(doing)
                if self.learner.steps >= due:
                    report(self.learner.steps, self._validate(bar))
                    due = self.learner.steps + self.validate_every
                new = self.learner.steps > self.saved_steps
                if new and (interrupted() or time.monotonic() >= self.saved + self.checkpoint_seconds):
                    self.save()
                if interrupted():
                    raise KeyboardInterrupt

            self.learner.learn(watch)
            if not self.rows or int(self.rows[-1]["steps"]) < self.learner.steps:
                report(self.learner.steps, self._validate(bar))
            if interrupted():
                raise KeyboardInterrupt

    def save(self) -> None:
        """Write a checkpoint, then the files that it holds; only between updates."""
        content = to_bytes(self.learner, time.monotonic() - self.began, self.best, self.files)
        write_files({self.folder / name: content for name, content in {CHECKPOINT: content, **self.files}.items()})
        self.saved, self.saved_steps = time.monotonic(), self.learner.steps

    def _hold(self, files: Mapping[Path, bytes]) -> None:
        """Put files of the folder into the next checkpoint."""
        self.files |= {path.name: content for path, content in files.items()}

    def finish(self) -> dict[str, float]:
        """Test the best agent on episodes that did not choose it; the contents of ``summary.json``."""
        figures = self._figures(self.best_policy(), JUDGING)
        path = self.folder / "agent.onnx"
        contract, content = read_agent(path)
        summary = {
            "validation_episodes": len(JUDGING),
            "validation_cost": figures.cost,
            "validation_rmse_mm": figures.rmse_mm,
            **{f"{name}_rmse_mm": rmse for name, rmse in self._validate_references(JUDGING).items()},
            "pull_step_rms_mm_per_min": figures.pull_step_rms_mm_per_min,
            "failure_rate": figures.failure_rate,
            "training_steps": contract.training_steps,
            "steps": self.learner.steps,
            "seconds": time.monotonic() - self.began,
        }
        self._hold(agent_files(path, content, _with_figures(contract, figures)))
        self._hold({self.folder / "summary.json": to_json(summary)})
        self.save()
        return summary

    def best_policy(self) -> OnnxPolicy:
        """The agent of least validation cost."""
        return OnnxPolicy.load(self.folder / "agent.onnx", self.config)

    def _validate(self, bar: Any) -> Validation:
        """Export the actor as it stands and run the file itself on validation episodes; keep it if it is the best."""
        content = self.learner.exported()
        contract = make_contract(
            content,
            **facts_of(self.config),
            algorithm=self.recipe.name,
            training_seed=self.seed,
            training_steps=self.learner.steps if self.recipe.steps else 0,
            validation_cost=0.0,
            validation_rmse_mm=0.0,
        )
        figures = self._figures(OnnxPolicy.of(contract, content, self.config), PICKING)
        if self.best is None or figures.cost < self.best:
            self.best = figures.cost
            self._hold(agent_files(self.folder / "agent.onnx", content, _with_figures(contract, figures)))
        seconds = round(time.monotonic() - self.began, 1)
        row = (self.learner.steps, seconds, *figures, *self.references.values())
        self.rows.append(dict(zip(COLUMNS, row, strict=True)))
        self._hold({self.folder / "progress.csv": to_csv(self.rows)})
        if self.plot:
            from .plot import progress

            self._hold({self.folder / "progress.png": progress(self.rows, f"{self.recipe.name}, seed {self.seed}")})
        self.save()
        for name, figure in figures._asdict().items():
            self.learner.logger.record(f"validation/{name}", figure)
        beside = ", ".join(f"{name} {rmse:.3f}" for name, rmse in self.references.items())
        bar.set_postfix_str(f"RMSE {figures.rmse_mm:.3f} mm, {figures.failure_rate:.0%} lost ({beside})")
        return figures

    def _figures(self, policy: OnnxPolicy, seeds: Sequence[int]) -> Validation:
        return validate(policy, self.config, seeds, self.recipe.weights, self.recipe.observable)

    def _validate_references(self, seeds: Sequence[int]) -> dict[str, float]:
        return {name: validate(each, self._measured, seeds).rmse_mm for name, each in self._references.items()}

    def _write_settings(self, sessions: list[dict[str, Any]]) -> None:
        """Write the run's settings; each time it is begun or resumed adds a session."""
        session = {"from_step": self.learner.steps, **provenance()}
        first = sessions[0] if sessions else session
        sessions = [*sessions[:1], *sessions[1:][-MAX_SESSIONS:], session]
        facts = {**identity(self.recipe, self.seed), "steps": self.learner.total, **first, "sessions": sessions}
        write_files({self.folder / "settings.json": to_json(facts)})


def _with_figures(contract: Contract, figures: Validation) -> Contract:
    return replace(contract, validation_cost=figures.cost, validation_rmse_mm=figures.rmse_mm)


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C into a flag, which the function returned reads; the second one interrupts as usual.

    Only where Ctrl-C would raise KeyboardInterrupt: in the main thread, with Python's own handler.
    """
    pressed = False

    def note(*_: Any) -> None:
        nonlocal pressed
        pressed = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        print("\ninterrupted: stops after this update; Ctrl-C again stops at once", file=sys.stderr)

    own = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if own := own and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, note)
    try:
        yield lambda: pressed
    finally:
        if own:
            signal.signal(signal.SIGINT, signal.default_int_handler)
