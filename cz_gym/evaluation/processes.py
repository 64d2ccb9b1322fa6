"""One function on many tasks, through any executor: in several processes of this machine, or on a cluster."""

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from threading import Thread
from typing import Any

from cz_gym.errors import CzError
from cz_gym.support.processors import processors

WAIT = 1.0
"""Longest time between two calls of :data:`Look` [s], a function that is called while tasks run."""
Look = Callable[[], None]


def through(
    executor: Executor, function: Callable[[Any], Any], tasks: Sequence[Any], look: Look | None = None
) -> Iterator[tuple[int, Any]]:
    """Run ``function`` on every task by an executor; yields the number of a task and its result, as they come.

    Function, tasks and results must pickle. The exception of a task is raised here.
    """
    with _uninterrupted():
        numbers = {executor.submit(function, task): number for number, task in enumerate(tasks)}
    while numbers:
        for each in wait(numbers, WAIT, FIRST_COMPLETED).done:
            yield numbers.pop(each), each.result()
        if look:
            look()


def in_processes(
    function: Callable[[Any], Any], tasks: Sequence[Any], look: Look | None = None, processes: int | None = None
) -> Iterator[tuple[int, Any]]:
    """Run tasks as :func:`through` does, in a pool of processes (None: one a processor) that ends with its caller."""
    # Forking would copy the threads of torch and of the native batch in unknown states.
    context = get_context("spawn")
    leash, held = context.Pipe(duplex=False)
    workers = max(min(processes or processors(), len(tasks)), 1)
    pool = ProcessPoolExecutor(workers, context, initializer=_end_with, initargs=(leash,))
    try:
        yield from through(pool, function, tasks, look)
        pool.shutdown()
    except BrokenProcessPool:
        raise CzError("a process was killed: is there enough memory?") from None
    finally:
        held.close()
        pool.shutdown(cancel_futures=True)


def side_by_side(
    function: Callable[[Any], Any],
    tasks: Sequence[Any],
    look: Look | None = None,
    cluster: str | None = None,
    shared: Path | None = None,
    processes: int | None = None,
) -> Iterator[tuple[int, Any]]:
    """Run tasks as :func:`through` does, on the cluster at that address, or in processes of this machine.

    ``shared`` is the folder that tasks write into.
    """
    if not cluster:
        yield from in_processes(function, tasks, look, processes)
    elif tasks:
        on_cluster = import_module("cz_gym.evaluation.cluster").on_cluster
        yield from on_cluster(cluster, function, tasks, look, shared)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Ctrl-C waits till the end, and never comes to processes that start here: their imports would show a traceback."""
    mask: Any = getattr(signal, "pthread_sigmask", lambda *_: None)  # Windows has none
    before = mask(getattr(signal, "SIG_BLOCK", 0), {signal.SIGINT})
    try:
        yield
    finally:
        mask(getattr(signal, "SIG_SETMASK", 0), before)


def _end_with(leash: Any) -> None:
    """In a process of a pool: leave Ctrl-C to the caller, and end when the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def follow() -> None:
        try:
            leash.recv()
        except EOFError:
            os._exit(1)

    Thread(target=follow, daemon=True).start()
