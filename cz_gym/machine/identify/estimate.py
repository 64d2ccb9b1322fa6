"""Maximum a posteriori of the filter's prediction errors: what a log tells of a puller, and what it does not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.stats import chi2

from cz_gym.errors import CzError
from cz_gym.machine.puller import DEFAULT, PullerFile
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters
from cz_gym.support.names import unknown

from .log import Floats, Log
from .model import LAM, Model, Noise, Predicted, sensitivities

HEATER = ("C_1", "C_2", "C_b", "kappa_12", "G_1a", "G_2b", "eps", "k_l")
"""Parameters of the path from the heater."""
PULL = ("sigma", "lam")
"""Parameters of the path from the pull speed to the ring; ``lam`` stands for the product lam dT_0."""
PRIOR_SD, NOISE_SD = 0.35, 1.0
"""Standard deviation of the logarithm of a parameter, and of the strength of a noise [-]."""
LAM_SD = 0.3
"""Standard deviation of lam [-]; with the mean LAM about that of a uniform distribution."""
WIDER = 1.3
"""Factor on the standard deviations of the curvature, which is steeper at the maximum than around it; ``python -m
studies.identify`` counts the intervals that hold the truth."""
INFORMED = 0.5
"""An informed parameter keeps less than this share of the prior's standard deviation [-]."""
MOVE, ENOUGH, PAST = 0.005, 20 * 0.02**2, 6
"""Unexplained moves count from this share of nominal on; their squares must add up to those of 20 steps of 2 %. PAST
values of every signal explain a move."""
LAGS, WHITE = 20, 0.01
"""Lags of the whiteness test, and the probability below which residuals count as coloured."""
CAUTIOUS = {"pyrometer_sd": 20.0, "camera_sd": 4.0}
"""Factors on the noise where the search begins, so that the filter of a wrong puller can follow the log."""


class Estimate(NamedTuple):
    """What a log says of one number, SI units; of ``lam``, the product lam dT_0 [K]."""

    name: str
    prior: float
    value: float
    low: float
    """Lower end of the 95 % interval."""
    high: float
    left: float
    """Share of the prior's standard deviation that is left [-]."""
    excited: bool = True
    """Whether its drive moved enough; without that it is not estimated."""

    @property
    def informed(self) -> bool:
        """Whether the log says enough for the value to be used."""
        return self.left < INFORMED


@dataclass(frozen=True)
class Identified:
    """The result of an identification."""

    start: PullerFile
    estimates: tuple[Estimate, ...]
    """Of HEATER and PULL."""
    noise: tuple[Estimate, ...]
    """Of :class:`Noise`."""
    excitation: tuple[float, float]
    """Moves of pull speed and heater that no reading explains, in multiples of what is needed [-]."""
    errors: Floats
    """Prediction errors of pyrometer and ring in their standard deviations, shape (rows, 2); NaN without a reading."""
    predicted: Predicted
    settled: bool
    """Whether the search has ended at a maximum."""

    @property
    def puller(self) -> PullerFile:
        """The start with the numbers that the log tells: parameters, and the noise of camera and pyrometer.

        ``lam`` is none of them: each crystal of a scenario draws its own.
        """
        told = {e.name: e.value for e in (*self.estimates, *self.noise) if e.informed}
        sensors: dict[str, Any] = {
            name: (told[sd], told[sd])
            for name, sd in (("camera_noise", "camera_sd"), ("pyrometer_noise", "pyrometer_sd"))
            if sd in told
        }
        parameters = {name: value for name, value in told.items() if name in Parameters._fields}
        return replace(
            self.start,
            parameters=self.start.parameters._replace(**parameters),
            **sensors,
        )

    @property
    def whiteness(self) -> tuple[float, float]:
        """Probability of residuals as coloured as these if they were white: pyrometer, ring."""
        return whiteness(self.errors[:, 0]), whiteness(self.errors[:, 1])


def identify(
    log: Log,
    start: PullerFile = DEFAULT,
    prior_sd: Mapping[str, float] | None = None,
    meniscus: MeniscusModel = HURLE,
) -> Identified:
    """Estimate what the log tells of a puller; parameters of a path that is not excited are left alone.

    ``start`` holds the prior's medians, ``prior_sd`` standard deviations of logarithms other than PRIOR_SD.
    """
    sds = dict.fromkeys((*HEATER, *PULL), PRIOR_SD) | dict.fromkeys(Noise._fields, NOISE_SD) | {"lam": LAM_SD}
    for name, value in (prior_sd or {}).items():
        if name not in sds or not 0.0 < value < np.inf:
            raise CzError(unknown("parameter", name, sds) if name not in sds else f"prior of {name}: {value!r}")
        sds[name] = value
    moved = measure_excitation(log, start)
    free = (*(HEATER if moved[1] >= 1.0 else ()), *(PULL if moved[0] >= 1.0 else ()))
    model = Model((*free, *Noise._fields), start.parameters, meniscus)
    sd = np.array([sds[name] for name in model.names])
    theta, spread, out, settled = _maximise(log, model, sd)

    def estimate(name: str) -> Estimate:
        prior = model.value(name, LAM if name == "lam" else 0.0)
        if name not in model.names:
            return Estimate(name, prior, prior, prior, prior, 1.0, excited=False)
        j = model.names.index(name)
        low, value, high = (model.value(name, theta[j] + sign * 1.96 * spread[j]) for sign in (-1.0, 0.0, 1.0))
        return Estimate(name, prior, value, low, high, spread[j] / sd[j])

    read = np.isfinite([log.T_1, log.ring]).T
    errors = np.where(read, out.error / np.sqrt(out.variance), np.nan)
    told, noise = tuple(map(estimate, (*HEATER, *PULL))), tuple(map(estimate, Noise._fields))
    return Identified(start, told, noise, moved, errors, out, settled)


