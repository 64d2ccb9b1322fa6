"""The end of the search: its best trials once more, on other crystals and training seeds, beside the recipe."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cz_gym.agents.agent_file.contract import read_json
from cz_gym.agents.training.run_files import provenance
from cz_gym.atomic_files import write_files
from cz_gym.evaluation.statistics import Estimate, Resamples, means

from .space import KNOBS, Trial, Values, settings_of
from .trial import CHOOSE, CONFIRM, attempt

Floats = npt.NDArray[np.float64]
SHIPPED = 0
"""Number of the trial that is the settings that ship."""


def confirm(
    trials: Sequence[Trial], finalists: int, seeds: int, steps: int, folder: Path, work: Path
) -> dict[int, Floats]:
    """Cost and RMSE [mm] less those of the imitation, shape (seeds, crystals, 2), by trial; what is kept is not redone.

    Training seeds begin at 1: the search used 0.
    """
    complete = [number for number, trial in enumerate(trials) if not trial.pruned and number != SHIPPED]
    best = sorted(complete, key=lambda number: trials[number].cost)[:finalists]
    found: dict[int, Floats] = {}
    for number in (SHIPPED, *best) if best else ():
        runs = [_confirmed(trials[number].values, number, seed, steps, folder, work) for seed in range(1, 1 + seeds)]
        found[number] = np.array(runs)
    return found


def _confirmed(values: Values, number: int, seed: int, steps: int, folder: Path, work: Path) -> Floats:
    path = folder / f"trial{number}-seed{seed}.json"
    if path.exists():
        told = read_json(path)
        kept = np.array(told.get("less_start", ()), np.float64) if isinstance(told, dict) else np.zeros(0)
        if kept.shape != (len(CONFIRM), 2) or told.get("values") != list(values) or told.get("steps") != steps:
            raise ValueError(f"{path}: of another search, or damaged; move it away")
        return kept
    tried = attempt(settings_of(values, steps), seed, CONFIRM, work)
    less = [[float(f"{value:.5g}") for value in row] for row in tried.last - tried.start]
    facts = {"trial": number, "seed": seed, "steps": steps, "values": list(values), "provenance": provenance()}
    write_files({path: (json.dumps({**facts, "less_start": less}) + "\n").encode()})
    return np.array(less)


def report(trials: Sequence[Trial], confirmed: Mapping[int, Floats], steps: int) -> str:
    """``report.md``."""
    given_up = sum(trial.pruned for trial in trials)
    lines = [
        "# Search of `ppo`'s hyperparameters",
        "",
        f"{len(trials)} trials of {steps:,} environment steps, {given_up} of them given up on the way; training seed 0."
        f" Trial {SHIPPED} is the recipe as it stands. Cost and RMSE are the last agent's on {len(CHOOSE)} validation"
        " crystals, less those of the imitation that it began as: below zero, learning helped.",
        "",
        f"| trial | {' | '.join(knob.name for knob in KNOBS)} | cost less start | RMSE less start [um] |",
        f"|--:|{'--:|' * (len(KNOBS) + 2)}",
    ]
    ranked = sorted(range(len(trials)), key=lambda number: (trials[number].pruned, trials[number].cost))
    for number in ranked:
        trial = trials[number]
        ends = "given up" if trial.pruned else f"{trial.cost:+.5f}", "" if trial.pruned else f"{trial.rmse_um:+.2f}"
        lines.append(f"| {number} | {' | '.join(f'{value:g}' for value in trial.values)} | {' | '.join(ends)} |")
    return "\n".join([*lines, "", *_confirmation(confirmed), ""])


def _confirmation(confirmed: Mapping[int, Floats]) -> list[str]:
    if SHIPPED not in confirmed:
        return ["Nothing was confirmed."]
    seeds, crystals = confirmed[SHIPPED].shape[:2]
    draws = Resamples.draw(crystals)
    lines = [
        f"The best again, on {crystals} other validation crystals with {seeds} other training seeds; 95 % intervals,"
        " bootstrap over both.",
        "",
        "| trial | cost less start | cost less that of the recipe | RMSE less that of the recipe [um] |",
        "|--:|--:|--:|--:|",
    ]
    better = []
    for number, values in confirmed.items():
        own, apart = means(values, draws)[0], means(values - confirmed[SHIPPED], draws)
        entries = [_text(own, 5, 1.0)]
        entries += ["-", "-"] if number == SHIPPED else [_text(apart[0], 5, 1.0), _text(apart[1], 2, 1e-3)]
        lines.append(f"| {number} | {' | '.join(entries)} |")
        if number != SHIPPED and apart[0].ci95 is not None and apart[0].ci95[1] < 0.0:
            better.append(str(number))
    beaten = f"Beyond this noise, better than the recipe: trial {', '.join(better)}." if better else ""
    return [*lines, "", beaten or "None is better than the recipe beyond this noise."]


def _text(estimate: Estimate, digits: int, unit: float) -> str:
    ends = ", ".join(f"{end / unit:+.{digits}f}" for end in estimate.ci95 or ())
    return f"{estimate.mean / unit:+.{digits}f} [{ends}]"
