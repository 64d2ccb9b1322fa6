"""Runs of an environment for a check, with sampled actions and the resets that its autoreset mode needs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from .nested_arrays import flatten, overwrite

MakeVector = Callable[[int, AutoresetMode], Any]
"""Makes the native form from a number of slots and an autoreset mode."""
MakeScalar = Callable[[], Any]


class NotConforming(AssertionError):
    """A vector environment differs from a vector of its scalar form; the message is one line."""


class Checked(NamedTuple):
    """Counts of a check."""

    steps: int = 0
    """Batched steps of the native form."""
    episodes: int = 0
    """Episodes that ended, all slots together."""
    failures: int = 0
    """Episodes that ended by ``terminated``."""
    held: int = 0
    """Returned arrays that were kept through later calls."""

    def __str__(self) -> str:
        """The counts in words."""
        return (
            f"{self.steps} steps, {self.episodes} episodes, {self.failures} of them failures, "
            f"{self.held} arrays kept through later calls"
        )

    def __add__(self, other: Any) -> Checked:
        """The sums of both."""
        return Checked(*(one + more for one, more in zip(self, other, strict=True)))


class Event(NamedTuple):
    """A call and its result."""

    call: str
    result: tuple[Any, ...]
    first: Any
    """Slots whose observation is an episode's first, bool of shape (num_envs,)."""


@dataclass
class Driver:
    """Runs environments in one autoreset mode, and counts the native form's steps and episodes."""

    make_vector: MakeVector
    make_scalar: MakeScalar
    num_envs: int
    steps: int
    seed: int
    mode: AutoresetMode
    seen: Checked = field(default_factory=Checked)

    def vector(self) -> Any:
        """A new native form, as a context."""
        return closing(self.make_vector(self.num_envs, self.mode))

    def scalars(self) -> Any:
        """The oracle as a context: Gymnasium's vector of scalars."""
        return closing(SyncVectorEnv([self.make_scalar] * self.num_envs, autoreset_mode=self.mode))

    def require(self, fact: Any, message: str) -> None:
        """Raise :class:`NotConforming` unless the fact is true."""
        if not fact:
            raise NotConforming(f"[{self.mode.value}] {message}")

    def run(self, env: VectorEnv[Any, Any, Any], oracle: bool = False, overwrites: bool = False) -> Iterator[Event]:
        """Reset and step with sampled actions; where the mode is ``DISABLED``, reset the slots that ended.

        An ``oracle`` is not counted. ``overwrites`` overwrites each action after its step.
        """
        env.action_space.seed(self.seed)
        over, none = np.zeros(self.num_envs, np.bool_), np.zeros(self.num_envs, np.bool_)
        yield Event("reset", env.reset(seed=self.seed), ~none)
        for k in range(self.steps):
            action = env.action_space.sample()
            given = [(array.value, array.value.copy()) for array in flatten(action)]
            result = env.step(action)
            self.require(all(np.array_equal(a, b) for a, b in given), f"step {k} wrote into the actions it was given")
            if overwrites:
                overwrite(action)
            ended = np.array(result[2] | result[3], np.bool_)
            if not oracle:
                self.seen += Checked(1, int(ended.sum()), int(np.sum(result[2])))
            begun = {AutoresetMode.NEXT_STEP: over, AutoresetMode.SAME_STEP: ended}.get(self.mode, none)
            over = ended.copy()
            yield Event(f"step {k}", result, begun.copy())
            if self.mode == AutoresetMode.DISABLED and over.any():
                mask = over.copy()
                again = env.reset(options={"reset_mask": mask})
                mask[:] = True
                yield Event(f"reset of ended slots after step {k}", again, over)
