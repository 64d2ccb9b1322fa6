"""An episode's draw: a value made at reset from the episode's own random streams.

One 128-bit key an episode; stream n is ``SeedSequence(key, spawn_key=(n,))``, so that families never share a
random number and saved states continue bit-exactly. Ramps are kept as parameters and evaluated where needed
(:mod:`cz_gym.schedule`); only what is random at every step is stored. Scalars come before series on each
stream and series are drawn front to back: a longer horizon extends a draw, it never changes it.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from ._compile import kernel
from .scenario import DRAW_SPAN, MAX_FLAGGED, MAX_UNFLAGGED, Faults, Range, Scenario

GRID = 5.0
"""Interval [s] of the grid on which physical fluctuations live; held in between."""
FREEZES = MAX_FLAGGED + MAX_UNFLAGGED
"""Freeze windows an episode can hold; the last is the unflagged one."""
Floats = npt.NDArray[np.float64]


class Stream(IntEnum):
    """The independent random streams of an episode."""

    START = 0
    PARAMETERS = 1
    SCHEDULE = 2
    INTERFACE = 3
    SENSOR = 4
    FAULTS = 5
    DROPOUTS = 6
    OUTLIERS = 7


class Episode(NamedTuple):
    """What an episode's ramps, sensors and drives are made of; every field a float."""

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


class Series(NamedTuple):
    """What is random at every step."""

    interface: Floats
    """dT_i on the 5 s grid [K], shape (grid points,)."""
    noise: Floats
    """Camera noise [m] (NaN: the sample drops out) and pyrometer noise [K], shape (samples, 2)."""
    freezes: Floats
    """Start and end of each camera freeze [s], shape (FREEZES, 2); the last is unflagged, end 0 is none."""


class Factors(NamedTuple):
    """A puller's factors on its design parameters, and its mix of models."""

    lam: float = 1.0
    a: float = 1.0
    k_l: float = 1.0
    kappa_12: float = 1.0
    G_1a: float = 1.0
    G_2b: float = 1.0
    kappa_b: float = 1.0


