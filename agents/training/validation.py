"""Cost, radius error and losses of an agent on validation crystals."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.agents.agent_file.contract import Contract
from cz_gym.body.cost import COST_CAP
from cz_gym.config import Config
from cz_gym.evaluation.metrics import Metrics, metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.vector import CzVectorEnv

from .recipes import Recipe

Floats = npt.NDArray[np.float64]
PICKING = VALIDATION_SEEDS[:64]
"""Seeds of the crystals that choose the best agent of a run."""
JUDGING = VALIDATION_SEEDS[64:264]
"""Seeds of the crystals that a finished run's agent is tested on; they choose nothing within a run."""

REFERENCES = {"Cz-v0": ("paper", "paper-tuned", "lqg"), "CzCrystal-v0": ("compensated", "lqg-along")}
"""Classical controllers that an agent is shown beside while it learns, by environment."""
References = Mapping[str, tuple[float, float]]
"""Mean RMSE of each reference [mm], on the crystals of PICKING and of JUDGING."""
COLUMNS = "steps", "seconds", "validation_cost", "validation_rmse_mm", "pull_step_rms_mm_per_min", "failure_rate"
"""Figures of a validation; :func:`beside` names those of the references, which follow, the same in every row."""


class Validation(NamedTuple):
    """Mean figures over validation episodes."""

    cost: float
    """Mean cost of a step before it saturates, at most ten; that of a lost crystal is ten [-]."""
    rmse_mm: float
    pull_step_rms_mm_per_min: float
    failure_rate: float

    def put_into(self, contract: Contract) -> Contract:
        """The contract of an agent with these figures."""
        return replace(contract, validation_cost=self.cost, validation_rmse_mm=self.rmse_mm)


def beside(name: str) -> str:
    """Name of the column with the RMSE of a reference [mm]."""
    return f"{name}_rmse_mm"


def validate(policy: Any, config: Config, seeds: Sequence[int]) -> Validation:
    """Run one episode a seed."""
    measured = metrics(rollout(policy, config, seeds))
    figures = (costs(measured), measured.rmse_mm, measured.pull_step_rms_mm_per_min, measured.failure_rate)
    return Validation(*(float(figure.mean()) for figure in figures))


def references(make_controller: Callable[[str, Config], Any], recipe: Recipe) -> References:
    """RMSEs of the classical controllers on the crystals of a recipe; ``make_controller`` makes one by its name."""
    config = replace(recipe.config, observation="measured", action="direct")

    def rmse_mm(name: str, seeds: Sequence[int]) -> float:
        return _by_scenario(lambda own: make_controller(name, own), config, seeds)

    return {name: (rmse_mm(name, PICKING), rmse_mm(name, JUDGING)) for name in REFERENCES[config.process.name]}


def _by_scenario(make: Callable[[Config], Any], config: Config, seeds: Sequence[int]) -> float:
    """Mean RMSE [mm] of a controller with its design for each crystal's own scenario, as in the benchmark."""
    with closing(CzVectorEnv.from_config(config, len(seeds))) as env:
        _, info = env.reset(seed=list(seeds))
    drawn, total = info.get("scenario", [config.scenario.name] * len(seeds)), 0.0
    for scenario in config.scenario.scenarios:
        if own := [seed for seed, name in zip(seeds, drawn, strict=True) if name == scenario.name]:
            alone = config.with_scenario(scenario)
            total += len(own) * validate(make(alone), alone, own).rmse_mm
    return total / len(seeds)


def costs(measured: Metrics) -> Floats:
    """Mean cost of a step of each episode (:attr:`Validation.cost`), shape (episodes,)."""
    return np.where(measured.failure_rate > 0, COST_CAP, np.minimum(measured.cost, COST_CAP))
