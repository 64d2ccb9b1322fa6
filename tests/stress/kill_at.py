"""Processes that kill themselves at a point with a name, so that a test knows what was under way.

``os:replace:2`` is the second call of ``os.replace``: it is not made, the process gets SIGKILL. ``>`` begins to count
at another point: ``train:train:1>os:replace:2`` is the second such call after ``train.train`` was called.
"""

import functools
import importlib
import itertools
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

KILLED = -signal.SIGKILL
_FRESH = multiprocessing.get_context("forkserver")
_FRESH.set_forkserver_preload(["tests.stress.small_runs"])


def ending(program: Callable[[list[str]], int], arguments: list[str], point: str | None, log: Path) -> int | None:
    """Exit code of a program that runs in a process of its own; :data:`KILLED` if it got to the point."""
    process = _FRESH.Process(target=_run, args=(program, arguments, point, log))
    process.start()
    process.join()
    return process.exitcode


def _run(program: Callable[[list[str]], int], arguments: list[str], point: str | None, log: Path) -> None:
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    try:
        if point is not None:
            _kill_at(point)
        code = program(arguments)
    except BaseException:
        traceback.print_exc()
        code = 99
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _kill_at(point: str) -> None:
    here, _, later = point.partition(">")
    module, name, turn = here.split(":")
    *path, last = name.split(".")
    owner: Any = functools.reduce(getattr, path, importlib.import_module(module))
    function, calls = getattr(owner, last), itertools.count(1)

    @functools.wraps(function)
    def counted(*given: Any, **named: Any) -> Any:
        if next(calls) == int(turn):
            if not later:
                os.kill(os.getpid(), signal.SIGKILL)
            _kill_at(later)
        return function(*given, **named)

    setattr(owner, last, counted)
