"""All experiments in order, and the numbers that come of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cz_gym import make_puller
from cz_gym.baselines.analysis.compensator_design import Margins, design_compensator, margins
from cz_gym.baselines.pid.compensated_pid import CompensatedPID, Compensator
from cz_gym.physics.linearisation import RadiusModel, radius_model
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.units import HOUR, MINUTE, MM, MM_PER_MIN

from .beyond import CutOffResult, NoiseResult, at_pull_limit, cut_off_result, noise_result
from .experiments import (
    MODELS,
    CaseDifference,
    InverseResponse,
    StepComparison,
    Trace,
    case_difference,
    errors,
    inverse_response,
    pull_change,
    step_comparison,
    trace,
)
from .meniscus import MeniscusPair, RingSlope, compare_menisci, compare_ring_slopes, exact_height
from .published import MODEL_I, MODEL_II, PID

CUT_OFFS = (1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2)
"""High-pass cut-offs compared [rad/s]; 2e-4 is the paper's."""
NOISES = tuple(noise * MM for noise in (0.01, 0.02, 0.05, 0.1))
"""Camera noise compared [m]."""
STEPS = (-0.01, -0.1)
"""Pull-speed steps compared with the linear model, as shares of v_0 [-]."""
PUBLISHED = {"I": MODEL_I, "II": MODEL_II}
BEFORE = 120.0
"""Rest before the pull change in the figures [s]."""
STAGES = 8
"""Number of times :func:`compute` reports progress."""


@dataclass(frozen=True)
class Results:
    """Everything the report shows; dictionaries are by model, "I" or "II", unless they say otherwise."""

    models: dict[str, RadiusModel]
    """Linear models of our plant."""
    published_compensator: Compensator
    """The procedure applied to the paper's functions of Model I."""
    own_compensator: Compensator
    """The procedure applied to our plant, Model I."""
    margins: dict[str, Margins]
    """By "published_I", "published_II", "own_I", "own_II"."""
    bare_margins: dict[str, Margins]
    """The same without compensator."""
    open_loop: dict[str, Trace]
    """The smooth pull change, beginning at ``BEFORE``."""
    inverse: dict[str, InverseResponse]
    """The smooth pull change."""
    inverse_step: dict[str, InverseResponse]
    """A sudden change of the same size."""
    steps: dict[str, list[StepComparison]]
    cases: dict[str, tuple[Trace, Trace]]
    """Cases A and B."""
    case_difference: dict[str, CaseDifference]
    ramp: dict[str, Trace]
    bare_ramp: dict[str, Trace]
    """The ramp under the PID without compensator."""
    exact_ramp: Trace
    """The ramp on the exact meniscus, Model I."""
    cut_offs: list[CutOffResult]
    noise: list[NoiseResult]
    menisci: list[MeniscusPair]
    ring_slopes: list[RingSlope]
    exact_h: float
    """Exact meniscus height at the operating point [m]."""


def own_models() -> dict[str, RadiusModel]:
    """Linear models of our plant."""
    return {model: radius_model(make_puller(lam=lam)) for model, lam in MODELS.items()}


