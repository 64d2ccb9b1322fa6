"""The LQG's settings on the crystals that a comparison is judged on: radius error is to be read at equal activity.

A row that learns to move the pull less has a larger radius error, and one that moves it more a smaller; the LQG's
frontier (:mod:`cz_gym.evaluation.equal_activity`) says what the same moves buy without learning.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

from cz_gym.agents.agent_file.contract import read_json
from cz_gym.atomic_files import write_files
from cz_gym.baselines.lqg.settings import FAMILY
from cz_gym.baselines.registry import find_controller
from cz_gym.config import make_config
from cz_gym.evaluation.equal_activity import frontier

from . import runs as ablation_run
from .runs import FARTHER, FIGURES, SCENARIO, Plan

KEPT = "lqg.json"
RMSE, ACTIVITY = "rmse_mm", "pull_step_rms_mm_per_min"


class Rivals(NamedTuple):
    """The family of LQGs, by name: each figure's mean over the crystals."""

    means: Mapping[str, Mapping[str, float]]

    def ratio(self, rmse: float, activity: float) -> float | None:
        """A radius error over the LQG's at that pull step RMS; None for one quieter than any of the family."""
        points = [(each[ACTIVITY], each[RMSE]) for each in self.means.values()]
        try:
            return rmse / float(frontier(points).at(activity))
        except ValueError:
            return None


def rivals(plan: Plan) -> Rivals:
    """Those kept in the plan's folder; judged, and kept there, if there are none of these settings and crystals."""
    names = FAMILY
    laws = {name: find_controller(name).make(make_config(SCENARIO)) for name in names}
    about = [ablation_run.judged_on(), asdict(plan.weights)]
    told = json.dumps([about, {name: law.settings.hash for name, law in laws.items()}])
    digest, path = hashlib.sha256(told.encode()).hexdigest()[:16], plan.out / KEPT
    kept = _read(path)
    if kept is None or kept["of"] != digest or set(kept["means"]) != set(names):
        means = {
            name: dict(zip(FIGURES, map(float, ablation_run.judge(law, plan.weights).mean(axis=0)), strict=True))
            for name, law in laws.items()
        }
        kept = {"of": digest, "means": means}
        write_files({path: (json.dumps(kept, indent=1) + "\n").encode()})
    return Rivals(kept["means"])


def _read(path: Any) -> Any:
    """What is kept; None if nothing that can be used is."""
    if not path.exists():
        return None
    try:
        kept = read_json(path)
        sound = all(isinstance(each[name], float) for each in kept["means"].values() for name in FIGURES)
        return kept if sound and isinstance(kept["of"], str) else None
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def rivals_table(found: Rivals) -> list[str]:
    """Lines of a table in markdown, from lively to quiet."""
    heads = ("controller", "RMSE [um]", "1000 cost", "1000 reward's cost", "pull step [mm/min]", "lost [%]",
             f"{FARTHER}: RMSE [um]", "lost [%]")  # fmt: skip
    lines = [f"| {' | '.join(heads)} |", f"|---|{'--:|' * (len(heads) - 1)}"]
    for name, each in sorted(found.means.items(), key=lambda item: -item[1][ACTIVITY]):
        cells = (
            f"{1e3 * each['rmse_mm']:.1f}",
            f"{1e3 * each['cost']:.2f}",
            f"{1e3 * each['reward_cost']:.2f}",
            f"{each[ACTIVITY]:.4f}",
            f"{100.0 * each['failure_rate']:.1f}",
            f"{1e3 * each[f'{FARTHER}_rmse_mm']:.1f}",
            f"{100.0 * each[f'{FARTHER}_failure_rate']:.1f}",
        )
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines
