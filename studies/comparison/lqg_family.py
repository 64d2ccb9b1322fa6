"""The LQG's settings on the crystals that a comparison is judged on: radius error is to be read at equal activity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cz_gym.baselines.lqg.settings import FAMILY
from cz_gym.baselines.registry import make_controller
from cz_gym.config import make_config
from cz_gym.evaluation.equal_activity import frontier

from .results import ACTIVITY, LOST, RMSE, SCENARIO, Plan, Result, cached, judge

FEW = 0.01
"""Share of lost crystals up to which radius errors are compared at equal activity: lost ones would be most of it."""
Family = Mapping[str, Result]
"""The LQG's settings, by name."""


def lqg_family(plan: Plan) -> Family:
    """The family on the plan's crystals; judged if that is not cached."""
    config = make_config(SCENARIO)

    def judged(name: str) -> Result:
        controller: Any = make_controller(name, config)
        return cached(plan, name, controller.settings.hash, lambda: Result(judge(plan, controller, config)))

    return {name: judged(name) for name in FAMILY}


def at_equal_activity(results: list[Result], family: Family) -> float | None:
    """Mean radius error over the LQG's at the same mean pull step RMS.

    None for results quieter than any of the family, and where more than a few crystals are lost.
    """
    rmse, activity, lost = (sum(each.mean(name) for each in results) / len(results) for name in (RMSE, ACTIVITY, LOST))
    try:
        lqg = frontier([(each.mean(ACTIVITY), each.mean(RMSE)) for each in family.values()]).at(activity)
    except ValueError:
        return None
    return rmse / lqg if lost <= FEW else None
