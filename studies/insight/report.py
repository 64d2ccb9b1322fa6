"""The tables of the study, in Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from cz_gym.baselines.analysis import frequency, sampled_loop
from cz_gym.evaluation.report.tables import markdown as table
from cz_gym.evaluation.rollout import Floats, Signals
from cz_gym.physics.linearisation import StateSpace
from cz_gym.physics.plant import make_puller
from cz_gym.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from .step_tests import BEGIN, JUMPS, LIMITS, SPANS, StepTest, Survival, control_interval

A_CRYSTAL = 3.0 * HOUR
"""How long a crystal is grown [s]. A slower mode is an agent's use of its integral, which no crystal feels."""


def answers(signals: Mapping[StepTest, Mapping[str, Signals]]) -> str:
    """Largest and RMS radius error, and largest moves of the drives, after each event."""
    heads = ("event", "controller", "largest error [µm]", "RMS error [µm]", "pull speed [mm/min]", "heater [kW]")
    rows = []
    for test, by_name in signals.items():
        for name, one in by_name.items():
            error = 1e3 * (one.r_c - one.r_ref) / MM
            moves = (one.v_p - one.v_p[0]) / MM_PER_MIN, (one.Q_H - one.Q_H[0]) / KILO
            figures = np.abs(error).max(), np.sqrt(np.mean(error**2)), *(np.abs(move).max() for move in moves)
            rows.append((test.title, name, *(f"{value:.3g}" for value in figures)))
    return table(heads, rows)


def jumps(gains: Mapping[str, Mapping[str, Floats]]) -> str:
    """Largest move of the pull speed per jump, by the jump's size."""
    rows = [
        (name, noise, *(f"{gain:.2f}" for gain in values * MM / MM_PER_MIN))
        for name, by_noise in gains.items()
        for noise, values in by_noise.items()
    ]
    return table(("controller", "noise", *(f"{size:g} mm" for size in JUMPS / MM)), rows)


def ripples(gains: Mapping[str, Floats]) -> str:
    """The pull speed's answer to a ripple, as time passes."""
    minutes = BEGIN / MINUTE
    shown = {f"{minutes * k:.0f} to {minutes * (k + 1):.0f} min": k for k in (0, 2, 5, SPANS - 1)}
    rows = [(name, *(f"{by[k] * MM / MM_PER_MIN:.2f}" for k in shown.values())) for name, by in gains.items()]
    return table(("controller", *shown), rows)


def margins(systems: Mapping[str, StateSpace]) -> str:
    """Margins on both models, loop opened at the camera and at the pull speed.

    None where a mode of the closed loop grows by e within a crystal; the table then has that time.
    """
    heads = ("controller", "plant", "opened at", "stable", "crossover [rad/s]", "gain up", "gain down", "phase [°]",
             "delay [s]", "peak sensitivity")  # fmt: skip
    dt, rows = control_interval(), []
    omega = frequency.frequencies(dt)
    for name, system in systems.items():
        for plant, lam in (("Model I", 1.0), ("Model II", 0.0)):
            puller = make_puller(lam=lam)
            growth = sampled_loop.close(system, puller, dt).growth
            stable = "yes" if math.isinf(growth) else f"grows by e in {growth / HOUR:.3g} h"
            for at in ("camera", "v_p"):
                values = frequency.response(frequency.opened(system, puller, dt, at), dt, omega)
                found = frequency.margins_of(values, omega, dt, growth > A_CRYSTAL)
                rows.append((name, plant, at, stable, *("-" if math.isnan(one) else f"{one:.3g}" for one in found)))
    return table(heads, rows)


def limits(survived: Mapping[str, Sequence[Survival]]) -> str:
    """The largest amplitude of each event that a controller survives."""

    def cell(one: Survival) -> str:
        return f"{one.largest:.3g} ({one.least:.3g} to {'over ' if one.capped else ''}{one.most:.3g})"

    rows = [
        (f"{limit.name} ({limit.meaning}) [{limit.unit}]", *(cell(by[i]) for by in survived.values()))
        for i, limit in enumerate(LIMITS)
    ]
    return table(("event", *survived), rows)


def parts(found: Mapping[str, Mapping[str, tuple[float, float]]]) -> str:
    """Observable RMSE and lost crystals when randomized gets one property of puller."""

    def cell(rmse_mm: float, lost: float) -> str:
        return f"{rmse_mm:.3f} mm" + (f", {100.0 * lost:.0f} % lost" if lost else "")

    names = next(iter(found.values()))
    rows = [(part, *(cell(*by_part[part]) for by_part in found.values())) for part in names]
    return table(("what randomized gets of puller", *found), rows)
