"""The draw of an episode: a value made at reset from one 128-bit key, and the random numbers that follow from it.

A scenario is a record for the compiled draws. Each kind of random number has a stream of its own, seeded with its own
number (:func:`stream_number`), so families never share one. Scalars come first on each stream, the noise of each step
after them in order of time: a longer horizon extends a draw and never changes it, whether it is drawn step by step, as
the environment does, or as whole series (:func:`episode_from_key`). Ramps are kept as parameters and evaluated where
needed (:mod:`cz_gym.physics.plant`).
"""

import math
from enum import IntEnum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.jit import jittable, kernel
from cz_gym.physics.parameters import Parameters, Range
from cz_gym.physics.plant import DRAW_SPAN

from .rng import WORDS, normal, seed_stream, two_normals, uniform
from .scenario import FAMILIES, GRID, MAX_FLAGGED, MAX_UNFLAGGED, Distribution, Scenario
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
    LAYER = 8
    TOLD = 9


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
    """Ripple of the ring's readings: amplitude [m], angular frequency [rad/s], phase at t = 0 [rad]."""
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
    pull_scale: float = 1.0
    pull_offset: float = 0.0
    pull_resolution: float = 0.0
    heater_scale: float = 1.0
    heater_offset: float = 0.0
    heater_resolution: float = 0.0
    delay: float = 0.0
    told_power: float = 0.0
    told_temperature: float = 0.0
    """Nominal power [W] and temperature [K] that controllers are told, minus the puller's own."""


class Factors(NamedTuple):
    """A puller's factors on its design parameters, its mix of models, and what they lack."""

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
    R: float = 0.0
    """Resistance of the boundary layer beside the design's [m2 K/W]."""
    phi_b: float = 0.0
    """Slope of the meniscus at the ring [rad]; 0: the design's."""


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


# Compiled: streams from one key, then the puller, ramps, constants and freezes.

STREAMS = len(Stream)
_NUMBERS = tuple(map(stream_number, range(STREAMS)))
SHORTEST = 1e-9
"""Least duration of a ramp [s]; one of zero duration is a jump."""
_START, _PARAMETERS, _SCHEDULE = int(Stream.START), int(Stream.PARAMETERS), int(Stream.SCHEDULE)
_INTERFACE, _SENSOR, _FAULTS = int(Stream.INTERFACE), int(Stream.SENSOR), int(Stream.FAULTS)
_LAYER, _TOLD = int(Stream.LAYER), int(Stream.TOLD)
AVERAGING_ERROR = 0.02
"""Standard deviation of the relative error of the time over which the ring is averaged: the rotation is known so well
[-]."""
_SPREAD_NUMBERS, _HOT_ZONE_NUMBERS, _FAULT_NUMBERS = 7, 7, 5 + 3 * FREEZES


@jittable
def seed_streams(streams: Any, key: Any) -> None:
    """Seed an episode's streams, shape (streams, 4), from its key, two 64-bit words."""
    for index in range(STREAMS):
        seed_stream(streams[index], key, _NUMBERS[index])


@jittable
def between(limits: Any, u: Any) -> Any:
    """Linear interpolation in a range, u from 0 to 1."""
    return limits[0] + (limits[1] - limits[0]) * u


@jittable
def _factor(spread: Any, u: Any) -> Any:
    return 1.0 + spread * (2.0 * u - 1.0)


@jittable
def _log_factor(limits: Any, u: Any) -> Any:
    """Logarithmic interpolation in a range, u from 0 to 1."""
    return limits[0] * np.exp(np.log(limits[1] / limits[0]) * u) if limits[0] < limits[1] else limits[0]


@jittable
def _varies(limits: Any) -> Any:
    return limits[0] != 1.0 or limits[1] != 1.0


@jittable
def draw_scenario(cumulative_share: Any, key: Any) -> Any:
    """Index of the scenario that an episode is drawn from, by the running sums of the scenarios' shares."""
    index = 0
    if cumulative_share.size > 1:
        stream = np.zeros(WORDS, np.uint64)
        seed_stream(stream, key, MIXTURE_STREAM)
        u = uniform(stream)
        while index < cumulative_share.size - 1 and u >= cumulative_share[index]:
            index += 1
    return index


@jittable
def _uniforms(s: Any, count: Any) -> Any:
    """The stream's next numbers in [0, 1); one loop compiles in a fraction of the time of as many calls."""
    u = np.zeros(count)
    for number in range(count):
        u[number] = uniform(s)
    return u


