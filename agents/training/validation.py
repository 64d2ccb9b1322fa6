"""How good an agent is while it trains, and when it has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.cost import FAILURE_COST, cost_terms
from cz_gym.evaluation.metrics import Metrics, metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.units import KILO, MM, MM_PER_MIN

from .recipes import OWN_WEIGHTS, CostWeights

Floats = npt.NDArray[np.float64]
PICKING = VALIDATION_SEEDS[:64]
"""Seeds of the crystals that pick the best agent of a run."""
JUDGING = VALIDATION_SEEDS[64:264]
"""Seeds of those that say what it is worth; they pick nothing within a run."""


class Validation(NamedTuple):
    """Mean figures over validation episodes."""

    cost: float
    """Of a step, weighed as in training; ten at most, which is what a lost episode costs [-]."""
    rmse_mm: float
    pull_step_rms_mm_per_min: float
    failure_rate: float


def validate(policy: Any, config: Config, seeds: Sequence[int], weights: CostWeights = OWN_WEIGHTS) -> Validation:
    """Run the episodes of those seeds."""
    found = metrics(rollout(policy, config, seeds))
    figures = costs(found, weights), found.rmse_mm, found.pull_step_rms_mm_per_min, found.failure_rate
    return Validation(*(float(figure.mean()) for figure in figures))


def costs(found: Metrics, weights: CostWeights) -> Floats:
    """Mean cost of a step of each episode, as :class:`Validation` says, shape (episodes,)."""
    error = found.rmse_observable_mm if weights.observable else found.rmse_mm
    terms = cost_terms(
        error * MM,
        found.pull_rms_mm_per_min * MM_PER_MIN,
        found.pull_step_rms_mm_per_min * MM_PER_MIN,
        found.heater_step_rms_kw * KILO,
    )
    cost = terms.radius + weights.pull * terms.pull
    cost += weights.pull_step * terms.pull_step + weights.heater_step * terms.heater_step
    return np.where(found.failure_rate > 0, FAILURE_COST, np.minimum(cost, FAILURE_COST))
