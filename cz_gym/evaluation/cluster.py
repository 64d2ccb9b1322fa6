"""The same work on the machines of a Ray cluster: functions and tasks as here, results in the order they are done."""

from __future__ import annotations

import hashlib
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cz_gym

from .user_code import PREFIX

RETRIES = 20
"""Times that a task begins again whose node is lost."""
TIMEOUT = 5.0
"""Longest wait for a cluster's address to answer [s]."""
WAIT = 1.0
"""Longest time between two looks at what is done [s]."""


def connect(address: str) -> None:
    """Join the cluster at ``HOST:PORT``; "" is one on this machine, begun if there is none.

    ValueError says in a line what is wrong: no Ray, no cluster there, or a node with another ``cz_gym``.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise ValueError('ray is missing: pip install ".[ray]"') from None
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if not ray.is_initialized():
        _check_answers(address)
        try:
            ray.init(address=address or None, **quiet)
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            raise ValueError(f"no Ray cluster at {address or 'this machine'}: {' '.join(str(error).split())}") from None
    _check_nodes(facts_of_sources())


def _check_answers(address: str) -> None:
    """ValueError unless something answers at ``HOST:PORT``: Ray itself would ask for minutes."""
    host, colon, port = address.rpartition(":")
    if colon and port.isdigit():
        try:
            socket.create_connection((host, int(port)), TIMEOUT).close()
        except (OSError, OverflowError) as error:
            raise ValueError(f"no Ray cluster at {address}: {error}") from None


def _check_nodes(ours: tuple[str, str]) -> None:
    """ValueError names a node whose :func:`facts_of_sources` are others."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    facts = ray.remote(facts_of_sources)
    nodes = {node["NodeID"]: node["NodeManagerAddress"] for node in ray.nodes() if node["Alive"]}
    asked = {
        node: facts.options(num_cpus=0, scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)).remote()
        for node in nodes
    }
    for node, answer in asked.items():
        try:
            theirs = ray.get(answer)
        except ray.exceptions.RayError as error:
            cause = getattr(error, "cause", None) or error
            raise ValueError(f"node {nodes[node]} cannot run cz_gym: {' '.join(str(cause).split())[:200]}") from None
        if theirs != ours:
            raise ValueError(
                f"node {nodes[node]} has cz_gym {' '.join(theirs)}, this machine {' '.join(ours)}: install the same"
            )


def facts_of_sources() -> tuple[str, str]:
    """Version of ``cz_gym`` and hash of all its sources."""
    digest = hashlib.sha256()
    for package in ("cz_gym", "cz_gym.agents", "cz_gym.baselines"):
        spec = find_spec(package)
        assert spec is not None
        root = Path(str(spec.origin)).parent
        for file in sorted(root.rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return cz_gym.__version__, digest.hexdigest()[:12]


def completed(function: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
    """Run ``function`` on every task, a processor each: the number of a task and its result, as they come.

    A task whose node is lost runs again elsewhere. What a task raises is raised here.
    """
    import ray

    for name, module in list(sys.modules.items()):
        if name.startswith(PREFIX):  # other machines do not have the user's files
            ray.cloudpickle.register_pickle_by_value(module)
    remote = ray.remote(function).options(num_cpus=1, max_retries=RETRIES)
    numbers = {remote.remote(task): number for number, task in enumerate(tasks)}
    while numbers:
        done, _ = ray.wait(list(numbers), timeout=WAIT)
        for reference in done:
            try:
                result = ray.get(reference)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from None
            except ray.exceptions.RayError as error:
                raise ValueError(f"the cluster lost a task {RETRIES} times: {' '.join(str(error).split())}") from None
            yield numbers.pop(reference), result
