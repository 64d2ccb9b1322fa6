"""The arrays of the compiled loops: the memory of a slot, the constants of a step and its results."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cz_gym.body.plant import Puller, State
from cz_gym.episodes.record import FREEZES, Episode, Stream
from cz_gym.episodes.rng import WORDS
from cz_gym.errors import CzError


def _record(fields: tuple[str, ...]) -> np.dtype[Any]:
    return np.dtype([(name, np.float64) for name in fields])


SLOT = np.dtype(
    [
        ("puller", _record(Puller._fields)),
        ("episode", _record(Episode._fields)),
        ("x", _record(State._fields)),
        ("freezes", np.float64, (FREEZES, 2)),
        ("v_p", np.float64),
        ("Q_H", np.float64),
        ("Q_H_slewed", np.float64),
        ("dT_i", np.float64),
        ("Q_d", np.float64),
        ("ring", np.float64),
        ("h_seen", np.float64),
        ("T_1", np.float64),
        ("valid", np.float64),
        ("integral", np.float64),
        ("drift", np.float64),
        ("k", np.int64),
        ("frames", np.int64),
        ("over", np.int64),
        ("k_seen", np.int64),
        ("key", np.uint64, (2,)),
        ("scenario", np.int64),
        ("v_p_before", np.float64),
        ("Q_H_before", np.float64),
        ("clipped", np.float64),
        ("point", np.int64),
        ("fast", np.float64),
        ("slow", np.float64),
        ("streams", np.uint64, (len(Stream), WORDS)),
    ],
    align=True,
)
"""One slot: constants of puller and episode, plant state, drives [m/s, W], the disturbance of the last substep,
the last readings (``ring`` [m] without the operator's bias, with the meniscus height ``h_seen`` [m] and the sample
``k_seen`` it was taken at, ``T_1`` [K], ``valid``), the integral of the scaled ring error, the drift [K] that ``Q_d``
belongs to, the sample number ``k``, the number of camera frames taken, whether the episode is over, the ``key`` it
was drawn from and the index of its ``scenario`` in the mixture, the drives [m/s, W] of the step before and whether the
action was clipped: a sample can be written again from its slot. Then the 5 s grid point that ``dT_i`` belongs to with
its two processes [standard deviations], and the episode's random streams, as far as they are drawn from."""
PULLER_AT, EPISODE_AT, STATE_AT = np.cumsum([0, len(Puller._fields), len(Episode._fields)]).tolist()
"""Offsets in a slot of the puller's constants, the episode's constants and the plant's state [numbers of 8 bytes]."""


class Clock(NamedTuple):
    """Time base of the slots, and the limit of their radius."""

    interval: float
    """Control interval [s]."""
    steps: int
    """Steps in an episode."""
    grid_points: int
    """Points of the 5 s grid in an episode."""
    radius_limit: float
    """Largest |r_c - r_ref| [m]."""


class Memory(NamedTuple):
    """The memory of the slots, one row per slot."""

    slots: Any
    """Records of :data:`SLOT`, shape (n,)."""
    numbers: Any
    """The same memory as plain float64, shape (n, numbers a record)."""
    history: Any
    """Running sums of the remembered channels, circular in time, shape (n, depth, channels); depth 0: none."""
    frames: Any
    """Time [s], ring [m] and meniscus height [m] of camera frames, circular, shape (n, depth, 3)."""


class Out(NamedTuple):
    """The results of a step, one row per slot."""

    observation: Any
    """The "measured" or "history" channels, float32, shape (n, channels)."""
    state: Any
    """The "state" channels, float32, shape (n, channels); of width 0 if not wanted."""
    image: Any
    """The camera's image, uint8, shape (n, rows, columns, 1); empty unless it is the observation. Written after the
    step, by :mod:`cz_gym.camera.image`."""
    reward: Any
    """Float64, shape (n,)."""
    terminated: Any
    """Bool, shape (n,)."""
    truncated: Any
    """Bool, shape (n,)."""
    info: Any
    """Rows of :class:`cz_gym.body.signals.Logged`, float64, shape (rows, n or a little more:
    see :func:`info_width`)."""


class ObservationScales(NamedTuple):
    """Constants with which a slot's signals become an observation."""

    measured: Any
    """One over the scales of the measured channels, shape (channels,)."""
    state: Any
    """One over the scales of the state channels, shape (channels,)."""
    newest: Any
    """Age of the newest sample of each remembered span, shape (lags,)."""
    before: Any
    """Age of the sample before the oldest one of each span, shape (lags,)."""
    share: Any
    """One over the number of samples in each span, shape (lags,)."""
    everything: bool
    """Whether all of ``info`` is written; otherwise only ``LEAN`` and ``action_clipped``."""


INFO_CHOICES = ("lean", "all")


def check_info(info: str) -> bool:
    """Return whether all of ``info`` is wanted; raise CzError for anything but "lean" and "all"."""
    if info not in INFO_CHOICES:
        raise CzError(f"info must be one of {', '.join(INFO_CHOICES)}, not {info!r}")
    return info == "all"


def info_width(n: int) -> int:
    """Length of an info row for n slots: rows a multiple of 4 KiB apart would share one set of the cache."""
    return n + 8 if n % 64 == 0 else n
