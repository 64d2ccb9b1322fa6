"""Rows of the speed table: this package's environments beside others."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from cz_gym.config import make_config
from cz_gym.differentiable import DifferentiableBatch
from cz_gym.engine.batch import Batch
from cz_gym.env import CzEnv
from cz_gym.processors import processors
from cz_gym.vector import CzVectorEnv

THREADS = processors()
"""Threads that the larger cases may use."""
SLOTS, SB3_SLOTS = 1024, 256
"""Slots of the batches that are compared, and of those behind stable-baselines3."""
UNFAILED = 50
"""Steps that every crystal survives in open loop."""


class Stepper(NamedTuple):
    """An environment or loop whose steps are timed."""

    num_envs: int
    step: Callable[[], Any]
    """One step of every slot."""
    close: Callable[[], Any] = lambda: None


class Case(NamedTuple):
    """A row of the table."""

    name: str
    make: Callable[[], Any]
    """Makes a :class:`Stepper`, or an environment, scalar or batched, that is stepped with actions of zero."""


def cases(quick: bool) -> list[Case]:
    """Every row, in the table's order."""
    threads = {n: "1 thread" if n == 1 else f"{n} threads" for n in sorted({1, THREADS})}
    return [
        *(Case(f"{name} scalar", partial(gym.make, name)) for name in ("Cz-v0", "Pendulum-v1")),
        *(
            Case(f"{name}, {named}", partial(make, SLOTS, n))
            for name, make in (
                ("Cz-v0 batch, measured", ours),
                ("Cz-v0 batch without resets", without_resets),
                ("bare compiled plant and ring", bare),
                ("EnvPool Pendulum-v1", _envpool),
            )
            for n, named in threads.items()
        ),
        Case("step without derivatives", partial(differentiable, False)),
        Case("step with derivatives", partial(differentiable, True)),
        Case("pc-gym CSTR", _pcgym),
        Case("SB3 adapter over the batch", lambda: import_module("cz_gym.sb3").make_vec_env(SB3_SLOTS)),
        *(
            Case(f"{loop}, {name}", partial(make, name))
            for loop, make in (
                ("SB3 make_vec_env", _sb3_make_vec_env),
                ("SyncVectorEnv", partial(gym.make_vec, num_envs=4, vectorization_mode="sync")),
            )
            for name in ("cz_gym:Cz-v0", "Pendulum-v1")
        ),
        Case("SB3 DummyVecEnv", partial(_sb3, "DummyVecEnv", SB3_SLOTS)),
        *(
            Case(f"SB3 SubprocVecEnv, {n} processes", partial(_sb3, "SubprocVecEnv", n))
            for n in ((2,) if quick else (2, 16))
        ),
        Case("Cz-v0 scalar, camera", partial(CzEnv, "nominal", observation="camera")),
    ]


def stepper(made: Any) -> Stepper:
    """A case's environment, stepped with actions of zero and reset where it does not reset itself."""
    if isinstance(made, Stepper):
        return made
    if getattr(made, "num_envs", None) is not None:
        made.reset()
        return batched(made, made.num_envs)
    made.reset(seed=0)
    action = np.zeros(made.action_space.shape, made.action_space.dtype)[()]

    def step() -> None:
        _, _, terminated, truncated, _ = made.step(action)
        if terminated or truncated:
            made.reset()

    return Stepper(1, step, made.close)


def batched(env: Any, num_envs: int) -> Stepper:
    """A batch that has been reset, of any library."""
    space = getattr(env, "single_action_space", env.action_space)
    action = np.zeros((num_envs, *space.shape), space.dtype)
    return Stepper(num_envs, lambda: env.step(action), env.close)


def ours(num_envs: int, threads: int = 1) -> Stepper:
    """The native batch, its slots at random steps of their episodes, so that resets are spread out."""
    env = CzVectorEnv(num_envs, observation="measured", threads=threads)
    env.reset(seed=0)
    env._batch.memory.slots["k"] = np.random.default_rng(0).integers(0, env.config.steps, num_envs)
    return batched(env, num_envs)


def without_resets(num_envs: int, threads: int) -> Stepper:
    """The native batch, repeating the same first minutes without resets, to compare with the bare loop."""
    env = CzVectorEnv(num_envs, observation="measured", threads=threads)
    env.reset(seed=0)
    return repeated(env._batch, batched(env, num_envs))


def bare(num_envs: int, threads: int) -> Stepper:
    """The compiled plant and bright ring alone: no sensors, observation, reward, info or Python shell."""
    batch = Batch(make_config(observation="measured"), num_envs, threads)
    rings = np.zeros(num_envs)
    batch.reset(range(num_envs), [(i, i) for i in range(num_envs)], batch.new_out())
    return repeated(batch, Stepper(num_envs, lambda: batch.advance(rings), batch.close))


def repeated(batch: Batch, stepper: Stepper) -> Stepper:
    """The same, but every slot goes back to where it is now before any crystal fails."""
    slots, first = batch.memory.slots, batch.memory.slots.copy()

    def step() -> None:
        stepper.step()
        if slots["k"][0] >= UNFAILED:
            slots[:] = first

    return stepper._replace(step=step)


def differentiable(derivatives: bool) -> Stepper:
    """A batch of 256 over and over the same first minutes, each step with its derivatives or without."""
    batch = DifferentiableBatch(make_config(), 256)
    batch.reset(range(256))
    inner, out, action = batch._batch, batch._batch.new_out(), np.zeros((256, 2))
    step = (lambda: batch.step(action)) if derivatives else (lambda: inner.step(action, out))
    return repeated(inner, Stepper(256, step, batch.close))


def _envpool(num_envs: int, threads: int) -> Stepper:
    envpool = import_module("envpool")
    env = envpool.make("Pendulum-v1", env_type="gymnasium", num_envs=num_envs, num_threads=threads)
    env.reset()
    return batched(env, num_envs)


def _pcgym() -> Any:
    """Its documentation's CSTR: three states, one input, 100 steps of 0.26 min."""
    return import_module("pcgym").make_env(
        {
            "N": 100,
            "tsim": 26,
            "SP": {"Ca": [0.85] * 50 + [0.9] * 50},
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
    )


def _sb3_make_vec_env(name: str) -> Any:
    return import_module("stable_baselines3.common.env_util").make_vec_env(name, 16)


def _sb3(kind: str, num_envs: int) -> Any:
    make = getattr(import_module("stable_baselines3.common.vec_env"), kind)
    return make([partial(gym.make, "cz_gym:Cz-v0")] * num_envs)
