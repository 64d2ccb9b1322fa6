"""The seam that controllers and agents share: stable-baselines3's ``predict``, batched."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

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


def batched(observation: Any) -> tuple[Floats, bool]:
    """The observation with a batch axis, and whether it had none."""
    array = np.asarray(observation, np.float64)
    return np.atleast_2d(array), array.ndim == 1


def to_action(pull: Floats, heat: Floats, single: bool) -> npt.NDArray[np.float32]:
    """Actions from the two normalised inputs, each of shape (n,), clipped to the box."""
    action = np.clip(np.stack([pull, heat], axis=-1), -1.0, 1.0).astype(np.float32)
    return action[0] if single else action


def fresh(state: Any, zeros: Any, episode_start: Any) -> Any:
    """The state as a tuple of arrays, zeroed where an episode begins; ``zeros`` is the state at rest."""
    if state is None:
        return zeros
    if episode_start is None:
        return state
    begins = np.atleast_1d(np.asarray(episode_start, np.bool_))
    if not begins.any():
        return state
    kept = (
        np.where(begins.reshape(-1, *(1,) * (old.ndim - 1)), zero, old) for old, zero in zip(state, zeros, strict=True)
    )
    return type(zeros)(*kept)
