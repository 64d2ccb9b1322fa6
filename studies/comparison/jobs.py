"""Training runs of a comparison, one after the other or some at once, each kept as it finishes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from tqdm import tqdm

from studies.ablation.rows import Row

from .runs import Plan, read_finished, run_one

Task = tuple[Row, int]
"""A row and a training seed."""


def missing(plan: Plan, tasks: Sequence[Task]) -> list[Task]:
    """Those that are not finished; ValueError if a finished one is of other settings."""
    return [(row, seed) for row, seed in tasks if not read_finished(plan, row, seed)]


def run_all(plan: Plan, tasks: Sequence[Task], jobs: int, kept: Callable[[], None]) -> None:
    """Do the runs, so many at once; ``kept`` is called after each."""
    if jobs == 1:
        for row, seed in tasks:
            print(_run(plan, row, seed), flush=True)
            kept()
        return
    # Forking would copy the threads of torch and of the native batch in unknown states.
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        under_way = [pool.submit(_run, plan, row, seed) for row, seed in tasks]
        try:
            for each in as_completed(under_way):
                print(each.result(), flush=True)
                kept()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _run(plan: Plan, row: Row, seed: int) -> str:
    title = f"{row.name}, seed {seed}"
    with tqdm(total=plan.steps, desc=title, unit="step", unit_scale=True, mininterval=1.0, disable=None) as bar:
        run_one(plan, row, seed, bar)
    return f"{title}: done"
