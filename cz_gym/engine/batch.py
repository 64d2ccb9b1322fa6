"""A batch of slots: the arrays, the draws at reset and the compiled step, on several threads if large.

The scalar environment is a batch of one; both environments are thin shells over :class:`Batch`.
"""

import math
import os
from collections import deque
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding

from cz_gym.camera.image import build_render
from cz_gym.camera.view import IMAGE, make_view
from cz_gym.config import Config, Identity
from cz_gym.episodes.draw import ScenarioTable, scenario_table
from cz_gym.episodes.scenario import GRID, Distribution, series_table
from cz_gym.jit import entry
from cz_gym.physics.parameters import MAX_DEAD_TIME, MAX_LATENCY
from cz_gym.process import NO_OPERATING_POINT, scales
from cz_gym.spaces import drives_of, lags, observations
from cz_gym.support.errors import CzError

from .kernels import BatchConstants, ObservationScales, Out, SlotMemory, build_kernels, info_width, slot_type


def processors() -> int:
    """Return how many processors this process may use; taskset or a container may allow fewer than the machine has."""
    counts: Any = os  # Python 3.13 has the one, Linux the other
    if hasattr(counts, "process_cpu_count"):
        return counts.process_cpu_count() or 1
    return len(counts.sched_getaffinity(0)) if hasattr(counts, "sched_getaffinity") else os.cpu_count() or 1


SLOTS_PER_THREAD, SLOTS_AT_ONCE = 256, 128
"""Least slots per thread in a step, and slots that a thread takes at once."""
DRAWS_PER_THREAD, DRAWS_AT_ONCE = 16, 16
"""Least draws per thread in a reset, and draws that a thread takes at once."""
_SAVED = ("slot", "history", "frames")
Key = tuple[int, int]
"""The 128 random bits from which an episode is drawn, as two 64-bit words."""


def new_key(random: np.random.Generator) -> Key:
    """The next episode key of an environment's random stream."""
    raw = random.bit_generator.random_raw(2)
    return int(raw[0]), int(raw[1])


def first_key(seed: int) -> Key:
    """The key of the first episode after ``reset(seed=seed)``."""
    return new_key(seeding.np_random(seed)[0])


@dataclass(frozen=True)
class SlotState:
    """The whole state of a slot; picklable, continued bit for bit by :meth:`Batch.restore`."""

    identity: Identity
    slot: npt.NDArray[Any]
    history: npt.NDArray[np.float64]
    frames: npt.NDArray[np.float64]
    scenario: str
    """Name of the scenario that the episode was drawn from."""


