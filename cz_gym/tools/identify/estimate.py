"""Maximum a posteriori estimate of a puller's numbers from its logs, by the filter's prediction errors.

Prediction errors, operating point and noise at the maximum say whether the model fits the log.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares, minimize

from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters
from cz_gym.puller.file import DEFAULT, PullerFile
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.units import KILO, MM
from cz_gym.tools.posterior import Posterior

from .log import Floats, Log, join_logs, prepare, shift_drives
from .model import (
    FAST,
    LAM,
    LOAD,
    RING_GAIN,
    SLOW,
    TAU_FAST,
    TAU_SLOW,
    Lags,
    Model,
    NoiseLevels,
    Predicted,
    melt_from_start,
    sensitivities,
    smooth,
)  # fmt: skip
from .moves import measure_excitation

SENSORS = "pyrometer", "ring"
"""Sensors in the order of prediction errors."""
HEATER = ("C_1", "C_2", "C_b", "kappa_12", "G_1a", "G_2b", "eps", "k_l")
"""Parameters of the path from the heater."""
PULL = ("sigma", "rho_l", "alpha_0", "lam")
"""Parameters of the path from the pull speed to the ring; ``lam`` stands for the product lam dT_0."""
LAGS = Lags._fields
"""Delays of the heater's path; a log tells their sum better than each."""
SHORT, LAG_SD, DEAD_SD = 2.0, 1.5, 5.0
"""Median of a lag that the start does not have [s], standard deviation of a lag's logarithm [-] and of the dead
time [s]."""
PRIOR_SD, NOISE_SD = 0.35, 1.0
"""Standard deviation of the logarithm of a parameter, and of the strength of a noise [-]."""
MATERIAL_SD = {
    "sigma": (0.05, "handbooks of silicon: 0.72 to 0.83 N/m"),
    "k_l": (0.1, "handbooks of silicon: 54 to 67 W/m/K"),
    "rho_l": (0.01, "handbooks of silicon: 2510 to 2570 kg/m3"),
    "alpha_0": (0.1, "measured growth angles of silicon: 11 deg, 1 deg more or less"),
}
"""Material constants: standard deviation of the logarithm [-], and where it comes from."""
LAM_SD = 0.3
"""Standard deviation of lam [-]; with the mean LAM about that of a uniform distribution."""
WIDER = 1.3
"""Factor on the standard deviations of the curvature, which is steeper at the maximum than around it; ``python -m
studies.identify`` counts the intervals that hold the truth."""
INFORMED = 0.5
"""Share of the prior's standard deviation that is left of an informed parameter's, at most [-]."""
AT_REST = 8, 0.02
"""Number of steps and the gain in them below which the search ends: a dead time of whole rows is a kink."""
CAUTIOUS = {"pyrometer_sd": 20.0, "camera_sd": 4.0}
"""Factors on the noise where the search begins, so that the filter of a wrong puller can follow the log."""


class Estimate(NamedTuple):
    """Estimate of one number from a log, SI units; of ``lam``, the product lam dT_0 [K]."""

    name: str
    prior: float
    value: float
    low: float
    """Lower end of the 95 % interval."""
    high: float
    left: float
    """Share of the prior's standard deviation that is left [-]."""
    excited: bool = True
    """True if its drive moved enough; without that it is not estimated."""
    trusted: bool = True
    """True if the model fits the log; for a lag, if the lags add up to more than half a row too."""

    @property
    def informed(self) -> bool:
        """True if the log says enough for the value to be used."""
        return self.trusted and self.left < INFORMED


