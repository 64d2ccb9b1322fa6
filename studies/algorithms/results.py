"""What the agent of one training run does on validation crystals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cz_gym.agents.policies.onnx import OnnxPolicy
from cz_gym.agents.training import validation
from cz_gym.agents.training.fleet import Job, train_seed
from cz_gym.agents.training.run_files import read_rows
from cz_gym.agents.training.validation import references
from cz_gym.baselines.registry import make_controller
from cz_gym.config import Config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import Floats, rollout

SCENARIO, TRANSFER = "randomized", "hard"
"""Scenario of the crystals, whatever an agent was trained on; and a harder scenario to transfer to."""
FIGURES = ("rmse", "cost", "pull_step", "lost", "transfer_rmse", "transfer_lost")
"""Of a crystal: RMSE of the radius [mm]; mean cost of a step as the reward counts it [-], ten for a lost crystal;
RMS of the pull speed's steps [mm/min]; 1 if the crystal was lost; RMSE and loss on TRANSFER."""


class Result(NamedTuple):
    """Figures of one training run."""

    figures: Floats
    """Shape (crystals, figures)."""
    progress: Sequence[Mapping[str, float]]
    """Rows of the run's ``progress.csv``."""


def train_and_evaluate(job: Job) -> Result:
    """Train a run to its end, from its checkpoint if there is one, and evaluate its best agent."""
    if job.summary is None:
        train_seed(job._replace(references=references(make_controller, job.recipe)))
    config = job.recipe.config
    rows = [{name: float(value) for name, value in row.items()} for row in read_rows(job.folder / "progress.csv")]
    return Result(evaluate(OnnxPolicy.load(job.folder / "agent.onnx", config), config), rows)


def evaluate(policy: Any, config: Config) -> Floats:
    """Figures on the validation crystals that chose no agent, shape (crystals, figures)."""
    own, transfer = (
        metrics(rollout(policy, config.with_scenario(name), validation.JUDGING)) for name in (SCENARIO, TRANSFER)
    )
    cost = validation.costs(own)
    columns = own.rmse_mm, cost, own.pull_step_rms_mm_per_min, own.failure_rate, transfer.rmse_mm, transfer.failure_rate
    return np.stack(columns, axis=-1)
