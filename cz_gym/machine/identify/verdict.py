"""Whether a model fits a log: what its prediction errors, its operating point and its noise say."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cz_gym.errors import CzError
from cz_gym.support.units import KILO, MM

from .grid import Floats
from .model import Lags

LAGS, COLOURED = 20, 0.15
"""Lags at which prediction errors are correlated [rows], and the correlation above which the model does not fit [-];
many rows make smaller ones significant."""
SEEN = 0.05, 0.01 * MM
"""Least standard deviation of prediction errors of pyrometer [K] and ring [m] that are judged: no sensor shows less,
and a model need not be better."""
FAR = 3.0
"""Standard deviations of its prior from which on an estimate stands at its end."""
T_1_OFF, Q_H_OFF = 15.0, 0.06
"""Largest differences of the model's operating point and the log's means: T_1 [K], share of the power [-]."""
NOISY = 2.5
"""Largest ratio of a sensor's noise to what the start file says."""


def misfits(identified: Any, puller: Any, away: Mapping[str, float]) -> tuple[str, ...]:
    """Reasons why the model does not fit the log, in words.

    ``identified`` is an :class:`.estimate.Identified`, ``puller`` its puller with Q_H_0 and T_1_0, ``away`` how far
    each estimate is from its prior's mean, in standard deviations. Only paths that were estimated are judged; a delay
    or a noise may well be absent.
    """
    pull, heater = (share >= 1.0 for share in identified.excitation)
    if not (pull or heater):
        return ()
    judged = ((0, "pyrometer", heater), (1, "ring", True))
    reasons = [] if identified.settled else ["the search has not settled"]
    for sensor, name, estimated in judged:
        seen = np.nanstd(identified.predicted.error[:, sensor]) > SEEN[sensor]
        if estimated and seen and (size := coloured(identified.errors[:, sensor])) > COLOURED:
            reasons.append(f"prediction errors of the {name} are coloured (correlation {size:.2f})")
    if heater:
        T_1, Q_H = np.nanmean(identified.log.T_1), np.mean(identified.log.Q_H)
        if abs(puller.T_1_0.real - T_1) > T_1_OFF:
            reasons.append(f"its T_1 is {puller.T_1_0.real:.0f} K where the log's mean is {T_1:.0f} K")
        if abs(puller.Q_H_0.real / Q_H - 1.0) > Q_H_OFF:
            reasons.append(f"it needs {puller.Q_H_0.real / KILO:.1f} kW where the log's mean is {Q_H / KILO:.1f} kW")
    parameters = {e.name for e in identified.estimates} - set(Lags._fields)
    ends = [f"{name} ({by:+.1f})" for name, by in away.items() if (abs(by) if name in parameters else by) > FAR]
    if ends:
        reasons.append(f"estimates stand at the ends of their priors [standard deviations]: {', '.join(ends)}")
    noise, sensors = {e.name: e.value for e in identified.noise}, identified.start
    ring = np.hypot(max(sensors.camera_noise or (0.0,)), max(sensors.ripple or (0.0,)))
    for name, value, usual, unit, size in (
        ("ring", noise["camera_sd"], ring, "mm", MM),
        ("pyrometer", noise["pyrometer_sd"], max(sensors.pyrometer_noise or (0.0,)), "K", 1.0),
    ):
        if usual and value > NOISY * usual:
            reasons.append(f"noise of the {name} is {value / size:.2g} {unit}, the file says {usual / size:.2g} {unit}")
    try:
        _ = identified.puller
    except CzError as error:
        reasons.append(f"its numbers are not plausible: {error}")
    return tuple(reasons)


def coloured(errors: Floats) -> float:
    """Largest correlation of errors within LAGS rows [-], without their strongest line, which may be the rotation's.

    Errors are NaN where nothing was read.
    """
    u = np.nan_to_num(errors - np.nanmean(errors))
    spectrum = np.fft.rfft(u)
    peak = int(np.abs(spectrum).argmax())
    spectrum[max(peak - 1, 0) : peak + 2] = 0.0
    u = np.fft.irfft(spectrum, len(u))
    u -= u.mean()
    return float(max(abs(u[lag:] @ u[:-lag]) for lag in range(1, LAGS + 1)) / (u @ u))
