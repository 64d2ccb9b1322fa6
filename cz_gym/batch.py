"""A batch of slots: the arrays, the draws at reset and the compiled step, on as many threads as pay.

The scalar environment is a batch of one; both environments are thin shells over this class.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from .config import Config
from .episode import GRID, Series, draw_episode, draw_factors, randomised
from .kernels import KERNELS, Kernels, build_kernels
from .meniscus import HURLE, MeniscusModel
from .observation import HISTORY, LAGGED, MEASURED, STATE, lags, scales
from .plant import check_puller
from .scenario import MAX_LATENCY, Scenario
from .slots import INFO, SLOT, Clock, Memory, Out, Reading

SLOTS_PER_THREAD = 256
"""Fewest slots worth a thread of their own."""
Key = tuple[int, int]
"""128 random bits that an episode is drawn from, as two 64-bit words."""


@lru_cache(maxsize=8)
def _kernels(meniscus: MeniscusModel) -> Kernels:
    return KERNELS if meniscus == HURLE else build_kernels(meniscus)


def new_key(random: np.random.Generator) -> Key:
    """The next episode key of an environment's random stream."""
    raw = random.bit_generator.random_raw(2)
    return int(raw[0]), int(raw[1])


@dataclass(frozen=True)
class SlotState:
    """Everything one slot is at an instant; picklable, continued bit-exactly by :meth:`Batch.restore`."""

    config_hash: str
    slot: npt.NDArray[Any]
    interface: npt.NDArray[np.float64]
    noise: npt.NDArray[np.float64]
    history: npt.NDArray[np.float64]
    frames: npt.NDArray[np.float64]
    sample: tuple[npt.NDArray[Any], ...]
    """The slot's rows of the last :class:`cz_gym.slots.Out`."""