class Batch:
    """The slots of ``num_envs`` crystals with the same settings, and the compiled loops over them.

    Each step writes into new arrays (:meth:`new_out`): those of earlier steps never change.
    """

    def __init__(self, config: Config, num_envs: int, threads: int | None = None, everything: bool = True) -> None:
        self.config = config
        self.identity = config.identity
        self.num_envs = num_envs
        process = config.process
        self.kernels = build_kernels(process, config.meniscus)
        points = math.ceil(config.horizon / GRID) + 1
        series = series_table(config.scenario.scenarios)
        self.fixed = BatchConstants(
            config.control_interval, config.steps, points, config.radius_limit, config.weights, series
        )
        self.drives = drives_of(config.action, config.control_interval, *config.ranges[::-1])
        self.channels = len(observations(process)["history" if config.observation == "history" else "measured"])
        shows_state = config.observation == "state" or (everything and config.observation == "history")
        self.state_channels = len(process.state) if shows_state else 0
        self._camera = config.observation == "camera"
        newest, oldest = lags(config.control_interval)
        measured, state = (1.0 / scales(channels, *config.ranges) for channels in (process.measured, process.state))
        share = 1.0 / (oldest - newest + 1)
        self.scales = ObservationScales(measured, state, newest, oldest + 1, share, everything)
        depth = int(oldest[-1]) + 2 if config.observation == "history" else 0
        interval = config.control_interval
        oldest_age = max(MAX_LATENCY, MAX_DEAD_TIME)
        frames = math.ceil(oldest_age / interval) + math.ceil((oldest_age + interval) / GRID) + 2
        slots = np.zeros(num_envs, slot_type(process))
        self.memory = SlotMemory(
            slots,
            slots.view(np.float64).reshape(num_envs, -1),
            np.zeros((num_envs, depth, process.lagged)),
            np.zeros((num_envs, frames, 6)),
        )
        self.memory.slots["over"] = 1
        self._lots = scenario_table(config.scenario, config.model)
        self.scenarios, self._drawn = np.full(num_envs, "", object), slots["scenario"]
        self._parameters = type(config.parameters)(*map(float, config.parameters))
        self.actions = np.zeros((num_envs, 2))
        self._all = np.ones(num_envs, np.bool_)
        out, which, keys = self.new_out(), np.zeros(1, np.int64), np.zeros((1, 2), np.uint64)
        stepped = (self.memory, self.actions, self._all, self.fixed, self.drives, self.scales, out, 0, 1)
        drawn = self._drawing(which, keys, self._lots, out)
        self._step, self._draw = entry(self.kernels.step, stepped), entry(self.kernels.draw, (*drawn, 0, 1))
        threads = threads or os.cpu_count() or 1
        self._parts = max(1, min(threads, num_envs // (1 if self._camera else SLOTS_PER_THREAD)))
        if self._camera:
            self._view = make_view(config.camera)
            seen = (self.memory.slots, self._all, self._view, out.image, 0, 1)
            self._images_of = entry(build_render(config.process, config.meniscus), seen)
        self._pool: ThreadPoolExecutor | None = None
        self._owner = os.getpid()

    def new_out(self) -> Out:
        """New arrays for the results of a step."""
        n = self.num_envs
        return Out(
            np.empty((n, self.channels), np.float32),
            np.empty((n, self.state_channels), np.float32),
            np.empty((n, *(IMAGE if self._camera else (0, 0, 0))), np.uint8),
            np.empty(n),
            np.empty(n, np.bool_),
            np.empty(n, np.bool_),
            np.empty((len(self.config.process.info), info_width(n))),
        )

    def shown(self, out: Out) -> npt.NDArray[Any]:
        """The observations among the results of a step, one row per slot."""
        shown: npt.NDArray[Any] = {"state": out.state, "camera": out.image}.get(
            self.config.observation, out.observation
        )
        return shown

    def bound_step(self, actions: npt.NDArray[np.float64], out: Out) -> Any:
        """``step`` of all slots, bound to these arrays: it is called without arguments."""
        n = self.num_envs
        step = partial(self._step, self.memory, actions, self._all, self.fixed, self.drives, self.scales, out, 0, n)
        if not self._camera:
            return step

        def step_and_render() -> None:
            step()
            self._render(out, self._all)

        return step_and_render

    def _render(self, out: Out, active: npt.NDArray[np.bool_]) -> None:
        """Write the images of the active slots, where images are observed."""
        if self._camera:
            arguments = (self.memory.slots, active, self._view, out.image)
            self._run(self._images_of, arguments, self.num_envs, 1)

    def reset(self, which: Sequence[int], keys: Iterable[Key], out: Out, given: Distribution | None = None) -> None:
        """Draw new episodes for the slots ``which`` and write their first sample into ``out``.

        They are drawn from the given scenario or mixture, which must be on the batch's puller; by default from its
        own. A puller without a finite operating point is drawn again; ValueError if none is found.
        """
        if given and any(each.series for each in (*given.scenarios, *self.config.scenario.scenarios)):
            raise CzError("series of a log come with the environment: make it with that scenario, not its reset")
        lots = self._lots if given is None else scenario_table(given, self.config.model)
        slots = np.array(which, np.int64)
        words = np.array(list(keys), np.uint64).reshape(-1, 2)
        arguments = self._drawing(slots, words, lots, out)
        if max(self._run(self._draw, arguments, len(slots), DRAWS_PER_THREAD, DRAWS_AT_ONCE)) >= 0:
            raise CzError(NO_OPERATING_POINT)
        members = (given or self.config.scenario).scenarios
        for i in which:
            self.scenarios[i] = members[self._drawn.item(i)].name
        if self._camera:
            self._render(out, np.isin(np.arange(self.num_envs), slots))

    def _drawing(self, which: Any, keys: Any, lots: ScenarioTable, out: Out) -> tuple[Any, ...]:
        """Arguments of the compiled draw, without the range of slots."""
        return self.memory, which, keys, lots, self._parameters, self.fixed, self.scales, out

    def step(self, actions: npt.ArrayLike, out: Out, active: npt.NDArray[np.bool_] | None = None) -> int:
        """Advance the active slots by one control interval; actions of shape (num_envs, 2), not NaN.

        Returns how many episodes ended.
        """
        if actions is not self.actions:
            self.actions[:] = actions
        active = self._all if active is None else active
        arguments = (self.memory, self.actions, active, self.fixed, self.drives, self.scales, out)
        ended: int = sum(self._run(self._step, arguments, self.num_envs, SLOTS_PER_THREAD, SLOTS_AT_ONCE))
        self._render(out, active)
        return ended

    def advance(self, rings: npt.NDArray[np.float64]) -> None:
        """Advance drives and plant and write the rings [m], nothing else: the reference for the speed of a step."""
        arguments = (self.memory, self.actions, self._all, self.fixed, self.drives, rings)
        self._run(self.kernels.plant, arguments, self.num_envs, SLOTS_PER_THREAD, SLOTS_AT_ONCE)

    def _run(self, loop: Any, arguments: tuple[Any, ...], count: int, least: int, share: int = 1) -> list[Any]:
        """Run a loop over ``count`` rows, on one thread for every ``least`` rows; return the results of its calls.

        A free thread takes the next ``share`` rows: so a late or busy one delays nobody.
        """
        parts = min(self._parts, count // least)
        if parts <= 1:
            return [loop(*arguments, 0, count)]
        if self._pool is None or self._owner != os.getpid():
            # A forked child inherits the pool without its threads and would wait for them for ever.
            self._pool = ThreadPoolExecutor(self._parts - 1, thread_name_prefix="cz-gym")
            self._owner = os.getpid()
        starts = deque([*range(0, count, share), *[None] * parts])

        def work() -> list[Any]:
            return [loop(*arguments, start, min(start + share, count)) for start in iter(starts.popleft, None)]

        futures = [self._pool.submit(work) for _ in range(parts - 1)]
        try:
            mine = work()
        finally:
            begun = [future for future in futures if not future.cancel()]
            wait(begun)
        return [*mine, *(result for future in begun for result in future.result())]

    def save(self, i: int) -> SlotState:
        """A copy of the state of slot i."""
        # array[i] of a structured array is a view that np.copy does not copy; array[i, ...] is an array.
        slot, history, frames = (rows[i, ...].copy() for rows in self._saved())
        return SlotState(self.identity, slot, history, frames, self.scenarios[i])

    def check(self, state: SlotState) -> None:
        """Raise ValueError if this is no saved state, or one saved under other settings."""
        saved = getattr(state, "identity", None)
        if not isinstance(saved, Identity):
            raise CzError("this state was saved by another version of cz_gym")
        odd = saved.difference(self.identity)
        if odd is not None:
            raise CzError(f"this state was saved under other settings than this environment's: {odd}")
        for name, rows in zip(_SAVED, self._saved(), strict=True):
            array = getattr(state, name)
            if not isinstance(array, np.ndarray) or (array.dtype, array.shape) != (rows.dtype, rows.shape[1:]):
                raise CzError(f"this state was saved by another version of cz_gym, or damaged: its {name} does not fit")
        if not 0 <= int(state.slot["k"]) <= self.fixed.steps:
            raise CzError(f"this state is damaged: sample {int(state.slot['k'])} of {self.fixed.steps}")

    def restore(self, which: Sequence[int], states: Sequence[SlotState], out: Out) -> None:
        """Continue slots from states that passed :meth:`check`; write their last samples into ``out``."""
        for i, state in zip(which, states, strict=True):
            for name, rows in zip(_SAVED, self._saved(), strict=True):
                rows[i] = getattr(state, name)
            self.scenarios[i] = state.scenario
        self.kernels.show(self.memory, np.array(which, np.int64), self.fixed, self.scales, out, 0, len(which))
        if self._camera:
            self._render(out, np.isin(np.arange(self.num_envs), which))

    def _saved(self) -> tuple[npt.NDArray[Any], ...]:
        memory = self.memory
        return memory.slots, memory.history, memory.frames

    def close(self) -> None:
        """Stop the threads."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
