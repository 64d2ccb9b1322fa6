"""Numbers that Part II prints, its design, and its experiments on our nonlinear plant; each result is computed once.

Bukhari, Hovd and Winkler, "Inverse response behaviour in the bright ring radius measurement of the Czochralski process
II: Mitigation by control", Journal of Crystal Growth.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from cz_gym import HURLE, MeniscusModel, Scenario, make_puller
from cz_gym.baselines.analysis import Margins, design_compensator, margins
from cz_gym.baselines.pid import CompensatedPID, Compensator, SeriesPID
from cz_gym.body.process import RadiusModel, radius_model
from cz_gym.body.signals import Logged
from cz_gym.config import make_config
from cz_gym.evaluation.rollout import Playback, rollout
from cz_gym.physics.plant import quintic
from cz_gym.process import Floats
from cz_gym.support.units import HOUR, MINUTE, MM, MM_PER_MIN

MODEL_I = RadiusModel(numerator=-0.0047626, poles=(8.78e-6, -1.684e-3), lead=-47.1864, constant=1.0041)
MODEL_II = RadiusModel(numerator=-0.0048849, poles=(4.63e-7, 7.602e-6), lead=-46.0050, constant=1.0043)
PUBLISHED = {"I": MODEL_I, "II": MODEL_II}
"""G_p and G_m by model, section on the linearised model."""
ZERO = 0.021
"""Right half plane zero of both models, as rounded in the text [rad/s]."""
COMPENSATOR = Compensator()
"""The paper's compensator, G_pc,real."""
ODE = (1.884e-3, 3.368e-7)
"""Compensator as a differential equation in time: coefficients of y_pc' [rad/s] and y_pc [(rad/s)^2]."""
PID = SeriesPID()
"""The paper's PID, Table 1."""
CROSSOVER = 0.03275
"""Crossover of Table 1 [rad/s]."""
PHASE_MARGIN_DEG = 74.0
"""Phase margin below Table 1, "around 74 degrees for both models" [degrees]."""

MODELS = {"I": 1.0, "II": 0.0}
"""Share of conduction of the paper's models [-]."""
SOURCES = ("published", "own")
"""Sources of linear models: the paper's functions, our plant."""
PRINTED, BARE = CompensatedPID(pid=PID), CompensatedPID(pid=PID, compensator=None)
"""Printed controller, and its PID alone."""
INTERVAL = 5.0
"""Time between actions in closed loop [s]."""
FINE = 1.0
"""Time between actions in open loop [s]."""
SUDDEN = 1e-3
"""Duration of a sudden change [s]."""
BEFORE = 120.0
"""Rest before the pull change in the figures [s]."""


@cache
def linear_model(source: str, model: str) -> RadiusModel:
    """G_p and G_m of one of SOURCES."""
    return PUBLISHED[model] if source == "published" else radius_model(make_puller(lam=MODELS[model]))


@cache
def compensator(source: str) -> Compensator:
    """Apply the design procedure to Model I of one of SOURCES."""
    return design_compensator(linear_model(source, "I"))


@cache
def loop_margins(source: str, model: str, compensated: bool = True) -> Margins:
    """Margins of the loop with the printed PID."""
    return margins(linear_model(source, model), compensator(source) if compensated else None, PID)


class Trace(NamedTuple):
    """One episode from t = 0 until its end, arrays of shape (samples,)."""

    t: Floats
    """Time [s]."""
    signals: Logged
    """Logged signals, SI units, radians."""
    r_tilde: Floats
    """Ring minus bias plus compensator [m]; without a compensator, ring minus bias."""
    failed: bool
    """True if the episode ended in a failure."""

    @property
    def minutes(self) -> Floats:
        """Time [min]."""
        return self.t / MINUTE


