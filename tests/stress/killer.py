"""Commands that tell what they are doing, in processes of their own, killed in the middle of it.."""

from __future__ import annotations

import functools
import os
import random
import select
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple


class Watched(NamedTuple):
    """A function that is a phase of a run."""

    owner: Any
    name: str
    phase: str | Callable[..., str]


class Killer:
    """Runs a command in processes of their own and kills them; remembers how long each phase takes, and how often."""

    def __init__(self, command: Any, watched: tuple[Watched, ...], log: Path, chance: random.Random) -> None:
        self.command, self.watched, self.log, self.chance = command, watched, log, chance
        self.lasts: dict[str, float] = {}
        self.times: Counter[str] = Counter()
        self.kills: Counter[str] = Counter()

    def run(self, arguments: list[str], target: str | None) -> int | None:
        """Kill the command in the target phase: None; its exit code if it ends before, or has no target."""
        heard, tells = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(heard)
            self._child(arguments, tells)
        os.close(tells)
        phase, began, deadline = "before main", time.monotonic(), float("inf")
        met: Counter[str] = Counter()
        turn = self.chance.randint(1, max(self.times[target] // 2, 1)) if target else 0
        while time.monotonic() < deadline:
            patience = None if deadline == float("inf") else max(deadline - time.monotonic(), 0.0)
            if not select.select([heard], [], [], patience)[0]:
                continue
            line = _line(heard)
            if not line:
                break
            now = time.monotonic()
            self.lasts[phase] = now - began
            phase, began = line, now
            met[phase] += 1
            if phase == target and met[phase] == turn:
                deadline = now + self.chance.uniform(0.0, self.lasts.get(phase, 0.1))
        os.close(heard)
        if time.monotonic() >= deadline:
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        code = os.waitstatus_to_exitcode(status)
        if code == -signal.SIGKILL:
            self.kills[phase] += 1
            return None
        self.times = self.times & met or met  # the fewest that a run to its end has met
        check(code == 0, f"exit code {code}: {self.log.read_text()[-2000:]}")
        return code

    def _child(self, arguments: list[str], tells: int) -> None:
        handle = os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        now = ["before main"]

        def tell(phase: str) -> None:
            now[0] = phase
            os.write(tells, f"{phase}\n".encode())

        def told(function: Any, phase: str | Callable[..., str]) -> Any:
            @functools.wraps(function)
            def inner(*given: Any, **named: Any) -> Any:
                outer = now[0]
                tell(phase if isinstance(phase, str) else phase(*given))
                try:
                    return function(*given, **named)
                finally:
                    tell(outer)

            return inner

        for watched in self.watched:
            setattr(watched.owner, watched.name, told(getattr(watched.owner, watched.name), watched.phase))
        try:
            code = self.command.main(arguments)
        except BaseException as error:
            print(repr(error), flush=True)
            code = 99
        sys.stdout.flush()
        os._exit(code)

    def where(self) -> str:
        """How many kills hit which phase."""
        return "; ".join(f"{phase} {number}" for phase, number in sorted(self.kills.items()))


def _line(handle: int) -> str:
    """A line of a pipe, without its end; nothing where the pipe has ended."""
    line = b""
    while not line.endswith(b"\n"):
        byte = os.read(handle, 1)
        if not byte:
            return ""
        line += byte
    return line.decode().rstrip("\n")


def check(condition: bool, what: object) -> None:
    """Raise RuntimeError unless it holds."""
    if not condition:
        raise RuntimeError(str(what))