@dataclass(frozen=True)
class Identified:
    """Result of an identification."""

    start: PullerFile
    estimates: tuple[Estimate, ...]
    """Estimates of the numbers in HEATER, LAGS and PULL."""
    noise: tuple[Estimate, ...]
    """Estimates of the numbers in :class:`NoiseLevels`."""
    excitation: tuple[float, float]
    """Moves of pull speed and heater that no reading explains, in multiples of what is needed [-]."""
    errors: Floats
    """Prediction errors of pyrometer and ring in their standard deviations, shape (rows, 2); NaN without a reading."""
    predicted: Predicted
    logs: tuple[Log, ...]
    """Logs in the rows that were estimated from."""
    settled: bool
    """True if the search has ended at a maximum."""
    ring_gain: tuple[float, float] = (1.0, np.inf)
    """Factor on the file's ring-to-height gain that the log asks for, and its logarithm's standard deviation [-]."""
    sds: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the priors by name."""
    told_sds: tuple[str, ...] = ()
    """Names of the priors that the user gave, in place of handbooks' and the usual ones."""
    misfits: tuple[str, ...] = ()
    """Reasons why the model does not fit the log, in words; empty if it does."""
    posterior: Posterior | None = None
    """Posterior of parameters and lags; that of a parameter whose drive was not excited is its prior."""

    @property
    def log(self) -> Log:
        """Logs one after the other."""
        return join_logs(self.logs)

    @property
    def ring_outside(self) -> float:
        """Distance of the ring from the reference in the middle of the log; from r_0 if it has none [m]."""
        log = self.log
        meant = np.where(np.isfinite(log.r_ref), log.r_ref, self.start.parameters.r_0)
        return float(np.nanmedian(log.ring - meant))

    def series(self, meniscus: MeniscusModel = HURLE) -> list[tuple[Floats, Floats, Floats]]:
        """Times [s], load on the melt [W] and fluctuation of the interface [K] of each log, from a smoother.

        With them a crystal of :attr:`puller` grows as the log's did. A simulated crystal starts at rest: so the load
        counts from the first row, as nominal power and temperatures do, and the fluctuation holds what the melt's
        temperature differs because the log's temperatures were not at rest there.
        """
        lags = _lags_of(self.puller, False)
        model = Model(NoiseLevels._fields, self.puller.parameters, meniscus, lags)
        theta = np.array([np.log(each.value / each.prior) for each in self.noise])
        pairs = []
        for log in self.logs:
            states = smooth(log, model, theta)
            fluctuation = states[:, FAST] + states[:, SLOW] + melt_from_start(log, model, theta, states[0])
            pairs.append((log.time - log.time[0], states[:, LOAD] - states[0, LOAD], fluctuation))
        return pairs

    @property
    def puller(self) -> PullerFile:
        """Start file with the numbers that the log tells: parameters, lags, fluctuations of the melt, and the noise of
        camera and pyrometer.

        ``lam`` is not among them: each crystal of a scenario draws its own. Where the model does not fit, the numbers
        are the ones that explain the log best.
        """
        sure = {e.name: e.value for e in (*self.estimates, *self.noise) if e.left < INFORMED}
        names = {"camera_sd": "camera_noise", "pyrometer_sd": "pyrometer_noise"}
        ranges = {own: sure[name] for name, own in names.items() if name in sure}
        ranges |= {e.name: max(e.value, 0.0) for e in self.estimates if e.name in LAGS and e.excited and self.delayed}
        parameters = {name: value for name, value in sure.items() if name in Parameters._fields}
        own: dict[str, Any] = {name: (value, value) for name, value in ranges.items()}
        if {"fast_sd", "slow_sd"} <= set(sure):
            sds = sorted((sure["fast_sd"], sure["slow_sd"]))
            own |= {"fluctuation_sd": tuple(sds), "tau_fast": TAU_FAST, "tau_slow": TAU_SLOW}
        return replace(self.start, parameters=self.start.parameters._replace(**parameters), **own)

    @property
    def verdict(self) -> str:
        """One line that says that the model fits the log, or why it does not."""
        if self.misfits:
            return f"THE MODEL DOES NOT FIT: {'; '.join(self.misfits)}"
        moved = [drive for drive, share in zip(("pull speed", "heater"), self.excitation, strict=True) if share >= 1.0]
        return f"the model fits the log; moves of their own: {', '.join(moved) or 'none, so the log tells nothing'}"

    @property
    def delayed(self) -> bool:
        """True if the heater's path has a delay that the model's equations do not have."""
        return any(e.trusted for e in self.estimates if e.name in LAGS and e.excited)


