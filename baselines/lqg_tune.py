"""Tune the LQG: ``python -m baselines.lqg_tune --controller lqg``.

COBYLA (SciPy) on the logarithms of design point and noise model, on training seeds; the best candidates then meet the
validation seeds, which choose. Test seeds are never touched. Every candidate stays in the history that is written.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import NonlinearConstraint, minimize

from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout

from .lqg import LQG, LQGSettings
from .lqr import Weights
from .policy import Floats

VALIDATION_SEED = 1_000_000
ROBUSTNESS_SEED = 100_000
"""First training seed of the episodes that only have to be survived."""
ROBUSTNESS = ("hard", "puller")
FINALISTS = 4
_FAILURE_PENALTY = 100.0
_MISS_PENALTY = 20.0
_EMPHASIS = 10.0
_FIRST_STEP = 0.5
_BOUNDS = np.log(1e-4), np.log(1e4)


@dataclass(frozen=True)
class Knob:
    """One number that is tuned, on a logarithmic scale."""

    group: str
    """Member of :class:`baselines.lqg.LQGSettings`, "noise" or "weights"."""
    name: str


KNOBS = (
    *(Knob("weights", name) for name in ("pull", "pull_step", "heater_step")),
    *(
        Knob("noise", name)
        for name in (
            "fast_sd",
            "slow_sd",
            "drift_rate_sd",
            "drift_rate_tau",
            "heater_walk",
            "thermal_walk",
            "pyrometer_sd",
            "recipe_share",
        )
    ),
)


@dataclass(frozen=True)
class Goal:
    """What a version of the controller is tuned to, on mean figures over training episodes."""

    rmse_mm: float
    """Largest radius error [mm]; missing it costs."""
    pull_step: float
    """Largest pull step RMS [mm/min]; missing it costs."""
    by_return: bool
    """Whether the rest is the mean return, or the radius error."""
    start: LQGSettings
    """Where the search begins."""

    def worth(self, found: Figures) -> float:
        """What is minimised within the limits, failures last; of order one."""
        worth = -found.mean_return / found.steps if self.by_return else found.rmse_mm / self.rmse_mm
        return _EMPHASIS * worth + _FAILURE_PENALTY * found.failure_rate

    def room(self, found: Figures) -> tuple[float, float]:
        """Relative distance to the limits, negative beyond them."""
        return 1.0 - found.rmse_mm / self.rmse_mm, 1.0 - found.pull_step / self.pull_step

    def score(self, found: Figures) -> float:
        """What candidates are ranked by: the worth, and what missing a limit costs."""
        return self.worth(found) + _MISS_PENALTY * sum(max(0.0, -room) for room in self.room(found))


@dataclass(frozen=True)
class Figures:
    """Mean figures over episodes."""

    rmse_mm: float
    pull_step: float
    heater_step: float
    mean_return: float
    failure_rate: float
    steps: int


GOALS = {
    "lqg": Goal(0.062, 0.02, True, LQGSettings(weights=Weights(pull=0.12, pull_step=0.06, heater_step=0.08))),
    "lqg-quiet": Goal(0.075, 0.0095, False, LQGSettings(weights=Weights(pull=0.1, pull_step=0.2, heater_step=0.1))),
}
"""By name: what the shipped versions are tuned to."""


@dataclass
class History:
    """Every candidate met, in order."""

    entries: list[dict[str, Any]] = field(default_factory=list)

    def best(self, count: int) -> list[dict[str, Any]]:
        """The best so many."""
        return sorted(self.entries, key=lambda entry: entry["score"])[:count]


def knobs(settings: LQGSettings) -> Floats:
    """Logarithms of the tuned numbers."""
    return np.log([getattr(getattr(settings, knob.group), knob.name) for knob in KNOBS])


def with_knobs(settings: LQGSettings, values: Floats) -> LQGSettings:
    """The settings with those numbers, to four digits."""
    for knob, value in zip(KNOBS, np.exp(np.clip(values, *_BOUNDS)), strict=True):
        group = replace(getattr(settings, knob.group), **{knob.name: float(f"{value:.4g}")})
        settings = replace(settings, **{knob.group: group})
    return settings


def measure(settings: LQGSettings, scenario: str, seeds: Sequence[int]) -> Figures:
    """Run the LQG of these settings on those episodes."""
    config = make_config(scenario)
    found = metrics(rollout(LQG(settings, config.control_interval), config, seeds))
    return Figures(
        float(found.rmse_mm.mean()),
        float(found.pull_step_rms_mm_per_min.mean()),
        float(found.heater_step_rms_kw.mean()),
        float(found.return_.mean()),
        float(found.failure_rate.mean()),
        config.steps,
    )


def search(goal: Goal, budget: int, episodes: int, survive: int) -> History:
    """COBYLA from the goal's start; the best so far must survive ``survive`` episodes of each harder scenario."""
    history = History()
    met: dict[bytes, Figures] = {}

    def figures(values: Floats) -> Figures:
        key = values.tobytes()
        if key not in met:
            met[key] = _try(goal, with_knobs(goal.start, values), history, episodes, survive)
        return met[key]

    def worth(values: Floats) -> float:
        return goal.worth(figures(values))

    options: Any = {"maxiter": budget, "rhobeg": _FIRST_STEP, "tol": 1e-3}
    limits: Any = NonlinearConstraint(lambda values: goal.room(figures(values)), 0.0, np.inf)
    minimize(
        worth,
        knobs(goal.start),
        method="COBYLA",
        constraints=limits,
        options=options,
    )
    return history


