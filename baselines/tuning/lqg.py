"""Tune the LQG: ``python -m cz_gym.baselines.tuning.lqg --controller lqg --scenario puller``.

COBYLA (SciPy) on the logarithms of design point and noise model, on training seeds; the best candidates then meet the
validation seeds, which choose. Test seeds are never touched. Every candidate stays in the history that is written.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import NonlinearConstraint, minimize

from cz_gym.atomic_files import check_writable, write_files
from cz_gym.baselines.lqg.controller import LQG, LQGSettings
from cz_gym.baselines.policy import Floats
from cz_gym.commands import OneLineParser, guarded
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout

from .lqg_goal import FAILURE_PENALTY, GOALS, Figures, Goal, knobs, settings_from, with_knobs

ROBUSTNESS_SEEDS = TRAINING_SEEDS[100_000:]
"""Training seeds of the episodes that only have to be survived."""
FINALISTS = 3
"""Candidates of a search that meet the validation seeds."""
CALMER = (1.0, 3.0, 10.0)
"""Factors on the weight of heater steps that every finalist is tried with: the search hardly sees that weight."""
_FIRST_STEP = 0.5


@dataclass
class History:
    """Every candidate met, in order."""

    entries: list[dict[str, Any]] = field(default_factory=list)
    keep: Callable[[list[dict[str, Any]]], None] = lambda entries: None
    """Called with all of them after each."""

    def add(self, entry: dict[str, Any]) -> None:
        """One more."""
        self.entries.append(entry)
        self.keep(self.entries)

    def best(self, count: int) -> list[dict[str, Any]]:
        """The best so many."""
        return sorted(self.entries, key=lambda entry: entry["score"])[:count]


def measure(settings: LQGSettings, scenario: str, seeds: Sequence[int]) -> Figures:
    """Run the LQG of these settings on those episodes."""
    config = make_config(scenario)
    found = metrics(rollout(LQG(settings, config.control_interval), config, seeds))
    return Figures(
        float(found.rmse_observable_mm.mean()),
        float(found.pull_step_rms_mm_per_min.mean()),
        float(found.heater_step_rms_kw.mean()),
        float(found.return_.mean()),
        float(found.failure_rate.mean()),
        config.steps,
    )


def search(goal: Goal, budget: int, episodes: int, survive: int, history: History | None = None) -> History:
    """COBYLA from the goal's start; the best so far must survive ``survive`` episodes of each harder scenario."""
    history = History() if history is None else history
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
    found = measure(settings, goal.scenario, TRAINING_SEEDS[:episodes])
    score = goal.score(found)
    lost = []
    if survive and all(score < entry["score"] for entry in history.entries):
        lost = [measure(settings, name, ROBUSTNESS_SEEDS[:survive]).failure_rate for name in goal.survive]
        score += FAILURE_PENALTY * sum(lost)
    history.add({"score": score, "settings": asdict(settings), "figures": asdict(found), "lost": lost})
    print(
        f"{len(history.entries):4d}  score {score:8.4f}  rmse {found.rmse_mm:.4f} mm  "
        f"step {found.pull_step:.4f} mm/min  return {found.mean_return:.1f}  lost {found.failure_rate} {lost}",
        flush=True,
    )
    return found


def choose(goal: Goal, history: History, episodes: int, survive: int, count: int = FINALISTS) -> dict[str, Any]:
    """The best on validation seeds of the finalists and their calmer versions, losses on training seeds first.

    Losses are counted on ``survive`` training episodes of each harder scenario. What is known of the camera is not
    searched: it is the goal's, whatever it was when a kept history was searched.
    """
    finals = []
    for candidate in (calmer(found, factor) for found in finalists(history, count) for factor in CALMER):
        settings = replace(candidate, ring=goal.start.ring)
        lost = {name: measure(settings, name, ROBUSTNESS_SEEDS[:survive]).failure_rate for name in goal.survive}
        found = measure(settings, goal.scenario, VALIDATION_SEEDS[:episodes])
        score = goal.score(found) + FAILURE_PENALTY * sum(lost.values())
        final = {"score": score, "settings": asdict(settings), "hash": settings.hash}
        finals.append(final | {"validation": asdict(found), "lost": lost})
        print(f"final  score {score:8.4f}  {settings.hash}  {found}  lost {lost}", flush=True)
    return min(finals, key=lambda final: final["score"])


