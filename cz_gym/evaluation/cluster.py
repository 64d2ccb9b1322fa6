"""The same work in many processes, here or on a Ray cluster's machines; results in the order they are done."""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from threading import Thread
from typing import Any

import cz_gym
from cz_gym.errors import CzError
from cz_gym.jit.code_hash import hash_files
from cz_gym.processors import processors

from .user_code import PREFIX

NUMBERS = "numpy", "scipy", "numba"
"""Packages whose version the figures may depend on."""
RETRIES = 20
"""Times that a task begins again whose node is lost."""
TIMEOUT = 5.0
"""Longest wait for a cluster's address to answer [s]."""
WAIT = 1.0
"""Longest time between two looks at what is done [s]."""
Look = Callable[[], None]
"""What is called about every second while tasks run."""


def connect(address: str) -> None:
    """Join the Ray cluster at ``HOST:PORT``; "" is one on this machine, begun if there is none.

    Raises CzError if Ray is not installed or finds no cluster there.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise CzError('ray is missing: pip install ".[ray]"') from None
    if not ray.is_initialized():
        host, colon, port = address.rpartition(":")
        try:
            if colon and port.isdecimal():  # where nobody listens, Ray would wait for minutes and then end the process
                socket.create_connection((host, int(port)), TIMEOUT).close()
            ray.init(address=address or None, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError, RuntimeError, OSError, OverflowError) as error:
            raise CzError(f"no Ray cluster at {address or 'this machine'}: {error}") from None


@cache
def software_here() -> str:
    """Version of ``cz_gym``, hash of all its sources, and the versions of :data:`NUMBERS`."""
    specs = [find_spec(name) for name in ("cz_gym", "cz_gym.agents", "cz_gym.baselines")]
    files = [file for spec in specs for file in sorted(Path(str(spec and spec.origin)).parent.rglob("*.py"))]
    return " ".join([cz_gym.__version__, hash_files(files), *map(version, NUMBERS)])


def _same_sources(ours: str, function: Callable[[Any], Any], task: Any) -> Any:
    """Run a task; CzError on a node with another ``cz_gym`` or other :data:`NUMBERS`, whenever it joined."""
    if (theirs := software_here()) != ours:
        raise CzError(f"node {socket.gethostname()} has cz_gym {theirs}, this machine {ours}: install the same")
    return function(task)


def check_shared(folder: Path) -> None:
    """Raise CzError for a node that does not see what is written into a folder here."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy as On

    with tempfile.NamedTemporaryFile(dir=folder) as file:
        for node in (node for node in ray.nodes() if node["Alive"]):
            there = ray.remote(os.path.exists).options(num_cpus=0, scheduling_strategy=On(node["NodeID"], soft=False))
            if not ray.get(there.remote(file.name)):
                place = node["NodeManagerAddress"]
                raise CzError(f"node {place} does not see {folder}: it must be on a file system that all nodes share")


def completed(
    function: Callable[[Any], Any], tasks: Sequence[Any], look: Look | None = None
) -> Iterator[tuple[int, Any]]:
    """Run ``function`` on every task, a processor each: the number of a task and its result, as they come.

    A task whose node is lost runs again elsewhere. What a task raises is raised here, with its traceback.
    """
    import ray

    for name, module in list(sys.modules.items()):
        if name.startswith(PREFIX):  # other machines do not have the user's files
            ray.cloudpickle.register_pickle_by_value(module)
    remote: Any = ray.remote(_same_sources).options(num_cpus=1, max_retries=RETRIES)
    ours = software_here()
    numbers = {remote.remote(ours, function, task): number for number, task in enumerate(tasks)}
    while numbers:
        done, _ = ray.wait(list(numbers), timeout=WAIT)
        for reference in done:
            try:
                result = ray.get(reference)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from error  # whose text has the traceback of the other process
            except ray.exceptions.RayError as error:
                raise CzError(f"the cluster lost a task {RETRIES} times: {error}") from None
            yield numbers.pop(reference), result
        if look:
            look()


def in_processes(
    function: Callable[[Any], Any], tasks: Sequence[Any], look: Look | None = None, processes: int | None = None
) -> Iterator[tuple[int, Any]]:
    """Run tasks as :func:`completed` does, in a pool of processes of this machine (None: one a processor).

    When the caller stops early, or is killed, the pool's processes end; no other process does.
    """
    # Forking would copy the threads of torch and of the native batch in unknown states.
    context = get_context("spawn")
    leash, held = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(
        max(min(processes or processors(), len(tasks)), 1), context, initializer=_end_with, initargs=(leash,)
    )
    try:
        numbers = {pool.submit(function, task): number for number, task in enumerate(tasks)}
        while numbers:
            for each in wait(numbers, WAIT, FIRST_COMPLETED).done:
                yield numbers.pop(each), each.result()
            if look:
                look()
        pool.shutdown()
    except BrokenProcessPool:
        raise CzError("a process was killed: is there enough memory?") from None
    finally:
        held.close()
        pool.shutdown(cancel_futures=True)


def _end_with(leash: Any) -> None:
    """In a process of a pool: leave Ctrl-C to the caller, and end when the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def follow() -> None:
        try:
            leash.recv()
        except EOFError:
            os._exit(1)

    Thread(target=follow, daemon=True).start()
