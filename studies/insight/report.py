"""What was found about an agent, as JSON and as tables for people."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from cz_gym.agents.agent_file.contract import Contract
from cz_gym.evaluation.rollout import Signals
from cz_gym.units import HOUR, KILO, MM, MM_PER_MIN

from .step_tests import DRAWS, JUMPS, LIMITS, TRIALS, Survival


class Found(NamedTuple):
    """What a study found; mappings by trial or controller first."""

    contract: Contract
    answers: Mapping[str, Mapping[str, Signals]]
    margins: Sequence[Any]
    noise: Mapping[str, Mapping[str, float]]
    limits: Mapping[str, Mapping[str, Survival]]
    parts: Mapping[str, Mapping[str, Mapping[str, float]]]
    episodes: int
    """Validation episodes of ``parts``."""
    apart_from: str
    """The controller that local gains are compared with."""
    apart: Mapping[str, Mapping[str, Sequence[float]]]
    """By controller and drive: largest |gain / its - 1| from the ring, in each of :data:`BANDS`."""
    jumps: Mapping[str, tuple[Any, Any]]
    """Pull speed moved over the jump of the radius [1/s], without noise and under it."""


BANDS = (1e-4, 1e-3, 1e-2, 0.1, 0.3)
"""Edges of the bands of frequency [rad/s] in which local gains are compared."""


def answer_figures(signals: Signals) -> dict[str, float]:
    """Largest and RMS radius error, largest moves of the drives, after an event."""
    error = signals.r_c - signals.r_ref
    return {
        "largest_error_um": float(np.abs(error).max() / MM * 1e3),
        "rms_error_um": float(np.sqrt(np.mean(error**2)) / MM * 1e3),
        "largest_pull_mm_per_min": float(np.abs(signals.v_p - signals.v_p[0]).max() / MM_PER_MIN),
        "largest_heater_kw": float(np.abs(signals.Q_H - signals.Q_H[0]).max() / KILO),
    }


def as_json(found: Found) -> str:
    """``insight.json``; margins that are missing, and the growth of what does not grow, are null."""
    rows = [
        {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in row._asdict().items()
        }
        for row in found.margins
    ]
    data = {
        "agent": asdict(found.contract),
        "answers": {
            trial: {name: answer_figures(signals) for name, signals in by_name.items()}
            for trial, by_name in found.answers.items()
        },
        "margins": rows,
        "noise_gain": found.noise,
        "apart": {"from": found.apart_from, "bands_rad_per_s": BANDS, **found.apart},
        "jumps": {
            "mm": [float(size / MM) for size in JUMPS],
            "mm_per_min_per_mm": {
                name: {
                    noise: [float(gain * MM / MM_PER_MIN) for gain in gains]
                    for noise, gains in zip(("none", "usual"), both, strict=True)
                }
                for name, both in found.jumps.items()
            },
        },
        "limits": {
            name: {limit: survival._asdict() for limit, survival in limits.items()}
            for name, limits in found.limits.items()
        },
        "puller_parts": {"validation_episodes": found.episodes, **found.parts},
    }
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def as_markdown(found: Found) -> str:
    """The tables for people."""
    contract = found.contract
    lines = [
        f"# What the agent does (seed {contract.training_seed} of `{contract.algorithm}`, "
        f"{contract.training_steps:,} steps of learning)",
        "",
        "## Answers to single events",
        "",
        *_answers(found),
        "",
        "## How strongly a jump of the radius is answered [mm/min per mm]",
        "",
        *_jumps(found),
        "",
        "## Margins of the loop",
        "",
        *_margins(found),
        "",
        "## Noise of the camera in the drives, by the linear loop",
        "",
        *_noise(found),
        "",
        f"## Local gain: largest deviation from {found.apart_from}'s",
        "",
        *_apart(found),
        "",
        f"## Largest event survived, median and range over {DRAWS} draws of noise",
        "",
        *_limits(found),
        "",
        f"## One property of the real puller at a time ({found.episodes} validation crystals)",
        "",
        *_parts(found),
    ]
    return "\n".join(lines) + "\n"


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    heads = list(heads)
    body = ["| " + " | ".join(row) + " |" for row in rows]
    return ["| " + " | ".join(heads) + " |", "|---" + "|--:" * (len(heads) - 1) + "|", *body]


def _answers(found: Found) -> list[str]:
    rows = []
    for trial in TRIALS:
        for name, signals in found.answers[trial.name].items():
            figures = answer_figures(signals).values()
            rows.append([trial.title, name, *(f"{value:.3g}" for value in figures)])
    heads = ("event", "controller", "largest error [µm]", "RMS error [µm]", "pull speed [mm/min]", "heater [kW]")
    return _table(heads, rows)


def _jumps(found: Found) -> list[str]:
    heads = ("controller", "noise", *(f"{size / MM:g} mm" for size in JUMPS))
    rows = []
    for name, both in found.jumps.items():
        for noise, gains in zip(("none", "usual"), both, strict=True):
            rows.append([name, noise, *(f"{gain * MM / MM_PER_MIN:.2f}" for gain in gains)])
    return _table(heads, rows)


def _margins(found: Found) -> list[str]:
    heads = ("controller", "plant", "opened at", "stable", "crossover [rad/s]", "gain up", "gain down", "phase [°]",
             "delay [s]", "peak sensitivity")  # fmt: skip
    rows = []
    for row in found.margins:
        numbers = ("-" if math.isnan(value) else f"{value:.3g}" for value in row[4:])
        rows.append(
            [
                row.controller,
                row.plant,
                row.at,
                "yes" if math.isinf(row.growth) else f"grows by e in {row.growth / HOUR:.3g} h",
                *numbers,
            ]
        )
    return _table(heads, rows)


def _noise(found: Found) -> list[str]:
    heads = ("controller", "pull speed [mm/min per mm]", "its steps [mm/min per mm]", "heater [kW per mm]")
    return _table(heads, ([name, *(f"{value:.3g}" for value in gains.values())] for name, gains in found.noise.items()))


def _apart(found: Found) -> list[str]:
    heads = ("controller", "drive", *(f"{low:g} to {high:g} rad/s" for low, high in pairwise(BANDS)))
    rows = []
    for name, by_drive in found.apart.items():
        for drive, values in by_drive.items():
            rows.append([name, drive, *(f"{100.0 * value:.0f} %" for value in values)])
    return _table(heads, rows)


def _limits(found: Found) -> list[str]:
    rows = []
    for limit in LIMITS:
        survived = (by_name[limit.name] for by_name in found.limits.values())
        cells = (
            f"{one.largest:.3g} ({one.least:.3g} to {'over ' if one.capped else ''}{one.most:.3g})" for one in survived
        )
        rows.append([f"{limit.name} ({limit.meaning}) [{limit.unit}]", *cells])
    return _table(("event", *found.limits), rows)


def _parts(found: Found) -> list[str]:
    rows = []
    for part in next(iter(found.parts.values())):
        cells = []
        for by_part in found.parts.values():
            one = by_part[part]
            lost = f", {100.0 * one['failure_rate']:.0f} % lost" if one["failure_rate"] else ""
            cells.append(f"{one['rmse_observable_mm']:.3f} mm{lost}")
        rows.append([part, *cells])
    return _table(("what randomized gets of puller", *found.parts), rows)
