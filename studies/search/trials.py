"""What the search turns of the ``ppo`` recipe, and its trials: Ray Tune runs them, and Optuna proposes them."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import optuna
from optuna import Study
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.storages.journal import JournalFileBackend, JournalStorage
from optuna.trial import FrozenTrial, TrialState
from ray import tune
from ray.tune.schedulers import MedianStoppingRule
from ray.tune.search.optuna import OptunaSearch
from tqdm import tqdm

from cz_gym.agents.training.recipes import PPO
from cz_gym.agents.training.validation import PICKING
from cz_gym.atomic_files import write_files
from cz_gym.errors import CzError
from cz_gym.evaluation.cluster import completed
from cz_gym.evaluation.files import csv_text
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from studies.comparison.command import compare
from studies.comparison.results import COST, Plan
from studies.comparison.training import is_finished, trained
from studies.comparison.variants import Study as Comparison
from studies.comparison.variants import Variant

REST = VALIDATION_SEEDS[len(PICKING) :]
JUDGED, CONFIRMING = REST[:150], REST[150:350]
"""Seeds of the crystals that trials are judged on, and of those that confirm; none of them picks a run's agent."""

Params = Mapping[str, Any]
"""A place in the space, by the names of :data:`SPACE`."""
SPACE: dict[str, BaseDistribution] = {
    "learning_rate": FloatDistribution(1e-4, 4e-3, log=True),
    "gae_lambda": FloatDistribution(0.5, 0.99),
    "clip_range": FloatDistribution(0.03, 0.4, log=True),
    "n_steps": CategoricalDistribution((16, 32, 64, 128, 256)),
    "batch_size": CategoricalDistribution((512, 1024, 2048, 4096, 8192)),
    "n_epochs": IntDistribution(1, 10),
    "horizon": FloatDistribution(10.0, 500.0, log=True),
    "noise": FloatDistribution(0.05, 1.0, log=True),
}
"""Fields of the recipe; but ``horizon`` is 1 / (1 - gamma) in steps."""
STARTUP, OTHERS, VALIDATIONS, RETRIES = 8, 4, 6, 3
"""Trials drawn at random first; others that must have come as far before one is given up; validations on a trial's
way; times that a trial begins again whose node is lost."""
SETTINGS = {
    "TUNE_DISABLE_SIGINT_HANDLER": "1",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "RAY_AIR_NEW_OUTPUT": "0",
}
"""Of Tune: Ctrl-C ends the command, as elsewhere; what a trial reports is in the journal alone; no tables."""


def params_of(recipe: PPO) -> dict[str, Any]:
    """Where a recipe stands in the space."""
    own = {name: getattr(recipe, name) for name in SPACE if hasattr(recipe, name)}
    return {**own, "horizon": 1.0 / (1.0 - recipe.gamma)}


def recipe_of(params: Params, steps: int, name: str) -> PPO:
    """The recipe at a place in the space, learning for so many environment steps."""
    own = {key: value for key, value in params.items() if hasattr(PPO(), key)}
    return replace(PPO(), name=name, steps=steps, gamma=1.0 - 1.0 / params["horizon"], **own)


class Search(NamedTuple):
    """What is searched."""

    plan: Plan
    steps: int
    """Environment steps of a trial."""
    trials: int
    seed: int

    def recipe(self, params: Params) -> PPO:
        """The recipe of a trial."""
        return recipe_of(params, self.steps, "ppo-search")

    def is_complete(self, trial: FrozenTrial) -> bool:
        """Whether a finished trial was judged; otherwise it was given up."""
        return is_finished(self.plan, (Variant(self.recipe(trial.params), ""), 0))


