"""A scenario as one record for the compiled draws, and the constants of a drawn episode."""

import math
from enum import IntEnum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .mixture import Distribution
from .scenario import FAMILIES, MAX_FLAGGED, MAX_UNFLAGGED
from .scenarios import mix_of

FREEZES = MAX_FLAGGED + MAX_UNFLAGGED
"""Freeze windows an episode can hold; the last is the unflagged one."""


FIRST_FRAME = 8
"""Number of the random stream from which the camera's first frame draws its shot noise; frame k draws from
FIRST_FRAME + k. Written into every image: it stays, however many members :class:`Stream` has."""
MOST_FRAMES = 2**31
"""Streams that are reserved for frames."""
MIXTURE_STREAM = 2**32 - 1
"""Number of the random stream from which a mixture's episode draws its scenario: the last one there is."""


class Stream(IntEnum):
    """The independent random streams of an episode; a new one goes last."""

    START = 0
    PARAMETERS = 1
    SCHEDULE = 2
    INTERFACE = 3
    SENSOR = 4
    FAULTS = 5
    DROPOUTS = 6
    OUTLIERS = 7


def stream_number(index: int) -> int:
    """Number n of an episode's stream, ``SeedSequence(key, spawn_key=(n,))``: its index, beyond the frames' numbers."""
    return index if index < FIRST_FRAME else MOST_FRAMES + index


class Episode(NamedTuple):
    """The constants of a drawn episode, floats in SI units.

    A field with the name of a scenario's member is that number, or the number drawn from its range.
    """

    r_c_start: float = 0.0
    """r_c(0) - r_0 [m]."""
    recipe_start: float = 0.0
    recipe_duration: float = 1.0
    recipe_amount: float = 0.0
    """Ramp of the recipe's error: start [s], duration [s], final value [K]."""
    drift_start: float = 0.0
    drift_duration: float = 1.0
    drift_amount: float = 0.0
    """Ramp of the hot zone's drift: start [s], duration [s], final value [K]."""
    drift_rate: float = 0.0
    """Steady rate of the hot zone's drift, on top of the ramp [K/s]."""
    reference_start: float = 0.0
    reference_duration: float = 1.0
    reference_amount: float = 0.0
    """Change of the reference: start [s], duration [s], size [m]."""
    melt_loss: float = 0.0
    ring_offset: float = 0.0
    """Constant offset of the ring, from bias and melt level [m]."""
    bias_drift_start: float = 0.0
    bias_drift_duration: float = 1.0
    bias_drift_amount: float = 0.0
    """Ramp of the ring's drift: start [s], duration [s], final value [m]."""
    ripple_amplitude: float = 0.0
    ripple_omega: float = 0.0
    ripple_phase: float = 0.0
    """Ripple of the ring: amplitude [m], angular frequency [rad/s], phase at t = 0 [rad]."""
    pyrometer_drift: float = 0.0
    latency: float = 0.0
    pull_window: float = math.inf
    pull_slew: float = math.inf
    heater_slew: float = math.inf
    heater_step: float = 0.0
    sd_fast: float = 0.0
    sd_slow: float = 0.0
    """Standard deviations of the interface's fast and slow fluctuation [K]."""
    keep_fast: float = 0.0
    keep_slow: float = 0.0
    """Factors of the two fluctuations over one interval of the grid [-]."""
    kick_fast: float = 0.0
    kick_slow: float = 0.0
    """Standard deviations of the two fluctuations' new parts, sqrt(1 - keep^2) [-]."""
    camera_sd: float = 0.0
    """Standard deviation of the ring's white noise [m]."""
    pyrometer_sd: float = 0.0
    """Standard deviation of the pyrometer's white noise [K]."""
    dropout: float = 0.0
    outlier_probability: float = 0.0
    outlier_sd: float = 0.0
    heater_lag: float = 0.0
    heater_dead_time: float = 0.0
    pyrometer_filter: float = 0.0


class Factors(NamedTuple):
    """A puller's factors on its design parameters, and its mix of models."""

    lam: float = 1.0
    a: float = 1.0
    k_l: float = 1.0
    kappa_12: float = 1.0
    G_1a: float = 1.0
    G_2b: float = 1.0
    kappa_b: float = 1.0
    C_1: float = 1.0
    C_2: float = 1.0
    C_b: float = 1.0


RECORD = np.dtype(
    [
        (family, [(name, np.float64, np.shape(value)) for name, value in vars(kind()).items()])
        for family, kind in FAMILIES.items()
    ]
)
"""A scenario as a record for the compiled draws: families of numbers and pairs."""


class ScenarioTable(NamedTuple):
    """Scenarios as read-only arrays for the compiled draws, one row a scenario."""

    records: npt.NDArray[Any]
    """The scenarios' numbers: records of :data:`RECORD`."""
    mixes: npt.NDArray[np.float64]
    """Range of the share of conduction [-], shape (scenarios, 2)."""
    cumulative_share: npt.NDArray[np.float64]
    """Running sums of the scenarios' shares [-]."""


@lru_cache(maxsize=64)
def scenario_table(distribution: Distribution, model: str | float | None = None) -> ScenarioTable:
    """The numbers of a scenario, or of each scenario of a mixture, under the environment's ``model`` argument."""
    records = np.zeros(len(distribution.scenarios), RECORD)
    for row, scenario in enumerate(distribution.scenarios):
        for family, each, value in scenario.members:
            records[family][each.name][row] = value
    mixes = np.array([mix_of(model, scenario) for scenario in distribution.scenarios], np.float64)
    table = ScenarioTable(records, mixes, np.cumsum(distribution.shares))
    for array in table:
        array.setflags(write=False)
    return table
