"""What ``python -m studies.speed`` measures besides steps: memory a slot, resets, start-up."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from cz_gym.jit.cache import CACHE_VARIABLE

from .cases import redraw_seconds

KIB = 1024.0
_FIRST_STEP = """
import gymnasium, cz_gym
env = gymnasium.make("Cz-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
"""
_MEMORY = """
import sys, numpy as np
from cz_gym import CzVectorEnv
from studies.speed.costs import resident
small, n = CzVectorEnv(8, {scenario!r}, observation={observation!r}), 2048
small.reset(seed=0); small.step(np.zeros((8, 2))); before = resident()
env = CzVectorEnv(n, {scenario!r}, observation={observation!r}, threads=1)
kept = [env.reset(seed=0)]
for _ in range(4): kept = [*kept, env.step(np.zeros((n, 2)))][-2:]
print((resident() - before) / n)
"""


def resident() -> int:
    """Memory of this process that is in use [B]; 0 where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return 0


def megabytes() -> float:
    """Memory that is free [MB]; infinite where the system does not say."""
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        return int(lines["MemAvailable"].split()[0]) / KIB
    except (OSError, ValueError, KeyError):
        return float("inf")


def memory_per_slot(scenario: str, observation: str) -> float:
    """What a slot costs a process that steps a batch at the default horizon, results held included [B]."""
    return float(_python(_MEMORY.format(scenario=scenario, observation=observation)))


def reset_seconds(num_envs: int) -> float:
    """Time of a reset per slot [s], median."""
    reset = redraw_seconds(num_envs)
    times = []
    for _ in range(21 if num_envs == 1 else 5):
        began = time.perf_counter()
        reset()
        times.append((time.perf_counter() - began) / num_envs)
    return statistics.median(times)


def start_seconds(cold: bool) -> tuple[float | None, float]:
    """Time of import, make, reset and first step in a new process [s]: without and with compiled code at hand."""
    if not cold:
        _python(_FIRST_STEP)
        return None, _time(None)
    with tempfile.TemporaryDirectory() as folder:
        return _time(folder), float(np.median([_time(folder) for _ in range(3)]))


def _time(folder: str | None) -> float:
    began = time.perf_counter()
    _python(_FIRST_STEP, folder)
    return time.perf_counter() - began


def _python(code: str, cache: str | None = None) -> str:
    environment = dict(os.environ) if cache is None else {**os.environ, CACHE_VARIABLE: cache}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"a process that was to be measured failed: {done.stderr.strip()[-300:]}")
    return done.stdout
