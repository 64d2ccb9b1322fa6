"""An episode's draw: a value made at reset from one 128-bit key, and the series that follow from it.

Ramps are kept as parameters and evaluated where needed (:mod:`cz_gym.body.schedule`). The noise of each step comes
from the episode's own streams (:mod:`cz_gym.episodes.noise`): the environment draws it step by step, this module as
whole series.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.jit.compile import kernel

from . import draw as draws
from .draw import STREAMS, seed_streams
from .noise import draw_series
from .record import FREEZES, Episode, Factors, scenario_table
from .rng import WORDS
from .scenario import Range, Scenario

Floats = npt.NDArray[np.float64]


class Series(NamedTuple):
    """The random series of an episode."""

    interface: Floats
    """dT_i on the 5 s grid [K], shape (grid points,)."""
    noise: Floats
    """Camera noise [m] (NaN: the sample drops out) and pyrometer noise [K], shape (samples, 2)."""
    freezes: Floats
    """Start and end of each camera freeze [s], shape (FREEZES, 2); the last is unflagged, end 0 is none."""


def new_series(grid_points: int, samples: int) -> Series:
    """Series of zeros."""
    return Series(np.zeros(grid_points), np.zeros((samples, 2)), np.zeros((FREEZES, 2)))


def draw_factors(scenario: Scenario, mix: Range, key: tuple[int, int]) -> Factors:
    """Draw the puller; ``mix`` is the range of the share of conduction [-]."""
    return Factors(*_factors(scenario_table(scenario).records, np.array(mix, np.float64), np.array(key, np.uint64)))


def draw_episode(scenario: Scenario, key: tuple[int, int], out: Series) -> Episode:
    """Draw an episode: ramps and constants are returned, series written into ``out``."""
    return Episode(*_episode(scenario_table(scenario).records, np.array(key, np.uint64), *out))


@kernel
def _factors(record: Any, mix: Any, key: Any) -> Any:
    streams = np.zeros((STREAMS, WORDS), np.uint64)
    seed_streams(streams, key)
    return draws.draw_factors(record[0], mix, streams)


@kernel
def _episode(record: Any, key: Any, interface: Any, noise: Any, freezes: Any) -> Any:
    streams = np.zeros((STREAMS, WORDS), np.uint64)
    seed_streams(streams, key)
    e = draws.draw_episode(record[0], streams, freezes)
    draw_series(e, streams, interface, noise)
    return e
