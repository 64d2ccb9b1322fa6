"""Margins of any classical controller's loop, opened at pull speed, heater and ring, and limits on them.

The loop is the sampled one with the camera's latency and the lags of heater and pyrometer. A loop opened at a drive
leaves the controller its own command as the drive's reading: only the drive's effect on the plant is uncertain. The
margins of the worse of Models I and II count. An unstable loop has a gain margin of 1, no phase margin and an infinite
peak.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.process import StateSpace
from cz_gym.support.errors import CzError

from .analysis import NO_LAGS, SEEN, Lags, LinearForm, close, linear_form, sampled_plant
from .clairvoyant import pullers_of
from .policy import Floats

PLACES = "pull", "heater", "ring"
"""Places where a loop is opened."""
POINTS = 400
"""Number of frequencies of a grid."""
DRAWS, SHARE = 200, 0.05
"""Number of pullers of a distribution of margins, and the share of them whose margins are worse [-]."""
_SLOWEST = 1e-5
_OFF = -2.0
"""Slack of a limit on the margins of an unstable loop [-]."""


class Margin(NamedTuple):
    """Margins of one opening; infinite, or zero for ``gain_down``, where no such change destabilises it."""

    gain_up: float
    """Factor by which the gain may grow [-]."""
    gain_down: float
    """Factor by which the gain may fall [-]."""
    phase: float
    """Least phase margin over all crossings [degrees]."""
    delay: float
    """Least delay that destabilises [s]."""
    peak: float
    """Peak of the sensitivity |1/(1 + L)| [-]."""

    @property
    def gain(self) -> float:
        """Smaller of the factors by which the gain may grow and by which it may be divided [-]."""
        return min(self.gain_up, 1.0 / self.gain_down if self.gain_down > 0.0 else math.inf)


NO_MARGIN = Margin(1.0, 1.0, 0.0, 0.0, math.inf)
"""Margins of an unstable loop."""


class Openings(NamedTuple):
    """Margins of a loop at each place where it is opened."""

    pull: Margin
    heater: Margin
    ring: Margin


class MarginLimits(NamedTuple):
    """Least gain and phase margin, and largest sensitivity peak, at every opening."""

    gain: float = 2.0
    """Factor by which the gain may grow, or be divided [-]."""
    phase: float = 30.0
    """Phase margin [degrees]."""
    peak: float = 2.0
    """Peak of the sensitivity [-]."""

    def slacks(self, openings: Openings) -> tuple[float, ...]:
        """Relative slacks of gain, phase and peak at the worst opening [-]; negative beyond a limit."""
        worst = worst_of(openings)
        if worst == NO_MARGIN:
            return (_OFF,) * 3
        least = math.log(worst.gain / self.gain), worst.phase / self.phase - 1.0, math.log(self.peak / worst.peak)
        return tuple(max(min(slack, 1.0), _OFF) for slack in least)


def margin_limits(text: str) -> MarginLimits | None:
    """Read limits from "GAIN,PHASE,PEAK", phase in degrees, or None from "off"; CzError for anything else."""
    if text == "off":
        return None
    try:
        gain, phase, peak = map(float, text.split(","))
    except ValueError:
        raise CzError(f"--margins {text}: write GAIN,PHASE,PEAK, such as 2,30,2, or off") from None
    if not (gain >= 1.0 and 0.0 < phase < 180.0 and peak > 1.0):
        raise CzError(f"--margins {text}: the gain must be at least 1, the phase 0 to 180 degrees, the peak above 1")
    return MarginLimits(gain, phase, peak)


def lags_of(config: Config) -> Lags:
    """Largest latency and lags of camera, heater and pyrometer in an environment's scenarios."""
    each = config.scenario.scenarios
    return Lags(
        max(one.sensor.latency for one in each),
        max(one.actuators.heater_lag[1] for one in each),
        max(one.actuators.heater_dead_time[1] for one in each),
        max(one.sensor.pyrometer_filter[1] for one in each),
    )