def finalists(history: History, count: int = FINALISTS) -> list[LQGSettings]:
    """The best settings met."""
    return [settings_from(entry["settings"]) for entry in history.best(count)]


def calmer(settings: LQGSettings, factor: float) -> LQGSettings:
    """The same with a heavier weight on heater steps."""
    weight = float(f"{factor * settings.weights.heater_step:.4g}")
    return replace(settings, weights=replace(settings.weights, heater_step=weight))


def _text(found: dict[str, Any]) -> bytes:
    return (json.dumps(found, indent=1) + "\n").encode()


def file_name(controller: str, scenario: str) -> str:
    """Where the history of that search is kept."""
    return f"{controller}.json" if scenario == "randomized" else f"{controller}-{scenario}.json"


def check_budget(survive: int = 0, *, validation: int, **least_one: int) -> None:
    """ValueError for a number out of range."""
    for name, value in least_one.items():
        if value < 1:
            raise ValueError(f"--{name} must be at least 1, not {value}")
    if not 1 <= validation <= len(VALIDATION_SEEDS):
        raise ValueError(f"--validation must be between 1 and {len(VALIDATION_SEEDS)}, not {validation}")
    if survive < 0:
        raise ValueError(f"--survive must be at least 0, not {survive}")


def read_history(path: Path) -> tuple[dict[str, int], History]:
    """Budget and candidates of a file this command wrote; ValueError for any other."""
    try:
        data = json.loads(path.read_text())
        return dict(data["budget"]), History(list(data["history"]))
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is no tuning history: {error!r}") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = OneLineParser(prog="python -m cz_gym.baselines.tuning.lqg", description=__doc__)
    parser.add_argument("--controller", choices=sorted({name for name, _ in GOALS}), default="lqg")
    parser.add_argument("--scenario", choices=sorted({scenario for _, scenario in GOALS}), default="randomized")
    parser.add_argument("--budget", type=int, default=60, help="candidates to try")
    parser.add_argument("--episodes", type=int, default=100, help="training episodes a candidate")
    parser.add_argument("--survive", type=int, default=20, help="more that must be survived, failures only")
    parser.add_argument("--validation", type=int, default=250, help="validation episodes a finalist")
    parser.add_argument("--finals", type=int, default=200, help="training episodes a finalist must survive")
    parser.add_argument("--finalists", type=int, default=FINALISTS, help="candidates that meet the validation seeds")
    parser.add_argument("--history", type=Path, help="choose again from this kept history, without a search")
    parser.add_argument("--output", type=Path, default=None, help="default in results/tuning")
    given = parser.parse_args(arguments)
    output = given.output or Path("results") / "tuning" / file_name(given.controller, given.scenario)
    part = output.with_suffix(".part.json")
    left = f"--history {part} chooses from the candidates met, if any was"
    return guarded(parser.prog, lambda: _tune(given, output, part), "benchmark", left)


def _tune(given: argparse.Namespace, output: Path, part: Path) -> int:
    sizes = {name: getattr(given, name) for name in ("budget", "episodes", "validation", "finals", "finalists")}
    check_budget(given.survive, **sizes)
    check_writable(output.parent)
    goal = GOALS[given.controller, given.scenario]
    if given.history is None:
        budget = {name: getattr(given, name) for name in ("budget", "episodes", "survive")}
        history = History(keep=lambda entries: write_files({part: _text({"budget": budget, "history": entries})}))
        search(goal, given.budget, given.episodes, given.survive, history)
    else:
        budget, history = read_history(given.history)
    budget |= {"validation": given.validation, "finals": given.finals}
    chosen = choose(goal, history, given.validation, given.finals, given.finalists)
    found = {
        "controller": given.controller,
        "scenario": given.scenario,
        "budget": budget,
        "chosen": chosen,
        "history": history.entries,
    }
    write_files({output: _text(found)})
    part.unlink(missing_ok=True)
    print(json.dumps(chosen, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
