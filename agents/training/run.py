"""A training run in its folder: settings and provenance, checkpoints, the best agent so far, progress."""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import parent_process
from pathlib import Path
from typing import Any, NamedTuple

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import configure_logger

from cz_gym.agents.agent_file.contract import agent_files, read_json
from cz_gym.agents.asymmetric import Asymmetric, LearnState
from cz_gym.agents.export import to_agent
from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.sb3 import environment_steps
from cz_gym.support.atomic_files import write_files

from . import validation
from .algorithms import make_algorithm, repeat_of
from .checkpoint import load_checkpoint, restore, to_bytes
from .recipes import Recipe
from .run_files import check_settings, identity, provenance, read_rows, to_csv, to_json
from .validation import COLUMNS, References, beside, validate

CHECKPOINT = "checkpoint.zip"
VALIDATE_EVERY = 200_000
"""Least number of steps between validations."""
MAX_SESSIONS = 100
"""Number of sessions that settings list, beside the first and the present one."""


class Job(NamedTuple):
    """A training seed's run."""

    folder: Path
    recipe: Recipe
    seed: int
    references: References
    """RMSEs of classical controllers on the same crystals, shown beside the agent's."""
    checkpoint_seconds: float = 60.0
    """Longest time between checkpoints, apart from validations and updates in between [s]."""
    plot: bool = False
    """Whether to draw the progress into the folder."""

    @property
    def sessions(self) -> list[dict[str, Any]]:
        """Sessions of the run in its folder, empty before the first; AgentFileError if that is another run."""
        exists = (self.folder / "settings.json").exists()
        return check_settings(self.folder, self.recipe, self.seed) if exists else []

    @property
    def summary(self) -> dict[str, float] | None:
        """The summary of the run; None before its end."""
        path = self.folder / "summary.json"
        saved = read_json(path) if self.sessions and path.exists() else None
        steps = saved.get("steps") if isinstance(saved, dict) else None
        return saved if isinstance(steps, int) and steps >= self.recipe.steps else None


