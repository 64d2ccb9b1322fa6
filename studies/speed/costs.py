"""Memory of a slot, time of a reset and of starting up."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from cz_gym.env import CzEnv
from cz_gym.jit.cache import CACHE_VARIABLE
from cz_gym.units import MICRO
from cz_gym.vector import CzVectorEnv

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
results = [env.reset(seed=0)]
for _ in range(4): results = [*results, env.step(np.zeros((n, 2)))][-2:]
print((resident() - before) / n)
"""


def costs(quick: bool) -> dict[str, float]:
    """Memory of a slot [KiB], time of a reset [us] and of the first step in a new process [s]."""
    found = {"memory_per_slot_randomized_kib": memory_per_slot("randomized", "measured") / KIB}
    if not quick:
        found["memory_per_slot_puller_history_kib"] = memory_per_slot("puller", "history") / KIB
    found["reset_scalar_us"] = reset_seconds(CzEnv(), 21) / MICRO
    found["reset_1024_us_per_slot"] = reset_seconds(CzVectorEnv(1024), 5) / 1024 / MICRO
    _python(_FIRST_STEP)
    found["start_cached_s"] = statistics.median(_start_seconds(None) for _ in range(3))
    if not quick:
        with tempfile.TemporaryDirectory() as folder:
            found["start_cold_s"] = _start_seconds(folder)
    return found


def resident() -> int:
    """Memory of this process that is in use [B]; 0 where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return 0


def memory_per_slot(scenario: str, observation: str) -> float:
    """Memory of a slot of a batch that is stepped, two results included [B]."""
    return float(_python(_MEMORY.format(scenario=scenario, observation=observation)))


def reset_seconds(env: Any, repeats: int) -> float:
    """Time of a reset that draws every slot anew [s], median."""
    env.reset(seed=0)
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        env.reset()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def _start_seconds(cache: str | None) -> float:
    """Time of import, make, reset and first step in a new process [s]."""
    began = time.perf_counter()
    _python(_FIRST_STEP, cache)
    return time.perf_counter() - began


def _python(code: str, cache: str | None = None) -> str:
    environment = dict(os.environ) if cache is None else {**os.environ, CACHE_VARIABLE: cache}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"a process that was to be measured failed: {done.stderr.strip()[-300:]}")
    return done.stdout