def frequency_response(system: StateSpace, z: Any) -> Any:
    """Responses of a system at points of the complex plane, shape (points, outputs, inputs)."""
    A, B, C, D = system
    return C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B) + D


def loop_gains(controller: Any, plant: StateSpace, z: Any) -> npt.NDArray[np.complex128]:
    """Loop gains L at points z, opened at each of PLACES, shape (3, points).

    ``controller`` is the response of its commands to the channels SEEN, shape (points, 2, 4).
    """
    P = frequency_response(plant, z)
    own = np.eye(2) - controller[:, :, 2:] / z[:, None, None]
    K = np.linalg.solve(own, controller[:, :, :2])
    gains = []
    for at in range(2):
        other = 1 - at
        # The drive that stays closed answers the plant's response to the opened one.
        answer = np.einsum("ni,ni->n", K[:, other], P[:, :, at]) / (
            1.0 - np.einsum("ni,ni->n", K[:, other], P[:, :, other])
        )
        seen = P[:, :, at] + answer[:, None] * P[:, :, other]
        gains.append(-np.einsum("ni,ni->n", K[:, at], seen))
    # The pyrometer's loop stays closed where the ring's is opened.
    warmth = np.einsum("ni,ni->n", P[:, 1], K[:, :, 0]) / (1.0 - np.einsum("ni,ni->n", P[:, 1], K[:, :, 1]))
    drives = K[:, :, 0] + warmth[:, None] * K[:, :, 1]
    gains.append(-np.einsum("ni,ni->n", P[:, 0], drives))
    return np.array(gains)


def margin_of(L: Any, omega: Floats, dt: float | None = None) -> Margin:
    """Margins of a stable loop from its gain on a grid of frequencies [rad/s]; with ``dt`` [s] it ends at Nyquist's."""
    if not np.any(L):
        return Margin(math.inf, 0.0, 180.0, math.inf, 1.0)
    factors, turned, crossed = crossings(L, np.log(omega))
    # At Nyquist's frequency the gain is real, and a delay turns one above one to the critical point's side.
    last, late = L[-1].real, np.mod(turned + np.pi, 2.0 * np.pi) / np.exp(crossed)
    if dt and last < 0.0:
        factors = np.append(factors, -1.0 / last)
    if dt and abs(last) > 1.0:
        late = np.append(late, np.mod(np.angle(L[-1]) + np.pi, 2.0 * np.pi) * dt / np.pi)
    return Margin(
        float(factors[factors > 1.0].min(initial=math.inf)),
        float(factors[factors < 1.0].max(initial=0.0)),
        float(np.degrees(np.abs(np.mod(turned, 2.0 * np.pi) - np.pi).min(initial=np.pi))),
        float(late.min(initial=math.inf)),
        float(np.max(1.0 / np.abs(1.0 + L))),
    )


def crossings(L: Any, place: Floats) -> tuple[Floats, Floats, Floats]:
    """Factors on the gain where the phase crosses -180 degrees, and phases [rad] and places where the gain crosses 1.

    ``place`` is a number for each point of the grid; between points everything is interpolated.
    """
    phase, gain = np.unwrap(np.angle(L)), np.log(np.abs(L))
    past = np.mod(phase, 2.0 * np.pi) - np.pi
    at = np.flatnonzero(((past[:-1] > 0.0) != (past[1:] > 0.0)) & (np.abs(np.diff(past)) < 1.0))
    through = np.flatnonzero((gain[:-1] > 0.0) != (gain[1:] > 0.0))
    return np.exp(-_crossed(past, gain, at)), _crossed(gain, phase, through), _crossed(gain, place, through)


def _crossed(through_zero: Floats, other: Floats, at: Any) -> Floats:
    """Another curve where one goes through zero between neighbours."""
    share = through_zero[at] / (through_zero[at] - through_zero[at + 1])
    values: Floats = other[at] + share * (other[at + 1] - other[at])
    return values


