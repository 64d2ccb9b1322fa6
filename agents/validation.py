"""Cost, radius error and losses of an agent on validation crystals, and their curves while it learns."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.signals import COST_CAP
from cz_gym.config import Config
from cz_gym.env import CzVectorEnv
from cz_gym.evaluation.metrics import Metrics, metrics
from cz_gym.evaluation.plots import INK, canvas, png, styles
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout

from .contract import Contract
from .recipes import TrainingConfig

Floats = npt.NDArray[np.float64]
SELECTION_SEEDS = VALIDATION_SEEDS[:64]
"""Seeds of the crystals that choose the best agent of a run."""
JUDGING_SEEDS = VALIDATION_SEEDS[64:264]
"""Seeds of the crystals that a finished run's agent is tested on; they choose nothing within a run."""

REFERENCES = {"Cz-v0": ("paper", "paper-tuned", "lqg"), "CzCrystal-v0": ("compensated", "lqg-along")}
"""Classical controllers that an agent is shown beside while it learns, by environment."""
References = Mapping[str, tuple[float, float]]
"""Mean RMSE of each reference [mm], on the crystals of SELECTION_SEEDS and of JUDGING_SEEDS."""
COLUMNS = "steps", "seconds", "validation_cost", "validation_rmse_mm", "pull_step_rms_mm_per_min", "failure_rate"
"""Figures of a validation; those of the references follow, the same in every row (:func:`reference_column`)."""


class Validation(NamedTuple):
    """Mean figures over validation episodes."""

    cost: float
    """Mean cost of a step before it saturates, at most ten; that of a lost crystal is ten [-]."""
    rmse_mm: float
    pull_step_rms_mm_per_min: float
    failure_rate: float

    def put_into(self, contract: Contract) -> Contract:
        """Return an agent's contract with these figures."""
        return replace(contract, validation_cost=self.cost, validation_rmse_mm=self.rmse_mm)


def reference_column(name: str) -> str:
    """Name the column with the RMSE of a reference controller [mm]."""
    return f"{name}_rmse_mm"


def validate(policy: Any, config: Config, seeds: Sequence[int]) -> Validation:
    """Mean figures of a policy over one episode a seed."""
    measured = metrics(rollout(policy, config, seeds))
    figures = (costs(measured), measured.rmse_mm, measured.pull_step_rms_mm_per_min, measured.failure_rate)
    return Validation(*(float(figure.mean()) for figure in figures))


def references(make_controller: Callable[[str, Config], Any], recipe: TrainingConfig) -> References:
    """RMSEs of classical controllers on a recipe's crystals, each designed for a crystal's own scenario.

    ``make_controller`` makes a controller by its name.
    """
    config = replace(recipe.config, observation="measured", action="direct")

    def rmse_mm(name: str, seeds: Sequence[int]) -> float:
        with closing(CzVectorEnv.from_config(config, len(seeds))) as env:
            _, info = env.reset(seed=list(seeds))
        drawn, total = info.get("scenario", [config.scenario.name] * len(seeds)), 0.0
        for scenario in config.scenario.scenarios:
            if own := [seed for seed, each in zip(seeds, drawn, strict=True) if each == scenario.name]:
                alone = config.with_scenario(scenario)
                total += len(own) * validate(make_controller(name, alone), alone, own).rmse_mm
        return total / len(seeds)

    names = REFERENCES[config.process.name]
    return {name: (rmse_mm(name, SELECTION_SEEDS), rmse_mm(name, JUDGING_SEEDS)) for name in names}


def costs(measured: Metrics) -> Floats:
    """Mean cost of a step of each episode [-] (:attr:`Validation.cost`), shape (episodes,)."""
    return np.where(measured.failure_rate > 0, COST_CAP, np.minimum(measured.cost, COST_CAP))


AXES = (("steps", 1e6, "environment steps [million]"), ("seconds", 60.0, "minutes, validation included"))
"""Horizontal axes: column of a run's progress, unit, label."""


def curves(runs: Mapping[str, Sequence[Sequence[Mapping[str, Any]]]]) -> bytes:
    """Validation RMSE [mm] against steps and minutes, a line a run, as PNG; the references are dashed lines across.

    ``runs`` are the rows of ``progress.csv`` of each run, by the name of their agents.
    """
    figure, style = canvas(9.4, 4.6), styles([*runs])
    panels = figure.subplots(1, 2, sharey=True)
    last = next(iter(runs.values()))[0][-1]
    for axis, (column, unit, title) in zip(panels, AXES, strict=True):
        for name, several in runs.items():
            for place, rows in enumerate(several):
                spent, error = ([float(row[each]) for row in rows] for each in (column, "validation_rmse_mm"))
                drawn = {"color": style[name].colour, "marker": style[name].marker}
                label = name if place == 0 and axis is panels[0] else None
                axis.plot([each / unit for each in spent], error, ms=2.5, lw=1.0, label=label, **drawn)
        references = {name.removesuffix("_rmse_mm"): float(last[name]) for name in [*last][len(COLUMNS) :]}
        for name, rmse in references.items():
            axis.axhline(rmse, color=INK, lw=0.9, ls="--")
            if axis is panels[0]:
                lowest = rmse == min(references.values())  # lines may be close together
                axis.annotate(name, (0.99, rmse), (0, -2 if lowest else 2), axis.get_yaxis_transform(), color=INK,
                              textcoords="offset points", ha="right", va="top" if lowest else "bottom",
                              fontsize=8)  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel=title)
        for each in (axis.xaxis, axis.yaxis):
            each.set_major_formatter(lambda value, _: f"{value:g}")
    panels[0].set_ylabel("validation RMSE of the radius [mm]")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.suptitle("Radius error on validation crystals while learning: a line a training seed", fontsize=11)
    return png(figure)
