"""What a Dask cluster adds to a benchmark: ``python -m studies.cluster``.

One worker and then two, processes of this machine with a thread each, run the same tasks. Nothing else may run
beside them.
"""

import argparse
import pickle
import sys
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

from cz_gym.baselines.registry import find_controller
from cz_gym.evaluation.cluster import on_cluster
from cz_gym.evaluation.protocol import find_case
from cz_gym.evaluation.report.tables import markdown
from cz_gym.evaluation.runner import Task, measure
from cz_gym.support.atomic_files import check_writable, write_files
from cz_gym.support.command_line import OneLineParser

CONTROLLERS, SCENARIOS = ("paper", "paper-tuned", "lqg", "lqg-quiet"), ("randomized", "hard", "sensor-fault")
CRYSTALS, EMPTY, WARM = 100, 500, 2
"""Crystals of a task, tasks without work, and crystals of the tasks that every worker has run before."""
RUNS = 2
"""Runs of all tasks, of which the faster one counts."""
MANY = 1000
"""Workers of the figures on paper."""


def timed(address: str, function: Callable[[Any], Any], tasks: Sequence[Any]) -> tuple[float, list[Any]]:
    """Time of tasks on a cluster [s], and their results."""
    start = time.perf_counter()
    results = [result for _, result in on_cluster(address, function, tasks)]
    return time.perf_counter() - start, results


def tasks_of(crystals: int, cache: Path) -> list[Task]:
    """Every controller on every scenario."""
    pairs = product(map(find_controller, CONTROLLERS), map(find_case, SCENARIOS))
    return [Task(contender, case, crystals, cache) for contender, case in pairs]


def _warm(tasks: Sequence[Task]) -> None:
    """In a worker: import, compile and design whatever the tasks need."""
    for task in tasks:
        measure(task)


def on_workers(number: int, cache: Path) -> tuple[float, float, list[Any]]:
    """Times of an empty task and of all tasks on that many workers [s], and the results."""
    start = import_module("distributed").LocalCluster
    with start(n_workers=number, threads_per_worker=1, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        cluster.get_client().run(_warm, tasks_of(WARM, cache))
        empty, one = timed(address, abs, range(EMPTY))[0], timed(address, abs, range(1))[0]
        runs = [timed(address, measure, tasks_of(CRYSTALS, cache)) for _ in range(RUNS)]
        return (empty - one) / (EMPTY - 1), min(seconds for seconds, _ in runs), runs[0][1]


def table(cache: Path) -> str:
    """The figures of one and of two workers, and what follows for a thousand."""
    empty, alone, results = on_workers(1, cache)
    _, together, _ = on_workers(2, cache)
    tasks = tasks_of(CRYSTALS, cache)
    task, result = (sum(len(pickle.dumps(each)) for each in some) / len(some) for some in (tasks, results))
    each = alone / len(tasks)
    rows = [
        ("a task without work [ms]", f"{1e3 * empty:.1f}"),
        (f"a controller on a scenario, {CRYSTALS} crystals, mean of {len(tasks)} [s]", f"{each:.2f}"),
        ("all of them, one worker [s]", f"{alone:.1f}"),
        ("all of them, two workers [s]", f"{together:.1f}"),
        ("two workers are faster by the factor", f"{alone / together:.2f}"),
        ("size of a task [kB]", f"{task / 1e3:.1f}"),
        ("size of its result [kB]", f"{result / 1e3:.0f}"),
        ("on paper: workers that one scheduler keeps busy with such tasks", f"{each / empty:.0f}"),
        (f"on paper: results of {MANY} such workers [MB/s]", f"{MANY * result / each / 1e6:.0f}"),
    ]
    return "# Tasks on a cluster\n\n" + markdown(("", "measured"), rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m studies.cluster", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/cluster/table.md"), help="(default: %(default)s)")
    return parser.run(_main, arguments, "cluster,benchmark")


def _main(given: argparse.Namespace) -> None:
    check_writable(given.out.parent)
    text = table(given.out.parent.absolute())
    print(text)
    write_files({given.out: f"{text}\n".encode()})


if __name__ == "__main__":
    sys.exit(main())
