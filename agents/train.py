"""Checkpoints: algorithm, best agent and progress in one file, a model of stable-baselines3 with a few members more.

One file is replaced at one moment, and a resumed run writes the run's other files again from it. Only tensors are read
from the model (``torch.load`` with ``weights_only``), never pickled objects: hyperparameters are the run's settings.
"""

import csv
import io
import json
import math
import signal
import subprocess
import sys
import threading
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from multiprocessing import parent_process
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import load_from_zip_file, save_to_zip_file
from stable_baselines3.common.utils import configure_logger
from tqdm import tqdm

from cz_gym.evaluation.parallel import side_by_side
from cz_gym.sb3 import environment_steps
from cz_gym.support.errors import CzError
from cz_gym.support.files import locked, write_files
from cz_gym.support.names import software

from . import validation
from .asymmetric import Asymmetric, LearnState
from .contract import MAX_JSON_BYTES, AgentFileError, agent_files, read_bounded, read_json
from .export import to_agent
from .policy import OnnxPolicy
from .recipes import Recipe, make_algorithm, repeat_of
from .validation import COLUMNS, References, beside, validate

PROGRESS = "cz-gym-checkpoint-6.json"
"""Member that holds :class:`Progress`; its name says the format's version."""
MAX_BYTES = 64_000_000
"""Largest checkpoint that is read."""
FILES = ("agent.onnx", "agent.json", "progress.csv", "progress.png", "summary.json")
"""Files of a run that its checkpoint may hold."""


class Progress(NamedTuple):
    """The state of a training run beside its algorithm's tensors."""

    steps: int
    """Environment steps taken."""
    seconds: float
    """Time spent, over all sessions [s]."""
    best_cost: float | None
    """Least validation cost so far [-]; None before the first."""
    returns: tuple[float, ...]
    """Mean, variance and count of the returns that rewards are normalised with; empty without a VecNormalize."""


class Learned(NamedTuple):
    """The tensors of an algorithm that training changes."""

    states: dict[str, Any]
    """State of each network and optimiser, by name."""
    variables: dict[str, torch.Tensor]
    """Tensors that belong to none of them, by name."""


def to_bytes(
    algorithm: BaseAlgorithm, seconds: float, best_cost: float | None, files: Mapping[str, bytes] | None = None
) -> bytes:
    """The checkpoint of an algorithm, without its replay buffer, and the run's ``files`` by name.

    AgentFileError if it learned numbers that are not finite: no run could continue from them.
    """
    lone = algorithm._get_torch_save_params()[1]
    learned = Learned(algorithm.get_parameters(), {name: attrgetter(name)(algorithm) for name in lone})
    if not all(tensor.isfinite().all() for tensor in _tensors(learned)):
        raise AgentFileError("the training went wrong: a weight is not finite; the last checkpoint stays")
    env: Any = algorithm.get_vec_normalize_env()
    returns = (
        () if env is None else tuple(float(each) for each in (env.ret_rms.mean, env.ret_rms.var, env.ret_rms.count))
    )
    progress = Progress(environment_steps(algorithm), seconds, best_cost, returns)
    content = io.BytesIO()
    save_to_zip_file(content, params=learned.states, pytorch_variables=learned.variables)
    with zipfile.ZipFile(content, "a") as archive:
        for name, member in {PROGRESS: json.dumps(progress._asdict()).encode(), **(files or {})}.items():
            archive.writestr(name, member)
    return content.getvalue()


def load_checkpoint(path: Path) -> tuple[Progress, Learned, dict[str, bytes]]:
    """Progress, tensors and the run's files of a checkpoint; AgentFileError if it cannot be read."""
    content = io.BytesIO(read_bounded(path, MAX_BYTES))
    try:
        with zipfile.ZipFile(content) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("packed members could be larger than the file")
            progress = Progress(**json.loads(archive.read(PROGRESS)))
            numbers = (progress.steps, progress.seconds, progress.best_cost or 0.0, *progress.returns)
            if type(progress.steps) is not int or not all(map(math.isfinite, numbers)) or len(numbers) not in (3, 6):
                raise ValueError("does not say where the run stood")
            files = {name: archive.read(name) for name in FILES if name in archive.namelist()}
        _, states, variables = load_from_zip_file(content, load_data=False, device="cpu")
    except Exception:  # a damaged file makes zipfile, json and torch raise whatever they like
        raise AgentFileError(f"{path}: not a checkpoint of this release, or damaged") from None
    return progress, Learned(states, variables or {}), files


def restore(algorithm: BaseAlgorithm, progress: Progress, learned: Learned, path: Path) -> None:
    """Put a checkpoint into an algorithm made with the same settings; AgentFileError if it does not fit."""
    env: Any = algorithm.get_vec_normalize_env()
    try:
        algorithm.set_parameters(learned.states, exact_match=True, device="cpu")
        with torch.no_grad():
            for name in algorithm._get_torch_save_params()[1]:
                attrgetter(name)(algorithm).copy_(learned.variables[name])
        if env is not None:
            env.ret_rms.mean, env.ret_rms.var, env.ret_rms.count = map(np.float64, progress.returns)
    except Exception:  # torch raises whatever it likes where names, types or shapes differ
        raise AgentFileError(f"{path}: does not fit this run's settings") from None


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    """Every tensor of floats inside nested mappings and sequences."""
    if isinstance(value, torch.Tensor):
        yield from [value] if value.is_floating_point() else []
    elif isinstance(value, (Mapping, list, tuple)):
        for each in value.values() if isinstance(value, Mapping) else value:
            yield from _tensors(each)


# The files of a run's folder beside its checkpoint: settings with provenance, and the progress of validations.

PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "stable-baselines3", "torch", "onnx", "onnxruntime")
SETTINGS = {"algorithm": str, "seed": int, "settings": dict, "steps": int, "sessions": list}
"""Fields of ``settings.json`` that a resumed run reads, and their types."""


def check_settings(folder: Path, recipe: Recipe, seed: int) -> list[dict[str, Any]]:
    """The sessions of the run in this folder; AgentFileError if it is another run."""
    path = folder / "settings.json"
    saved = read_settings(path)
    for name, value in identity(recipe, seed).items():
        if saved.get(name) != value:
            raise AgentFileError(f"{path}: the run was begun with another {name}; resume it with the same options")
    return list(saved["sessions"])


def identity(recipe: Recipe, seed: int) -> dict[str, Any]:
    """The settings that a resumed run must share with the one that was begun; it may be longer."""
    settings = {name: value for name, value in asdict(recipe).items() if name != "steps" and value not in ("", ())}
    return {
        "algorithm": recipe.name,
        "seed": seed,
        "settings": json.loads(json.dumps(settings)),
        "plant_hash": recipe.config.plant_hash,
        "scenario_hash": recipe.config.scenario.hash,
    }


def read_settings(path: Path) -> dict[str, Any]:
    """The contents of ``settings.json``; AgentFileError unless a run wrote it."""
    try:
        saved = read_json(path)
        sound = all(type(saved[name]) is kind for name, kind in SETTINGS.items()) and 0 < saved["steps"] < 2**63
        if not sound or not saved["sessions"] or not all(isinstance(session, dict) for session in saved["sessions"]):
            raise KeyError
    except (AgentFileError, KeyError, TypeError, IndexError):
        raise AgentFileError(f"{path}: missing or damaged, so there is nothing to resume") from None
    return dict(saved)


def provenance() -> dict[str, Any]:
    """The command, and the software it runs on: git commit, Python, packages."""
    command = " ".join([Path(sys.executable).name, Path(sys.argv[0]).name, *sys.argv[1:]])
    return {"command": command, "git_commit": _git_commit(), **software(PACKAGES)}


def _git_commit() -> str | None:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def to_json(content: Any) -> bytes:
    """The contents of a JSON file."""
    return (json.dumps(content, indent=2) + "\n").encode()


def to_csv(rows: Sequence[dict[str, Any]]) -> bytes:
    """The contents of a CSV file, as ``progress.csv``: a line a validation."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of ``progress.csv``; none without a file. AgentFileError if no run wrote it."""
    if not path.exists():
        return []
    try:
        rows = list(csv.DictReader(io.StringIO(read_bounded(path, MAX_JSON_BYTES).decode(), newline="")))
        named = all(list(row)[: len(COLUMNS)] == list(COLUMNS) for row in rows)
        if not named or not all(math.isfinite(float(value)) for row in rows for value in row.values()):
            raise ValueError
    except (ValueError, TypeError, csv.Error):
        raise AgentFileError(f"{path}: damaged; without it the run can be resumed") from None
    return rows


# A training run in its folder: settings and provenance, checkpoints, the best agent so far, progress.

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
            from .validation import curves

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


# Training seeds side by side, each a run in its own folder, in processes of this machine or on a cluster.


def train_seed(job: Job, bar: Any = None) -> dict[str, float]:
    """Train a seed to its end, from its checkpoint if there is one; the contents of ``summary.json``.

    ``bar`` is tqdm's and counts environment steps.
    """
    with locked(job.folder):
        if summary := job.summary:
            return summary
        run = Run(job)
        run.learn(tqdm(disable=True) if bar is None else bar)
        return run.finish()


def _tried(train: Callable[[Job], dict[str, float]], job: Job) -> dict[str, float] | Exception:
    """The summary of a seed, or the exception that ended its training: it stops no other seed."""
    try:
        return train(job)
    except CzError as error:
        return error
    except Exception as error:
        error.add_note(traceback.format_exc())  # a traceback itself does not reach another process
        return error


def train_seeds(jobs: Sequence[Job], bar: Any, cluster: str | None = None) -> Iterator[tuple[Job, dict[str, float]]]:
    """Train the seeds that are not finished; yields each with its summary. ``bar`` is tqdm's and counts seeds.

    Once the others are done, CzError names the seeds that failed; any other exception of a seed is raised as it is.
    """

    def look() -> None:
        shares, lines = zip(*map(_standing, jobs), strict=True)
        bar.set_postfix_str("  ".join(lines), refresh=False)
        bar.update(sum(shares) - bar.n)

    missing, failed = list[Job](), dict[int, Exception]()
    for job in jobs:
        if summary := job.summary:
            yield job, summary
        else:
            missing.append(job)
    shared = jobs[0].folder.parent
    for number, result in side_by_side(partial(_tried, train_seed), missing, look, cluster, shared):
        if isinstance(result, Exception):
            failed[missing[number].seed] = result
        else:
            yield missing[number], result
    look()
    for seed, error in failed.items():
        if not isinstance(error, CzError):
            error.add_note(f"seed {seed}")
            raise error
    if failed:
        raise CzError("; ".join(f"seed {seed}: {error}" for seed, error in failed.items()))


def _standing(job: Job) -> tuple[float, str]:
    """The share of a run that was done at its last validation [-], and a few words on it."""
    rows = read_rows(job.folder / "progress.csv")
    if not rows:
        return 0.0, f"{job.seed}: 0%"
    share = min(float(rows[-1]["steps"]) / job.recipe.steps, 1.0)
    return share, f"{job.seed}: {share:.0%} {float(rows[-1]['validation_rmse_mm']):.3f} mm"
