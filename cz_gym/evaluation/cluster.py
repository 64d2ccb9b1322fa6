"""The same work in many processes, here or on a Ray cluster's machines; results in the order they are done."""

from __future__ import annotations

import hashlib
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
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any

import cz_gym
from cz_gym.errors import CzError
from cz_gym.processors import processors

from .user_code import PREFIX

SETTINGS = b"\4"
"""Type of the first frame that a server of HTTP/2 sends, and so one of gRPC (RFC 9113, 3.4)."""
HTTP2_HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0\0\0" + SETTINGS + b"\0\0\0\0\0"
"""What a client of it begins with: the preface, and settings that change nothing."""
NUMBERS = "numpy", "scipy", "numba"
"""Packages whose version the figures may depend on."""
RETRIES = 20
"""Times that a task begins again whose node is lost."""
TIMEOUT = 5.0
"""Longest wait for a cluster's address to answer [s]."""
WAIT = 1.0
"""Longest time between two looks at what is done [s]."""


def connect(address: str, *more: str) -> None:
    """Join the cluster at ``HOST:PORT``; "" is one on this machine, begun if there is none.

    ValueError says in a line what is wrong: no Ray, no cluster there, or a node with another ``cz_gym``, or with other
    sources of the packages ``more``.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise CzError('ray is missing: pip install ".[ray]"') from None
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if not ray.is_initialized():
        _check_answers(address)
        try:
            ray.init(address=address or None, **quiet)
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            raise CzError(f"no Ray cluster at {address or 'this machine'}: {' '.join(str(error).split())}") from None
    _check_nodes(facts_of_sources(*more), *more)


def _check_answers(address: str) -> None:
    """ValueError unless a gRPC server answers at ``HOST:PORT``, as Ray's does: Ray itself would ask for minutes."""
    host, colon, port = address.rpartition(":")
    if colon and port.isdigit() and not os.environ.get("RAY_USE_TLS"):
        try:
            with socket.create_connection((host, int(port)), TIMEOUT) as connection:
                connection.sendall(HTTP2_HELLO)
                answer = connection.recv(len(HTTP2_HELLO))
        except (OSError, OverflowError) as error:
            raise CzError(f"no Ray cluster at {address}: {error}") from None
        if answer[3:4] != SETTINGS:
            raise CzError(f"no Ray cluster at {address}: what answers there is something else")


def _check_nodes(ours: tuple[str, str], *more: str) -> None:
    """ValueError names a node whose :func:`facts_of_sources` are others."""
    for node, theirs in _answers(facts_of_sources, *more):
        if theirs != ours:
            raise CzError(f"node {node} has cz_gym {' '.join(theirs)}, this machine {' '.join(ours)}: install the same")


def check_shared(folder: Path) -> None:
    """ValueError names a node that does not see what is written into a folder here."""
    with tempfile.NamedTemporaryFile(dir=folder) as file:
        for node, sees in _answers(os.path.exists, file.name):
            if not sees:
                raise CzError(f"node {node} does not see {folder}: it must be on a file system that all nodes share")


def _answers(question: Callable[..., Any], *arguments: Any) -> Iterator[tuple[str, Any]]:
    """Address and answer of every node; ValueError names one that cannot answer."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy as On

    ask = ray.remote(question)
    nodes = {node["NodeID"]: node["NodeManagerAddress"] for node in ray.nodes() if node["Alive"]}
    there = {node: ask.options(num_cpus=0, scheduling_strategy=On(node, soft=False)) for node in nodes}
    asked = [(nodes[node], task.remote(*arguments)) for node, task in there.items()]
    for node, answer in asked:
        try:
            yield node, ray.get(answer)
        except ray.exceptions.RayError as error:
            cause = getattr(error, "cause", None) or error
            raise CzError(f"node {node} cannot run cz_gym: {' '.join(str(cause).split())[:200]}") from None


def facts_of_sources(*more: str) -> tuple[str, str]:
    """Version of ``cz_gym``; hash of all its sources, those of the packages ``more``, and the versions of NUMBERS."""
    return _facts_of_sources(more)  # Ray takes plain functions only


@cache
def _facts_of_sources(more: tuple[str, ...]) -> tuple[str, str]:
    digest = hashlib.sha256(" ".join(map(version, NUMBERS)).encode())
    for package in ("cz_gym", "cz_gym.agents", "cz_gym.baselines", *more):
        spec = find_spec(package)
        if spec is None:
            raise ModuleNotFoundError(f"no package {package}: its checkout must be at the same place")
        root = Path(str(spec.origin)).parent
        for file in sorted(root.rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return cz_gym.__version__, digest.hexdigest()[:12]


def _same_sources(ours: tuple[str, str], function: Callable[[Any], Any], task: Any) -> Any:
    """What a function makes of a task; ValueError where the sources are others, as on a node that came later."""
    if facts_of_sources() != ours:
        raise CzError(f"node {socket.gethostname()} has another cz_gym or numpy than this machine: install the same")
    return function(task)


Look = Callable[[], None]
"""What is called about every second while tasks run."""


def completed(
    function: Callable[[Any], Any], tasks: Sequence[Any], look: Look | None = None
) -> Iterator[tuple[int, Any]]:
    """Run ``function`` on every task, a processor each: the number of a task and its result, as they come.

    A task whose node is lost runs again elsewhere. What a task raises is raised here.
    """
    import ray

    for name, module in list(sys.modules.items()):
        if name.startswith(PREFIX):  # other machines do not have the user's files
            ray.cloudpickle.register_pickle_by_value(module)
    remote: Any = ray.remote(_same_sources).options(num_cpus=1, max_retries=RETRIES)
    ours = facts_of_sources()
    numbers = {remote.remote(ours, function, task): number for number, task in enumerate(tasks)}
    while numbers:
        done, _ = ray.wait(list(numbers), timeout=WAIT)
        for reference in done:
            try:
                result = ray.get(reference)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from error  # whose text has the traceback of the other process
            except ray.exceptions.RayError as error:
                raise CzError(f"the cluster lost a task {RETRIES} times: {' '.join(str(error).split())}") from None
            yield numbers.pop(reference), result
        if look:
            look()


def in_processes(
    function: Callable[[Any], Any], tasks: Sequence[Any], look: Look | None = None, processes: int | None = None
) -> Iterator[tuple[int, Any]]:
    """As :func:`completed`, in so many processes of this machine (None: one a processor), which end with the caller."""
    processes = max(min(processes or processors(), len(tasks)), 1)
    # Forking would copy the threads of torch and of the native batch in unknown states.
    with ProcessPoolExecutor(processes, get_context("spawn"), initializer=_end_with_caller) as pool:
        numbers = {pool.submit(function, task): number for number, task in enumerate(tasks)}
        try:
            while numbers:
                for each in wait(numbers, WAIT, FIRST_COMPLETED).done:
                    yield numbers.pop(each), each.result()
                if look:
                    look()
        except BrokenProcessPool:
            raise CzError("a process was killed: is there enough memory?") from None
        finally:
            if numbers:
                for process in active_children():
                    process.terminate()


def _end_with_caller() -> None:
    """In a process of :func:`in_processes`: leave Ctrl-C to the caller, and end when it does, even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    caller: Any = parent_process()

    def follow() -> None:
        caller.join()
        os._exit(1)

    Thread(target=follow, daemon=True).start()
