"""One function on many tasks, through any executor: in several processes of this machine, or on a cluster."""

import os
import platform
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from threading import Thread
from typing import Any

from cz_gym.config import make_config
from cz_gym.engine.batch import processors
from cz_gym.support.errors import CzError

WAIT = 1.0
"""Longest time between two calls of :data:`PollProgress` [s]."""
PollProgress = Callable[[], None]
"""A function that is called while tasks run, to show their progress."""


def run_tasks(
    executor: Executor, function: Callable[[Any], Any], tasks: Sequence[Any], poll_progress: PollProgress | None = None
) -> Iterator[tuple[int, Any]]:
    """Run ``function`` on every task by an executor; yields the number of a task and its result, as they come.

    Function, tasks and results must pickle. The exception of a task is raised here.
    """
    with _uninterrupted():
        numbers = {executor.submit(function, task): number for number, task in enumerate(tasks)}
    while numbers:
        for each in wait(numbers, WAIT, FIRST_COMPLETED).done:
            yield numbers.pop(each), each.result()
        if poll_progress:
            poll_progress()


def in_processes(
    function: Callable[[Any], Any],
    tasks: Sequence[Any],
    poll_progress: PollProgress | None = None,
    processes: int | None = None,
) -> Iterator[tuple[int, Any]]:
    """Run tasks as :func:`run_tasks` does, in a pool of processes (None: one a processor) that ends with its caller."""
    # Forking would copy the threads of torch and of the native batch in unknown states.
    context = get_context("spawn")
    parent_pipe, held = context.Pipe(duplex=False)
    workers = max(min(processes or processors(), len(tasks)), 1)
    pool = ProcessPoolExecutor(workers, context, initializer=_end_with, initargs=(parent_pipe,))
    try:
        yield from run_tasks(pool, function, tasks, poll_progress)
        pool.shutdown()
    except BrokenProcessPool:
        raise CzError("a process was killed: is there enough memory?") from None
    finally:
        held.close()
        pool.shutdown(cancel_futures=True)


def run_parallel(
    function: Callable[[Any], Any],
    tasks: Sequence[Any],
    poll_progress: PollProgress | None = None,
    cluster: str | None = None,
    shared: Path | None = None,
    processes: int | None = None,
) -> Iterator[tuple[int, Any]]:
    """Run tasks as :func:`run_tasks` does, on the cluster at that address, or in processes of this machine.

    ``shared`` is the folder that tasks write into.
    """
    if not cluster:
        yield from in_processes(function, tasks, poll_progress, processes)
    elif tasks:
        yield from on_cluster(cluster, function, tasks, poll_progress, shared)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Postpone Ctrl-C to the end of the block; processes that start in it ignore it."""
    mask: Any = getattr(signal, "pthread_sigmask", lambda *_: None)  # Windows has none
    before = mask(getattr(signal, "SIG_BLOCK", 0), {signal.SIGINT})
    try:
        yield
    finally:
        mask(getattr(signal, "SIG_SETMASK", 0), before)


def _end_with(parent_pipe: Any) -> None:
    """Set up a worker process: it ignores Ctrl-C, and ends when the caller's end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def follow() -> None:
        try:
            parent_pipe.recv()
        except EOFError:
            os._exit(1)

    Thread(target=follow, daemon=True).start()


# Tasks on the workers of a Dask cluster (extra ``cluster``): any number of machines, or processes of this one.

ANSWER = 20.0
"""Longest wait for the scheduler, and for its first worker [s]."""
COMPUTING = "cz_gym", "numpy", "scipy", "numba"
"""Packages whose versions must be alike: numbers depend on them."""
Versions = dict[str, str]


@cache
def versions() -> Versions:
    """Return the versions of what numbers depend on, in this process."""
    packages = {name: str(import_module(name).__version__) for name in COMPUTING}
    return {"python": platform.python_version(), **packages, "plant_hash": make_config().plant_hash}


class OnWorker:
    """A function that a worker runs only if its versions are those of the process that asks."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function, self.asked = function, versions()

    def __call__(self, task: Any) -> Any:
        """Run a task; CzError where a version differs."""
        check_versions(platform.node(), versions(), self.asked)
        return self.function(task)


def check_versions(where: str, own: Versions, asked: Versions) -> None:
    """Raise CzError, which names every version of a worker that is not the one asked for."""
    differ = [f"{name} {own.get(name)}, here {asked[name]}" for name in asked if own.get(name) != asked[name]]
    if differ:
        raise CzError(f"worker {where} has other versions, so its numbers would differ: {'; '.join(differ)}")


def on_cluster(
    address: str,
    function: Callable[[Any], Any],
    tasks: Any,
    poll_progress: PollProgress | None = None,
    shared: Path | None = None,
) -> Iterator[tuple[int, Any]]:
    """Run tasks as :func:`run_tasks` does, on the workers of the scheduler at ``address``, tcp://HOST:8786.

    Every worker must have the same versions, one thread, and see the folder ``shared``; CzError otherwise. The task of
    a worker that dies is run again by another one; tasks that are left are cancelled when the caller stops.
    """
    distributed = import_module("distributed")
    with _client(distributed, address) as client:
        _check_workers(client, shared)
        executor = client.get_executor(pure=False)
        try:
            yield from run_tasks(executor, OnWorker(function), tasks, poll_progress)
        except distributed.scheduler.KilledWorker:
            raise CzError("a task has ended one worker after the other: is there enough memory?") from None
        finally:
            executor.shutdown(wait=False)


@contextmanager
def _client(distributed: Any, address: str) -> Iterator[Any]:
    """Connect to the scheduler; CzError if none answers, or no worker comes."""

    class Client(distributed.Client):  # type: ignore[misc]
        """Closes where it does not connect: as garbage it would wait for a lock that the next client's start holds."""

        def start(self, **settings: Any) -> None:
            try:
                super().start(**settings)
            except BaseException:
                with suppress(Exception):
                    self.close()
                raise

    try:
        client = Client(address, timeout=ANSWER, set_as_default=False)
    except (OSError, ValueError, AssertionError) as error:  # asserted: the loop's thread runs within ten seconds
        why = str(error) or "this computer is too busy to ask"
        raise CzError(f"no Dask scheduler answers at {address!r}, an address such as tcp://HOST:8786: {why}") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=ANSWER)
        except TimeoutError:
            raise CzError(f"the scheduler at {address} has no workers: dask worker {address} --nthreads 1") from None
        yield client


def _check_workers(client: Any, shared: Path | None) -> None:
    """Raise CzError for a worker on which tasks would fail, or give other numbers."""
    for worker, facts in client.scheduler_info(n_workers=-1)["workers"].items():
        if facts["nthreads"] != 1:
            raise CzError(f"worker {worker} has {facts['nthreads']} threads: start it with --nthreads 1")
    try:
        theirs = client.run(versions)
    except (ImportError, AttributeError) as error:
        raise CzError(f"the workers have no cz_gym, or another one: {error}") from None
    for worker, own in theirs.items():
        check_versions(worker, own, versions())
    if shared:
        shared.mkdir(parents=True, exist_ok=True)
    for worker, sees in client.run(os.path.isdir, str(shared)).items() if shared else ():
        if not sees:
            raise CzError(f"worker {worker} does not see {shared}: name a folder that all machines share")