def identify(
    log: Log | Sequence[Log],
    start: PullerFile = DEFAULT,
    prior_sd: Mapping[str, float] | None = None,
    meniscus: MeniscusModel = HURLE,
    progress: Callable[[], Any] = lambda: None,
) -> Identified:
    """Estimate what one or several logs tell of a puller; parameters of a path that is not excited are left alone.

    ``start`` holds the prior's medians, ``prior_sd`` standard deviations of logarithms other than those of
    :func:`prior_sds`; ``progress`` is called at each step of the search. Drives that seem to act before they do are
    moved by a row: the log's row then holds what came after its readings.
    """
    logs = (log,) if isinstance(log, Log) else tuple(log)
    sds = prior_sds(prior_sd or {})
    pull, heater = measure_excitation(logs, start)
    free = (*((*HEATER, *LAGS) if heater >= 1.0 else ()), *(PULL if pull >= 1.0 else ()))
    model = Model((*free, *NoiseLevels._fields), start.parameters, meniscus, _lags_of(start, heater >= 1.0))
    sd, latency = np.array([sds[name] for name in model.names]), start.latency or 0.0
    rows, best = _fit(logs, latency, model, sd, progress)
    if "heater_lag" in free and (total := _delay(best, model))[0] + 2.0 * total[1] < 0.0:
        logs = tuple(map(shift_drives, logs))
        rows, best = _fit(logs, latency, model, sd, progress)

    whole = join_logs(rows)
    read = np.isfinite([whole.T_1, whole.ring]).T
    errors = np.where(read, best.out.error / np.sqrt(best.out.variance), np.nan)
    estimate = partial(_estimate, best=best, model=model, sd=sd, interval=logs[0].interval)
    told, noise = tuple(map(estimate, (*HEATER, *LAGS, *PULL))), tuple(map(estimate, NoiseLevels._fields))
    gain = _ring_gain(rows, model, best, sd) if pull >= 1.0 else (1.0, np.inf)
    result = Identified(start, told, noise, (pull, heater), errors, best.out, tuple(rows), best.settled, gain, sds)
    result = replace(result, told_sds=tuple(prior_sd or ()))
    known = _posterior(model, best, (*HEATER, *PULL, *(LAGS if result.delayed else ())), sds)
    away = dict(zip(model.names, (best.theta - model.mean) / sd, strict=True))
    if reasons := misfits(result, model.puller(best.theta + 0j), away):
        told, noise = (tuple(e._replace(trusted=False) for e in each) for each in (told, noise))
    return replace(result, estimates=told, noise=noise, misfits=reasons, posterior=known)