def measure_excitation(log: Log, start: PullerFile = DEFAULT) -> tuple[float, float]:
    """:func:`excitation` of pull speed and heater."""
    errors = np.stack([log.ring - np.nan_to_num(log.r_ref), log.T_1 - np.nan_to_num(log.T_1_ref)], axis=1)
    return excitation(log.v_p / start.parameters.v_0, errors), excitation(log.Q_H / np.median(log.Q_H), errors)


def excitation(drive: Floats, readings: Floats) -> float:
    """How much a drive, in shares of nominal, moves on its own; 1 is just enough.

    A linear regression of its moves on the last values of drive and readings explains what a controller does, at the
    controller's own pace. The moves that it leaves unexplained count.
    """
    at = np.flatnonzero(np.diff(drive)) + 1
    pace = int(np.median(np.diff(at))) if len(at) > 1 else 1
    at = at[at >= PAST * pace]
    series = np.column_stack([drive, readings])
    past = np.concatenate([series[at - 1 - lag * pace] for lag in range(PAST)], axis=1)
    good = np.isfinite(past).all(axis=1)
    if good.sum() < 2 * past.shape[1]:
        return 0.0
    move, X = (drive[at] - drive[at - 1])[good], past[good] - past[good].mean(axis=0)
    X = np.column_stack([X / np.maximum(X.std(axis=0), 1e-12), np.ones(len(X))])
    left = move - X @ np.linalg.lstsq(X, move, rcond=1e-10)[0]
    return float(np.square(left[np.abs(left) > MOVE]).sum() / ENOUGH)


def whiteness(errors: Floats) -> float:
    """Ljung and Box's probability over LAGS lags; NaN errors are where nothing was read."""
    u = np.nan_to_num(errors - np.nanmean(errors))
    n, lags = int(np.isfinite(errors).sum()), np.arange(1, LAGS + 1)
    correlations = np.array([u[lag:] @ u[:-lag] for lag in lags]) / (u @ u)
    return float(chi2.sf(n * (n + 2) * np.sum(np.square(correlations) / (n - lags)), LAGS))


def _maximise(log: Log, model: Model, sd: Floats) -> tuple[Floats, Floats, Predicted, bool]:
    """The posterior's maximum, standard deviations by its curvature, the filter's output there, and whether it settled.

    The curvature is Fisher's information of Gaussian prediction errors, so no second derivatives are needed.
    """

    @lru_cache(maxsize=2)
    def posterior(packed: bytes) -> tuple[float, Floats, Floats, Predicted]:
        away = np.frombuffer(packed)
        out, E, S = sensitivities(log, model, model.mean + away * sd)
        e, s = out.error, out.variance
        if not (np.isfinite(E).all() and np.isfinite(S).all() and s.min() > 0.0):
            return np.inf, np.zeros(len(away)), np.eye(len(away)), out
        slope = np.sum(e * E / s + 0.5 * S / s * (1.0 - e * e / s), axis=(1, 2)) * sd + away
        A, B = ((part.reshape(len(away), -1).T * sd).T for part in (E / np.sqrt(s), S / s))
        value = 0.5 * float(np.sum(np.log(s) + e * e / s) + away @ away)
        return value, slope, A @ A.T + 0.5 * B @ B.T + np.eye(len(away)), out

    def part(index: int) -> Callable[[Floats], Any]:
        return lambda x: posterior(x.tobytes())[index]

    first = _plausible_start(log, model, sd)
    found = minimize(
        part(0), first, jac=part(1), hess=part(2), method="trust-exact", options={"gtol": 0.1, "maxiter": 200}
    )
    value, _, curvature, out = posterior(found.x.tobytes())
    if not np.isfinite(value):
        raise CzError("the filter cannot follow this log from these parameters: is it another puller's?")
    spread = WIDER * np.sqrt(np.diag(np.linalg.inv(curvature)))
    return model.mean + found.x * sd, spread * sd, out, bool(found.success)


def _plausible_start(log: Log, model: Model, sd: Floats) -> Floats:
    """A start in prior standard deviations: its operating point has the log's mean temperature and power, nearly."""
    away = np.zeros(len(sd))
    for name, factor in CAUTIOUS.items():
        j = model.names.index(name)
        away[j] = np.log(factor) / sd[j]
    if "G_1a" not in model.names:
        return away
    T_1, Q_H = np.nanmean(log.T_1), np.mean(log.Q_H)

    def misfit(x: Floats) -> Floats:
        p = model.puller(model.mean + x * sd)
        return np.array([*(x - away), (p.T_1_0 - T_1) / 5.0, (p.Q_H_0 / Q_H - 1.0) / 0.02])

    found: Floats = least_squares(misfit, away).x
    return found