def stream(key: tuple[int, int], number: Stream) -> np.random.Generator:
    """The random stream of that number for this episode key (two 64-bit words)."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key, spawn_key=(int(number),))))


def draw_factors(scenario: Scenario, mix: Range, key: tuple[int, int]) -> Factors:
    """Draw the puller."""
    spread = scenario.pullers
    if mix[0] == mix[1] and not (spread.capillary or spread.conductivity or spread.conductance):
        return Factors(lam=mix[0])
    u = stream(key, Stream.PARAMETERS).random(7).tolist()
    widths = (spread.capillary, spread.conductivity, *(spread.conductance,) * 4)
    return Factors(
        _between(mix, u[0]), *(1.0 + width * (2.0 * v - 1.0) for width, v in zip(widths, u[1:], strict=True))
    )


def draw_episode(scenario: Scenario, key: tuple[int, int], out: Series) -> Episode:
    """Draw an episode: ramps and constants are returned, series written into ``out``."""
    r_c_start = 0.0
    if scenario.pullers.start_radius_sd:
        r_c_start = scenario.pullers.start_radius_sd * stream(key, Stream.START).standard_normal()
    recipe, drift, reference, sensor, faults = (
        scenario.recipe, scenario.drift, scenario.reference, scenario.sensor, scenario.faults,
    )  # fmt: skip
    u = stream(key, Stream.SCHEDULE).random(10).tolist()
    recipe_duration = _between(recipe.duration, u[1])
    _draw_interface(scenario, key, out.interface)
    offset, rotation, ripple, phase, pyrometer_drift = _draw_sensor(scenario, key, out.noise)
    bias_drift = _draw_faults(faults, key, out)
    drives = scenario.actuators
    return Episode(
        r_c_start=r_c_start,
        recipe_start=_between(recipe.start, u[2]),
        recipe_duration=max(recipe_duration, 1e-9),
        recipe_amount=_between(recipe.rate, u[0]) * recipe_duration,
        drift_start=_between(drift.start, u[5]),
        drift_duration=max(_between(drift.duration, u[4]), 1e-9),
        drift_amount=_between(drift.amount, u[3]),
        drift_rate=drift.rate,
        reference_start=_between(reference.start, u[9]),
        reference_duration=max(_between(reference.duration, u[8]), 1e-9),
        reference_amount=_between(reference.amount, u[7]) * (u[6] < reference.probability),
        melt_loss=scenario.pullers.melt_loss,
        ring_offset=offset,
        bias_drift_start=bias_drift[0],
        bias_drift_duration=bias_drift[1],
        bias_drift_amount=bias_drift[2],
        ripple_amplitude=ripple,
        ripple_omega=2.0 * math.pi * rotation,
        ripple_phase=phase,
        pyrometer_drift=pyrometer_drift,
        latency=sensor.latency,
        pull_window=drives.pull_window,
        pull_slew=drives.pull_slew,
        heater_slew=drives.heater_slew,
        heater_step=drives.heater_step,
    )


def randomised(parameters: Any, factors: Factors) -> Any:
    """The parameters of the drawn puller: factors on a, k_l and the conductances."""
    return parameters._replace(
        sigma=parameters.sigma * factors.a**2,
        k_l=parameters.k_l * factors.k_l,
        kappa_12=parameters.kappa_12 * factors.kappa_12,
        G_1a=parameters.G_1a * factors.G_1a,
        G_2b=parameters.G_2b * factors.G_2b,
        eps=parameters.eps * factors.kappa_b,
    )


def new_series(grid_points: int, samples: int) -> Series:
    """Series of zeros."""
    return Series(np.zeros(grid_points), np.zeros((samples, 2)), np.zeros((FREEZES, 2)))


def _between(limits: Range, u: float) -> float:
    return limits[0] + (limits[1] - limits[0]) * u


def _draw_interface(scenario: Scenario, key: tuple[int, int], out: Floats) -> None:
    interface = scenario.interface
    if interface.sd[1] == 0.0:
        out[:] = 0.0
        return
    random = stream(key, Stream.INTERFACE)
    u = random.random(2).tolist()
    normals = random.standard_normal((out.size, 2))
    keep_fast, keep_slow = math.exp(-GRID / interface.tau_fast), math.exp(-GRID / interface.tau_slow)
    _ornstein_uhlenbeck(normals, _between(interface.sd, u[0]), _between(interface.sd, u[1]), keep_fast, keep_slow, out)


@kernel
def _ornstein_uhlenbeck(
    normals: Floats, sd_fast: float, sd_slow: float, keep_fast: float, keep_slow: float, out: Floats
) -> None:
    """Sum of two stationary processes, discretised exactly: x <- keep x + sqrt(1 - keep^2) sd n."""
    kick_fast, kick_slow = np.sqrt(1.0 - keep_fast**2), np.sqrt(1.0 - keep_slow**2)
    fast, slow = normals[0, 0], normals[0, 1]
    out[0] = sd_fast * fast + sd_slow * slow
    for j in range(1, out.size):
        fast = keep_fast * fast + kick_fast * normals[j, 0]
        slow = keep_slow * slow + kick_slow * normals[j, 1]
        out[j] = sd_fast * fast + sd_slow * slow


def _draw_sensor(scenario: Scenario, key: tuple[int, int], noise: Floats) -> tuple[float, float, float, float, float]:
    """Write the noise; return ring offset, rotation, ripple amplitude and phase, pyrometer drift."""
    sensor = scenario.sensor
    random = stream(key, Stream.SENSOR)
    u = random.random(8).tolist()
    sds = _between(sensor.camera_noise, u[0]), _between(sensor.pyrometer_noise, u[1])
    if max(sds) > 0.0:
        random.standard_normal(out=noise)
        noise *= sds
    else:
        noise[:] = 0.0
    if sensor.outlier_probability > 0.0:
        chance = stream(key, Stream.OUTLIERS).random(len(noise)) / sensor.outlier_probability
        hit = np.flatnonzero((chance > 0.0) & (chance < 1.0))
        noise[hit, 0] += sensor.outlier_sd * ndtri(chance[hit])
    offset = _between(sensor.bias_offset, u[2]) + _between(sensor.level_offset, u[3])
    phase = 2.0 * math.pi * u[6]
    return (
        offset,
        _between(sensor.rotation, u[5]),
        _between(sensor.ripple, u[4]),
        phase,
        _between(sensor.pyrometer_drift, u[7]),
    )


def _draw_faults(faults: Faults, key: tuple[int, int], out: Series) -> tuple[float, float, float]:
    """Write freezes and drop-outs; return start [s], length [s] and size [m] of the ring's drift."""
    out.freezes[:] = 0.0
    if faults == Faults():
        return 0.0, 1.0, 0.0
    u = stream(key, Stream.FAULTS).random(5 + 3 * FREEZES).tolist()
    bias_drift = (
        u[0] * DRAW_SPAN,
        max(_between(faults.bias_drift_duration, u[1]), 1e-9),
        _between(faults.bias_drift, u[2]),
    )
    least, most = faults.flagged
    flagged = min(most, least + int(u[3] * (most - least + 1)))
    wanted = list(range(flagged)) + [MAX_FLAGGED] * faults.unflagged
    _place_freezes(faults, wanted, u[5:], out.freezes)
    chance = _between(faults.dropout, u[4])
    if chance > 0.0:
        dropped = stream(key, Stream.DROPOUTS).random(len(out.noise)) < chance
        out.noise[dropped, 0] = np.nan
    return bias_drift


def _place_freezes(faults: Faults, wanted: list[int], u: list[float], freezes: Floats) -> None:
    """Place disjoint windows uniformly: sorted starts in the time left over, lengths put back in between."""
    lengths = {
        which: _between(faults.unflagged_duration if which == MAX_FLAGGED else faults.flagged_duration, u[which])
        for which in wanted
    }
    order = sorted(wanted, key=lambda which: u[FREEZES + which])
    room = DRAW_SPAN - sum(lengths.values())
    starts = sorted(u[2 * FREEZES + which] * room for which in wanted)
    passed = 0.0
    for which, start in zip(order, starts, strict=True):
        freezes[which] = passed + start, passed + start + lengths[which]
        passed += lengths[which]
