"""A training run in its folder: it learns, validates, keeps the best agent, and goes on after a stop.

One checkpoint file holds the learner's tensors, the progress and the run's other files; it is replaced at one moment,
and a resumed run writes the other files again from it. Only tensors, numbers and bytes are read back (``torch.load``
with ``weights_only``): hyperparameters are the run's settings. A resumed run goes on from the last checkpoint, not bit
for bit as if it had never stopped.
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
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import parent_process
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import configure_logger
from tqdm import tqdm

from cz_gym.evaluation.parallel import run_parallel
from cz_gym.evaluation.protocol import load_user_object
from cz_gym.sb3 import environment_steps
from cz_gym.support.errors import CzError, software
from cz_gym.support.files import locked, write_files

from . import recipes
from .callbacks import AverageWeights
from .contract import MAX_JSON_BYTES, AgentFileError, OnnxPolicy, agent_files, read_bounded, read_json
from .from_sb3 import to_agent
from .recipes import TrainingConfig, make_algorithm, repeat_of
from .residual import Base

CHECKPOINT = "checkpoint.zip"
"""Name of the checkpoint in a run's folder."""
MAX_BYTES = 64_000_000
"""Largest checkpoint that is read."""
FILES = ("agent.onnx", "agent.json", "progress.csv", "progress.png", "summary.json")
"""Files of a run that its checkpoint may hold."""
VALIDATE_EVERY = 200_000
"""Least number of steps between validations."""
PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "stable-baselines3", "torch", "onnx", "onnxruntime")
"""Packages whose versions a run's settings name."""
SETTINGS = {"algorithm": str, "seed": int, "settings": dict, "steps": int, "sessions": list}
"""Fields of ``settings.json`` that a resumed run reads, and their types."""


class Checkpoint(NamedTuple):
    """Content of a checkpoint file."""

    steps: int
    """Environment steps taken."""
    seconds: float
    """Time spent, over all sessions [s]."""
    best_cost: float | None
    """Least validation cost so far [-]; None before the first."""
    returns: tuple[float, ...]
    """Mean, variance and count of the returns that rewards are normalised with; empty without a VecNormalize."""
    parameters: dict[str, Any]
    """State of each network and optimiser, by name (stable-baselines3's ``get_parameters``)."""
    variables: dict[str, torch.Tensor]
    """Tensors that belong to no network or optimiser, by name."""
    files: dict[str, bytes]
    """The run's other files, by name."""