class Batch:
    """``num_envs`` slots of one configuration.

    Every array that :meth:`step` and :meth:`reset` fill is fresh: nothing returned is written again.
    """

    def __init__(self, config: Config, num_envs: int, threads: int | None = None) -> None:
        self.config = config
        self.num_envs = num_envs
        self.kernels = _kernels(config.meniscus)
        self.clock = Clock(config.control_interval, config.steps)
        self.channels = len(MEASURED) if config.observation == "measured" else len(HISTORY)
        self.state_channels = 0 if config.observation == "measured" else len(STATE)
        if config.observation == "state":
            self.channels = len(MEASURED)
        ages = lags(config.control_interval)
        v_0 = config.parameters.v_0
        self.reading = Reading(scales(MEASURED, v_0), scales(STATE, v_0), ages.newest, ages.oldest)
        depth = int(ages.oldest[-1]) + 2 if config.observation == "history" else 0
        grid_points = math.ceil(config.horizon / GRID) + 1
        frames = (
            math.ceil(MAX_LATENCY / config.control_interval)
            + math.ceil((MAX_LATENCY + config.control_interval) / GRID)
            + 2
        )
        self.memory = Memory(
            np.zeros(num_envs, SLOT),
            np.zeros((num_envs, grid_points)),
            np.zeros((num_envs, config.steps + 1, 2)),
            np.zeros((num_envs, depth, len(LAGGED))),
            np.zeros((num_envs, frames, 2)),
        )
        self.memory.slots["over"] = 1
        self._actions = np.zeros((num_envs, 2))
        self._all = np.ones(num_envs, np.bool_)
        threads = threads or os.cpu_count() or 1
        self._parts = max(1, min(threads, num_envs // SLOTS_PER_THREAD))
        self._pool: ThreadPoolExecutor | None = None
        self._owner = os.getpid()

    def new_out(self) -> Out:
        """Fresh arrays to write into."""
        n = self.num_envs
        return Out(
            np.empty((n, self.channels), np.float32),
            np.empty((n, self.state_channels), np.float32),
            np.empty(n),
            np.empty(n, np.bool_),
            np.empty(n, np.bool_),
            np.empty((len(INFO), n)),
        )

    def reset(self, which: Iterable[int], keys: Iterable[Key], out: Out, scenario: Scenario | None = None) -> None:
        """Draw new episodes for the slots ``which`` and write their first sample into ``out``."""
        config = self.config if scenario is None else self.config.with_scenario(scenario)
        indices = np.fromiter(which, np.int64)
        for i, key in zip(indices.tolist(), keys, strict=True):
            self._draw(i, key, config)
        self.observe(indices, out)

    def observe(self, which: npt.NDArray[np.int64], out: Out) -> None:
        """Write the first sample of freshly drawn slots."""
        self.kernels.observe(self.memory, which, self.clock, self.reading, out)

    def step(self, actions: npt.ArrayLike, out: Out, active: npt.NDArray[np.bool_] | None = None) -> None:
        """Advance the active slots by one control interval; actions of shape (num_envs, 2), not NaN."""
        self._actions[:] = actions
        active = self._all if active is None else active
        arguments: tuple[Any, ...] = (self.memory, self._actions, active, self.clock, self.reading, out)
        if self._parts == 1:
            self.kernels.step(*arguments, 0, self.num_envs)
            return
        if self._pool is None or self._owner != os.getpid():
            # A forked child inherits the pool without its threads and would wait for them for ever.
            self._pool = ThreadPoolExecutor(self._parts - 1, thread_name_prefix="cz-gym")
            self._owner = os.getpid()
        bounds = np.linspace(0, self.num_envs, self._parts + 1).astype(int).tolist()
        part = partial(self.kernels.step, *arguments)
        futures = [self._pool.submit(part, start, stop) for start, stop in pairwise(bounds[1:])]
        part(bounds[0], bounds[1])
        for future in futures:
            future.result()

    def save(self, i: int, out: Out) -> SlotState:
        """A copy of everything slot i is, with its last sample."""
        sample = tuple(np.copy(array[..., i] if name == "info" else array[i]) for name, array in out._asdict().items())
        # array[i] of a structured array is a view that np.copy does not copy; array[i, ...] is an array.
        slot, interface, noise, history, frames = (array[i, ...].copy() for array in self.memory)
        return SlotState(self.config.hash, slot, interface, noise, history, frames, sample)

    def check(self, state: SlotState) -> None:
        """Raise ValueError if this is no saved state, or one saved under other settings."""
        if not isinstance(state, SlotState):
            raise ValueError(f"expected a state made by get_state, not {type(state).__name__}")
        if state.config_hash != self.config.hash:
            raise ValueError(
                f"this state was saved under other settings (hash {state.config_hash}) than this environment's "
                f"(hash {self.config.hash}): scenario, model, observation, interval, horizon and parameters must agree"
            )

    def restore(self, i: int, state: SlotState, out: Out) -> None:
        """Continue slot i from a state that :meth:`check` let pass and write its last sample into ``out``."""
        saved = (state.slot, state.interface, state.noise, state.history, state.frames)
        for array, values in zip(self.memory, saved, strict=True):
            array[i] = values
        for name, array, values in zip(out._fields, out, state.sample, strict=True):
            array[(..., i) if name == "info" else i] = values

    def close(self) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def _draw(self, i: int, key: Key, config: Config) -> None:
        memory = self.memory
        slot = memory.slots[i]
        factors = draw_factors(config.scenario, config.mix, key)
        puller = self.kernels.derive(randomised(config.parameters, factors), factors.lam)
        check_puller(puller)
        series = Series(memory.interface[i], memory.noise[i], slot["freezes"])
        episode = draw_episode(config.scenario, key, series)
        slot["puller"], slot["episode"] = puller, episode
        slot["x"] = (puller.r_0 + episode.r_c_start, puller.h_0, puller.T_1_0, puller.T_2_0, puller.T_b_0)
        slot["v_p"], slot["Q_H"], slot["Q_H_slewed"] = puller.v_0, puller.Q_H_0, puller.Q_H_0
        slot["dT_i"], slot["Q_d"] = memory.interface[i, 0], 0.0
        slot["integral"], slot["k"], slot["frames"], slot["over"] = 0.0, 0, 0, 0
