"""Training seeds side by side, each a run in its own folder, in processes of this machine or on a cluster."""

import traceback
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from tqdm import tqdm

from cz_gym.errors import CzError
from cz_gym.evaluation.processes import side_by_side
from cz_gym.support.atomic_files import locked

from .run import Job, Run
from .run_files import read_rows


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