def attempt(params: Params, search: Search) -> None:
    """Train and judge an agent, and tell Tune the cost of each validation on the way, then that of the judged agent.

    An attempt that was interrupted goes on from its checkpoint, and tells the earlier validations again.
    """
    told = 0

    def tell(rows: Sequence[Mapping[str, Any]]) -> None:
        nonlocal told
        for row in rows[told:]:
            told += 1
            tune.report({"cost": float(row["validation_cost"])})

    with tqdm(disable=True) as bar:
        recipe, every = search.recipe(params), max(search.steps // VALIDATIONS, 1)
        result = trained(search.plan, recipe, 0, bar, every, tell)
    tell(result.validations)
    tune.report({"cost": result.mean(COST)})


def run(search: Search) -> Study:
    """Try settings until there are as many trials as asked for, going on from the journal."""
    os.environ.update(SETTINGS)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    storage = JournalStorage(JournalFileBackend(str(search.plan.out / "journal.log")))
    study = optuna.create_study(storage=storage, study_name=f"ppo-{search.steps}-steps", load_if_exists=True)
    enqueue(study)
    done = finished(study)
    if len(done) >= search.trials:
        return study
    rule: Any = {"grace_period": 1, "min_samples_required": OTHERS, "min_time_slice": math.inf}
    median: Any = MedianStoppingRule("training_iteration", "cost", "min", **rule)
    for earlier in done:
        for number, cost in earlier.intermediate_values.items():
            median.on_trial_complete(None, earlier.number, {"training_iteration": number, "cost": cost})
    sampler = optuna.samplers.TPESampler(seed=search.seed + len(done), n_startup_trials=STARTUP)
    searcher = OptunaSearch(SPACE, "cost", "min", sampler=sampler, study_name=study.study_name, storage=storage)
    shutil.rmtree(search.plan.work / "tune", ignore_errors=True)

    def trial(params: Params) -> None:
        attempt(params, search)

    tuner = tune.Tuner(
        tune.with_resources(trial, {"cpu": 1}),
        tune_config=tune.TuneConfig(search_alg=searcher, scheduler=median, num_samples=search.trials - len(done)),
        run_config=tune.RunConfig(
            name="tune",
            storage_path=str(search.plan.work),
            callbacks=[History(search, study)],
            failure_config=tune.FailureConfig(max_failures=RETRIES),
            verbose=0,
        ),
    )
    for error in tuner.fit().errors:
        raise CzError(f"a trial failed: {str(error).strip().splitlines()[-1]}")
    return study


def enqueue(study: Study) -> None:
    """Let the recipe be tried first, and again what was interrupted."""
    known = [trial.params for trial in finished(study)]
    known += [trial.system_attrs["fixed_params"] for trial in study.get_trials(states=[TrialState.WAITING])]
    interrupted = study.get_trials(states=[TrialState.RUNNING, TrialState.FAIL])
    for params in (params_of(PPO()), *(trial.params for trial in interrupted)):
        if params and params not in known:
            study.enqueue_trial(params)
            known.append(params)
    for trial in interrupted:
        if trial.state == TrialState.RUNNING:
            study.tell(trial.number, state=TrialState.FAIL)


def finished(study: Study) -> list[FrozenTrial]:
    """Trials that were judged or given up."""
    return study.get_trials(states=[TrialState.COMPLETE])


class History(tune.Callback):
    """Writes ``history.csv`` after each trial."""

    def __init__(self, search: Search, study: Study) -> None:
        self.search, self.study = search, study

    def on_trial_complete(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Tune calls this when Optuna knows of the trial's end."""
        write_history(self.search, self.study)
        print(f"{len(finished(self.study))} of {self.search.trials} trials are finished", flush=True)


def write_history(search: Search, study: Study) -> None:
    """Write the finished trials as CSV."""
    rows = []
    for trial in finished(study):
        seconds = trial.duration.total_seconds() if trial.duration else 0.0
        state = "complete" if search.is_complete(trial) else "pruned"
        values = [f"{trial.params[name]:.6g}" for name in SPACE]
        rows.append((trial.number, state, f"{trial.value:.6g}", f"{seconds:.0f}", *values))
    text = csv_text(("trial", "state", "cost", "seconds", *SPACE), rows)
    write_files({search.plan.out / "history.csv": text.encode()})


def confirm(study: Study, search: Search, finalists: int, seeds: int) -> None:
    """Train the best trials once more beside the recipe, on other crystals and training seeds, and write their table.

    Training seeds begin at 1: the search used 0.
    """
    complete = sorted(filter(search.is_complete, finished(study)), key=lambda each: each.values)
    variants = [Variant(PPO(), "the recipe as it stands").of(search.steps)]
    for trial in [each for each in complete if each.params != params_of(PPO())][:finalists]:
        recipe = recipe_of(trial.params, search.steps, f"ppo-trial-{trial.number}")
        meaning = ", ".join(f"{name} {value:.4g}" for name, value in trial.params.items())
        variants.append(Variant(recipe, meaning, variants[0].name))
    comparison = Comparison("search", f"The best of {len(complete)} trials beside the recipe", variants, search.steps)
    if len(variants) > 1:
        plan = search.plan._replace(crystals=CONFIRMING)
        compare(comparison, plan, variants, range(1, 1 + seeds), completed)
