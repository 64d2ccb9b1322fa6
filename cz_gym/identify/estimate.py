"""Maximum a posteriori of the filter's prediction errors: what a log tells of a puller, and what it does not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import toeplitz
from scipy.optimize import least_squares, minimize
from scipy.stats import chi2

from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import derive_puller

from .log import Floats, Log
from .model import Noise, Predicted, free_model, sensitivities

THERMAL = ("C_1", "C_2", "C_b", "kappa_12", "G_1a", "G_2b", "eps", "k_l")
"""Parameters of the path from the heater."""
PULL = ("sigma", "lam")
"""Parameters of the path from the pull speed to the ring; ``lam`` stands for the product lam dT_0."""
PRIOR_SD = 0.35
"""Standard deviation of a parameter's logarithm [-]: a factor of two either way is two of them."""
NOISE_SD = 1.0
"""The same of the noise's strengths [-]."""
LAM, LAM_SD = 0.5, 0.3
"""Mean and standard deviation of lam, about those of a uniform distribution [-]."""
INFORMED = 0.5
"""Largest share of the prior's standard deviation that an informed parameter has left [-]."""
MOVE, MOVES, PAST = 0.005, 20, 6
"""A move counts from this share of nominal on; as much as 20 steps of 2 % must have happened."""
LAGS, WHITE = 20, 0.01
"""Lags of the whiteness test, and the probability below which residuals are called coloured."""
SETTLED = 1e-3
"""Largest gradient at the maximum, in units of the log posterior per standard deviation."""


WIDE={"pyrometer_sd":20.,"camera_sd":4.}

class Estimate(NamedTuple):
    """What a log says of one number."""

    name: str
    prior: float
    value: float
    low: float
    """Lower end of the 95 % interval."""
    high: float
    left: float
    """Standard deviation left, as a share of the prior's [-]; 1: the log says nothing."""
    why: str = ""
    """Why it was not estimated at all."""

    @property
    def informed(self) -> bool:
        """Whether the log says enough for the value to be used."""
        return self.left < INFORMED


@dataclass(frozen=True)
class Identified:
    """The result of an identification."""

    start: Parameters
    estimates: tuple[Estimate, ...]
    noise: tuple[Estimate, ...]
    excitation: tuple[float, float]
    """Moves of pull speed and heater that the readings do not explain, in multiples of what is needed [-]."""
    predicted: Predicted
    whiteness: tuple[float, float]
    """Probability that residuals as coloured as these are white: pyrometer, ring."""

    @property
    def parameters(self) -> Parameters:
        """The start's parameters with those that the log tells; lam is no parameter of the file."""
        found = {e.name: e.value for e in self.estimates if e.informed and e.name in Parameters._fields}
        return self.start._replace(**found)

    def of(self, name: str) -> Estimate:
        """The estimate of that name."""
        return next(e for e in (*self.estimates, *self.noise) if e.name == name)


def excitation(drive: Floats, readings: Floats) -> float:
    """How much a drive moves on its own: squares of its moves that past readings and drives do not explain.

    A linear regression of each move on the last samples of drive and readings explains what a controller does. What
    is left counts where it exceeds MOVE; 1 is as much as MOVES steps of 2 %. ``drive`` is a share of nominal.
    """
    move = np.diff(drive)
    past = [np.roll(series, lag)[:-1] for series in (drive, *readings.T) for lag in range(PAST)]
    X, y = np.column_stack([*past, np.ones(len(move))])[PAST:], move[PAST:]
    good = np.isfinite(X).all(axis=1) & np.isfinite(y)
    if good.sum() < 2 * X.shape[1]:
        return 0.0
    X, y = X[good] - X[good].mean(axis=0), y[good]
    X = np.column_stack([X / np.maximum(X.std(axis=0), 1e-12), np.ones(len(y))])
    left = y - X @ np.linalg.lstsq(X, y, rcond=1e-10)[0]
    return float(np.sum(np.square(left[np.abs(left) > MOVE])) / (MOVES * 0.02**2))


def whiteness(error: Floats) -> float:
    """Ljung and Box's probability that standardised errors are white, over LAGS lags."""
    u = error[np.isfinite(error)] - np.nanmean(error)
    n = len(u)
    correlations = np.array([u[lag:] @ u[: n - lag] for lag in range(1, LAGS + 1)]) / (u @ u)
    return float(chi2.sf(n * (n + 2) * np.sum(np.square(correlations) / (n - np.arange(1, LAGS + 1))), LAGS))


