"""Processes side by side bring every result, and end with their caller."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest

from cz_gym.evaluation.parallel import in_processes
from tests.processes import ROOT


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
    code = "from cz_gym.evaluation.parallel import in_processes; from tests.evaluation.test_processes import *"
    main = 'if __name__ == "__main__": list(in_processes(tell_and_wait, [0]))'
    with subprocess.Popen([sys.executable, "-c", f"{code}\n{main}"], cwd=ROOT, stdout=subprocess.PIPE) as caller:
        assert caller.stdout is not None
        assert caller.stdout.readline() == b"begun\n"
        caller.kill()
        assert caller.stdout.read() == b"", "a process outlived its caller"
