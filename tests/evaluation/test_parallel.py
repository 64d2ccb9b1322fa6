"""Processes side by side, on one machine or a Dask cluster, bring every result, and end with their caller."""

import multiprocessing
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

from cz_gym.evaluation import parallel
from cz_gym.evaluation.metrics import SPEED
from cz_gym.evaluation.parallel import in_processes
from cz_gym.evaluation.protocol import find_case, user_controller
from cz_gym.support.errors import CzError
from cz_gym.tools.registry import find_controller
from cz_gym.tools.run import run
from tests.conftest import ROOT


def number_and_process(task):
    """What came with the process's number, if no Ctrl-C can come to it, nor could while it began."""
    if sys.platform != "win32":
        assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    return task, os.getpid()


def fail_or_sleep(task):
    if task == 0:
        raise IndexError("task 0")
    time.sleep(600.0)


def tell_and_wait(task):
    """Print that it has begun, and after a minute that it is still there."""
    print("begun", flush=True)
    time.sleep(60.0)
    print("still there", flush=True)


@pytest.mark.slow
def test_processes_bring_results_and_end_alone():
    """A process that the caller has of its own goes on."""
    own = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600.0,))
    own.start()
    try:
        found = dict(result for _, result in in_processes(number_and_process, [3, 4], processes=2))
        assert found.keys() == {3, 4}
        began = time.monotonic()
        with pytest.raises(IndexError, match="task 0") as caught:
            list(in_processes(fail_or_sleep, [1, 0, 2], processes=2))
        assert "fail_or_sleep" in str(caught.value.__cause__), "the traceback of the other process"
        assert time.monotonic() - began < 120.0
        assert own.is_alive()
    finally:
        own.kill()
        own.join()


@pytest.mark.slow
def test_a_killed_process_is_one_line():
    with pytest.raises(ValueError, match="a process was killed"):
        list(in_processes(os._exit, [1]))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals as POSIX has them")
def test_processes_end_with_a_killed_caller():
    code = "from cz_gym.evaluation.parallel import in_processes; from tests.evaluation.test_parallel import *"
    main = 'if __name__ == "__main__": list(in_processes(tell_and_wait, [0]))'
    with subprocess.Popen([sys.executable, "-c", f"{code}\n{main}"], cwd=ROOT, stdout=subprocess.PIPE) as caller:
        assert caller.stdout is not None
        assert caller.stdout.readline() == b"begun\n"
        caller.kill()
        assert caller.stdout.read() == b"", "a process outlived its caller"


ONCE = """
import os, time
from pathlib import Path
import numpy as np

def once(config):
    if not (told := Path(__file__).with_name("process")).exists() and os.getpid() != CALLER:
        told.with_suffix(".part").write_text(str(os.getpid()))
        told.with_suffix(".part").rename(told)
        time.sleep(600.0)
    return Still()

class Still:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2), np.float32), state
"""


@pytest.fixture
def dask():
    pytest.importorskip("distributed")


@pytest.fixture
def workers(tmp_path, dask):
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
    (tmp_path / "mine.py").write_text(ONCE.replace("CALLER", str(os.getpid())))  # which makes one of its own
    contenders = [user_controller(f"{tmp_path / 'mine.py'}:once"), *map(find_controller, ("paper", "paper-tuned"))]
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
@pytest.mark.usefixtures("dask")
def test_workers_that_would_give_other_numbers_are_named(given, said, tmp_path):
    with pytest.raises(CzError, match=said):
        parallel._check_workers(client(**given), tmp_path)
    parallel._check_workers(client(), tmp_path)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere", "ssh://a:b:c"])
@pytest.mark.usefixtures("dask")
def test_an_address_without_a_scheduler_is_one_line(address, monkeypatch):
    monkeypatch.setattr(parallel, "ANSWER", 0.5)
    with pytest.raises(CzError, match=f"no Dask scheduler answers at '{address}'"):
        list(parallel.on_cluster(address, abs, [1]))


@pytest.mark.usefixtures("dask")
def test_a_client_that_does_not_connect_is_closed_and_takes_no_lock_as_garbage(monkeypatch):
    """A collection may begin in the thread that starts the next client, and holds the lock of all loops."""
    from distributed import Client
    from distributed.utils import LoopRunner

    monkeypatch.setattr(parallel, "ANSWER", 0.5)
    made, new = [], Client.__new__
    monkeypatch.setattr(Client, "__new__", lambda kind, *given, **named: made.append(new(kind)) or made[0])
    with pytest.raises(CzError):
        list(parallel.on_cluster("nowhere", abs, [1]))
    assert made[0].status == "closed"
    with LoopRunner._lock:
        made.pop().__del__()