def compute(progress: Callable[[str], Any]) -> Results:
    """Run everything; ``progress`` is called with the name of each of the ``STAGES`` stages as it begins."""
    progress("design")
    models = own_models()
    published, own = design_compensator(MODEL_I), design_compensator(models["I"])
    sources = {"published": (PUBLISHED, published), "own": (models, own)}
    loops = {f"{name}_{m}": (found[m], c) for name, (found, c) in sources.items() for m in MODELS}
    progress("open loop")
    open_loop = {m: pull_change(m, before=BEFORE, horizon=1200.0 + BEFORE) for m in MODELS}
    inverse = {m: inverse_response(pull_change(m)) for m in MODELS}
    inverse_step = {m: inverse_response(pull_change(m, over=1e-3)) for m in MODELS}
    progress("linear against nonlinear")
    steps = {m: [step_comparison(m, share) for share in STEPS] for m in MODELS}
    progress("reference changes")
    controller = CompensatedPID(pid=PID)
    cases = {m: (trace(controller, m, "reference-a"), trace(controller, m, "reference-b")) for m in MODELS}
    progress("temperature ramp")
    ramp = {m: trace(controller, m, "paper-ramp") for m in MODELS}
    bare = {m: trace(CompensatedPID(pid=PID, compensator=None), m, "paper-ramp") for m in MODELS}
    progress("high-pass cut-offs")
    cut_offs = [
        cut_off_result(
            cut_off,
            lambda frequency: design_compensator(models["I"], frequency),
            lambda m, compensator: margins(models[m], compensator, PID).phase_margin_deg,
        )
        for cut_off in CUT_OFFS
    ]
    progress("camera noise")
    noise = [noise_result(sd, PID, MM_PER_MIN) for sd in NOISES]
    progress("exact meniscus")
    return Results(
        models=models,
        published_compensator=published,
        own_compensator=own,
        margins={name: margins(model, compensator, PID) for name, (model, compensator) in loops.items()},
        bare_margins={name: margins(model, None, PID) for name, (model, _) in loops.items()},
        open_loop=open_loop,
        inverse=inverse,
        inverse_step=inverse_step,
        steps=steps,
        cases=cases,
        case_difference={m: case_difference(*pair) for m, pair in cases.items()},
        ramp=ramp,
        bare_ramp=bare,
        exact_ramp=trace(controller, "I", "paper-ramp", meniscus=YOUNG_LAPLACE),
        cut_offs=cut_offs,
        noise=noise,
        menisci=compare_menisci(),
        ring_slopes=compare_ring_slopes(),
        exact_h=exact_height(),
    )


def ramp_numbers(run: Trace) -> dict[str, float]:
    """Errors and lowest pull speed of a ramp."""
    true, seen = errors(run)
    return {
        "max_error_mm": float(abs(true).max()) / MM,
        "rmse_mm": float((true[1:] ** 2).mean() ** 0.5) / MM,
        "max_compensated_error_mm": float(abs(seen).max()) / MM,
        "v_p_min_mm_per_min": float(run.signals.v_p.min()) / MM_PER_MIN,
    }


def cycle_numbers(run: Trace) -> dict[str, float]:
    """How far a ramp's crystal swings and how hard its drive works; a lost crystal up to its end."""
    late = run.signals.r_c[run.t >= run.t[-1] - HOUR]
    return {
        **ramp_numbers(run),
        "lived_min": float(run.t[-1]) / MINUTE,
        "at_limit": float(at_pull_limit(run.signals.v_p[1:], make_puller().v_0).mean()),
        "late_swing_mm": float(late.max() - late.min()) / MM,
    }


def _model_numbers(model: RadiusModel) -> dict[str, Any]:
    return {
        "G_p": {"numerator": model.numerator, "poles": list(model.poles)},
        "G_m": [model.lead, model.constant],
        "rhp_zero": model.zero,
    }


def numbers(results: Results) -> dict[str, Any]:
    """The content of numbers.json: rad/s and s where no unit is named."""
    r = results
    nominal = make_puller()
    return {
        "model_I": _model_numbers(r.models["I"]),
        "model_II": _model_numbers(r.models["II"]),
        "compensator": {"published_functions": r.published_compensator.gain, "own_plant": r.own_compensator.gain},
        "margins": {
            name: {"crossover": found.crossover, "phase_margin_deg": found.phase_margin_deg}
            for name, found in r.margins.items()
        },
        "inverse_response": {
            m: {"depth_mm": found.depth / MM, "recovery_s": found.recovery} for m, found in r.inverse.items()
        },
        "case_ab": {m: found._asdict() for m, found in r.case_difference.items()},
        "paper_ramp": {m: ramp_numbers(run) for m, run in r.ramp.items()},
        "young_laplace": {"h_mm": r.exact_h / MM, "hurle_h_mm": nominal.h_0 / MM},
    }