def to_bytes(
    algorithm: BaseAlgorithm, seconds: float, best_cost: float | None, files: Mapping[str, bytes] | None = None
) -> bytes:
    """Checkpoint of an algorithm, without its replay buffer, and of the run's other files.

    AgentFileError if it learned numbers that are not finite: no run could continue from them.
    """
    variables = {name: attrgetter(name)(algorithm) for name in algorithm._get_torch_save_params()[1]}
    if not all(tensor.isfinite().all() for tensor in (*algorithm.policy.state_dict().values(), *variables.values())):
        raise AgentFileError("the training went wrong: a weight is not finite; the last checkpoint stays")
    env: Any = algorithm.get_vec_normalize_env()
    returns = () if env is None else (env.ret_rms.mean, env.ret_rms.var, env.ret_rms.count)
    checkpoint = Checkpoint(
        environment_steps(algorithm), seconds, best_cost, tuple(map(float, returns)),
        algorithm.get_parameters(), variables, dict(files or {}),
    )  # fmt: skip
    content = io.BytesIO()
    torch.save(checkpoint._asdict(), content)
    return content.getvalue()


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint; AgentFileError if that cannot be done."""
    content = io.BytesIO(read_bounded(path, MAX_BYTES))
    try:
        with zipfile.ZipFile(content) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("packed members could be larger than the file")
        content.seek(0)
        checkpoint = Checkpoint(**torch.load(content, map_location="cpu", weights_only=True))
        numbers = (checkpoint.steps, checkpoint.seconds, checkpoint.best_cost or 0.0, *checkpoint.returns)
        files, known = checkpoint.files.items(), len(numbers) in (3, 6) and all(map(math.isfinite, numbers))
        if not known or type(checkpoint.steps) is not int or checkpoint.steps < 0:
            raise ValueError("does not say where the run stood")
        if not all(name in FILES and isinstance(member, bytes) for name, member in files):
            raise ValueError("holds files that no run writes")
    except Exception:  # a damaged file makes zipfile and torch raise whatever they like
        raise AgentFileError(f"{path}: not a checkpoint of this release, or damaged") from None
    return checkpoint


def restore(algorithm: BaseAlgorithm, checkpoint: Checkpoint, path: Path) -> None:
    """Put a checkpoint into an algorithm made with the same settings; AgentFileError if it does not fit."""
    env: Any = algorithm.get_vec_normalize_env()
    try:
        algorithm.set_parameters(checkpoint.parameters, exact_match=True, device="cpu")
        with torch.no_grad():
            for name in algorithm._get_torch_save_params()[1]:
                attrgetter(name)(algorithm).copy_(checkpoint.variables[name])
        if env is not None:
            env.ret_rms.mean, env.ret_rms.var, env.ret_rms.count = map(np.float64, checkpoint.returns)
    except Exception:  # torch raises whatever it likes where names, types or shapes differ
        raise AgentFileError(f"{path}: does not fit this run's settings") from None


@dataclass
class TrainingRun:
    """The run of one training seed in its folder, continued from the checkpoint there.

    A value names the run and its settings, and pickles; :meth:`train` makes the learner and trains it. Raises
    AgentFileError if the folder cannot be used.
    """

    folder: Path
    recipe: TrainingConfig
    seed: int
    references: recipes.References
    """RMSEs of classical controllers on the same crystals, shown beside the agent's."""
    checkpoint_seconds: float = 60.0
    """Longest time between checkpoints, apart from validations and updates in between [s]."""
    plot: bool = False
    """True if the progress is drawn into the folder."""
    callbacks: tuple[str, ...] = ()
    """Places FILE.py:NAME of the user's callbacks."""
    base: Base | None = None
    """Controller that the agent adds to; None if it acts alone."""
    files: dict[str, bytes] = field(default_factory=dict, init=False, repr=False)
    """The run's other files as the next checkpoint holds them."""
    rows: list[dict[str, Any]] = field(default_factory=list, init=False, repr=False)
    """Rows of ``progress.csv``."""
    best_cost: float | None = field(default=None, init=False)
    algorithm: BaseAlgorithm = field(init=False, repr=False)
    averaged: AverageWeights | None = field(default=None, init=False, repr=False)
    """Mean of the weights that the kept agent has; None if it has the last ones."""

    @property
    def sessions(self) -> list[dict[str, Any]]:
        """Sessions of the run in its folder, empty before the first; AgentFileError if that is another run."""
        path = self.folder / "settings.json"
        if not path.exists():
            return []
        saved = read_settings(path)
        for name, value in self._identity().items():
            if saved.get(name) != value:
                raise AgentFileError(f"{path}: the run was begun with another {name}; resume it with the same options")
        return list(saved["sessions"])

    @property
    def summary(self) -> dict[str, float] | None:
        """Content of ``summary.json``; None before the run's end."""
        path = self.folder / "summary.json"
        saved = read_json(path) if self.sessions and path.exists() else None
        steps = saved.get("steps") if isinstance(saved, dict) else None
        return saved if isinstance(steps, int) and steps >= self.recipe.steps else None

    @property
    def steps(self) -> int:
        """Environment steps taken."""
        return int(self.algorithm.num_timesteps) * repeat_of(self.recipe)

    def train(self, bar: Any = None) -> dict[str, float]:
        """Train to the end, from the checkpoint if there is one; returns the content of ``summary.json``.

        ``bar`` is tqdm's and counts environment steps. Ctrl-C ends the run between two updates, with a checkpoint, by
        KeyboardInterrupt.
        """
        with locked(self.folder):
            if summary := self.summary:
                return summary
            bar = tqdm(disable=True) if bar is None else bar
            bar.set_description("compiling")
            self.begin()
            self.learn(bar)
            bar.set_description("testing the best agent")
            return self.finish()

    def begin(self) -> None:
        """Make the learner, as it stands in the checkpoint if there is one, and write the settings."""
        self.began, sessions = time.monotonic(), self.sessions
        if sessions:
            checkpoint = load_checkpoint(self.folder / CHECKPOINT)
            self.files, self.best_cost = checkpoint.files, checkpoint.best_cost
            write_files({self.folder / name: content for name, content in self.files.items()})
            self.rows = read_rows(self.folder / "progress.csv")
            self.began -= checkpoint.seconds
            self.algorithm = make_algorithm(self.recipe, self.seed, checkpoint.steps, self.base)
            restore(self.algorithm, checkpoint, self.folder / CHECKPOINT)
            self.saved, self.saved_steps = time.monotonic(), self.steps
        else:
            self.algorithm = make_algorithm(self.recipe, self.seed, 0, self.base)
            self.save()
        # Made last: a run that is refused leaves no folder.
        self.logger = configure_logger(0, str(self.folder / "tensorboard"), "run", reset_num_timesteps=False)
        self.algorithm.set_logger(self.logger)
        command = " ".join([Path(sys.executable).name, Path(sys.argv[0]).name, *sys.argv[1:]])
        session = {"from_step": self.steps, "command": command, "git_commit": _git_commit(), **software(PACKAGES)}
        first = sessions[0] if sessions else session
        facts = {**self._identity(), "steps": self.recipe.steps, **first, "sessions": [*sessions, session]}
        write_files({self.folder / "settings.json": _to_json(facts)})

    def learn(self, bar: Any) -> None:
        """Learn to the end, validating and saving on the way; nothing if that is done."""
        bar.update(self.steps - bar.n)
        with deferred_interrupt() as interrupted:
            if self.steps < self.recipe.steps:
                left = -(-(self.recipe.steps - self.steps) // repeat_of(self.recipe))
                fits = self.recipe.own_callbacks
                if self.recipe.average:
                    self.averaged = AverageWeights(self.recipe.average * self.recipe.updates)
                    fits.append(self.averaged)
                fits += map(load_callback, self.callbacks)
                self.algorithm.learn(left, [*fits, _Watch(self, bar, interrupted)], reset_num_timesteps=False)
            if not self.rows or int(self.rows[-1]["steps"]) < self.steps:
                self.validate(bar)
            if interrupted():
                raise KeyboardInterrupt

    def save(self) -> None:
        """Write a checkpoint, then the files that it holds; only between updates."""
        content = to_bytes(self.algorithm, time.monotonic() - self.began, self.best_cost, self.files)
        write_files({self.folder / name: content for name, content in {CHECKPOINT: content, **self.files}.items()})
        self.saved, self.saved_steps = time.monotonic(), self.steps

    def validate(self, bar: Any) -> None:
        """Export the actor as it stands and run the file itself on validation episodes; keep it if it is the best."""
        path, config = self.folder / "agent.onnx", self.recipe.config
        bar.set_description("validating")
        normalisation = self.algorithm.get_vec_normalize_env()
        with self.averaged.applied() if self.averaged else nullcontext():
            agent = to_agent(self.algorithm, self.recipe.name, self.seed, config, normalisation, path)
        figures = recipes.validate(agent, config, recipes.SELECTION_SEEDS)
        if self.best_cost is None or figures.cost < self.best_cost:
            self.best_cost = figures.cost
            self._keep_agent(agent, figures)
        picked = {name: rmse_mm for name, (rmse_mm, _) in self.references.items()}
        row = self.steps, round(time.monotonic() - self.began, 1), *figures, *picked.values()
        names = (*recipes.COLUMNS, *map(recipes.reference_column, picked))
        self.rows.append(dict(zip(names, row, strict=True)))
        text = io.StringIO()
        writer = csv.DictWriter(text, fieldnames=names)
        writer.writeheader()
        writer.writerows(self.rows)
        self.files["progress.csv"] = text.getvalue().encode()
        if self.plot:
            self.files["progress.png"] = recipes.curves({self.recipe.name: [self.rows]})
        self.save()
        for name, figure in figures._asdict().items():
            self.logger.record(f"validation/{name}", figure)
        figures_now = f"{figures.rmse_mm:.3f} mm, {figures.failure_rate:.0%} lost"
        bar.set_description("learning", refresh=False)
        bar.set_postfix_str(figures_now)
        if not sys.stderr.isatty() and parent_process() is None:  # a log holds lines
            left = (self.recipe.steps / self.steps - 1.0) * (time.monotonic() - self.began)
            others = ", ".join(f"{name} {rmse:.3f}" for name, rmse in picked.items())
            print(f"{self.steps:,} steps: {figures_now} ({others}); {tqdm.format_interval(left)} left", flush=True)

    def finish(self) -> dict[str, float]:
        """Test the best agent on episodes that did not choose it; returns the content of ``summary.json``."""
        agent = OnnxPolicy.load(self.folder / "agent.onnx", self.recipe.config, self.base)
        figures = recipes.validate(agent, self.recipe.config, recipes.JUDGING_SEEDS)
        summary = {
            "validation_episodes": len(recipes.JUDGING_SEEDS),
            "validation_cost": figures.cost,
            "validation_rmse_mm": figures.rmse_mm,
            **{recipes.reference_column(name): judged for name, (_, judged) in self.references.items()},
            "pull_step_rms_mm_per_min": figures.pull_step_rms_mm_per_min,
            "failure_rate": figures.failure_rate,
            "chosen_at": agent.contract.training_steps,
            "steps": self.steps,
            "seconds": time.monotonic() - self.began,
        }
        self._keep_agent(agent, figures)
        self.files["summary.json"] = _to_json(summary)
        self.save()
        return summary

    def poll_progress(self) -> tuple[float, str]:
        """Share of the run that was done at its last validation [-], and a few words on it."""
        rows = read_rows(self.folder / "progress.csv")
        if not rows:
            return 0.0, f"{self.seed}: 0%"
        share = min(float(rows[-1]["steps"]) / self.recipe.steps, 1.0)
        return share, f"{self.seed}: {share:.0%} {float(rows[-1]['validation_rmse_mm']):.3f} mm"

    def _keep_agent(self, agent: OnnxPolicy, figures: recipes.Validation) -> None:
        """Put an agent with its figures into the next checkpoint."""
        contract = figures.put_into(replace(agent.contract, training_steps=self.steps + self.recipe.steps_before))
        files = agent_files(self.folder / "agent.onnx", agent.content, contract)
        self.files |= {path.name: content for path, content in files.items()}

    def _identity(self) -> dict[str, Any]:
        """Settings that a resumed run must share with the one that was begun; it may be longer."""
        fields = asdict(self.recipe).items()
        settings = {name: value for name, value in fields if name != "steps" and value not in ("", ())}
        return {
            "algorithm": self.recipe.name,
            "seed": self.seed,
            "settings": json.loads(json.dumps(settings)),
            "plant_hash": self.recipe.config.plant_hash,
            "scenario_hash": self.recipe.config.scenario.hash,
        }


def load_callback(place: str) -> BaseCallback:
    """The callback at ``FILE.py:NAME``, made if that is a class or a function; CzError if it is none."""

    def fits(value: Any, _: str) -> bool:
        return isinstance(value, BaseCallback) or (isinstance(value, type) and issubclass(value, BaseCallback))

    _, found = load_user_object(place, "callback", fits)
    made = found() if callable(found) else found
    if not isinstance(made, BaseCallback):
        raise CzError(f"{place}: no callback: a {type(made).__name__}, not a BaseCallback of stable-baselines3")
    return made


class _Watch(BaseCallback):
    """Validates, saves and ends a run when it is due; called at every step, never in the middle of an update."""

    def __init__(self, run: TrainingRun, bar: Any, interrupted: Callable[[], bool]) -> None:
        super().__init__()
        self.run, self.bar, self.interrupted = run, bar, interrupted
        self.every = max(run.recipe.steps // 24, VALIDATE_EVERY)
        self.due = run.steps + self.every

    def _on_step(self) -> bool:
        run, interrupted = self.run, self.interrupted()
        if not self.bar.n:
            self.bar.set_description("learning", refresh=False)
        self.bar.update(run.steps - self.bar.n)
        if run.steps >= self.due:
            run.validate(self.bar)
            self.due = run.steps + self.every
        if run.steps > run.saved_steps and (interrupted or time.monotonic() >= run.saved + run.checkpoint_seconds):
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


def read_settings(path: Path) -> dict[str, Any]:
    """Read ``settings.json``; AgentFileError unless a run wrote it."""
    try:
        saved = read_json(path)
        sound = all(type(saved[name]) is kind for name, kind in SETTINGS.items()) and 0 < saved["steps"] < 2**63
        if not sound or not saved["sessions"] or not all(isinstance(session, dict) for session in saved["sessions"]):
            raise KeyError
    except (AgentFileError, KeyError, TypeError, IndexError):
        raise AgentFileError(f"{path}: missing or damaged, so there is nothing to resume") from None
    return dict(saved)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of ``progress.csv``; none without a file. AgentFileError if no run wrote it."""
    if not path.exists():
        return []
    try:
        rows = list(csv.DictReader(io.StringIO(read_bounded(path, MAX_JSON_BYTES).decode(), newline="")))
        columns = list(recipes.COLUMNS)
        named = all(list(row)[: len(columns)] == columns for row in rows)
        if not named or not all(math.isfinite(float(value)) for row in rows for value in row.values()):
            raise ValueError
    except (ValueError, TypeError, csv.Error):
        raise AgentFileError(f"{path}: damaged; without it the run can be resumed") from None
    return rows


def _git_commit() -> str | None:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _to_json(content: Any) -> bytes:
    return (json.dumps(content, indent=2) + "\n").encode()


# Training seeds in parallel, each a run in its own folder, in processes of this machine or on a cluster.


def _try_training(run: TrainingRun) -> dict[str, float] | Exception:
    """Summary of a run, or the exception that ended it: it stops no other run."""
    try:
        return run.train()
    except CzError as error:
        return error
    except Exception as error:
        error.add_note(traceback.format_exc())  # a traceback itself does not reach another process
        return error


def train_seeds(
    runs: Sequence[TrainingRun], bar: Any, cluster: str | None = None
) -> Iterator[tuple[TrainingRun, dict[str, float]]]:
    """Train the runs that are not finished; yields each with its summary. ``bar`` is tqdm's and counts runs.

    Once the others are done, CzError names the seeds that failed; any other exception of a seed is raised as it is.
    """

    def poll_progress() -> None:
        shares, lines = zip(*(run.poll_progress() for run in runs), strict=True)
        bar.set_postfix_str("  ".join(lines), refresh=False)
        bar.update(sum(shares) - bar.n)

    missing, failed = list[TrainingRun](), dict[int, Exception]()
    for run in runs:
        if summary := run.summary:
            yield run, summary
        else:
            missing.append(run)
    shared = runs[0].folder.parent
    for number, result in run_parallel(_try_training, missing, poll_progress, cluster, shared):
        if isinstance(result, Exception):
            failed[missing[number].seed] = result
        else:
            yield missing[number], result
    poll_progress()
    for seed, error in failed.items():
        if not isinstance(error, CzError):
            error.add_note(f"seed {seed}")
            raise error
    if failed:
        raise CzError("; ".join(f"seed {seed}: {error}" for seed, error in failed.items()))
