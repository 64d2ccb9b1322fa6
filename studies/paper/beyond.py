"""What the paper does not show: its controller under camera noise, and with other high-pass cut-offs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.pid.compensated_pid import CompensatedPID, Compensator, SeriesPID
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Sensor
from cz_gym.episodes.scenarios import NOMINAL
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import Rollout, rollout
from cz_gym.units import HOUR

from .experiments import INTERVAL, MODELS, Floats, errors, trace

SEEDS = VALIDATION_SEEDS[:16]
"""Episodes of the noise experiment."""


class NoiseResult(NamedTuple):
    """The printed controller under camera noise, mean over episodes of an hour."""

    noise: float
    """Standard deviation of the camera noise [m]."""
    expected_pull_rms_mm_per_min: float
    """RMS of v_p if nothing were clipped: noise through the discrete K [mm/min]."""
    pull_rms_mm_per_min: float
    """RMS of v_p - v_0 [mm/min]."""
    clipped: float
    """Share of time at a limit of the pull speed [-]."""
    rmse_mm: float
    """RMS of the true radius error [mm]."""
    failures: float
    """Share of episodes lost [-]."""


def noise_result(noise: float, pid: SeriesPID, to_mm_per_min: float) -> NoiseResult:
    """Hold the radius for an hour under white camera noise of standard deviation ``noise`` [m], Model I."""
    scenario = replace(NOMINAL, name="camera-noise", sensor=Sensor(camera_noise=(noise, noise)))
    run = rollout(CompensatedPID(pid=pid), make_config(scenario, "I", horizon=HOUR), list(SEEDS))
    found = metrics(run)
    return NoiseResult(
        noise,
        noise * _noise_gain(pid) / to_mm_per_min,
        float(found.pull_rms_mm_per_min.mean()),
        _share_clipped(run),
        float(found.rmse_mm.mean()),
        float(found.failure_rate.mean()),
    )


def _share_clipped(run: Rollout) -> float:
    return float(at_pull_limit(run.signals.v_p, run.config.parameters.v_0)[run.alive].mean())


def at_pull_limit(v_p: Floats, v_0: float) -> npt.NDArray[np.bool_]:
    """Where a pull speed [m/s] stands at one of its limits, 0 and 2 v_0."""
    return np.abs(v_p - v_0) > (1.0 - 1e-6) * v_0


def _noise_gain(pid: SeriesPID) -> float:
    """RMS of the discrete lead's output per RMS of white noise, times K_p [1/s]; the integrator adds nearly nothing."""
    b_0, b_1, a_1 = pid.lead(INTERVAL)
    # Impulse response b_0, then (b_1 - a_1 b_0) (-a_1)^k: a geometric series.
    tail = (b_1 - a_1 * b_0) ** 2 / (1.0 - a_1 * a_1)
    return float(pid.K_p * np.sqrt(b_0 * b_0 + tail))


class CutOffResult(NamedTuple):
    """The paper's ramp with the compensator redesigned for another high-pass cut-off."""

    cut_off: float
    """[rad/s]."""
    phase_margin_deg: dict[str, float]
    """By model [degrees]."""
    max_error: dict[str, float]
    """Largest true radius error by model [m]."""
    max_compensated_error: dict[str, float]
    """Largest error of r_tilde by model [m]."""


def cut_off_result(
    cut_off: float, design: Callable[[float], Compensator], margin: Callable[[str, Compensator], float]
) -> CutOffResult:
    """Design, run the ramp on both models, and keep the peaks; a failed run counts as infinite."""
    compensator = design(cut_off)
    peaks: dict[str, tuple[float, float]] = {}
    for model in MODELS:
        run = trace(CompensatedPID(compensator=compensator), model, "paper-ramp")
        lost = np.inf if run.failed else 0.0
        true, seen = (np.max(np.abs(radius)) + lost for radius in errors(run))
        peaks[model] = float(true), float(seen)
    return CutOffResult(
        cut_off,
        {model: margin(model, compensator) for model in MODELS},
        {model: peak[0] for model, peak in peaks.items()},
        {model: peak[1] for model, peak in peaks.items()},
    )
