"""What was found about an agent, as JSON and as tables for people."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from cz_gym.evaluation.report.tables import markdown as table
from cz_gym.evaluation.rollout import Floats, Signals
from cz_gym.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from .loop import BANDS
from .step_tests import BEGIN, DRAWS, JUMPS, LIMITS, RIPPLE, SPANS, STEP_TESTS


def answer_figures(signals: Signals) -> dict[str, float]:
    """Largest and RMS radius error, largest moves of the drives, after an event."""
    error = signals.r_c - signals.r_ref
    return {
        "largest_error_um": float(np.abs(error).max() / MM * 1e3),
        "rms_error_um": float(np.sqrt(np.mean(error**2)) / MM * 1e3),
        "largest_pull_mm_per_min": float(np.abs(signals.v_p - signals.v_p[0]).max() / MM_PER_MIN),
        "largest_heater_kw": float(np.abs(signals.Q_H - signals.Q_H[0]).max() / KILO),
    }


def jump_figures(jumps: Mapping[str, Sequence[Floats]]) -> dict[str, Any]:
    """Answers to jumps [1/s] by controller, without noise and under it, in units for people."""
    gains = {
        name: {noise: (gains * MM / MM_PER_MIN).tolist() for noise, gains in zip(("none", "usual"), both, strict=True)}
        for name, both in jumps.items()
    }
    return {"mm": (JUMPS / MM).tolist(), "mm_per_min_per_mm": gains}


def ripple_figures(ripples: Mapping[str, Floats]) -> dict[str, list[float]]:
    """Answers to a ripple by controller, in each span of ten minutes, in mm/min per mm."""
    return {name: (gains * MM / MM_PER_MIN).tolist() for name, gains in ripples.items()}


def as_json(found: Mapping[str, Any]) -> str:
    """``insight.json``; margins that are missing, and the growth of what does not grow, are null."""

    def finite(value: Any) -> Any:
        return None if isinstance(value, float) and not math.isfinite(value) else value

    rows = [{name: finite(value) for name, value in row.items()} for row in found["margins"]]
    apart = {"from": found["apart"]["from"], "bands_rad_per_s": BANDS, **found["apart"]}
    return json.dumps({**found, "margins": rows, "apart": apart}, indent=1, allow_nan=False) + "\n"


def as_markdown(found: Mapping[str, Any]) -> str:
    """The tables for people."""
    agent, compared = found["agent"], found["apart"]["from"]
    episodes = found["puller_parts"]["validation_episodes"]
    sections = (
        ("Answers to single events", _answers(found["answers"])),
        ("How strongly a jump of the radius is answered [mm/min per mm]", _jumps(found["jumps"])),
        (f"How strongly a ripple of {RIPPLE / MM:g} mm is answered [mm/min per mm]", _ripples(found["ripples"])),
        ("Margins of the loop", _margins(found["margins"])),
        ("Noise of the camera in the drives, by the linear loop", _noise(found["noise_gain"])),
        (f"Local gain: largest deviation from {compared}'s", _apart(found["apart"])),
        (f"Largest event survived, median and range over {DRAWS} draws of noise", _limits(found["limits"])),
        (f"One property of the real puller at a time ({episodes} validation crystals)", _parts(found["puller_parts"])),
    )
    title = (
        f"# What the agent does (seed {agent['training_seed']} of `{agent['algorithm']}`, "
        f"{agent['training_steps']:,} steps of learning)"
    )
    return "\n\n".join([title, *(f"## {head}\n\n{text}" for head, text in sections)]) + "\n"


def _answers(answers: Mapping[str, Any]) -> str:
    rows = [
        (test.title, name, *(f"{value:.3g}" for value in figures.values()))
        for test in STEP_TESTS
        for name, figures in answers[test.name].items()
    ]
    heads = ("event", "controller", "largest error [µm]", "RMS error [µm]", "pull speed [mm/min]", "heater [kW]")
    return table(heads, rows)


def _jumps(jumps: Mapping[str, Any]) -> str:
    rows = [
        (name, noise, *(f"{gain:.2f}" for gain in gains))
        for name, by_noise in jumps["mm_per_min_per_mm"].items()
        for noise, gains in by_noise.items()
    ]
    return table(("controller", "noise", *(f"{size:g} mm" for size in jumps["mm"])), rows)


def _ripples(ripples: Mapping[str, Sequence[float]]) -> str:
    minutes = BEGIN / MINUTE
    shown = {f"{minutes * k:.0f} to {minutes * (k + 1):.0f} min": k for k in (0, 2, 5, SPANS - 1)}
    return table(
        ("controller", *shown), [(name, *(f"{by[k]:.2f}" for k in shown.values())) for name, by in ripples.items()]
    )


def _margins(margins: Sequence[Mapping[str, Any]]) -> str:
    heads = ("controller", "plant", "opened at", "stable", "crossover [rad/s]", "gain up", "gain down", "phase [°]",
             "delay [s]", "peak sensitivity")  # fmt: skip
    rows = []
    for row in margins:
        controller, plant, at, growth, *numbers = row.values()
        stable = "yes" if math.isinf(growth) else f"grows by e in {growth / HOUR:.3g} h"
        rows.append((controller, plant, at, stable, *("-" if math.isnan(one) else f"{one:.3g}" for one in numbers)))
    return table(heads, rows)


def _noise(noise: Mapping[str, Mapping[str, float]]) -> str:
    heads = ("controller", "pull speed [mm/min per mm]", "its steps [mm/min per mm]", "heater [kW per mm]")
    return table(heads, [(name, *(f"{gain:.3g}" for gain in gains.values())) for name, gains in noise.items()])


def _apart(apart: Mapping[str, Any]) -> str:
    heads = ("controller", "drive", *(f"{low:g} to {high:g} rad/s" for low, high in pairwise(BANDS)))
    rows = [
        (name, drive, *(f"{100.0 * value:.0f} %" for value in values))
        for name, by_drive in apart.items()
        if name != "from"
        for drive, values in by_drive.items()
    ]
    return table(heads, rows)


def _limits(limits: Mapping[str, Any]) -> str:
    def cell(largest: float, least: float, most: float, capped: bool) -> str:
        return f"{largest:.3g} ({least:.3g} to {'over ' if capped else ''}{most:.3g})"

    rows = [
        (f"{limit.name} ({limit.meaning}) [{limit.unit}]", *(cell(**by[limit.name]) for by in limits.values()))
        for limit in LIMITS
    ]
    return table(("event", *limits), rows)


def _parts(parts: Mapping[str, Any]) -> str:
    def cell(rmse_observable_mm: float, failure_rate: float) -> str:
        return f"{rmse_observable_mm:.3f} mm" + (f", {100.0 * failure_rate:.0f} % lost" if failure_rate else "")

    columns = {name: by_part for name, by_part in parts.items() if name != "validation_episodes"}
    names = next(iter(columns.values()))
    rows = [(part, *(cell(**by_part[part]) for by_part in columns.values())) for part in names]
    return table(("what randomized gets of puller", *columns), rows)
