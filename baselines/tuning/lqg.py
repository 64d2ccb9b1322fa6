"""Tune the LQG: ``python -m cz_gym.baselines.tuning.lqg --controller lqg --scenario puller``.

COBYLA (SciPy) on the logarithms of weights and noise model, on training seeds; the best candidates then meet the
validation seeds, which choose. Test seeds are never touched. Every candidate is kept in the file that is written; the
same command goes on where it stopped.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import NonlinearConstraint, minimize

from cz_gym.baselines.lqg.controller import LQG, LQGSettings
from cz_gym.baselines.policy import Floats
from cz_gym.commands import OneLineParser, between
from cz_gym.config import make_config
from cz_gym.errors import CzError
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS

from .harness import Figures, Score, Search, file_name, measure, rounded, value_at
from .lqg_goals import FAILURE_PENALTY, GOALS, PARAMETERS

SURVIVAL_SEEDS = TRAINING_SEEDS[100_000:]
"""Training seeds of the episodes that only have to be survived."""
HEATER_FACTORS = (1.0, 3.0, 10.0)
"""On the weight of heater steps, tried with every finalist: the search hardly sees that weight."""
BUDGET = "budget", "episodes", "survive", "validation", "finals", "finalists"
"""Options that the history tells."""
_FIRST_STEP = 0.5


def figures(settings: LQGSettings, scenario: str, seeds: Sequence[int]) -> Figures:
    """Run the LQG of these settings on those episodes."""
    config = make_config(scenario)
    return measure(LQG(settings, config.control_interval), config, seeds)


class LQGSearch(Search):
    """COBYLA from the goal's start."""

    def __init__(self, controller: str, scenario: str, budget: Mapping[str, int]) -> None:
        if (controller, scenario) not in GOALS:
            known = ", ".join(where for name, where in GOALS if name == controller)
            raise CzError(f"{controller} has no goal on {scenario!r}, but on {known}")
        self.goal = GOALS[controller, scenario]
        super().__init__(controller, scenario, self.goal.start, PARAMETERS, budget)

    def training_score(self, settings: LQGSettings) -> Score:
        """The goal's score on training episodes; a candidate that would be the best must also survive harder ones."""
        found = figures(settings, self.goal.scenario, TRAINING_SEEDS[: self.budget["episodes"]])
        score, survive = self.goal.score(found), self.budget["survive"]
        lost = self._lost(settings, survive) if survive and score < self.best_score else {}
        score += FAILURE_PENALTY * sum(lost.values())
        print(f"{len(self.trials) + 1:4d}  score {score:8.4f}  {found}  lost {lost}", flush=True)
        return score, {"figures": found._asdict(), "lost": lost}

    def validation_score(self, settings: LQGSettings) -> Score:
        """The goal's score on validation episodes; losses on training episodes of harder scenarios count first."""
        found = figures(settings, self.goal.scenario, VALIDATION_SEEDS[: self.budget["validation"]])
        lost = self._lost(settings, self.budget["finals"])
        score = self.goal.score(found) + FAILURE_PENALTY * sum(lost.values())
        print(f"final  score {score:8.4f}  {settings.hash}  {found}  lost {lost}", flush=True)
        return score, {"hash": settings.hash, "figures": found._asdict(), "lost": lost}

    def _lost(self, settings: LQGSettings, episodes: int) -> dict[str, float]:
        """Failure rates on training episodes of the scenarios that have to be survived."""
        seeds = SURVIVAL_SEEDS[:episodes]
        return {name: figures(settings, name, seeds).failure_rate for name in self.goal.survive}

    def run(self) -> None:
        """COBYLA is deterministic: candidates that the history holds are met again, but not measured again."""
        lowest, highest = np.log([[p.low, p.high] for p in self.parameters]).T

        def found(logarithms: Floats) -> Figures:
            values = rounded(np.exp(np.clip(logarithms, lowest, highest)))
            known = {trial.values: trial for trial in self.trials}
            return Figures(**(known.get(values) or self.add(values)).facts["figures"])

        def objective(logarithms: Floats) -> float:
            return self.goal.objective(found(logarithms))

        options: Any = {"maxiter": self.budget["budget"], "rhobeg": _FIRST_STEP, "tol": 1e-3}
        limits: Any = NonlinearConstraint(lambda logarithms: self.goal.slack(found(logarithms)), 0.0, np.inf)
        start = np.log([value_at(self.base, p.path) for p in self.parameters])
        minimize(objective, start, method="COBYLA", constraints=limits, options=options)

    def finalists(self) -> list[Floats]:
        """The best candidates, each also with heavier weights on heater steps."""
        heavier = np.ones((len(HEATER_FACTORS), len(self.parameters)))
        heavier[:, [p.path for p in self.parameters].index("weights.heater_step")] = HEATER_FACTORS
        return [values for best in super().finalists() for values in heavier * np.array(best)]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = OneLineParser(prog="python -m cz_gym.baselines.tuning.lqg", description=__doc__)
    parser.add_argument("--controller", choices=sorted({name for name, _ in GOALS}), default="lqg")
    parser.add_argument("--scenario", choices=sorted({scenario for _, scenario in GOALS}), default="randomized")
    add = parser.add_argument
    add("--budget", type=between(1, 100_000), default=100, help="candidates to try")
    add("--episodes", type=between(1, 10_000), default=100, help="training episodes a candidate")
    add("--survive", type=between(0, 10_000), default=20, help="more that must be survived, failures only")
    add("--validation", type=between(1, len(VALIDATION_SEEDS)), default=200, help="validation episodes a finalist")
    add("--finals", type=between(1, 10_000), default=200, help="training episodes a finalist must survive")
    add("--finalists", type=between(1, 1000), default=3, help="candidates that meet the validation seeds")
    parser.add_argument("--history", type=Path, help="choose again from this kept history, without a search")
    parser.add_argument("--output", type=Path, default=None, help="default in results/tuning")
    return parser.run(_tune, arguments, "benchmark", "the same command goes on from the candidates in its history")


def _tune(given: argparse.Namespace) -> None:
    search = LQGSearch(given.controller, given.scenario, {name: getattr(given, name) for name in BUDGET})
    path = given.output or Path("results/tuning") / file_name(given.controller, given.scenario)
    chosen = search.tune(path, given.history)
    print(search.settings(chosen.values))


if __name__ == "__main__":
    sys.exit(main())
