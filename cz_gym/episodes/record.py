"""A scenario as one record for the compiled draws, and the constants of a drawn episode."""

from __future__ import annotations

import dataclasses
import math
from enum import IntEnum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .mixture import Distribution
from .scenario import MAX_FLAGGED, MAX_UNFLAGGED, Scenario
from .scenarios import mix_of

GRID = 5.0
"""Interval [s] of the grid on which physical fluctuations live; held in between."""
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
    """The constants of an episode's ramps, sensors and drives; every field is a float."""

    r_c_start: float = 0.0
    """r_c(0) - r_0 [m]."""
    recipe_start: float = 0.0
    """Start of the recipe error's ramp [s]."""
    recipe_duration: float = 1.0
    """Its length [s]."""
    recipe_amount: float = 0.0
    """Its final value [K]."""
    drift_start: float = 0.0
    """Start of the hot zone's drift [s]."""
    drift_duration: float = 1.0
    """Its length [s]."""
    drift_amount: float = 0.0
    """Its final value [K]."""
    drift_rate: float = 0.0
    """Steady drift on top [K/s]."""
    reference_start: float = 0.0
    """Start of the reference change [s]."""
    reference_duration: float = 1.0
    """Its length [s]."""
    reference_amount: float = 0.0
    """The change [m]."""
    melt_loss: float = 0.0
    """Share of the melt's heat capacity lost over 3 h [-]."""
    ring_offset: float = 0.0
    """Constant offset of the ring [m]."""
    bias_drift_start: float = 0.0
    """Start of the ring's drift [s]."""
    bias_drift_duration: float = 1.0
    """Its length [s]."""
    bias_drift_amount: float = 0.0
    """Its final value [m]."""
    ripple_amplitude: float = 0.0
    """Amplitude of the ring's ripple [m]."""
    ripple_omega: float = 0.0
    """Its angular frequency [rad/s]."""
    ripple_phase: float = 0.0
    """Its phase at t = 0 [rad]."""
    pyrometer_drift: float = 0.0
    """Drift of the pyrometer over 3 h [K]."""
    latency: float = 0.0
    """Age of the newest camera frame [s]."""
    pull_window: float = math.inf
    """Largest |v_p - v_0| [m/s]."""
    pull_slew: float = math.inf
    """Largest |dv_p/dt| [m/s2]."""
    heater_slew: float = math.inf
    """Largest |dQ_H/dt| [W/s]."""
    heater_step: float = 0.0
    """Resolution of the heater [W]."""
    sd_fast: float = 0.0
    """Standard deviation of the interface's fast fluctuation [K]."""
    sd_slow: float = 0.0
    """Standard deviation of its slow fluctuation [K]."""
    keep_fast: float = 0.0
    """Factor of the fast fluctuation over one interval of the grid [-]."""
    keep_slow: float = 0.0
    """The same of the slow fluctuation [-]."""
    kick_fast: float = 0.0
    """Standard deviation of the fast fluctuation's new part, sqrt(1 - keep_fast^2) [-]."""
    kick_slow: float = 0.0
    """The same of the slow fluctuation [-]."""
    camera_sd: float = 0.0
    """Standard deviation of the ring's white noise [m]."""
    pyrometer_sd: float = 0.0
    """Standard deviation of the pyrometer's white noise [K]."""
    dropout: float = 0.0
    """Probability that a sample drops out [-]."""
    outlier_probability: float = 0.0
    """Probability that a sample carries an outlier [-]."""
    outlier_sd: float = 0.0
    """Standard deviation of an outlier [m]."""
    heater_lag: float = 0.0
    """Time constant with which the power that heats follows the heater's setpoint [s]."""
    heater_dead_time: float = 0.0
    """Time before the power that heats begins to follow the setpoint [s]."""
    pyrometer_filter: float = 0.0
    """Time constant of the pyrometer's filter [s]."""


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


def _members(scenario: Scenario) -> list[tuple[str, dict[str, Any]]]:
    """Each family of a scenario and its members, by name."""
    return [(family.name, vars(getattr(scenario, family.name))) for family in dataclasses.fields(Scenario)[1:]]


def _record(members: dict[str, Any]) -> np.dtype[Any]:
    return np.dtype([(name, np.float64, (2,) if isinstance(value, tuple) else ()) for name, value in members.items()])


RECORD = np.dtype([(family, _record(members)) for family, members in _members(Scenario("plain"))])
"""A scenario as a record for the compiled draws: families of numbers and pairs."""


class Lots(NamedTuple):
    """Scenarios as read-only arrays for the compiled draws, one row a scenario."""

    records: npt.NDArray[Any]
    """The scenarios' numbers: records of :data:`RECORD`."""
    mixes: npt.NDArray[np.float64]
    """Range of the share of conduction [-], shape (scenarios, 2)."""
    upto: npt.NDArray[np.float64]
    """Running sums of the scenarios' shares [-]."""


@lru_cache(maxsize=64)
def lots_of(distribution: Distribution, model: str | float | None = None) -> Lots:
    """The numbers of a scenario, or of each scenario of a mixture, under the environment's ``model`` argument."""
    records = np.zeros(len(distribution.scenarios), RECORD)
    for row, scenario in enumerate(distribution.scenarios):
        for family, members in _members(scenario):
            for member, value in members.items():
                records[family][member][row] = value
    mixes = np.array([mix_of(model, scenario) for scenario in distribution.scenarios], np.float64)
    lots = Lots(records, mixes, np.cumsum(distribution.shares))
    for array in lots:
        array.setflags(write=False)
    return lots
