"""Judging agents and controllers on validation crystals; each result is cached as one small JSON file.

A file's name ends in a hash of everything that the result depends on: settings, crystals, scenarios, plant, code.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.agents import training
from cz_gym.agents.agent_file.contract import read_json
from cz_gym.agents.training.recipes import OWN_WEIGHTS
from cz_gym.agents.training.run_files import provenance
from cz_gym.agents.training.validation import costs
from cz_gym.atomic_files import write_files
from cz_gym.baselines import lqg
from cz_gym.config import Config, make_config
from cz_gym.errors import CzError
from cz_gym.evaluation.cache import hash_sources
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import Floats, rollout
from cz_gym.jit.cache import compiled_sources

SCENARIO, TRANSFER = "randomized", "hard"
"""What crystals are drawn from, whatever an agent was trained on; and a scenario to transfer to."""
RMSE, ACTIVITY, COST, LOST = "rmse_mm", "pull_step_rms_mm_per_min", "cost", "failure_rate"
FIGURES = (RMSE, COST, ACTIVITY, LOST, f"{TRANSFER}_{RMSE}", f"{TRANSFER}_{LOST}")
"""Of a crystal: true-radius RMSE [mm]; mean cost of a step as the reward counts it [-], a lost crystal costing ten;
RMS of the pull speed's steps [mm/min]; 1 if the crystal was lost; radius error and loss on the other scenario."""
DIGITS = 5
"""Significant digits in a file."""


class Plan(NamedTuple):
    """Where results go, and what they are judged on."""

    out: Path
    """Folder of the results: cached ones in ``runs``, the table beside it."""
    work: Path
    """Folder of unfinished runs."""
    crystals: Sequence[int]
    """Seeds of the validation crystals."""


class Result(NamedTuple):
    """What an agent or controller did on the crystals."""

    figures: Floats
    """Shape (crystals, figures)."""
    validations: Sequence[Mapping[str, float]] = ()
    """Of a training run: the rows of its ``progress.csv``."""

    def mean(self, figure: str) -> float:
        """Mean over the crystals."""
        return float(self.figures[:, FIGURES.index(figure)].mean())


def judge(plan: Plan, policy: Any, config: Config) -> Floats:
    """Figures of a policy on the plan's crystals, at its own observation, action and time between actions.

    Shape (crystals, figures).
    """
    own, transfer = (
        metrics(rollout(policy, config.with_scenario(name), plan.crystals)) for name in (SCENARIO, TRANSFER)
    )
    cost = costs(own, OWN_WEIGHTS)
    columns = own.rmse_mm, cost, own.pull_step_rms_mm_per_min, own.failure_rate, transfer.rmse_mm, transfer.failure_rate
    return np.stack(columns, axis=-1)


def path_of(plan: Plan, name: str, settings: Any) -> Path:
    """Where the result of these settings (a JSON value) is cached."""
    return (
        plan.out / "runs" / f"{name}-{hashlib.sha256(json.dumps(_key(plan, settings)).encode()).hexdigest()[:12]}.json"
    )


def cached(plan: Plan, name: str, settings: Any, make: Callable[[], Result]) -> Result:
    """The result of these settings; made, and written with its provenance, if there is none."""
    path = path_of(plan, name, settings)
    if not path.exists():
        result = make()
        columns = ([float(f"{value:.{DIGITS}g}") for value in column] for column in result.figures.T)
        facts = {
            "key": _key(plan, settings),
            "provenance": provenance(),
            "validations": list(result.validations),
            "figures": dict(zip(FIGURES, columns, strict=True)),
        }
        write_files({path: json.dumps(facts, allow_nan=False).encode()})
    return _read(path, len(plan.crystals))


def _key(plan: Plan, settings: Any) -> Any:
    hashes = {name: make_config(name, observation="history").hash for name in (SCENARIO, TRANSFER)}
    crystals = [int(seed) for seed in plan.crystals]
    return {"settings": settings, "crystals": crystals, "scenarios": hashes, "code": _code()}


@cache
def _code() -> str:
    """Hash of plant, learners and the LQG."""
    own = [path for package in (training, lqg) for path in sorted(Path(str(package.__file__)).parent.glob("*.py"))]
    return hash_sources([*compiled_sources(), *own])


def _read(path: Path, crystals: int) -> Result:
    """A cached result; ValueError if the file is damaged."""
    content = read_json(path)
    try:
        figures = np.array([content["figures"][name] for name in FIGURES], np.float64).T
        validations = [{str(name): float(value) for name, value in row.items()} for row in content["validations"]]
    except (KeyError, TypeError, ValueError, AttributeError):
        figures, validations = np.zeros(0), []
    if figures.shape != (crystals, len(FIGURES)) or not np.isfinite(figures).all():
        raise CzError(f"{path}: damaged; move it away to run it again")
    return Result(figures, validations)