@jittable
def draw_factors(record: Any, mix: Any, streams: Any) -> Any:
    """Draw the puller: its mix of models and the factors on its parameters."""
    spread = record.pullers
    capacity, melt, conductance = spread.capacity_factor, spread.melt_capacity_factor, spread.conductance_factor
    u, v = _uniforms(streams[_PARAMETERS], _SPREAD_NUMBERS), np.zeros(_HOT_ZONE_NUMBERS)
    if _varies(capacity) or _varies(melt) or _varies(conductance):
        v = _uniforms(streams[_PARAMETERS], _HOT_ZONE_NUMBERS)
    return Factors(
        lam=between(mix, u[0]),
        a=_factor(spread.capillary, u[1]),
        k_l=_factor(spread.conductivity, u[2]),
        kappa_12=_factor(spread.conductance, u[3]) * _log_factor(conductance, v[3]),
        G_1a=_factor(spread.conductance, u[4]) * _log_factor(conductance, v[4]),
        G_2b=_factor(spread.conductance, u[5]) * _log_factor(conductance, v[5]),
        kappa_b=_factor(spread.conductance, u[6]) * _log_factor(conductance, v[6]),
        C_1=_log_factor(capacity, v[0]),
        C_2=_log_factor(capacity, v[1]),
        C_b=_log_factor(melt, v[2]),
        R=between(spread.boundary_layer, uniform(streams[_LAYER])),
        phi_b=spread.ring_slope,
    )


@jittable
def randomised(q: Any, f: Any) -> Any:
    """The parameters of the drawn puller: factors on a, k_l, the conductances and the heat capacities; layer, ring."""
    phi_b = f.phi_b if f.phi_b > 0.0 else q.phi_b
    return Parameters(
        sigma=q.sigma * f.a**2, rho_l=q.rho_l, alpha_0=q.alpha_0, g=q.g, sigma_SB=q.sigma_SB, k_l=q.k_l * f.k_l,
        rho_s=q.rho_s, dH=q.dH, T_m=q.T_m, dT_0=q.dT_0, r_0=q.r_0, v_0=q.v_0,
        phi_b=phi_b,
        C_1=q.C_1 * f.C_1, C_2=q.C_2 * f.C_2, C_b=q.C_b * f.C_b,
        kappa_12=q.kappa_12 * f.kappa_12, G_1a=q.G_1a * f.G_1a, T_a=q.T_a,
        G_2b=q.G_2b * f.G_2b, eps=q.eps * f.kappa_b, R_cr=q.R_cr, T_e=q.T_e, R=q.R + f.R,
    )  # fmt: skip


