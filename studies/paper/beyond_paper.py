"""Experiments beyond the paper: other high-pass cut-offs, the exact meniscus."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from cz_gym import HURLE, Parameters, make_puller
from cz_gym.baselines.analysis.compensator_design import design_compensator, margins
from cz_gym.baselines.pid.compensated_pid import CompensatedPID
from cz_gym.physics.linearisation import radius_model
from cz_gym.physics.young_laplace import YOUNG_LAPLACE, solve_height
from cz_gym.units import MM

from .experiments import errors, linear_model, ramp
from .published import PID

CUT_OFFS = (1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""High-pass cut-offs compared [rad/s]; 2e-4 is the paper's."""
RING_SLOPES_DEG = (1.0, 2.0, 3.5, 5.0, 8.0, 12.0)
"""Slopes of the bright ring compared [degrees]; 3.5 is the plant's."""


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


def compare_menisci() -> dict[str, tuple[float, float]]:
    """Hurle's and the exact meniscus at the operating point: quantities by name and unit."""
    rows = []
    for model in (HURLE, YOUNG_LAPLACE):
        puller = make_puller(meniscus=model)
        linear = radius_model(puller, model)
        rate = linear.numerator / puller.v_0
        rows.append((puller.h_0 / MM, rate * MM, puller.ring_bias / MM, linear.lead, linear.zero))
    names = ("height [mm]", "d alpha_c/d h [rad/mm]", "ring less radius [mm]", "coefficient of s in G_m [s]",
             "zero [rad/s]")  # fmt: skip
    return dict(zip(names, zip(*rows, strict=True), strict=True))


def ring_slopes() -> tuple[list[float], list[float]]:
    """Coefficient of s in G_m [s] for each of RING_SLOPES_DEG, Hurle's and the exact meniscus'."""
    parameters = [Parameters(phi_b=math.radians(degrees)) for degrees in RING_SLOPES_DEG]
    hurle, exact = (
        [radius_model(make_puller(each, meniscus=model), model).lead for each in parameters]
        for model in (HURLE, YOUNG_LAPLACE)
    )
    return hurle, exact


def exact_height() -> float:
    """Exact height at the operating point, from the shooting itself rather than its table [m]."""
    puller = make_puller()
    return float(solve_height(puller.r_0, Parameters().alpha_0, puller.a))