@cache
def trace(
    policy: Any,
    model: str,
    scenario: str | Scenario = "nominal",
    horizon: float = 3.0 * HOUR,
    interval: float = INTERVAL,
    meniscus: MeniscusModel = HURLE,
) -> Trace:
    """Run a policy once on one model of the paper."""
    config = make_config(scenario, model, "measured", interval, horizon, meniscus=meniscus, action="direct")
    run = rollout(policy.for_config(config) if hasattr(policy, "for_config") else policy, config, [0])
    lived = int(run.alive.sum())
    pairs = zip(run.start, run.signals, strict=True)
    logged = Logged(*(np.concatenate([start[0], log[:lived, 0]]) for start, log in pairs))
    puller = make_puller(lam=MODELS[model], meniscus=meniscus)
    r_tilde = logged.r_br_measured - puller.ring_bias
    parallel = getattr(policy, "compensator", None)
    if parallel is not None:
        r_tilde = r_tilde + parallel.respond(logged.v_p - puller.v_0, interval)
    return Trace(interval * np.arange(lived + 1, dtype=np.float64), logged, r_tilde, bool(run.failed[0]))


@cache
def pull_change(
    model: str, change: float = -0.1, over: float = 600.0, before: float = 0.0, horizon: float = 1200.0
) -> Trace:
    """Change the pull speed by a share of v_0 along the quintic, at constant heater power; times in s."""
    middle = FINE * (np.arange(round(horizon / FINE)) + 0.5) - before
    share = change * quintic(np.clip(middle / over, 0.0, 1.0))
    actions = np.column_stack([share, np.zeros(len(share))])
    return trace(Playback(actions), model, horizon=len(share) * FINE, interval=FINE)


def inverse_response(run: Trace, change: float = -0.1) -> tuple[float, float]:
    """Measure the ring's largest move the wrong way after a pull change [m], and the time until it is back [s].

    ArithmeticError if it never comes back.
    """
    ring = run.signals.r_br - run.signals.r_br[0]
    # Pulling slower thickens the crystal; the ring's wrong way has the sign of the change.
    wrong = np.sign(change) * ring
    lowest = int(np.argmax(wrong))
    later = np.flatnonzero(wrong[lowest:] <= 0.0)
    if wrong[lowest] <= 0.0 or len(later) == 0:
        raise ArithmeticError("the ring shows no inverse response that recovers within the run")
    k = lowest + int(later[0])
    back = run.t[k - 1] + (run.t[k] - run.t[k - 1]) * wrong[k - 1] / (wrong[k - 1] - wrong[k])
    return float(wrong[lowest]), float(back)


def case_difference(model: str) -> dict[str, float]:
    """Nonlinearity between cases A and B: max |A - 5 B| / max |A| of the deviations from rest [-]."""
    gaps = {}
    for name in ("r_c", "h_c", "alpha_c", "v_p"):
        large, small = (getattr(run.signals, name) - getattr(run.signals, name)[0] for run in cases(model))
        gaps[name] = float(np.max(np.abs(large - 5.0 * small)) / np.max(np.abs(large)))
    return gaps


def cases(model: str) -> tuple[Trace, Trace]:
    """Run the paper's cases A and B."""
    return trace(PRINTED, model, "reference-a"), trace(PRINTED, model, "reference-b")


def ramp(model: str, policy: Any = PRINTED, meniscus: MeniscusModel = HURLE) -> Trace:
    """Run the paper's temperature ramp."""
    return trace(policy, model, "paper-ramp", meniscus=meniscus)


def ramp_numbers(run: Trace) -> dict[str, float]:
    """Errors of a ramp, how far its crystal swings and how hard its drive works; a lost crystal up to its end."""
    true, seen = errors(run)
    v_p, v_0, late = run.signals.v_p[1:], make_puller().v_0, run.signals.r_c[run.t >= run.t[-1] - HOUR]
    return {
        "max_error_mm": float(abs(true).max()) / MM,
        "rmse_mm": float((true[1:] ** 2).mean() ** 0.5) / MM,
        "max_compensated_error_mm": float(abs(seen).max()) / MM,
        "v_p_min_mm_per_min": float(v_p.min()) / MM_PER_MIN,
        "lived_min": float(run.t[-1]) / MINUTE,
        "at_limit": float((np.abs(v_p - v_0) > (1.0 - 1e-6) * v_0).mean()),
        "late_swing_mm": float(late.max() - late.min()) / MM,
    }


def errors(run: Trace) -> tuple[Floats, Floats]:
    """r_c - r_ref and r_tilde - r_ref [m]."""
    return run.signals.r_c - run.signals.r_ref, run.r_tilde - run.signals.r_ref
