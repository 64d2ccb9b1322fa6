"""Measure a benchmark's tasks on one and two Ray nodes of a processor each, and say what many machines would do.

A cluster of N machines does K tasks in T(N) = connect + load + ceil(K / N) t + K d. The time on two nodes is no part of
the fit: it tests the model. All figures need a quiet machine with three free processors: two nodes and the driver.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

from cz_gym.baselines.registry import make_controller
from cz_gym.commands import OneLineParser, between
from cz_gym.evaluation.cluster import completed, connect
from cz_gym.evaluation.protocol import find_row
from cz_gym.evaluation.report.tables import markdown as table
from cz_gym.evaluation.runner import Piece, run_piece

MACHINES = (1, 2, 10, 100, 1000, 10_000)
EMPTY = 300
"""Tasks that do nothing."""


class Model(NamedTuple):
    """What a run of tasks takes [s]."""

    connect: float
    """Joining the cluster, with the check of its nodes' sources."""
    load: float
    """The first task in a new process, less a task."""
    t: float
    """A task on its node."""
    d: float
    """What the driver needs to hand a task out and to take its result; measured by tasks that only return one."""

    def seconds(self, tasks: int, machines: int) -> float:
        """Time of so many tasks."""
        return self.connect + self.load + math.ceil(tasks / machines) * self.t + tasks * self.d

    @property
    def most(self) -> float:
        """Machines that one driver can keep at work."""
        return self.t / self.d


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.cluster", description=(__doc__ or "").split("\n")[0])
    for option, most, default, meaning in (
        ("--tasks", 10_000, 24, "tasks to measure"),
        ("--crystals", 500, 500, "crystals a task"),
    ):
        kind = between(1, most)
        parser.add_argument(option, type=kind, default=default, help=f"{meaning} (default: %(default)s)")
    return parser.run(_main, arguments, "ray")


def _main(given: argparse.Namespace) -> None:
    piece = a_piece(given.crystals)
    walls = {}
    for nodes in (2, 1):
        with cluster(nodes) as joining:
            first = timed(piece, nodes)[1]
            found, walls[nodes] = timed(piece, given.tasks)
            t = sum(seconds for seconds, _ in found) / given.tasks
            _, empty = timed(found[0][1], EMPTY)
    model = Model(joining, max(first - t, 0.0), t, empty / EMPTY)
    print(
        f"connect {model.connect:.2f} s, load {model.load:.2f} s, task {model.t:.3f} s, driver {1e3 * model.d:.2f} ms\n"
    )
    start = model.connect + model.load
    rows = [(f"{n}", f"{start + walls[n]:.1f}", f"{model.seconds(given.tasks, n):.1f}") for n in sorted(walls)]
    print(table(("nodes", f"{given.tasks} tasks, measured [s]", "by the model [s]"), rows) + "\n")
    print(forecast(model))


def forecast(model: Model) -> str:
    """What the model says of many machines: seconds, and times as fast as one machine."""
    tasks = (1000, 100_000, 10_000_000)
    rows = [(f"{n:,}", *(_cell(model, each, n) for each in tasks)) for n in MACHINES]
    heads = ("machines", *(f"{each:,} tasks" for each in tasks))
    first = (
        f"One driver serves {1.0 / model.d:,.0f} tasks a second. It saturates first, at {model.most:,.0f} machines if "
        f"a task takes {model.t:.2f} s; 10,000 machines need tasks of {10_000 * model.d:.0f} s or longer."
    )
    return f"{table(heads, rows)}\n\n{first}"


def _cell(model: Model, tasks: int, machines: int) -> str:
    seconds = model.seconds(tasks, machines)
    return f"{seconds:,.0f} s ({model.seconds(tasks, 1) / seconds:,.1f} x)"


@contextmanager
def cluster(nodes: int) -> Iterator[float]:
    """A Ray cluster of so many nodes on this machine, a processor each; the time that joining it took [s]."""
    import ray
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        for _ in range(nodes):
            made.add_node(num_cpus=1)
        began = time.perf_counter()
        connect(made.address, "studies")
        yield time.perf_counter() - began
    finally:
        ray.shutdown()
        made.shutdown()


def a_piece(crystals: int) -> Piece:
    """The LQG on test crystals of ``randomized``: a task of the benchmark."""
    row = find_row("randomized")
    config, seeds = row.config(), tuple(row.seeds(crystals))
    return Piece("", partial(make_controller, "lqg"), row.design_config("measured"), config, 0, seeds, frozenset())


def timed(task: Any, count: int) -> tuple[list[Any], float]:
    """Do a task so often: what came back, and the time that all took [s]."""
    began = time.perf_counter()
    found = [result for _, result in completed(work, [task] * count)]
    return found, time.perf_counter() - began


def work(task: Any) -> Any:
    """Of a piece: the time that it took where it ran [s], and its result. What is no piece comes back as it is."""
    if not isinstance(task, Piece):
        return task
    began = time.perf_counter()
    part = run_piece(task)
    return time.perf_counter() - began, part


if __name__ == "__main__":
    sys.exit(main())
