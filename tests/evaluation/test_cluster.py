"""Tasks on a Dask cluster: two real workers bring the same table as one machine, and what would not work is said."""

import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from types import SimpleNamespace

import pytest

pytest.importorskip("distributed")
from cz_gym.evaluation import parallel, user_code
from cz_gym.evaluation.metrics import SPEED
from cz_gym.evaluation.protocol import find_case
from cz_gym.support.errors import CzError
from cz_gym.tools.registry import find_controller
from cz_gym.tools.run import run
from tests.processes import ROOT

ONCE = """
import os, time
from pathlib import Path
import numpy as np

def once(config):
    if not (told := Path(__file__).with_name("process")).exists():
        told.with_suffix(".part").write_text(str(os.getpid()))
        told.with_suffix(".part").rename(told)
        time.sleep(600.0)
    return Still()

class Still:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2), np.float32), state
"""


@pytest.fixture
def workers(tmp_path):
    """The address of a scheduler with two workers, each a process of its own."""

    def start(kind, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments, "--no-dashboard"]
        log = stack.enter_context((tmp_path / f"{kind}{len(started)}").open("w"))
        started.append(subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log))

    started: list[subprocess.Popen] = []
    with ExitStack() as stack:
        start("scheduler", "--host", "127.0.0.1", "--port", "0")
        try:
            log = tmp_path / "scheduler0"
            while not (found := re.search(r"Scheduler at:\s+(tcp://127\S+)", log.read_text())):
                assert started[0].poll() is None, log.read_text()
                time.sleep(0.1)
            for _ in range(2):
                start("worker", found[1], "--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
            yield found[1]
        finally:
            for process in started:
                process.kill()
                process.wait()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals as POSIX has them")
def test_two_workers_one_killed_bring_the_same_table(workers, tmp_path):
    (tmp_path / "mine.py").write_text(ONCE)
    contenders = [user_code.controller(f"{tmp_path / 'mine.py'}:once"), *map(find_controller, ("paper", "paper-tuned"))]
    rows = [find_case("nominal"), find_case("randomized")]
    with ThreadPoolExecutor() as pool:
        there = pool.submit(run, contenders, rows, 2, tmp_path, None, True, workers)
        while not (told := tmp_path / "process").exists():
            assert not there.done(), there.result()
            time.sleep(0.1)
        first = int(told.read_text())
        assert first != os.getpid()
        os.kill(first, signal.SIGKILL)
        found = there.result(timeout=600.0)
    wanted = run(contenders, rows, 2, tmp_path, None, True)
    assert found.contenders == wanted.contenders == tuple(contenders)
    assert found.episodes.drop(columns=SPEED).equals(wanted.episodes.drop(columns=SPEED))


def client(threads=1, sees=True, **others):
    workers = {"tcp://w:1": {"nthreads": threads}}
    answers = {parallel.versions: parallel.versions() | others, os.path.isdir: sees}
    return SimpleNamespace(
        scheduler_info=lambda n_workers: {"workers": workers}, run=lambda what, *_: {"tcp://w:1": answers[what]}
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"threads": 4}, "worker tcp://w:1 has 4 threads: start it with --nthreads 1"),
        (
            {"numpy": "1.0", "plant_hash": "x"},
            "worker tcp://w:1 has other versions.*numpy 1.0, here .*; plant_hash x, here",
        ),
        ({"sees": False}, "worker tcp://w:1 does not see .*: name a folder that all machines share"),
    ],
)
def test_workers_that_would_give_other_numbers_are_named(given, said, tmp_path):
    with pytest.raises(CzError, match=said):
        parallel._check_workers(client(**given), tmp_path)
    parallel._check_workers(client(), tmp_path)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere", "ssh://a:b:c"])
def test_an_address_without_a_scheduler_is_one_line(address, monkeypatch):
    monkeypatch.setattr(parallel, "ANSWER", 0.5)
    with pytest.raises(CzError, match=f"no Dask scheduler answers at '{address}'"):
        list(parallel.on_cluster(address, abs, [1]))