class Run:
    """One training run, continued from its folder's checkpoint if it has begun there.

    The checkpoint holds the run's other files too: best agent, progress and, with ``plot``, a picture of it. Raises
    AgentFileError if the folder cannot be used.
    """

    def __init__(self, job: Job) -> None:
        folder, recipe, seed = self.folder, self.recipe, self.seed = job[:3]
        self.job = job
        self.config = recipe.config
        self.files: dict[str, bytes] = {}
        self.rows: list[dict[str, Any]] = []
        self.best: float | None = None
        self.began, sessions = time.monotonic(), job.sessions
        if sessions:
            progress, learned, self.files = load_checkpoint(folder / CHECKPOINT)
            write_files({folder / name: content for name, content in self.files.items()})
            self.rows, self.best = read_rows(folder / "progress.csv"), progress.best_cost
            self.began -= progress.seconds
            self.algorithm = make_algorithm(recipe, seed, progress.steps)
            restore(self.algorithm, progress, learned, folder / CHECKPOINT)
            self.saved, self.saved_steps = time.monotonic(), self.steps
        else:
            self.algorithm = make_algorithm(recipe, seed)
            self.save()
        # Made last: a run that is refused leaves no folder.
        self.logger = configure_logger(0, str(folder / "tensorboard"), "run", reset_num_timesteps=False)
        self.algorithm.set_logger(self.logger)
        self.validate_every = max(recipe.steps // 24, VALIDATE_EVERY)
        self._write_settings(sessions)

    @property
    def steps(self) -> int:
        """Environment steps taken."""
        return environment_steps(self.algorithm)

    def learn(self, bar: Any) -> None:
        """Learn to the end, validating and saving on the way; nothing if that is done.

        ``bar`` counts environment steps, as tqdm's does. Ctrl-C ends the run between two updates, with a checkpoint, by
        KeyboardInterrupt.
        """
        bar.update(self.steps - bar.n)
        with deferred_interrupt() as interrupted:
            if self.steps < self.recipe.steps:
                left = -(-(self.recipe.steps - self.steps) // repeat_of(self.recipe))
                fits: list[BaseCallback] = [LearnState()] if isinstance(self.algorithm.policy, Asymmetric) else []
                self.algorithm.learn(left, [*fits, _Watch(self, bar, interrupted)], reset_num_timesteps=False)
            if not self.rows or int(self.rows[-1]["steps"]) < self.steps:
                self.validate(bar)
            if interrupted():
                raise KeyboardInterrupt

    def save(self) -> None:
        """Write a checkpoint, then the files that it holds; only between updates."""
        content = to_bytes(self.algorithm, time.monotonic() - self.began, self.best, self.files)
        write_files({self.folder / name: content for name, content in {CHECKPOINT: content, **self.files}.items()})
        self.saved, self.saved_steps = time.monotonic(), self.steps

    def _hold(self, files: Mapping[Path, bytes]) -> None:
        """Put files of the folder into the next checkpoint."""
        self.files |= {path.name: content for path, content in files.items()}

    def finish(self) -> dict[str, float]:
        """Test the best agent on episodes that did not choose it; the contents of ``summary.json``."""
        path = self.folder / "agent.onnx"
        agent = OnnxPolicy.load(path, self.config)
        figures = validate(agent, self.config, validation.JUDGING)
        summary = {
            "validation_episodes": len(validation.JUDGING),
            "validation_cost": figures.cost,
            "validation_rmse_mm": figures.rmse_mm,
            **{beside(name): judged for name, (_, judged) in self.job.references.items()},
            "pull_step_rms_mm_per_min": figures.pull_step_rms_mm_per_min,
            "failure_rate": figures.failure_rate,
            "chosen_at": agent.contract.training_steps,
            "steps": self.steps,
            "seconds": time.monotonic() - self.began,
        }
        whole_run = replace(agent.contract, training_steps=self.steps)
        self._hold(agent_files(path, agent.content, figures.put_into(whole_run)))
        self._hold({self.folder / "summary.json": to_json(summary)})
        self.save()
        return summary

    def validate(self, bar: Any) -> None:
        """Export the actor as it stands and run the file itself on validation episodes; keep it if it is the best."""
        path, normalisation = self.folder / "agent.onnx", self.algorithm.get_vec_normalize_env()
        agent = to_agent(self.algorithm, self.recipe.name, self.seed, self.config, normalisation, path)
        figures = validate(agent, self.config, validation.PICKING)
        if self.best is None or figures.cost < self.best:
            self.best = figures.cost
            self._hold(agent_files(path, agent.content, figures.put_into(agent.contract)))
        picked = {name: picked for name, (picked, _) in self.job.references.items()}
        row = self.steps, round(time.monotonic() - self.began, 1), *figures, *picked.values()
        self.rows.append(dict(zip((*COLUMNS, *map(beside, picked)), row, strict=True)))
        self._hold({self.folder / "progress.csv": to_csv(self.rows)})
        if self.job.plot:
            from .plot import curves

            self._hold({self.folder / "progress.png": curves({self.recipe.name: [self.rows]})})
        self.save()
        for name, figure in figures._asdict().items():
            self.logger.record(f"validation/{name}", figure)
        others = ", ".join(f"{name} {rmse:.3f}" for name, rmse in picked.items())
        figures_now = f"RMSE {figures.rmse_mm:.3f} mm, {figures.failure_rate:.0%} lost ({others})"
        bar.set_postfix_str(figures_now)
        if not sys.stderr.isatty() and parent_process() is None:  # a log holds lines
            print(f"{self.steps:,} steps: {figures_now}", flush=True)

    def _write_settings(self, sessions: list[dict[str, Any]]) -> None:
        """Write the run's settings; each time it is begun or resumed adds a session."""
        session = {"from_step": self.steps, **provenance()}
        first = sessions[0] if sessions else session
        sessions = [*sessions[:1], *sessions[1:][-MAX_SESSIONS:], session]
        facts = {**identity(self.recipe, self.seed), "steps": self.recipe.steps, **first, "sessions": sessions}
        write_files({self.folder / "settings.json": to_json(facts)})


class _Watch(BaseCallback):
    """Validates, saves and ends a run when it is due; called at every step, never in the middle of an update."""

    def __init__(self, run: Run, bar: Any, interrupted: Callable[[], bool]) -> None:
        super().__init__()
        self.run, self.bar, self.interrupted = run, bar, interrupted
        self.due = run.steps + run.validate_every

    def _on_step(self) -> bool:
        run, interrupted = self.run, self.interrupted()
        self.bar.update(run.steps - self.bar.n)
        if run.steps >= self.due:
            run.validate(self.bar)
            self.due = run.steps + run.validate_every
        if run.steps > run.saved_steps and (interrupted or time.monotonic() >= run.saved + run.job.checkpoint_seconds):
            run.save()
        if interrupted:
            raise KeyboardInterrupt
        return True


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
