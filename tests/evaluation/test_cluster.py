"""A benchmark on a Ray cluster of several nodes: the same figures, also when a node is lost on the way."""

import io
import socket
import sys
from dataclasses import replace
from threading import Thread
from typing import Any

import numpy as np
import pytest
from tqdm import tqdm

import benchmark
from cz_gym.evaluation import cluster, runner
from cz_gym.evaluation.protocol import Row, find_row
from cz_gym.evaluation.results import Benchmark

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


class Short(Row):
    """A row of ten minutes."""

    def config(self, *arguments: Any) -> Any:
        return replace(super().config(*arguments), horizon=600.0)


def plan() -> runner.Plan:
    given = benchmark.parse(["--controllers", "paper,lqg,gradient", "--scenarios", "randomized", "--episodes", "4"])
    row = find_row("randomized")
    return replace(benchmark.make_plan(given, ""), rows=(Short(row.name, row.scenario, row.meaning),))


def values(found: Benchmark) -> dict[str, Any]:
    return {outcome.controller.name: outcome.sample.values for outcome in found.scenarios[0].outcomes}


def test_a_lost_node_changes_nothing(nodes: tuple[Any, Any]) -> None:
    made, second = nodes
    lost = []

    def losing(pieces: Any, bar: Any) -> Any:
        for number, part in runner.on_cluster(pieces, bar):
            if not lost:
                lost.append(number)
                made.remove_node(second, allow_graceful=False)
            yield number, part

    here, there = tqdm(file=io.StringIO()), tqdm(file=io.StringIO())
    wanted, found = runner.run(plan(), here), runner.run(plan(), there, losing)
    assert lost
    assert there.n == here.n == plan().steps
    for name, ours in values(wanted).items():
        np.testing.assert_array_equal(values(found)[name], ours, err_msg=name)
    assert len(values(wanted)["gradient"]) == 5


def test_a_node_with_other_sources_is_named(nodes: tuple[Any, Any]) -> None:
    with pytest.raises(ValueError, match=r"has cz_gym 0\.1\.0 .*, this machine 0\.0\.0 elsewhere: install the same"):
        cluster._check_nodes(("0.0.0", "elsewhere"))


def test_what_a_task_raises_is_raised_here(nodes: tuple[Any, Any]) -> None:
    with pytest.raises(ZeroDivisionError):
        list(cluster.completed(lambda task: 1 // task, [1, 0]))


def test_without_a_cluster_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    with pytest.raises(ValueError, match=r"no Ray cluster at 127\.0\.0\.1:1") as refusal:
        cluster.connect("127.0.0.1:1")
    assert "\n" not in str(refusal.value)


def test_what_is_no_cluster_is_one_line() -> None:
    """Ray would try for minutes."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        Thread(target=lambda: server.accept()[0].sendall(b"220 mail.example.org ready\r\n"), daemon=True).start()
        with pytest.raises(ValueError, match="what answers there is something else"):
            cluster._check_answers(f"127.0.0.1:{server.getsockname()[1]}")


def test_a_node_that_came_later_with_other_sources_does_nothing() -> None:
    assert cluster._same_sources(cluster.facts_of_sources(), abs, -1) == 1
    with pytest.raises(ValueError, match="has another cz_gym or numpy than this machine: install the same"):
        cluster._same_sources(("0.0.0", "elsewhere"), abs, -1)


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r'pip install "\.\[ray\]"'):
        cluster.connect("")
