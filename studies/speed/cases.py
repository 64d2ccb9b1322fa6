"""What ``python -m studies.speed`` measures of this package: environments, batches, bare loops, as runnable cases."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from cz_gym.config import make_config
from cz_gym.engine.batch import Batch
from cz_gym.env import CzEnv
from cz_gym.physics.meniscus import HURLE
from cz_gym.physics.plant import NO_DISTURBANCE, Inputs, State, make_puller, rk4
from cz_gym.vector import CzVectorEnv

THREADS = os.cpu_count() or 1
"""Threads that the larger cases may use."""


_UNFAILED = 50
"""Steps that every crystal survives in open loop."""


class Case(NamedTuple):
    """Something that steps."""

    name: str
    num_envs: int
    step: Callable[[], Any]
    """One step of every slot."""
    close: Callable[[], Any]
    calls: int = 1
    """Calls between two looks at the clock."""


class Skipped(NamedTuple):
    """A case that cannot be measured here."""

    name: str
    why: str


def scalar(name: str, env: Any) -> Case:
    """Any scalar environment, with its resets."""
    action = np.zeros(env.action_space.shape, env.action_space.dtype)
    env.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return Case(name, 1, step, env.close, 200)


def vector(name: str, env: Any, calls: int = 1) -> Case:
    """Any batch that resets itself."""
    action = np.zeros(env.action_space.shape, env.action_space.dtype)
    return Case(name, env.num_envs, lambda: env.step(action), env.close, calls)


def ours(num_envs: int, threads: int = THREADS, observation: str = "measured", scenario: str = "randomized") -> Case:
    """The native batch, its slots at random places of their episodes, so that resets are spread out."""
    env = CzVectorEnv(num_envs, scenario=scenario, observation=observation, threads=threads)
    spread_out(env)
    label = f"Cz-v0 batch, {observation}, {_threads(min(threads, max(1, num_envs // 256)))}"
    return vector(label, env, max(1, 256 // num_envs))


def spread_out(env: CzVectorEnv) -> None:
    """Reset a batch and move its slots to random steps of their episodes, as after hours of running."""
    env.reset(seed=0)
    env._batch.memory.slots["k"] = np.random.default_rng(0).integers(0, env.config.steps, env.num_envs)


def in_step(num_envs: int, threads: int) -> Case:
    """The native batch over and over the same first minutes: no resets, to compare with the bare loop."""
    env = CzVectorEnv(num_envs, threads=threads)
    action = np.zeros((num_envs, 2), np.float32)
    env.reset(seed=0)
    step = _again_and_again(env._batch, lambda: env.step(action))
    return Case(f"Cz-v0 batch without resets, {_threads(threads)}", num_envs, step, env.close)


def bare(num_envs: int, threads: int) -> Case:
    """The compiled plant and bright ring alone: no sensors, observation, reward, info or Python shell."""
    batch = Batch(make_config(), num_envs, threads)
    rings = np.zeros(num_envs)
    batch.reset(range(num_envs), [(i, i) for i in range(num_envs)], batch.new_out())
    step = _again_and_again(batch, lambda: batch.advance(rings))
    return Case(f"bare compiled plant and ring, {_threads(threads)}", num_envs, step, batch.close)


def _again_and_again(batch: Batch, step: Callable[[], Any]) -> Callable[[], None]:
    """A step that takes every slot back to where it is now before any crystal fails."""
    slots, first = batch.memory.slots, batch.memory.slots.copy()

    def again() -> None:
        step()
        if slots["k"][0] >= _UNFAILED:
            slots[:] = first

    return again


def plain_numpy(num_envs: int) -> Case:
    """The same equations uncompiled on arrays: plant and ring alone, nominal pullers."""
    p = make_puller()
    x = State(*(np.full(num_envs, value) for value in p.state_0))
    u = Inputs(p.v_0, p.Q_H_0)

    def step() -> None:
        new = rk4(x, u, NO_DISTURBANCE, p, 5.0, HURLE.slope)
        for held, value in zip(x, new, strict=True):
            held[:] = value
        HURLE.ring_offset(x.r_c, x.h_c, p)

    return Case("plain NumPy plant and ring", num_envs, step, lambda: None)


def failing(num_envs: int, fails: bool) -> Case:
    """Open loop on "hard": as episodes keep failing, or over and over the first 50 steps, before any does."""
    env = CzVectorEnv(num_envs, scenario="hard", autoreset_mode=AutoresetMode.SAME_STEP)
    action = np.zeros((num_envs, 2), np.float32)
    if fails:
        spread_out(env)
        for _ in range(env.config.steps):
            env.step(action)
    else:
        env.reset(seed=0)

    def step() -> None:
        env.step(action)

    label = "open loop on hard, " + ("failing episodes" if fails else "no failures")
    return Case(label, num_envs, step if fails else _again_and_again(env._batch, step), env.close)


def scalars() -> list[Case]:
    """Our scalar environment and Gymnasium's, all through ``gym.make``."""
    return [
        scalar("Cz-v0 scalar", gym.make("Cz-v0")),
        scalar("Pendulum-v1 scalar", gym.make("Pendulum-v1")),
        scalar("CartPole-v1 scalar", _Flat(gym.make("CartPole-v1"))),
    ]


class _Flat(gym.ActionWrapper[Any, Any, Any]):
    """A discrete environment driven by the array of zeros that the others take."""

    def action(self, action: Any) -> Any:
        """The first action."""
        return int(action)


def redraw_seconds(num_envs: int) -> Callable[[], Any]:
    """A call that draws every slot anew."""
    env: Any = CzEnv() if num_envs == 1 else CzVectorEnv(num_envs)
    env.reset(seed=0)
    return lambda: env.reset()


def _threads(count: int) -> str:
    return "1 thread" if count == 1 else f"{count} threads"
