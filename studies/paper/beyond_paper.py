"""What the paper does not show: its controller under camera noise, other high-pass cut-offs, the exact meniscus."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from cz_gym import HURLE, MeniscusModel, Parameters, make_puller
from cz_gym.baselines.analysis.compensator_design import design_compensator, margins
from cz_gym.baselines.pid.compensated_pid import CompensatedPID, SeriesPID
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Sensor
from cz_gym.episodes.scenarios import NOMINAL
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.linearisation import radius_model
from cz_gym.physics.young_laplace import YOUNG_LAPLACE, solve_height
from cz_gym.units import HOUR, MM, MM_PER_MIN

from .experiments import INTERVAL, at_pull_limit, errors, linear_model, ramp
from .published import PID

SEEDS = VALIDATION_SEEDS[:16]
"""Episodes of the noise experiment."""
CUT_OFFS = (1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""High-pass cut-offs compared [rad/s]; 2e-4 is the paper's."""
NOISES = tuple(noise * MM for noise in (0.01, 0.02, 0.05, 0.1))
"""Camera noise compared [m]."""
RADII = tuple(radius * MM for radius in (50.0, 62.5, 75.0, 87.5, 100.0, 112.5, 125.0, 137.5, 150.0))
"""Crystal radii at which the menisci are compared [m]."""
RING_SLOPES_DEG = (1.0, 2.0, 3.5, 5.0, 8.0, 12.0)
"""Slopes of the bright ring compared [degrees]; 3.5 is the plant's."""


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


@cache
def noise_result(noise: float, pid: SeriesPID = PID) -> NoiseResult:
    """Hold the radius for an hour under white camera noise of standard deviation ``noise`` [m], Model I."""
    scenario = replace(NOMINAL, name="camera-noise", sensor=Sensor(camera_noise=(noise, noise)))
    run = rollout(CompensatedPID(pid=pid), make_config(scenario, "I", horizon=HOUR), list(SEEDS))
    found = metrics(run)
    return NoiseResult(
        noise,
        noise * _noise_gain(pid) / MM_PER_MIN,
        float(found.pull_rms_mm_per_min.mean()),
        float(at_pull_limit(run.signals.v_p, run.config.parameters.v_0)[run.alive].mean()),
        float(found.rmse_mm.mean()),
        float(found.failure_rate.mean()),
    )


def _noise_gain(pid: SeriesPID) -> float:
    """RMS of the discrete lead's output per RMS of white noise, times K_p [1/s]; the integrator adds nearly nothing."""
    b_0, b_1, a_1 = pid.lead(INTERVAL)
    # Impulse response b_0, then (b_1 - a_1 b_0) (-a_1)^k: a geometric series.
    tail = (b_1 - a_1 * b_0) ** 2 / (1.0 - a_1 * a_1)
    return float(pid.K_p * np.sqrt(b_0 * b_0 + tail))


class CutOffResult(NamedTuple):
    """The paper's ramp on one model with the compensator redesigned for another high-pass cut-off."""

    phase_margin_deg: float
    """[degrees]."""
    max_error: float
    """Largest true radius error [m]; infinite for a lost crystal."""
    max_compensated_error: float
    """Largest error of r_tilde [m]."""


@cache
def cut_off_result(cut_off: float, model: str) -> CutOffResult:
    """Design for Model I and that cut-off [rad/s], and run the ramp on a model."""
    compensator = design_compensator(linear_model("own", "I"), cut_off)
    run = ramp(model, CompensatedPID(compensator=compensator))
    lost = math.inf if run.failed else 0.0
    margin = margins(linear_model("own", model), compensator, PID).phase_margin_deg
    return CutOffResult(margin, *(float(np.max(np.abs(radius))) + lost for radius in errors(run)))


class Meniscus(NamedTuple):
    """A meniscus at a steady crystal, cone angle zero."""

    h: float
    """Height [m]."""
    slope_rate: float
    """Change of the cone angle with the height [rad/m]."""
    ring_offset: float
    """Bright ring minus radius [m]."""
    zero: float
    """Right half plane zero of G_m at the nominal growth rate [rad/s]."""


@cache
def compare_menisci() -> list[tuple[float, Meniscus, Meniscus]]:
    """Each of :data:`RADII` [m], Hurle's meniscus there and the exact one, everything else nominal."""

    def at(r_c: float, model: MeniscusModel) -> Meniscus:
        puller = make_puller(Parameters(r_0=r_c), meniscus=model)
        linear = radius_model(puller, model)
        return Meniscus(puller.h_0, linear.numerator / puller.v_0, puller.ring_bias, linear.zero)

    return [(r_c, at(r_c, HURLE), at(r_c, YOUNG_LAPLACE)) for r_c in RADII]


def compare_ring_slopes() -> list[tuple[float, float, float]]:
    """Slope of the ring [degrees], and coefficient of s in G_m at the operating point [s]: Hurle's and the exact."""
    found = []
    for degrees in RING_SLOPES_DEG:
        parameters = Parameters(phi_b=math.radians(degrees))
        hurle, exact = (radius_model(make_puller(parameters, meniscus=m), m).lead for m in (HURLE, YOUNG_LAPLACE))
        found.append((degrees, hurle, exact))
    return found


def exact_height() -> float:
    """Exact height at the operating point, from the shooting itself rather than its table [m]."""
    puller = make_puller()
    return float(solve_height(puller.r_0, Parameters().alpha_0, puller.a))