def prior_sds(given: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations of the priors by name: those of handbooks for a material's constants, PRIOR_SD for the hot
    zone's; ``given`` has others. CzError for names that there are not.
    """
    sds = dict.fromkeys((*HEATER, *PULL), PRIOR_SD) | dict.fromkeys(NoiseLevels._fields, NOISE_SD) | {"lam": LAM_SD}
    sds |= {name: sd for name, (sd, _) in MATERIAL_SD.items()}
    sds |= {"heater_lag": LAG_SD, "pyrometer_filter": LAG_SD, "heater_dead_time": DEAD_SD}
    for name, value in given.items():
        if name not in sds or not 0.0 < value < np.inf:
            raise CzError(
                unknown_name_message("parameter", name, sds) if name not in sds else f"prior of {name}: {value!r}"
            )
        sds[name] = value
    return sds


def _lags_of(start: PullerFile, free: bool) -> Lags:
    """Lags of the start file; where they are estimated, a short one in place of none."""
    lag, dead, slow = (float(np.mean(getattr(start, name) or 0.0)) for name in LAGS)
    return Lags(lag or SHORT * free, dead, slow or SHORT * free)


class Maximum(NamedTuple):
    """Maximum of the posterior."""

    theta: Floats
    """Free numbers."""
    covariance: Floats
    """Covariance of the free numbers."""
    out: Predicted
    """Output of the filter at the maximum."""
    settled: bool

    @property
    def sd(self) -> Floats:
        """Standard deviations of the free numbers."""
        return np.sqrt(np.diag(self.covariance))


def _posterior(model: Model, best: Maximum, of: Sequence[str], sds: Mapping[str, float]) -> Posterior:
    """The posterior of a puller's numbers. WIDER makes none less known than before; lam is each crystal's own."""
    names = [name for name in of if name != "lam"]
    covariance = np.diag([sds[name] ** 2 for name in names])
    at = [j for j, name in enumerate(names) if name in model.names]
    free = [model.names.index(names[j]) for j in at]
    shares = np.minimum(np.array([sds[names[j]] for j in at]) / best.sd[free], 1.0)
    covariance[np.ix_(at, at)] = best.covariance[np.ix_(free, free)] * np.outer(shares, shares)
    return Posterior(tuple(names), covariance)


def _delay(best: Maximum, model: Model) -> Floats:
    """Sum of the lags and its standard deviation [s], shape (2,)."""
    lags = model.delays(best.theta)
    slopes = {"heater_lag": lags.heater_lag, "heater_dead_time": 1.0, "pyrometer_filter": lags.pyrometer_filter}
    slope = np.array([slopes.get(name, 0.0) for name in model.names])
    return np.array([sum(lags), np.sqrt(slope @ best.covariance @ slope)])


def _fit(
    logs: Sequence[Log], latency: float, model: Model, sd: Floats, progress: Callable[[], Any]
) -> tuple[list[Log], Maximum]:
    """The logs on the rows of estimation, for a camera's latency [s], and the posterior's maximum on them."""
    rows = [prepare(each, latency) for each in logs]
    return rows, _maximise(rows, model, sd, progress)


def _estimate(name: str, best: Maximum, model: Model, sd: Floats, interval: float) -> Estimate:
    """Estimate of one number at the maximum, from a log with rows every ``interval`` [s]."""
    usual = model.value(name, LAM if name == "lam" else 0.0)
    if name not in model.names:
        return Estimate(name, usual, usual, usual, usual, 1.0, excited=False)
    j = model.names.index(name)
    deviation = min(best.sd[j], sd[j])  # WIDER is no reason to know less than before
    low, value, high = (model.value(name, best.theta[j] + sign * 1.96 * deviation) for sign in (-1.0, 0.0, 1.0))
    delay = name not in LAGS or np.subtract(*(_delay(best, model) * (1.0, 2.0))) > 0.5 * interval
    return Estimate(name, usual, value, low, high, deviation / sd[j], trusted=bool(delay))


def _maximise(logs: Sequence[Log], model: Model, sd: Floats, progress: Callable[[], Any]) -> Maximum:
    """Search the posterior's maximum; the start of the search if the filter cannot follow the log there.

    The curvature is Fisher's information of Gaussian prediction errors, so no second derivatives are needed.
    """

    @lru_cache(maxsize=2)
    def posterior(packed: bytes) -> tuple[float, Floats, Floats, Predicted]:
        away = np.frombuffer(packed)
        progress()
        value, slope, information, out = _likelihood(logs, model, model.mean + away * sd)
        if not np.isfinite(value):
            return np.inf, np.zeros(len(away)), np.eye(len(away)), out
        return (
            value + 0.5 * float(away @ away),
            slope * sd + away,
            information * np.outer(sd, sd) + np.eye(len(away)),
            out,
        )

    def part(index: int) -> Callable[[Floats], Any]:
        return lambda x: posterior(x.tobytes())[index]

    away, settled = _plausible_start(logs, model, sd), False
    values = [posterior(away.tobytes())[0]]

    def stop_at_rest(intermediate_result: Any) -> None:
        values.append(float(intermediate_result.fun))
        if len(values) > AT_REST[0] and values[-AT_REST[0]] - values[-1] < AT_REST[1]:
            raise StopIteration

    if np.isfinite(values[0]):
        options: Any = {"gtol": 0.1, "maxiter": 100}
        how: Any = {"jac": part(1), "hess": part(2), "method": "trust-exact", "callback": stop_at_rest}
        away = minimize(part(0), away, options=options, **how).x
        settled = len(values) <= options["maxiter"]
    _, _, curvature, out = posterior(away.tobytes())
    return Maximum(model.mean + away * sd, WIDER**2 * np.linalg.inv(curvature) * np.outer(sd, sd), out, settled)


def _likelihood(logs: Sequence[Log], model: Model, theta: Floats) -> tuple[float, Floats, Floats, Predicted]:
    """Minus the logarithm of the likelihood (infinite where the filter fails), its slope, its information, and the
    filter's output.
    """
    parts = [sensitivities(log, model, theta) for log in logs]
    out = Predicted(*(np.concatenate(each) for each in zip(*(part[0] for part in parts), strict=True)))
    E, S = (np.concatenate([part[k] for part in parts], axis=1) for k in (1, 2))
    e, s = out.error, out.variance
    if not (np.isfinite(E).all() and np.isfinite(S).all() and s.min() > 0.0):
        return np.inf, np.zeros(len(theta)), np.eye(len(theta)), out
    slope = np.sum(e * E / s + 0.5 * S / s * (1.0 - e * e / s), axis=(1, 2))
    A, B = (part.reshape(len(theta), -1) for part in (E / np.sqrt(s), S / s))
    return 0.5 * float(np.sum(np.log(s) + e * e / s)), slope, A @ A.T + 0.5 * B @ B.T, out


def _ring_gain(logs: Sequence[Log], model: Model, best: Maximum, sd: Floats) -> tuple[float, float]:
    """Factor on the ring-to-height gain that the log asks for beside the estimates, and its logarithm's sd [-].

    One step of Newton's method from the maximum, with the factor free and without a prior.
    """
    wider = model._replace(names=(*model.names, RING_GAIN))
    _, slope, information, _ = _likelihood(logs, wider, np.append(best.theta, 0.0))
    precision = np.append(sd**-2.0, 0.0)
    slope = slope + precision * np.append(best.theta - model.mean, 0.0)
    covariance = np.linalg.pinv(information + np.diag(precision), hermitian=True)
    step = -(covariance @ slope)[-1]
    return float(np.exp(np.clip(step, -3.0, 3.0))), float(WIDER * np.sqrt(covariance[-1, -1]))


def _plausible_start(logs: Sequence[Log], model: Model, sd: Floats) -> Floats:
    """Start of the search, in prior standard deviations: its operating point is near the log's mean T_1 and power."""
    away = np.zeros(len(sd))
    for name, factor in CAUTIOUS.items():
        j = model.names.index(name)
        away[j] = np.log(factor) / sd[j]
    if "G_1a" not in model.names:
        return away
    T_1, Q_H = (np.nanmean(np.concatenate([getattr(log, name) for log in logs])) for name in ("T_1", "Q_H"))

    def misfit(x: Floats) -> Floats:
        p = model.puller(model.mean + x * sd)
        return np.array([*(x - away), (p.T_1_0 - T_1) / 5.0, (p.Q_H_0 / Q_H - 1.0) / 0.02])

    start: Floats = least_squares(misfit, away).x
    return start


# Reasons against the model.

ROWS_BACK, COLOURED = 20, 0.15
"""Lags at which prediction errors are correlated [rows], and the correlation above which the model does not fit [-];
many rows make smaller ones significant."""
LEAST_ERROR = 0.05, 0.01 * MM
"""Least standard deviation of prediction errors of pyrometer [K] and ring [m] that are judged: no sensor shows less,
and a model need not be better."""
PRIOR_END = 3.0
"""Standard deviations of its prior from which on an estimate stands at its end."""
T_1_OFF, Q_H_OFF = 15.0, 0.06
"""Largest differences of the model's operating point and the log's means: T_1 [K], share of the power [-]."""
RING_OFF = 1.5 * MM
"""Largest difference of the file's ring, seen from the crystal, and the log's, seen from the reference [m]."""
GAIN_OFF = 0.25, 3.0
"""Deviation of the ring-to-height gain from which on it is judged [-], in its standard deviations too."""
NOISE_RATIO = 2.5
"""Largest ratio of a sensor's noise to what the start file says."""


def misfits(identified: Identified, puller: Any, away: Mapping[str, float]) -> tuple[str, ...]:
    """List the reasons why the model does not fit the log, in words.

    ``puller`` has the estimates' Q_H_0 and T_1_0, ``away`` how far each estimate is from its prior's mean, in standard
    deviations. Only paths that were estimated are judged; a delay or a noise may well be absent.
    """
    heater = identified.excitation[1] >= 1.0
    if not heater and identified.excitation[0] < 1.0:
        return ()
    reasons = [] if identified.settled else ["the search has not settled"]
    reasons += _coloured_errors(identified, SENSORS if heater else SENSORS[1:])
    if heater:
        reasons += _off_the_operating_point(identified.log, puller)
    reasons += _another_ring(identified, float(puller.ring_bias.real))
    parameters = {e.name for e in identified.estimates} - set(LAGS)
    ends = [f"{name} ({by:+.1f})" for name, by in away.items() if (abs(by) if name in parameters else by) > PRIOR_END]
    if ends:
        reasons.append(f"estimates stand at the ends of their priors [standard deviations]: {', '.join(ends)}")
    reasons += _noisy_sensors(identified)
    try:
        _ = identified.puller
    except CzError as error:
        reasons.append(f"its numbers are not plausible: {error}")
    return tuple(reasons)


def _coloured_errors(identified: Identified, judged: Sequence[str]) -> list[str]:
    """Find sensors whose prediction errors are correlated and larger than a sensor shows."""
    reasons = []
    for sensor, name in enumerate(SENSORS):
        large = name in judged and np.nanstd(identified.predicted.error[:, sensor]) > LEAST_ERROR[sensor]
        if large and (size := coloured(identified.errors[:, sensor])) > COLOURED:
            reasons.append(f"prediction errors of the {name} are coloured (correlation {size:.2f})")
    return reasons


def _off_the_operating_point(log: Log, puller: Any) -> list[str]:
    """Compare the model's temperature and power at rest with the log's means."""
    reasons, T_1, Q_H = [], np.nanmean(log.T_1), np.mean(log.Q_H)
    if abs(puller.T_1_0.real - T_1) > T_1_OFF:
        reasons.append(f"its T_1 is {puller.T_1_0.real:.0f} K where the log's mean is {T_1:.0f} K")
    if abs(puller.Q_H_0.real / Q_H - 1.0) > Q_H_OFF:
        reasons.append(f"it needs {puller.Q_H_0.real / KILO:.1f} kW where the log's mean is {Q_H / KILO:.1f} kW")
    return reasons


def _another_ring(identified: Identified, bias: float) -> list[str]:
    """Compare the ring's distance from the crystal, and its gain by the meniscus' height, with the log's."""
    file, seen, (gain, sd) = identified.start, identified.ring_outside, identified.ring_gain
    room = RING_OFF + sum(np.abs(offset or (0.0,)).max() for offset in (file.bias_offset, file.level_offset))
    reasons = []
    if abs(bias - seen) > room:
        reasons.append(
            f"its ring is {bias / MM:.1f} mm outside the crystal where the log's is {seen / MM:.1f} mm outside the "
            "reference (sigma, phi_b or the radius is another)"
        )
    if abs(np.log(gain)) > max(np.log1p(GAIN_OFF[0]), GAIN_OFF[1] * sd):
        reasons.append(f"the log's ring moves {gain:.2g} times as much with the meniscus' height as the file's")
    return reasons


def _noisy_sensors(identified: Identified) -> list[str]:
    """Compare the sensors' noise with what the start file says."""
    noise, file = {e.name: e.value for e in identified.noise}, identified.start
    ring = np.hypot(max(file.camera_noise or (0.0,)), max(file.ripple or (0.0,)))
    return [
        f"noise of the {name} is {value / size:.2g} {unit}, the file says {usual / size:.2g} {unit}"
        for name, value, usual, unit, size in (
            ("ring", noise["camera_sd"], ring, "mm", MM),
            ("pyrometer", noise["pyrometer_sd"], max(file.pyrometer_noise or (0.0,)), "K", 1.0),
        )
        if usual and value > NOISE_RATIO * usual
    ]


def coloured(errors: Floats) -> float:
    """Largest correlation of errors within ROWS_BACK rows [-], without their strongest line, perhaps the rotation's.

    Errors are NaN where nothing was read.
    """
    u = np.nan_to_num(errors - np.nanmean(errors))
    spectrum = np.fft.rfft(u)
    peak = int(np.abs(spectrum).argmax())
    spectrum[max(peak - 1, 0) : peak + 2] = 0.0
    u = np.fft.irfft(spectrum, len(u))
    u -= u.mean()
    return float(max(abs(u[lag:] @ u[:-lag]) for lag in range(1, ROWS_BACK + 1)) / (u @ u))
