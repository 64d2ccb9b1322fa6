"""How good an agent is, on validation crystals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config, make_config
from cz_gym.cost import FAILURE_COST, WEIGHTS, Weights, cost_terms
from cz_gym.evaluation.metrics import Metrics, metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.units import KILO, MM, MM_PER_MIN

from .recipes import Recipe

Floats = npt.NDArray[np.float64]
PICKING = VALIDATION_SEEDS[:64]
"""Seeds of the crystals that choose the best agent of a run."""
JUDGING = VALIDATION_SEEDS[64:264]
"""Seeds of the crystals that a finished run's agent is tested on; they choose nothing within a run."""

REFERENCES = ("paper", "paper-tuned", "lqg")
"""Classical controllers that an agent is shown beside while it learns."""
References = Mapping[str, tuple[float, float]]
"""Mean RMSE of each reference [mm], on the crystals of PICKING and of JUDGING."""
COLUMNS = (
    "steps",
    "seconds",
    "validation_cost",
    "validation_rmse_mm",
    "pull_step_rms_mm_per_min",
    "failure_rate",
    *(f"{name}_rmse_mm" for name in REFERENCES),
)
"""Figures of a validation; those of the references are the same in every row."""


class Validation(NamedTuple):
    """Mean figures over validation episodes."""

    cost: float
    """Mean cost of a step with the recipe's weights, at most ten; that of a lost crystal is ten [-]."""
    rmse_mm: float
    pull_step_rms_mm_per_min: float
    failure_rate: float


def validate(
    policy: Any, config: Config, seeds: Sequence[int], weights: Weights = WEIGHTS, observable: bool = False
) -> Validation:
    """Run one episode a seed."""
    measured = metrics(rollout(policy, config, seeds))
    figures = (
        costs(measured, weights, observable),
        measured.rmse_mm,
        measured.pull_step_rms_mm_per_min,
        measured.failure_rate,
    )
    return Validation(*(float(figure.mean()) for figure in figures))


def references(make_controller: Callable[[str, Config], Any], recipe: Recipe) -> References:
    """What the classical controllers reach on the crystals of a recipe; ``make_controller`` makes one by its name."""
    config = make_config(recipe.config.scenario, control_interval=recipe.control_interval)
    # Classical controllers are designed for one scenario.
    design = config if len(config.scenario.scenarios) == 1 else config.with_scenario("randomized")
    found = {}
    for name in REFERENCES:
        policy = make_controller(name, design)
        found[name] = validate(policy, config, PICKING).rmse_mm, validate(policy, config, JUDGING).rmse_mm
    return found


def costs(measured: Metrics, weights: Weights = WEIGHTS, observable: bool = False) -> Floats:
    """Mean cost of a step of each episode (:attr:`Validation.cost`), shape (episodes,).

    With ``observable``, the radius error leaves out the offset that no sensor shows.
    """
    error = measured.rmse_observable_mm if observable else measured.rmse_mm
    terms = cost_terms(
        error * MM,
        measured.pull_rms_mm_per_min * MM_PER_MIN,
        measured.pull_step_rms_mm_per_min * MM_PER_MIN,
        measured.heater_step_rms_kw * KILO,
        weights,
    )
    return np.where(measured.failure_rate > 0, FAILURE_COST, np.minimum(sum(terms), FAILURE_COST))
