"""The draw of an episode, compiled: streams from one key, then the puller, ramps, constants and freezes.

Stream n of an episode is ``SeedSequence(key, spawn_key=(n,))``, so that families never share a random number.
Scalars come first on each stream; what is random at every step follows as the episode goes
(:mod:`cz_gym.fluctuation`), so a longer horizon extends a draw and never changes it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ._compile import physics
from .law import FREEZES, GRID, Episode, Factors, Stream
from .parameters import Parameters
from .scenario import DRAW_SPAN, MAX_FLAGGED
from .streams import normal, seed_stream, uniform

STREAMS = len(Stream)
SHORTEST = 1e-9
"""Length [s] of a ramp that is a jump."""
_START, _PARAMETERS, _SCHEDULE = int(Stream.START), int(Stream.PARAMETERS), int(Stream.SCHEDULE)
_INTERFACE, _SENSOR, _FAULTS = int(Stream.INTERFACE), int(Stream.SENSOR), int(Stream.FAULTS)
_FAULT_NUMBERS = 5 + 3 * FREEZES


@physics
def seed_streams(streams: Any, key: Any) -> None:
    """Seed an episode's streams, shape (streams, 4), from its key, two 64-bit words."""
    for number in range(STREAMS):
        seed_stream(streams[number], key, number)


@physics
def between(limits: Any, u: Any) -> Any:
    """The number at share u of a range."""
    return limits[0] + (limits[1] - limits[0]) * u


@physics
def _factor(spread: Any, u: Any) -> Any:
    return 1.0 + spread * (2.0 * u - 1.0)


@physics
def draw_factors(law: Any, mix: Any, streams: Any) -> Any:
    """Draw the puller: its mix of models and the factors on its parameters."""
    s, spread = streams[_PARAMETERS], law.pullers
    return Factors(
        between(mix, uniform(s)),
        _factor(spread.capillary, uniform(s)),
        _factor(spread.conductivity, uniform(s)),
        _factor(spread.conductance, uniform(s)),
        _factor(spread.conductance, uniform(s)),
        _factor(spread.conductance, uniform(s)),
        _factor(spread.conductance, uniform(s)),
    )


@physics
def randomised(q: Any, f: Any) -> Any:
    """The parameters of the drawn puller: factors on a, k_l and the conductances."""
    return Parameters(
        q.sigma * f.a**2, q.rho_l, q.alpha_0, q.g, q.sigma_SB, q.k_l * f.k_l, q.rho_s, q.dH, q.T_m, q.dT_0, q.phi_b,
        q.r_0, q.v_0, q.C_1, q.C_2, q.C_b, q.kappa_12 * f.kappa_12, q.G_1a * f.G_1a, q.T_a, q.G_2b * f.G_2b,
        q.eps * f.kappa_b, q.R_cr, q.T_e,
    )  # fmt: skip


@physics
def draw_episode(law: Any, streams: Any, freezes: Any) -> Any:
    """Draw ramps and constants; freezes [s], shape (FREEZES, 2), are written."""
    recipe, drift, reference, sensor, drives = law.recipe, law.drift, law.reference, law.sensor, law.actuators
    s = streams[_SCHEDULE]
    rate, recipe_length, recipe_start = uniform(s), between(recipe.duration, uniform(s)), uniform(s)
    drift_amount, drift_length, drift_start = uniform(s), uniform(s), uniform(s)
    moves, amount, length, start = uniform(s), uniform(s), uniform(s), uniform(s)
    moved = 1.0 if moves < reference.probability else 0.0
    at = streams[_INTERFACE]
    sd_fast, sd_slow = between(law.interface.sd, uniform(at)), between(law.interface.sd, uniform(at))
    keep_fast, keep_slow = np.exp(-GRID / law.interface.tau_fast), np.exp(-GRID / law.interface.tau_slow)
    read = streams[_SENSOR]
    camera_sd, pyrometer_sd = (
        between(sensor.camera_noise, uniform(read)),
        between(sensor.pyrometer_noise, uniform(read)),
    )
    offset = between(sensor.bias_offset, uniform(read)) + between(sensor.level_offset, uniform(read))
    amplitude, rotation = between(sensor.ripple, uniform(read)), between(sensor.rotation, uniform(read))
    phase, pyrometer_drift = 2.0 * math.pi * uniform(read), between(sensor.pyrometer_drift, uniform(read))
    fault = _draw_faults(law.faults, streams[_FAULTS], freezes)
    return Episode(
        law.pullers.start_radius_sd * normal(streams[_START]),
        between(recipe.start, recipe_start), max(recipe_length, SHORTEST), between(recipe.rate, rate) * recipe_length,
        between(drift.start, drift_start), max(between(drift.duration, drift_length), SHORTEST),
        between(drift.amount, drift_amount), drift.rate,
        between(reference.start, start), max(between(reference.duration, length), SHORTEST),
        between(reference.amount, amount) * moved,
        law.pullers.melt_loss, offset, fault[0], fault[1], fault[2],
        amplitude, 2.0 * math.pi * rotation, phase, pyrometer_drift, sensor.latency,
        drives.pull_window, drives.pull_slew, drives.heater_slew, drives.heater_step,
        sd_fast, sd_slow, keep_fast, keep_slow, np.sqrt(1.0 - keep_fast**2), np.sqrt(1.0 - keep_slow**2),
        camera_sd, pyrometer_sd, fault[3], sensor.outlier_probability, sensor.outlier_sd,
    )  # fmt: skip


@physics
def _draw_faults(faults: Any, s: Any, freezes: Any) -> Any:
    """Place the freezes; return start [s], length [s] and size [m] of the ring's drift, and the drop-outs' share."""
    u = np.zeros(_FAULT_NUMBERS)
    for number in range(_FAULT_NUMBERS):
        u[number] = uniform(s)
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


@physics
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