@jittable
def draw_episode(record: Any, streams: Any, freezes: Any) -> Any:
    """Draw ramps and constants; freezes [s], shape (FREEZES, 2), are written."""
    recipe, drift, reference = record.recipe, record.drift, record.reference
    sensor, drives = record.sensor, record.actuators
    plan, read = _uniforms(streams[_SCHEDULE], 10), _uniforms(streams[_SENSOR], 8)
    at = _uniforms(streams[_INTERFACE], 2)
    recipe_duration = between(recipe.duration, plan[1])
    moved = 1.0 if plan[6] < reference.probability else 0.0
    sd_fast, sd_slow = between(record.interface.sd, at[0]), between(record.interface.sd, at[1])
    keep_fast, keep_slow = np.exp(-GRID / record.interface.tau_fast), np.exp(-GRID / record.interface.tau_slow)
    fault = _draw_faults(record.faults, streams[_FAULTS], freezes)
    readings, reads = record.readings, _draw_readings(record.readings, streams[_FAULTS])
    r_c_start = record.pullers.start_radius_sd * normal(streams[_START])
    slow = _uniforms(streams[_START], 3)
    told_power, told_temperature = two_normals(streams[_TOLD])
    ripple_omega = 2.0 * math.pi * between(sensor.rotation, read[5])
    revolutions = sensor.averaging * (1.0 + AVERAGING_ERROR * normal(streams[_TOLD])) if ripple_omega > 0.0 else 0.0
    amplitude, phase = _averaged(between(sensor.ripple, read[4]), 2.0 * math.pi * read[6], revolutions)
    return Episode(
        r_c_start=r_c_start, melt_loss=record.pullers.melt_loss,
        recipe_start=between(recipe.start, plan[2]), recipe_duration=max(recipe_duration, SHORTEST),
        recipe_amount=between(recipe.rate, plan[0]) * recipe_duration,
        drift_start=between(drift.start, plan[5]), drift_duration=max(between(drift.duration, plan[4]), SHORTEST),
        drift_amount=between(drift.amount, plan[3]), drift_rate=drift.rate,
        reference_start=between(reference.start, plan[9]),
        reference_duration=max(between(reference.duration, plan[8]), SHORTEST),
        reference_amount=between(reference.amount, plan[7]) * moved,
        ring_offset=between(sensor.bias_offset, read[2]) + between(sensor.level_offset, read[3]),
        bias_drift_start=fault[0], bias_drift_duration=fault[1], bias_drift_amount=fault[2], dropout=fault[3],
        ripple_amplitude=amplitude, ripple_omega=ripple_omega, ripple_phase=phase,
        camera_sd=between(sensor.camera_noise, read[0]), pyrometer_sd=between(sensor.pyrometer_noise, read[1]),
        pyrometer_drift=between(sensor.pyrometer_drift, read[7]),
        pyrometer_filter=between(sensor.pyrometer_filter, slow[2]),
        latency=sensor.latency, outlier_probability=sensor.outlier_probability, outlier_sd=sensor.outlier_sd,
        pull_window=drives.pull_window, pull_slew=drives.pull_slew,
        heater_slew=drives.heater_slew, heater_step=drives.heater_step,
        heater_lag=between(drives.heater_lag, slow[0]), heater_dead_time=between(drives.heater_dead_time, slow[1]),
        sd_fast=sd_fast, sd_slow=sd_slow, keep_fast=keep_fast, keep_slow=keep_slow,
        kick_fast=np.sqrt(1.0 - keep_fast**2), kick_slow=np.sqrt(1.0 - keep_slow**2),
        pull_scale=reads[0], pull_offset=reads[1], pull_resolution=readings.pull_resolution,
        heater_scale=reads[2], heater_offset=reads[3], heater_resolution=readings.heater_resolution,
        delay=readings.delay,
        told_power=record.told.power_sd * told_power, told_temperature=record.told.temperature_sd * told_temperature,
    )  # fmt: skip


@jittable
def _averaged(amplitude: Any, phase: Any, revolutions: Any) -> Any:
    """Amplitude and phase of a ripple in its mean over the revolutions before each frame; exact."""
    half = math.pi * revolutions
    if not half > 0.0:
        return amplitude, phase
    share = np.sin(half) / half
    return amplitude * np.abs(share), phase - half + (math.pi if share < 0.0 else 0.0)


@jittable
def _draw_readings(readings: Any, s: Any) -> Any:
    """Scale [-] and offset of the readings of pull speed [m/s] and heater power [W], after the faults' numbers."""
    u = _uniforms(s, 4)
    pull, heater = two_normals(s)
    return (
        between(readings.pull_scale, u[0]) + readings.scale_sd * pull,
        between(readings.pull_offset, u[1]),
        between(readings.heater_scale, u[2]) + readings.scale_sd * heater,
        between(readings.heater_offset, u[3]),
    )


@jittable
def _draw_faults(faults: Any, s: Any, freezes: Any) -> Any:
    """Place the freezes; return start [s], duration [s] and size [m] of the ring's drift, and the drop-outs' share."""
    u = _uniforms(s, _FAULT_NUMBERS)
    least, most = faults.flagged[0], faults.flagged[1]
    flagged = min(most, least + np.floor(u[3] * (most - least + 1.0)))
    lengths = np.zeros(FREEZES)
    for which in range(FREEZES):
        if which < flagged:
            lengths[which] = between(faults.flagged_duration, u[5 + which])
        elif which == MAX_FLAGGED and faults.unflagged > 0.0:
            lengths[which] = between(faults.unflagged_duration, u[5 + which])
    _place_freezes(lengths, u[5 + FREEZES : 5 + 2 * FREEZES], u[5 + 2 * FREEZES :], freezes)
    return (
        u[0] * DRAW_SPAN,
        max(between(faults.bias_drift_duration, u[1]), SHORTEST),
        between(faults.bias_drift, u[2]),
        between(faults.dropout, u[4]),
    )


