"""Observations, channel by channel: what each number means, its unit, its scale, and how to read it back.

A channel's observed value is ``(quantity / scale)`` clipped to +-10, float32. Temperatures, power and pull
speed are deviations from the puller's own nominal; radii from r_0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.errors import CzError
from cz_gym.physics.parameters import Parameters

from .units import KILO, MINUTE, MM

CLIP = 10.0
"""Largest observed value after scaling [-]."""
PREVIEWS = (0.0, 1.0 * MINUTE, 5.0 * MINUTE)
"""Times ahead for which reference and recipe are observed [s]."""
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
DRIVE_CHANNELS = tuple([channel.name for channel in MEASURED].index(name) for name in ("v_p", "Q_H"))
"""Where "measured" and "history" hold the applied drives, in units of the action."""

LAGGED = ("ring_error", "v_p", "T_1", "Q_H")
"""Channels that "history" remembers."""
LAGS = (5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 240.0, 360.0, 480.0, 720.0, 960.0, 1200.0)
"""Ages [s] that "history" reaches back to, in spans: each span holds the samples since the age before."""
_SPAN_SCALES = {"ring_error": 0.2 * MM, "v_p": 0.2 * PULL_SCALE, "T_1": 0.5, "Q_H": 0.5 * KILO}
_RELATIVE = {
    "r_ref_1min": ("r_ref", 0.1 * MM, "change of the radius reference within 1 minute"),
    "r_ref_5min": ("r_ref", 0.5 * MM, "change of the radius reference within 5 minutes"),
    "T_1_ref_1min": ("T_1_ref", 0.2, "change of the recipe within 1 minute"),
    "T_1_ref_5min": ("T_1_ref", 1.0, "change of the recipe within 5 minutes"),
    "T_1": ("T_1_ref", 2.0, "pyrometer reading minus recipe"),
}
"""Channels of "history" that are relative to another one: to which, scale, meaning."""


def _present() -> tuple[Channel, ...]:
    """The "measured" channels as "history" holds them."""
    return tuple(
        channel._replace(scale=_RELATIVE[channel.name][1], meaning=_RELATIVE[channel.name][2])
        if channel.name in _RELATIVE
        else channel
        for channel in MEASURED
    )


def _spans() -> tuple[Channel, ...]:
    units = {channel.name: channel.unit for channel in MEASURED}
    before = ("now", *(f"{age:g} s" for age in LAGS))
    return tuple(
        Channel(
            f"{name}_{age:g}s",
            units[name],
            _SPAN_SCALES[name],
            f"{name}: mean over the span up to {age:g} s ago, minus "
            + ("the value now" if earlier == "now" else f"that over the span up to {earlier}"),
        )
        for age, earlier in zip(LAGS, before, strict=False)
        for name in LAGGED
    )


HISTORY = (
    *_present(),
    Channel("integral", "m s", INTEGRAL_SCALE, "integral of ring_error since the start, held within +-10"),
    *_spans(),
)
"""Channels of ``observation="history"``. Means over neighbouring spans of the past differ by micrometres, the readings
themselves by millimetres: so the past is observed as differences of means, on scales of their own."""

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
    return np.array(
        [
            v_0 * (channel.scale / PULL_SCALE) if channel.name.startswith("v_p") else channel.scale
            for channel in channels
        ]
    )


def decode(observation: npt.ArrayLike, v_0: float = PULL_SCALE) -> Measured:
    """Read a "measured" or "history" observation, shape (..., channels), back into SI units.

    Raises ValueError if the last axis is neither.
    """
    array = np.asarray(observation, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] not in (len(MEASURED), len(HISTORY)):
        raise CzError(
            f"expected an observation of {len(MEASURED)} (measured) or {len(HISTORY)} (history) channels, "
            f"got shape {array.shape}"
        )
    relative = array.shape[-1] == len(HISTORY)
    head = array[..., : len(MEASURED)] * scales(HISTORY[: len(MEASURED)] if relative else MEASURED, v_0)
    values = Measured(*np.moveaxis(head, -1, 0))
    if not relative:
        return values
    return values._replace(
        **{name: getattr(values, name) + getattr(values, to) for name, (to, *_) in _RELATIVE.items()}
    )


def to_measured(history: npt.ArrayLike, v_0: float = PULL_SCALE) -> npt.NDArray[np.float32]:
    """The "measured" observation beside a "history" one, shape (..., channels), to the rounding of float32."""
    found = np.stack(decode(history, v_0), axis=-1) / scales(MEASURED, v_0)
    return np.clip(found, -CLIP, CLIP).astype(np.float32)


class Relative(NamedTuple):
    """The channels that "history" holds relative to another one; arrays of shape (channels,)."""

    channel: npt.NDArray[np.int64]
    """Its place."""
    to: npt.NDArray[np.int64]
    """The place of the other."""
    scale: npt.NDArray[np.float64]
    """From the scale of "measured" to its own [-]."""


def relative() -> Relative:
    """The relative channels of :data:`HISTORY`."""
    place = {channel.name: at for at, channel in enumerate(MEASURED)}
    rows = [(place[name], place[to], MEASURED[place[name]].scale / scale) for name, (to, scale, _) in _RELATIVE.items()]
    channel, to, scale = zip(*rows, strict=True)
    return Relative(np.array(channel), np.array(to), np.array(scale))


def undo_differences() -> npt.NDArray[np.float64]:
    """From HISTORY to readings and means of spans, both in SI units: a row vector times this 0/1 matrix."""
    place = {channel.name: at for at, channel in enumerate(HISTORY)}
    found = np.eye(len(HISTORY))
    for name, (to, *_) in _RELATIVE.items():
        found[place[to], place[name]] = 1.0
    for name in LAGGED:
        so_far = found[:, place[name]].copy()
        for age in LAGS:
            so_far[place[f"{name}_{age:g}s"]] = 1.0
            found[:, place[f"{name}_{age:g}s"]] = so_far
    return found


def span_scales() -> npt.NDArray[np.float64]:
    """From the scale of a remembered channel to that of the difference of its spans [-], shape (LAGGED,)."""
    own = {channel.name: channel.scale for channel in MEASURED}
    return np.array([own[name] / _SPAN_SCALES[name] for name in LAGGED])


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
