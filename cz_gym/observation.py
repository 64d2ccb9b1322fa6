"""Observations, channel by channel: what each number means, its unit, its scale, and how to read it back.

A channel's observed value is ``(quantity / scale)`` clipped to +-10, float32. Temperatures, power and pull
speed are deviations from the puller's own nominal; radii from r_0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.physics.parameters import Parameters

from .units import KILO, MINUTE, MM

CLIP = 10.0
"""Largest observed value after scaling [-]."""
PREVIEWS = (0.0, 1.0 * MINUTE, 5.0 * MINUTE)
"""Times ahead at which the recipe is shown [s]."""
PULL_SCALE = Parameters().v_0
"""The default puller's v_0 [m/s]; another puller's channels are scaled with its own."""
HEATER_SCALE = 10.0 * KILO
"""Half the heater's action range [W]."""
TEMPERATURE_SCALE = 5.0
INTEGRAL_SCALE = 1.0
"""One metre second: 1 mm held for 1000 s [m s]."""


class Channel(NamedTuple):
    """One number of an observation."""

    name: str
    unit: str
    scale: float
    meaning: str


MEASURED = (
    Channel("ring_error", "m", MM, "camera reading minus bias minus r_ref; the last valid reading while invalid"),
    Channel("valid", "1", 1.0, "1 if the camera says this reading is good, else 0"),
    Channel("r_ref", "m", MM, "radius reference minus r_0, now"),
    Channel("r_ref_1min", "m", MM, "the same in 1 minute"),
    Channel("r_ref_5min", "m", MM, "the same in 5 minutes"),
    Channel("T_1_ref", "K", TEMPERATURE_SCALE, "recipe of the heater temperature minus nominal, now"),
    Channel("T_1_ref_1min", "K", TEMPERATURE_SCALE, "the same in 1 minute"),
    Channel("T_1_ref_5min", "K", TEMPERATURE_SCALE, "the same in 5 minutes"),
    Channel("T_1", "K", TEMPERATURE_SCALE, "pyrometer reading minus nominal"),
    Channel("v_p", "m/s", PULL_SCALE, "applied pull speed minus v_0; the scale is v_0"),
    Channel("Q_H", "W", HEATER_SCALE, "applied heater power minus nominal"),
)
"""Channels of ``observation="measured"``."""

LAGGED = ("ring_error", "v_p", "T_1", "Q_H")
"""Channels that "history" remembers."""
LAGS = (5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 240.0, 360.0, 480.0, 720.0, 960.0, 1200.0)
"""Ages [s] that "history" reaches back to; each value is the mean over the samples since the age before."""


def _lagged() -> tuple[Channel, ...]:
    by_name = {channel.name: channel for channel in MEASURED}
    return tuple(
        Channel(
            f"{name}_{age:g}s",
            by_name[name].unit,
            by_name[name].scale,
            f"{name}, mean of the samples up to {age:g} s old",
        )
        for age in LAGS
        for name in LAGGED
    )


HISTORY = (
    *MEASURED,
    Channel("integral", "m s", INTEGRAL_SCALE, "integral of ring_error since the start, held within +-10"),
    *_lagged(),
)
"""Channels of ``observation="history"``."""

STATE = (
    Channel("r_c_error", "m", MM, "true radius minus r_ref"),
    Channel("h_c", "m", MM, "true meniscus height minus its nominal"),
    Channel("T_1", "K", TEMPERATURE_SCALE, "true heater temperature minus nominal"),
    Channel("T_2", "K", TEMPERATURE_SCALE, "true susceptor temperature minus nominal"),
    Channel("T_b", "K", TEMPERATURE_SCALE, "true melt temperature minus nominal"),
    *MEASURED[2:8],
    Channel("v_p", "m/s", PULL_SCALE, "applied pull speed minus v_0; the scale is v_0"),
    Channel("Q_H", "W", HEATER_SCALE, "applied heater power minus nominal"),
    Channel("dT_i", "K", 1.0, "interface fluctuation now"),
    Channel("Q_d", "W", KILO, "heat load on the melt now"),
    Channel("ring_offset", "m", MM, "offset of the ring that no sensor shows"),
    Channel("lam", "1", 1.0, "share of conduction: 1 is Model I, 0 is Model II"),
)
"""Channels of ``observation="state"``."""

OBSERVATIONS: dict[str, tuple[Channel, ...]] = {"measured": MEASURED, "history": HISTORY, "state": STATE}
CAMERA = "camera"
"""The observation that is an image instead of channels (:mod:`cz_gym.camera`)."""


class Measured(NamedTuple):
    """A "measured" (or the head of a "history") observation in SI units; arrays of the batch's shape."""

    ring_error: Any
    valid: Any
    r_ref: Any
    r_ref_1min: Any
    r_ref_5min: Any
    T_1_ref: Any
    T_1_ref_1min: Any
    T_1_ref_5min: Any
    T_1: Any
    v_p: Any
    Q_H: Any


def scales(channels: tuple[Channel, ...], v_0: float) -> npt.NDArray[np.float64]:
    """Scales of the channels for a puller of nominal pull speed v_0 [m/s], shape (channels,)."""
    return np.array([v_0 if channel.name.startswith("v_p") else channel.scale for channel in channels])


def decode(observation: npt.ArrayLike, v_0: float = PULL_SCALE) -> Measured:
    """Read a "measured" or "history" observation, shape (..., channels), back into SI units.

    Raises ValueError if the last axis is neither.
    """
    array = np.asarray(observation, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] not in (len(MEASURED), len(HISTORY)):
        raise ValueError(
            f"expected an observation of {len(MEASURED)} (measured) or {len(HISTORY)} (history) channels, "
            f"got shape {array.shape}"
        )
    head = array[..., : len(MEASURED)] * scales(MEASURED, v_0)
    return Measured(*np.moveaxis(head, -1, 0))


class Lags(NamedTuple):
    """The ages of "history" in samples."""

    newest: npt.NDArray[np.int64]
    """Age of the newest sample of each mean."""
    oldest: npt.NDArray[np.int64]
    """Age of the oldest sample of each mean."""


def lags(control_interval: float) -> Lags:
    """Sample ages for that control interval [s]; each mean holds at least one sample."""
    oldest = np.maximum(np.rint(np.array(LAGS) / control_interval).astype(np.int64), 1)
    before = np.concatenate([[0], oldest[:-1]])
    return Lags(np.minimum(before + 1, oldest), oldest)
