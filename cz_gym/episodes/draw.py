"""The draw of an episode, compiled: streams from one key, then the puller, ramps, constants and freezes.

Each stream is seeded with its own number (:func:`.record.stream_number`), so that families never share a random number.
Scalars come first on each stream, and the noise of each step after them (:mod:`cz_gym.episodes.noise`), so a longer
horizon extends a draw and never changes it.
"""

import math
from typing import Any

import numpy as np

from cz_gym.jit.compile import jittable
from cz_gym.physics.parameters import Parameters

from .record import FREEZES, MIXTURE_STREAM, Episode, Factors, Stream, stream_number
from .rng import WORDS, normal, seed_stream, uniform
from .scenario import DRAW_SPAN, GRID, MAX_FLAGGED

STREAMS = len(Stream)
_NUMBERS = tuple(map(stream_number, range(STREAMS)))
SHORTEST = 1e-9
"""Least duration of a ramp [s]; one of zero duration is a jump."""
_START, _PARAMETERS, _SCHEDULE = int(Stream.START), int(Stream.PARAMETERS), int(Stream.SCHEDULE)
_INTERFACE, _SENSOR, _FAULTS = int(Stream.INTERFACE), int(Stream.SENSOR), int(Stream.FAULTS)
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
    )


@jittable
def randomised(q: Any, f: Any) -> Any:
    """The parameters of the drawn puller: factors on a, k_l, the conductances and the heat capacities."""
    return Parameters(
        sigma=q.sigma * f.a**2, rho_l=q.rho_l, alpha_0=q.alpha_0, g=q.g, sigma_SB=q.sigma_SB, k_l=q.k_l * f.k_l,
        rho_s=q.rho_s, dH=q.dH, T_m=q.T_m, dT_0=q.dT_0, phi_b=q.phi_b, r_0=q.r_0, v_0=q.v_0,
        C_1=q.C_1 * f.C_1, C_2=q.C_2 * f.C_2, C_b=q.C_b * f.C_b,
        kappa_12=q.kappa_12 * f.kappa_12, G_1a=q.G_1a * f.G_1a, T_a=q.T_a,
        G_2b=q.G_2b * f.G_2b, eps=q.eps * f.kappa_b, R_cr=q.R_cr, T_e=q.T_e,
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
    r_c_start = record.pullers.start_radius_sd * normal(streams[_START])
    slow = _uniforms(streams[_START], 3)
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
        ripple_amplitude=between(sensor.ripple, read[4]),
        ripple_omega=2.0 * math.pi * between(sensor.rotation, read[5]), ripple_phase=2.0 * math.pi * read[6],
        camera_sd=between(sensor.camera_noise, read[0]), pyrometer_sd=between(sensor.pyrometer_noise, read[1]),
        pyrometer_drift=between(sensor.pyrometer_drift, read[7]),
        pyrometer_filter=between(sensor.pyrometer_filter, slow[2]),
        latency=sensor.latency, outlier_probability=sensor.outlier_probability, outlier_sd=sensor.outlier_sd,
        pull_window=drives.pull_window, pull_slew=drives.pull_slew,
        heater_slew=drives.heater_slew, heater_step=drives.heater_step,
        heater_lag=between(drives.heater_lag, slow[0]), heater_dead_time=between(drives.heater_dead_time, slow[1]),
        sd_fast=sd_fast, sd_slow=sd_slow, keep_fast=keep_fast, keep_slow=keep_slow,
        kick_fast=np.sqrt(1.0 - keep_fast**2), kick_slow=np.sqrt(1.0 - keep_slow**2),
    )  # fmt: skip


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
