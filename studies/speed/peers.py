"""Peers that ``python -m studies.speed`` measures beside this package, each skipped by name where it is missing."""

from __future__ import annotations

import importlib
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from cz_gym.vector import CzVectorEnv

from .cases import THREADS, Case, Skipped, scalar

SB3_SLOTS = 256
ENVPOOL, PCGYM, SUBPROC, DUMMY = "EnvPool Pendulum-v1", "pc-gym CSTR", "SB3 SubprocVecEnv", "SB3 DummyVecEnv"
ADAPTER = "SB3 adapter over the batch"


def peers(quick: bool) -> list[Case | Skipped]:
    """Every peer that is installed; the others as :class:`Skipped`."""
    native = gym.make_vec("CartPole-v1", num_envs=1024, vectorization_mode="vector_entry_point")
    found: list[Case | Skipped] = [_discrete("CartPole-v1 native batch", native)]
    for threads in sorted({1, THREADS}):
        found.append(_try(f"{ENVPOOL}, {threads} thread{'s' * (threads > 1)}", partial(_envpool, 1024, threads)))
    found.append(_try(PCGYM, _pcgym))
    found.append(_try(ADAPTER, _adapter))
    found.append(_try(DUMMY, _dummy))
    for processes in (2,) if quick else (2, 16):
        found.append(_try(f"{SUBPROC}, {processes} processes", partial(_subproc, processes)))
    return found


@contextmanager
def silenced() -> Iterator[None]:
    """Without the warnings of peers, here and in the processes they start."""
    variable = "PYTHONWARNINGS"
    before = os.environ.get(variable)
    os.environ[variable] = "ignore"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        if before is None:
            del os.environ[variable]
        else:
            os.environ[variable] = before


def _try(name: str, make: Callable[[str], Case]) -> Case | Skipped:
    try:
        return make(name)
    except ImportError as error:
        return Skipped(name, f"{error.name or error} is not installed")
    except Exception as error:  # a peer's own failure must not end the run
        return Skipped(name, " ".join(f"{type(error).__name__}: {error}".split())[:100])


def _discrete(name: str, env: Any) -> Case:
    action = np.zeros(env.num_envs, np.int64)
    env.reset(seed=0)
    return Case(name, env.num_envs, lambda: env.step(action), env.close)


def _envpool(num_envs: int, threads: int, name: str) -> Case:
    envpool = importlib.import_module("envpool")
    env = envpool.make("Pendulum-v1", env_type="gymnasium", num_envs=num_envs, num_threads=threads)
    action = np.zeros((num_envs, 1), np.float32)
    env.reset()
    return Case(name, num_envs, lambda: env.step(action), env.close, 5)


def _pcgym(name: str) -> Case:
    """Its documentation's CSTR: three states, one input, 100 steps of 0.26 min."""
    pcgym = importlib.import_module("pcgym")
    steps = 100
    settings = {
        "N": steps,
        "tsim": 26,
        "SP": {"Ca": [0.85] * (steps // 2) + [0.9] * (steps // 2)},
        "o_space": {"low": np.array([0.7, 300.0, 0.8]), "high": np.array([1.0, 350.0, 0.9])},
        "a_space": {"low": np.array([295.0]), "high": np.array([302.0])},
        "x0": np.array([0.8, 330.0, 0.8]),
        "model": "cstr",
        "r_scale": {"Ca": 1e3},
        "normalise_a": True,
        "normalise_o": True,
        "noise": True,
        "noise_percentage": 0.001,
        "integration_method": "casadi",
    }
    return scalar(name, pcgym.make_env(settings))._replace(calls=5)


def _stepping(name: str, env: Any, calls: int = 1) -> Case:
    env.seed(0)
    env.reset()
    action = np.zeros((env.num_envs, 2), np.float32)
    return Case(name, env.num_envs, lambda: env.step(action), env.close, calls)


def _adapter(name: str) -> Case:
    env = CzVectorEnv(SB3_SLOTS, autoreset_mode=AutoresetMode.SAME_STEP)
    return _stepping(name, importlib.import_module("cz_gym.agents.training.vec_env").CzVecEnv(env))


def _make() -> Any:
    import cz_gym  # noqa: F401  (registers the environment in a worker process)

    return gym.make("Cz-v0")


def _dummy(name: str) -> Case:
    sb3 = importlib.import_module("stable_baselines3.common.vec_env")
    return _stepping(name, sb3.DummyVecEnv([_make] * SB3_SLOTS))


def _subproc(processes: int, name: str) -> Case:
    sb3 = importlib.import_module("stable_baselines3.common.vec_env")
    method = "forkserver" if os.name == "posix" else "spawn"
    return _stepping(name, sb3.SubprocVecEnv([_make] * processes, start_method=method), 20)
