"""The interface that controllers and agents share: stable-baselines3's ``predict``, for a batch of crystals at once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from cz_gym.config import positive
from cz_gym.observation import HEATER_SCALE, Measured, decode

Floats = npt.NDArray[np.float64]


@runtime_checkable
class Policy(Protocol):
    """Anything that acts on observations.

    Settings are immutable; what a policy remembers travels in ``state``. ``observation`` has shape (n, channels) or
    (channels,), the action shape (n, 2) or (2,), float32; ``episode_start`` (bool, shape (n,)) marks slots that begin
    an episode, whose memory starts anew; None means none of them does, except when ``state`` is None.
    """

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """The action and the next state."""
        ...


class MeasuredController(ABC):
    """A controller that reads "measured" (or "history") observations.

    A subclass works in SI units on a batch of n crystals: it says what it remembers at first, and what it does with a
    sample. Its memory is a tuple of arrays with a leading axis n, or a tuple of such tuples. ValueError for a
    ``control_interval`` [s] that is not positive.
    """

    action: ClassVar[str] = "direct"
    """What its actions mean."""

    def __post_init__(self) -> None:
        positive("control_interval", self.control_interval)

    @property
    @abstractmethod
    def control_interval(self) -> float:
        """Time between actions that it is made for [s]."""

    @property
    @abstractmethod
    def v_0(self) -> float:
        """Nominal pull speed of the environment's parameters [m/s]."""

    @abstractmethod
    def at_rest(self, seen: Measured) -> Any:
        """The memory before the first sample, which is ``seen``."""

    @abstractmethod
    def step(self, seen: Measured, memory: Any) -> tuple[Floats, Floats, Any]:
        """Pull speed v_p - v_0 [m/s] and heater power Q_H - Q_H0 [W], each of shape (n,), and the new memory."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """The action and the next memory; arguments as of :class:`Policy`."""
        array, single = batched(observation)
        seen = decode(array, self.v_0)
        pull, power, memory = self.step(seen, fresh(state, self.at_rest(seen), episode_start))
        return to_action(pull / self.v_0, power / HEATER_SCALE, single), memory


def batched(observation: Any) -> tuple[Floats, bool]:
    """The observation with a batch axis, and whether it had none."""
    array = np.asarray(observation, np.float64)
    return np.atleast_2d(array), array.ndim == 1


def to_action(pull: Floats, heat: Floats, single: bool) -> npt.NDArray[np.float32]:
    """Actions from the two normalised inputs, each of shape (n,), clipped to the box."""
    action = np.clip(np.stack([pull, heat], axis=-1), -1.0, 1.0).astype(np.float32)
    return action[0] if single else action


def fresh(state: Any, zeros: Any, episode_start: Any) -> Any:
    """The state, a tuple of arrays or of such tuples, with ``zeros``, the state at rest, where an episode begins."""
    if state is None:
        return zeros
    if episode_start is None:
        return state
    begins = np.atleast_1d(np.asarray(episode_start, np.bool_))
    return select(begins, zeros, state) if begins.any() else state


def select(where: npt.NDArray[np.bool_], one: Any, other: Any) -> Any:
    """``one`` in the slots where ``where`` is true, ``other`` elsewhere; both as a state in :func:`fresh`."""
    return map_arrays(lambda a, b: np.where(where.reshape(-1, *(1,) * (b.ndim - 1)), a, b), one, other)


def map_arrays(function: Callable[..., Any], *values: Any) -> Any:
    """A nested NamedTuple with the function's result in place of each array; ``values`` are nested alike."""
    if isinstance(values[0], tuple):
        return type(values[0])(*(map_arrays(function, *parts) for parts in zip(*values, strict=True)))
    return function(*values)


def stack(values: Sequence[Any]) -> Any:
    """NamedTuples of one kind as one of arrays, with a new leading axis."""
    return map_arrays(lambda *parts: np.stack(parts), *values)
