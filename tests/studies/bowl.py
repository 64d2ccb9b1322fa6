"""Trials of a search that take no time, in whatever process."""

import os
import time
from typing import Any
from uuid import uuid4

import numpy as np
from ray import tune

from studies.comparison.results import FIGURES, Result, cached
from studies.comparison.training import _identity
from studies.search.trials import Search


def attempt_bowl(params: Any, search: Search) -> None:
    """The cost is least at a small rate and many epochs; it waits for a file ``go``, for ever if its node is lost."""
    cost = params["learning_rate"] / 1e-3 + 1.0 / params["n_epochs"]
    begun = search.plan.work / "begun" / uuid4().hex
    begun.parent.mkdir(parents=True, exist_ok=True)
    node = os.getppid()
    begun.touch()
    while not (search.plan.work / "go").exists() or os.getppid() != node:
        time.sleep(0.1)
    for _ in range(3):
        tune.report({"cost": cost})
    figures = np.full((len(search.plan.crystals), len(FIGURES)), cost)
    cached(search.plan, *_identity(search.recipe(params), 0), lambda: Result(figures))
    tune.report({"cost": cost})