def openings(form: LinearForm, pullers: Sequence[Puller], lags: Lags = NO_LAGS, points: int = POINTS) -> list[Openings]:
    """Margins of a controller's loop with each of those pullers."""
    omega = np.geomspace(_SLOWEST, np.pi / form.dt, points)
    z = np.exp(1j * omega * form.dt)
    A, B, C, D = form.controller
    controller = frequency_response(StateSpace(A, B[:, SEEN], C, D[:, SEEN]), z)
    found = []
    for puller in pullers:
        if not close(form.controller, puller, form.dt, lags=lags).stable:
            found.append(Openings(*[NO_MARGIN] * 3))
            continue
        gains = loop_gains(controller, sampled_plant(puller, form.dt, lags), z)
        found.append(Openings(*(margin_of(L, omega, form.dt) for L in gains)))
    return found


def worst_of(margins: Iterable[Margin]) -> Margin:
    """The worst of several margins, number by number."""
    up, down, phase, delay, peak = zip(*margins, strict=True)
    return Margin(min(up), max(down), min(phase), min(delay), max(peak))


def worst_margins(policy: Any, config: Config, points: int = POINTS) -> Openings:
    """Margins of a controller in an environment, on the worse of Models I and II; NotLinearError if it has no loop."""
    form = linear_form(policy, config.scenario.scenarios[0].sensor)
    pullers = [make_puller(config.parameters, lam, config.meniscus) for lam in (1.0, 0.0)]
    both = openings(form, pullers, lags_of(config), points)
    return Openings(*(worst_of(each) for each in zip(*both, strict=True)))


def margin_quantiles(policy: Any, config: Config, draws: int = DRAWS, share: float = SHARE) -> Openings:
    """Margins that all but a ``share`` of the drawn pullers have, each on the worse of Models I and II."""
    form = linear_form(policy, config.scenario.scenarios[0].sensor)
    spread = replace(config, scenario=RANDOMIZED)
    models = []
    for model in ("I", "II"):
        pullers = pullers_of(replace(spread, model=model), range(draws))
        models.append(openings(form, pullers, lags_of(config), POINTS // 2))
    places = []
    for place in range(len(PLACES)):
        each = np.array([worst_of((one[place], two[place])) for one, two in zip(*models, strict=True)])
        low, high = (np.sort(each, axis=0)[at] for at in (int(share * draws), -1 - int(share * draws)))
        places.append(Margin(*map(float, (low[0], high[1], low[2], low[3], high[4]))))
    return Openings(*places)


HEADS = ("opened at", "gain may grow by", "gain may fall to", "phase margin [deg]", "delay margin [s]", "sensitivity")
"""Heads of :func:`shown`."""
EXPLAINED = (
    "Margins of the sampled loop near rest with its lags, opened at each drive and at the ring, on the worse of the "
    f"plant's Models I and II; in brackets those of {100 * (1 - SHARE):.0f} % of {DRAWS} pullers that differ as those "
    f"of {RANDOMIZED.name} do. A textbook asks for a gain of 2, 30 to 60 degrees and a sensitivity of at most 2."
)


def shown(policy: Any, config: Config) -> list[tuple[str, ...]]:
    """Rows of a table of a controller's margins and of their quantiles; NotLinearError if it has no loop."""
    nominal = worst_margins(policy, config)
    if nominal.ring == NO_MARGIN:
        return [("any place", "unstable", *[""] * (len(HEADS) - 2))]
    spread = margin_quantiles(policy, config)
    return [
        (place, *(f"{_text(value)} ({_text(other)})" for value, other in zip(own, least, strict=True)))
        for place, own, least in zip(PLACES, nominal, spread, strict=True)
    ]


def _text(value: float) -> str:
    return f"{value:.3g}" if 0.0 < value < math.inf else "no limit"