@jittable
def _place_freezes(lengths: Any, order: Any, share: Any, freezes: Any) -> None:
    """Place disjoint windows uniformly: sorted starts in the time left over, lengths put back in between.

    ``order`` and ``share`` hold a random number for each window: which comes first, and where in the room a start
    lies. A window of length 0 is none.
    """
    room = DRAW_SPAN - np.sum(lengths)
    for which in range(FREEZES):
        freezes[which, 0] = freezes[which, 1] = 0.0
        if lengths[which] > 0.0:
            rank, passed, start = 0, 0.0, 0.0
            for other in range(FREEZES):
                if lengths[other] > 0.0 and order[other] < order[which]:
                    rank += 1
                    passed += lengths[other]
            for candidate in range(FREEZES):
                below = 0
                for other in range(FREEZES):
                    if lengths[other] > 0.0 and share[other] < share[candidate]:
                        below += 1
                if lengths[candidate] > 0.0 and below == rank:
                    start = passed + share[candidate] * room
            freezes[which, 0] = start
            freezes[which, 1] = start + lengths[which]


# Compiled: the random numbers of every step, from the streams of an :class:`Episode`.

_DROPOUTS, _OUTLIERS = int(Stream.DROPOUTS), int(Stream.OUTLIERS)


@jittable
def first_fluctuation(episode: Any, streams: Any) -> Any:
    """The interface's two stationary processes at t = 0 [standard deviations]."""
    return two_normals(streams[_INTERFACE]) if episode.sd_fast > 0.0 or episode.sd_slow > 0.0 else (0.0, 0.0)


@jittable
def next_fluctuation(episode: Any, streams: Any, fast: Any, slow: Any) -> Any:
    """The two processes at the next grid point, discretised exactly: x <- keep x + sqrt(1 - keep^2) n."""
    first, second = two_normals(streams[_INTERFACE]) if episode.sd_fast > 0.0 or episode.sd_slow > 0.0 else (0.0, 0.0)
    return episode.keep_fast * fast + episode.kick_fast * first, episode.keep_slow * slow + episode.kick_slow * second


@jittable
def fluctuation(episode: Any, fast: Any, slow: Any) -> Any:
    """dT_i [K] of the two processes."""
    return episode.sd_fast * fast + episode.sd_slow * slow


@jittable
def sample_noise(episode: Any, streams: Any) -> Any:
    """Camera [m] and pyrometer [K] noise of the next sample; a camera's NaN is a drop-out."""
    noisy = episode.camera_sd > 0.0 or episode.pyrometer_sd > 0.0
    camera, pyrometer = two_normals(streams[_SENSOR]) if noisy else (0.0, 0.0)
    camera, pyrometer = episode.camera_sd * camera, episode.pyrometer_sd * pyrometer
    if episode.outlier_probability > 0.0 and uniform(streams[_OUTLIERS]) < episode.outlier_probability:
        camera += episode.outlier_sd * normal(streams[_OUTLIERS])
    if episode.dropout > 0.0 and uniform(streams[_DROPOUTS]) < episode.dropout:
        camera = np.nan
    return camera, pyrometer


@jittable
def draw_series(episode: Any, streams: Any, interface: Any, noise: Any) -> None:
    """Write dT_i [K] on the grid, shape (points,), and the noise of each sample, shape (samples, 2)."""
    fast, slow = first_fluctuation(episode, streams)
    for j in range(interface.size):
        interface[j] = fluctuation(episode, fast, slow)
        fast, slow = next_fluctuation(episode, streams, fast, slow)
    for k in range(noise.shape[0]):
        noise[k, 0], noise[k, 1] = sample_noise(episode, streams)


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


def factors_from_key(scenario: Scenario, mix: Range, key: tuple[int, int]) -> Factors:
    """Draw the puller; ``mix`` is the range of the share of conduction [-]."""
    return Factors(*_factors(scenario_table(scenario).records, np.array(mix, np.float64), np.array(key, np.uint64)))


def episode_from_key(scenario: Scenario, key: tuple[int, int], out: Series) -> Episode:
    """Draw an episode: ramps and constants are returned, series written into ``out``."""
    return Episode(*_episode(scenario_table(scenario).records, np.array(key, np.uint64), *out))


@kernel
def _factors(record: Any, mix: Any, key: Any) -> Any:
    streams = np.zeros((STREAMS, WORDS), np.uint64)
    seed_streams(streams, key)
    return draw_factors(record[0], mix, streams)


@kernel
def _episode(record: Any, key: Any, interface: Any, noise: Any, freezes: Any) -> Any:
    streams = np.zeros((STREAMS, WORDS), np.uint64)
    seed_streams(streams, key)
    episode = draw_episode(record[0], streams, freezes)
    draw_series(episode, streams, interface, noise)
    return episode