def identify(
    log: Log,
    start: Parameters | None = None,
    noise: Noise | None = None,
    prior_sd: dict[str, float] | None = None,
    meniscus: MeniscusModel = HURLE,
) -> Identified:
    """Estimate what the log tells; parameters of a path without excitation are not touched."""
    start, noise, given = start or Parameters(), noise or Noise(), prior_sd or {}
    moved = _excitation(log, start)
    free = (*(PULL if moved[0] >= 1.0 else ()), *(THERMAL if moved[1] >= 1.0 else ()))
    names = (*free, *Noise._fields)
    mean = np.array([LAM if name == "lam" else 0.0 for name in names])
    sd = np.array([_sd(name, given) for name in names])
    model = free_model(names, start, noise)
    first = _static_start(log, names, mean, sd, model, meniscus)

    def posterior(theta: Floats) -> tuple[float, Floats, Floats, Predicted]:
        out, E, S = sensitivities(log, theta, model, meniscus)
        e, s, away = out.error, out.variance, (theta - mean) / sd
        if not (np.isfinite(e).all() and s.min() > 0.0 and np.isfinite(E).all() and np.isfinite(S).all()):
            return np.inf, 0.0 * theta, np.eye(len(theta)), out
        value = 0.5 * float(np.sum(np.log(s) + e * e / s) + away @ away)
        slope = np.sum(e * E / s + 0.5 * S / s * (1.0 - e * e / s), axis=(1, 2)) + away / sd
        A, B = (part.reshape(len(theta), -1) for part in (E / np.sqrt(s), S / s))
        return value, slope, A @ A.T + 0.5 * B @ B.T + np.diag(1.0 / sd**2), out

    theta, _, curvature, out = maximise(posterior, first, sd)
    spread = np.sqrt(np.diag(np.linalg.inv(curvature)))
    found = {
        name: _estimate(name, start, noise, theta[j], spread[j], sd[j]) for j, name in enumerate(names)
    }
    asked = tuple(found.get(name) or _untold(name, start, moved) for name in (*THERMAL, *PULL))
    white = np.where(out.variance == 1.0, np.nan, out.error / np.sqrt(out.variance))
    return Identified(
        start, asked, tuple(found[name] for name in Noise._fields), moved, out,
        (whiteness(white[:, 0]), whiteness(white[:, 1])),
    )  # fmt: skip


def maximise(posterior, theta, sd):
    known = {}
    def at(scaled):
        key = scaled.tobytes()
        if key not in known:
            known.clear(); known[key] = posterior(scaled * sd)
        return known[key]
    found = minimize(lambda x: at(x)[0], theta / sd, jac=lambda x: at(x)[1] * sd, hess=lambda x: at(x)[2] * np.outer(sd, sd), method="trust-exact", options={"gtol": SETTLED*10, "maxiter": 100})
    print(found.message, found.nit, found.fun, np.abs(found.jac).max())
    return (found.x * sd, *at(found.x)[1:])


def _sd(name: str, given: dict[str, float]) -> float:
    if name in given:
        return given[name]
    return LAM_SD if name == "lam" else NOISE_SD if name in Noise._fields else PRIOR_SD


def _excitation(log: Log, start: Parameters) -> tuple[float, float]:
    readings = np.column_stack([log.ring - np.where(np.isfinite(log.r_ref), log.r_ref, 0.0), log.T_1 - np.nan_to_num(log.T_1_ref)])
    nominal = np.nanmedian(log.Q_H)
    return excitation(log.v_p / start.v_0, readings), excitation(log.Q_H / nominal, readings)


def _static_start(log, names, mean, sd, model, meniscus):
    """Where the operating point has the log's mean temperature (within 5 K) and power (within 2 %)."""
    mean = mean.copy()
    for k in WIDE: mean[names.index(k)] = np.log(WIDE[k])
    if "G_1a" not in names:
        return mean
    T_1, Q_H = np.nanmean(log.T_1), np.nanmean(log.Q_H)

    def misfit(theta):
        q, lam, _ = model(theta)
        p = derive_puller(type(q)(*(float(np.real(v)) for v in q)), float(np.real(lam)), meniscus.height, meniscus.ring_offset)
        return [*((theta - mean) / sd), (p.T_1_0 - T_1) / 5.0, (p.Q_H_0 / Q_H - 1.0) / 0.02]

    return least_squares(misfit, mean).x


def _estimate(name, start, noise, at, spread, sd):
    wide = 1.96 * spread
    if name == "lam":
        prior, value, low, high = LAM * start.dT_0, at * start.dT_0, (at - wide) * start.dT_0, (at + wide) * start.dT_0
        return Estimate("lam", prior, value, low, high, spread / sd)
    prior = getattr(noise, name) if name in Noise._fields else getattr(start, name)
    return Estimate(name, prior, *(float(prior * np.exp(at + shift)) for shift in (0.0, -wide, wide)), spread / sd)


def _untold(name, start, moved):
    drive = "pull speed" if name in PULL else "heater"
    prior = LAM * start.dT_0 if name == "lam" else getattr(start, name)
    return Estimate(name, prior, prior, prior, prior, 1.0, f"the {drive} was not excited")
