"""The two ways in which searches propose candidates: explore and refine (Optuna), and COBYLA (SciPy)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from cz_gym.baselines.policy import Floats

from .search import Figures, Search, Trial, rounded, value_at

EXPLORE = 0.4
"""Share of the trials that explore; the others refine."""
STEPS = (0.01, 0.15)
"""Range of the standard deviation of a refining step, in parts of a parameter's range."""
FIRST_STEP = 0.5
"""COBYLA's first step, in natural logarithms of the parameters."""


def explore_and_refine(search: Search) -> None:
    """Explore with Optuna's tree-structured Parzen estimator, then try random steps around the best candidate."""
    import optuna
    from tqdm import tqdm

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    ranges = {p.path: optuna.distributions.FloatDistribution(p.low, p.high, log=p.log) for p in search.parameters}
    begun, trials, seed = len(search.trials), search.budget["trials"], search.budget["seed"]
    sampler = optuna.samplers.TPESampler(seed=seed + begun, n_startup_trials=30, n_ei_candidates=48)
    study = optuna.create_study(sampler=sampler)

    def tell(trial: Trial) -> None:
        params = dict(zip(ranges, inside(search, trial.values), strict=True))
        study.add_trial(optuna.trial.create_trial(params=params, distributions=dict(ranges), value=trial.score))

    for trial in search.trials:
        tell(trial)
    bar = tqdm(range(begun, trials), desc=search.controller, initial=begun, total=trials, disable=None)
    for number in bar:
        if number == 0:
            values = first(search)
        elif number < EXPLORE * trials:
            asked = study.ask(dict(ranges))
            values = [asked.params[path] for path in ranges]
            study.tell(asked, state=optuna.trial.TrialState.FAIL)  # the study learns from the rounded candidate
        else:
            values = _refined(search, np.random.default_rng([seed, number]))
        tell(search.add(values))
        bar.set_postfix(best=f"{search.best_score:.4f}")


def first(search: Search) -> list[float]:
    """The values with which a search begins."""
    return inside(search, (value_at(search.goal.start, p.path) for p in search.parameters))


def inside(search: Search, values: Iterable[float]) -> list[float]:
    """The values, clipped to their ranges."""
    return [float(np.clip(value, p.low, p.high)) for p, value in zip(search.parameters, values, strict=True)]


def _refined(search: Search, random: np.random.Generator) -> list[float]:
    """A normal step of random size from the best candidate, in about half of the parameters."""
    n = len(search.parameters)
    size = math.exp(random.uniform(math.log(STEPS[0]), math.log(STEPS[1])))
    parts = size * random.standard_normal(n) * (random.random(n) < 0.5)
    each = zip(search.parameters, search.best(1)[0].values, parts, strict=True)
    return inside(search, (v * (p.high / p.low) ** x if p.log else v + (p.high - p.low) * x for p, v, x in each))


def cobyla(
    search: Search, objective: Callable[[Figures], float], slack: Callable[[Figures], tuple[float, ...]]
) -> None:
    """Minimise the objective with COBYLA, on logarithms of the parameters, while every ``slack`` is positive.

    COBYLA is deterministic: it meets the candidates of a kept history again, and they are not measured again.
    """
    from scipy.optimize import NonlinearConstraint, minimize

    lowest, highest = np.log([[p.low, p.high] for p in search.parameters]).T

    def found(logarithms: Floats) -> Figures:
        values = rounded(np.exp(np.clip(logarithms, lowest, highest)))
        known = {trial.values: trial for trial in search.trials}
        return Figures(**(known.get(values) or search.add(values)).facts["figures"])

    options: Any = {"maxiter": search.budget["trials"], "rhobeg": FIRST_STEP, "tol": 1e-3}
    limits: Any = NonlinearConstraint(lambda logarithms: slack(found(logarithms)), 0.0, np.inf)
    start: Floats = np.log(first(search))

    def minimised(logarithms: Floats) -> float:
        return objective(found(logarithms))

    minimize(minimised, start, method="COBYLA", constraints=limits, options=options)
