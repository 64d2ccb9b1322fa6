"""A benchmark on a Ray cluster of several nodes: the same figures, also when a node is lost on the way."""

import io
import multiprocessing
import os
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tqdm import tqdm

import benchmark
from cz_gym.contender import Contender
from cz_gym.errors import CzError
from cz_gym.evaluation import cluster, runner
from cz_gym.evaluation.protocol import Row, find_row
from cz_gym.evaluation.results import Result

pytestmark = pytest.mark.filterwarnings("ignore")


class Short(Row):
    """A row of ten minutes."""

    def config(self, *arguments: Any) -> Any:
        return replace(super().config(*arguments), horizon=600.0)


ROW = Short(*(getattr(find_row("randomized"), name) for name in ("name", "scenario", "meaning")))


def run(bar: Any, perform: Any = runner.in_turn) -> Result:
    given = benchmark.parse(["--controllers", "paper,lqg,gradient", "--scenarios", "randomized", "--episodes", "4"])
    contenders: list[Contender] = benchmark.contenders_of(given, [ROW])
    (result,) = runner.run(contenders, [ROW], 4, bar, benchmark.CACHE, None, perform)
    return result


@pytest.mark.slow
def test_a_lost_node_changes_nothing(nodes: tuple[Any, Any]) -> None:
    made, second = nodes
    pytest.importorskip("ray").cloudpickle.register_pickle_by_value(sys.modules[__name__])  # the row's class
    lost = []

    def losing(pieces: Any, bar: Any) -> Any:
        for number, sample in runner.on_cluster(pieces, bar):
            if not lost:
                lost.append(number)
                made.remove_node(second, allow_graceful=False)
            yield number, sample

    here, there = tqdm(file=io.StringIO()), tqdm(file=io.StringIO())
    wanted, found = run(here), run(there, losing)
    assert lost
    assert there.n == here.n == here.total
    for ours, theirs in zip(wanted.samples, found.samples, strict=True):
        np.testing.assert_array_equal(theirs.values, ours.values, err_msg=ours.name)
    assert len(found.samples[-1].values) == 5


@pytest.mark.slow
def test_what_a_task_raises_is_raised_here_with_its_traceback(nodes: tuple[Any, Any]) -> None:
    with pytest.raises(ZeroDivisionError) as caught:
        list(cluster.completed(lambda task: 1 // task, [1, 0]))
    assert "test_cluster.py" in str(caught.value.__cause__)


@pytest.mark.slow
def test_without_a_cluster_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    with pytest.raises(CzError, match=r"no Ray cluster at 127\.0\.0\.1:1"):
        cluster.connect("127.0.0.1:1")


def test_a_node_with_other_sources_does_nothing() -> None:
    assert cluster._same_sources(cluster.software_here(), abs, -1) == 1
    with pytest.raises(CzError, match=r"has cz_gym 0\.1\.0 .*, this machine 0\.0\.0 elsewhere 1\.26: install the same"):
        cluster._same_sources("0.0.0 elsewhere 1.26", abs, -1)


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(CzError, match=r'pip install "\.\[ray\]"'):
        cluster.connect("")


def number_and_process(task: int) -> tuple[int, int]:
    return task, os.getpid()


def fail_or_sleep(task: int) -> None:
    if task == 0:
        raise IndexError("task 0")
    time.sleep(600.0)


def test_processes_bring_results_and_end_alone() -> None:
    """A process that the caller has of its own goes on."""
    own = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600.0,))
    own.start()
    try:
        found = dict(result for _, result in cluster.in_processes(number_and_process, [3, 4], processes=2))
        assert found.keys() == {3, 4}
        began = time.monotonic()
        with pytest.raises(IndexError, match="task 0") as caught:
            list(cluster.in_processes(fail_or_sleep, [1, 0, 2], processes=2))
        assert "fail_or_sleep" in str(caught.value.__cause__), "the traceback of the other process"
        assert time.monotonic() - began < 120.0
        assert own.is_alive()
    finally:
        own.kill()
        own.join()
