"""Tune a PID controller within a budget: ``python -m cz_gym.baselines.tuning.pid --controller paper-tuned``.

Optuna's tree-structured Parzen estimator explores on the first training seeds, always the same; steps around the best
design then refine it; the best few meet the first validation seeds, and the best there is chosen. Test seeds are never
touched. Every trial is kept in the file that is written; the same command goes on where it stopped.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.commands import OneLineParser, between
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS
from cz_gym.units import MM_PER_MIN

from .harness import Score, Search, Trial, file_name, measure, value_at
from .pid_spaces import Space, space_of

STEP_PRICE, EXCESS_PRICE, FAILURE_PRICE, RULE_PRICE = 0.2, 20.0, 5.0, 2.0
"""Prices of pull step RMS and its excess over what is allowed [mm per mm/min], of failures and broken rules [mm]."""
EXPLORE = 0.4
"""Share of the trials that explore; the others refine."""
STEPS = (0.01, 0.15)
"""Range of the standard deviation of a refining step, in parts of a parameter's range."""
SURVIVE = "hard"
"""Scenario whose episodes a design tuned on ``randomized`` has to survive as well."""
BUDGET = "trials", "episodes", "survive", "finalists", "validation"
"""Options that the history tells."""


class PIDSearch(Search):
    """Explore, then refine."""

    def __init__(self, space: Space, scenario: str, budget: Mapping[str, int], seed: int = 0) -> None:
        super().__init__(space.name, scenario, space.base, space.parameters, budget)
        self.space, self.seed = space, seed
        self.budget["survive"] *= scenario == "randomized"

    def training_score(self, settings: Any) -> Score:
        """The objective on the first training episodes."""
        return self.objective(
            settings, TRAINING_SEEDS[: self.budget["episodes"]], TRAINING_SEEDS[: self.budget["survive"]]
        )

    def validation_score(self, settings: Any) -> Score:
        """The objective on the first validation episodes."""
        seeds = VALIDATION_SEEDS[: self.budget["validation"]]
        return self.objective(settings, seeds, seeds if self.budget["survive"] else ())

    def objective(self, policy: Any, seeds: Sequence[int], survive: Sequence[int]) -> Score:
        """Mean RMSE against what a sensor can show, plus the priced pull steps, failures and broken rules [mm].

        Failures count on episodes of SURVIVE too, of the seeds in ``survive``.
        """
        found = measure(policy, self.config, seeds)
        failed = found.failure_rate * len(seeds)
        if survive:
            failed += measure(policy, self.config.with_scenario(SURVIVE), survive).failure_rate * len(survive)
        failures, broken = failed / (len(seeds) + len(survive)), self.space.rule(policy)
        excess = max(0.0, found.pull_step - self.space.allowed_step / MM_PER_MIN)
        cost = found.rmse_mm + STEP_PRICE * found.pull_step + EXCESS_PRICE * excess
        cost += FAILURE_PRICE * failures + RULE_PRICE * broken
        names = "rmse_mm", "pull_step_rms_mm_per_min", "failure_rate", "rule_excess"
        return cost, dict(zip(names, (found.rmse_mm, found.pull_step, failures, broken), strict=True))

    def run(self) -> None:
        """Optuna's sampler explores, random steps refine."""
        import optuna
        from tqdm import tqdm

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        ranges = {p.path: optuna.distributions.FloatDistribution(p.low, p.high, log=p.log) for p in self.parameters}
        begun, trials = len(self.trials), self.budget["trials"]
        sampler = optuna.samplers.TPESampler(seed=self.seed + begun, n_startup_trials=30, n_ei_candidates=48)
        study = optuna.create_study(sampler=sampler)

        def tell(trial: Trial) -> None:
            params = dict(zip(ranges, self._inside(trial.values), strict=True))
            study.add_trial(optuna.trial.create_trial(params=params, distributions=dict(ranges), value=trial.score))

        for trial in self.trials:
            tell(trial)
        bar = tqdm(range(begun, trials), desc=self.controller, initial=begun, total=trials, disable=None)
        for number in bar:
            if number == 0:
                values = self._inside(value_at(self.base, p.path) for p in self.parameters)
            elif number < EXPLORE * trials:
                asked = study.ask(dict(ranges))
                values = [asked.params[path] for path in ranges]
                study.tell(asked, state=optuna.trial.TrialState.FAIL)  # what is told is the rounded design
            else:
                values = self.refined(np.random.default_rng([self.seed, number]))
            tell(self.add(values))
            bar.set_postfix(best=f"{self.best_score:.4f}")

    def refined(self, random: np.random.Generator) -> list[float]:
        """A step from the best design: about half of the parameters, by a normal step whose size is drawn as well."""
        n = len(self.parameters)
        size = math.exp(random.uniform(math.log(STEPS[0]), math.log(STEPS[1])))
        parts = size * random.standard_normal(n) * (random.random(n) < 0.5)
        each = zip(self.parameters, self.best(1)[0].values, parts, strict=True)
        return self._inside(v * (p.high / p.low) ** x if p.log else v + (p.high - p.low) * x for p, v, x in each)

    def _inside(self, values: Iterable[float]) -> list[float]:
        """Values held inside their ranges."""
        return [float(np.clip(value, p.low, p.high)) for p, value in zip(self.parameters, values, strict=True)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser(prog="python -m cz_gym.baselines.tuning.pid", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--controller", required=True, help="paper-tuned, paper-filtered, pid-conventional, industrial")
    parser.add_argument("--scenario", default="randomized", help="scenario to tune on")
    add = parser.add_argument
    add("--trials", type=between(1, 100_000), default=60, help="trials in all, those of an earlier run included")
    add("--episodes", type=between(1, 10_000), default=60, help="training episodes a trial")
    add("--survive", type=between(0, 10_000), default=30, help="training episodes of hard to survive, on randomized")
    add("--finalists", type=between(1, 1000), default=8, help="designs that meet the validation seeds")
    add("--validation", type=between(1, len(VALIDATION_SEEDS)), default=200, help="validation episodes, at most 500")
    parser.add_argument("--seed", type=int, default=0, help="seed of the search")
    parser.add_argument("--out", type=Path, default=Path("results/tuning"), help="folder of histories and choices")
    return parser.run(_tune, arguments, "agents", "the same command goes on from the trials in its history")


def _tune(given: argparse.Namespace) -> None:
    budget = {name: getattr(given, name) for name in BUDGET}
    space = space_of(given.controller, given.scenario)
    search = PIDSearch(space, given.scenario, budget, given.seed)
    chosen = search.tune(given.out / file_name(space.name, given.scenario))
    print(f"{space.name} on {given.scenario}: {chosen.score:.4f} {chosen.facts}")
    print(search.settings(chosen.values))


if __name__ == "__main__":
    sys.exit(main())