def _try(goal: Goal, settings: LQGSettings, history: History, episodes: int, survive: int) -> Figures:
    found = measure(settings, "randomized", range(episodes))
    score = goal.score(found)
    lost = []
    if survive and all(score < entry["score"] for entry in history.entries):
        lost = [measure(settings, name, _from(ROBUSTNESS_SEED, survive)).failure_rate for name in ROBUSTNESS]
        score += _FAILURE_PENALTY * sum(lost)
    history.entries.append({"score": score, "settings": asdict(settings), "figures": asdict(found), "lost": lost})
    print(
        f"{len(history.entries):4d}  score {score:8.4f}  rmse {found.rmse_mm:.4f} mm  "
        f"step {found.pull_step:.4f} mm/min  return {found.mean_return:.1f}  lost {found.failure_rate} {lost}",
        flush=True,
    )
    return found


def choose(goal: Goal, history: History, episodes: int) -> dict[str, Any]:
    """The finalist that is best on validation seeds."""
    finals = []
    for entry in history.best(FINALISTS):
        settings = settings_from(entry["settings"])
        found = measure(settings, "randomized", _from(VALIDATION_SEED, episodes))
        finals.append(
            {
                "score": goal.score(found),
                "settings": asdict(settings),
                "hash": settings.hash,
                "validation": asdict(found),
            }
        )
    return min(finals, key=lambda final: final["score"])


def _from(first: int, count: int) -> range:
    return range(first, first + count)


def settings_from(data: dict[str, Any]) -> LQGSettings:
    """Settings from their form in JSON."""
    groups: dict[str, Any] = {}
    for member in dataclasses.fields(LQGSettings):
        value = data[member.name]
        if isinstance(value, dict):
            kind = type(getattr(LQGSettings(), member.name))
            value = kind(**{name: tuple(part) if isinstance(part, list) else part for name, part in value.items()})
        groups[member.name] = value
    return LQGSettings(**groups)


def write_whole(path: Path, data: Any) -> None:
    """Write JSON whole or not at all."""
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(json.dumps(data, indent=1) + "\n")
    os.replace(temporary, path)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m baselines.lqg_tune", description=__doc__)
    parser.add_argument("--controller", choices=sorted(GOALS), default="lqg")
    parser.add_argument("--budget", type=int, default=60, help="candidates to try")
    parser.add_argument("--episodes", type=int, default=100, help="training episodes a candidate")
    parser.add_argument("--survive", type=int, default=20, help="more of each harder scenario, failures only")
    parser.add_argument("--validation", type=int, default=250, help="validation episodes a finalist")
    parser.add_argument("--output", type=Path, default=None, help="default results/tuning/<controller>.json")
    given = parser.parse_args(arguments)
    for name in ("budget", "episodes", "validation"):
        if getattr(given, name) < 1:
            parser.error(f"--{name} must be at least 1, not {getattr(given, name)}")
    if given.survive < 0:
        parser.error(f"--survive must be at least 0, not {given.survive}")
    output = given.output or Path("results") / "tuning" / f"{given.controller}.json"
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        goal = GOALS[given.controller]
        history = search(goal, given.budget, given.episodes, given.survive)
        chosen = choose(goal, history, given.validation)
        budget = {name: getattr(given, name) for name in ("budget", "episodes", "survive", "validation")}
        found = {"controller": given.controller, "budget": budget, "chosen": chosen, "history": history.entries}
        write_whole(output, found)
    except OSError as error:
        print(f"cannot write {output}: {error}", file=sys.stderr)
        return 2
    print(json.dumps(chosen, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
