"""One run of the ablation: train a row for a seed, judge it on validation crystals, keep what was found as one file."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.agents.agent_file.contract import AgentFileError, read_json
from cz_gym.agents.training.recipes import Choice, CostWeights
from cz_gym.agents.training.run import Run
from cz_gym.agents.training.run_files import provenance
from cz_gym.agents.training.validation import JUDGING, costs
from cz_gym.atomic_files import locked, write_files
from cz_gym.baselines.registry import make_controller
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from studies.ablation.rows import Row

Floats = npt.NDArray[np.float64]
SCENARIO, FARTHER = "randomized", "hard"
"""What they are drawn from, whatever a row was trained on; and a scenario to travel to."""
_TRAVELLED = ("rmse_mm", "failure_rate")
FIGURES = (
    "rmse_mm", "cost", "reward_cost", "pull_step_rms_mm_per_min", "failure_rate",
    *(f"{FARTHER}_{name}" for name in _TRAVELLED),
)  # fmt: skip
"""Figures of an episode: true-radius RMSE [mm]; mean cost of a step [-] as ``ppo`` weighs it and as the environment's
reward does, a lost crystal costing ten; RMS of the pull speed's steps [mm/min]; 1 if the crystal was lost; radius error
and loss on the other scenario."""
STAGES = ("best", "last", "start")
"""The agents of a run: the one that did best on the validation that selects, the last one, and the one it began as."""
SINCE = {("recipe", "clone", "wide_share"): 1.0}
"""Settings that kept runs may be older than, and what they were then."""
DIGITS = 5
"""Significant digits that are kept."""


class Plan(NamedTuple):
    """What all runs of an ablation share."""

    steps: int
    """Environment steps a run."""
    out: Path
    """Folder of what is kept: finished runs in ``runs``, the table beside it."""
    work: Path
    """Folder of unfinished runs, and of imitations that several runs begin with."""
    weights: CostWeights
    """Of the figure ``cost``."""


@dataclass(frozen=True)
class Finished:
    """What a finished run left."""

    row: str
    seed: int
    settings: Mapping[str, Any]
    stages: Mapping[str, Floats]
    """By stage, shape (episodes, figures)."""


def path_of(plan: Plan, row: Row, seed: int) -> Path:
    """Where a finished run is kept."""
    return plan.out / "runs" / f"{row.name}-seed{seed}.json"


def run_one(plan: Plan, row: Row, seed: int, bar: Any) -> None:
    """Train and judge, from the checkpoint if there is one; the run's folder goes when its result is kept."""
    folder = plan.work / f"{row.name}-seed{seed}"
    with locked(folder):
        run = _open(folder, row.of(plan.steps), seed, plan.work / "imitations")
        try:
            run.learn(bar)
        except KeyboardInterrupt:
            run.save()
            raise
        policies = {"best": run.best_policy(), "last": run.present_policy(), "start": run.first_policy()}
        stages = {name: judge(policy, plan.weights) for name, policy in policies.items() if policy is not None}
        write_files({path_of(plan, row, seed): _to_json(plan, row, seed, run, stages)})
        run.training.learner.env.close()
    shutil.rmtree(folder)


def judged_on() -> dict[str, Any]:
    """What figures depend on beside the agent: crystals, and the scenarios and the plant that they are drawn from."""
    configs = {name: make_config(name, observation="history").hash for name in (SCENARIO, FARTHER)}
    return {"seeds": [JUDGING[0], JUDGING[-1]], "figures": list(FIGURES), **configs}


def judge(policy: Any, weights: CostWeights) -> Floats:
    """Figures of a policy on the crystals that all rows are judged on, shape (episodes, figures)."""
    found, farther = (
        metrics(rollout(policy, make_config(name, observation="history"), JUDGING)) for name in (SCENARIO, FARTHER)
    )
    by_name = {
        **found._asdict(),
        **{f"{FARTHER}_{name}": getattr(farther, name) for name in _TRAVELLED},
        "cost": costs(found, weights),
        "reward_cost": costs(found, CostWeights()),
    }
    return np.stack([by_name[name] for name in FIGURES], axis=-1)


def _open(folder: Path, choice: Choice, seed: int, imitations: Path) -> Run:
    """The run in this folder; one that cannot go on begins again."""
    if (folder / "settings.json").exists():
        try:
            return Run(folder, choice, seed, make_controller, True, imitations=imitations)
        except AgentFileError:
            for path in folder.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
    return Run(folder, choice, seed, make_controller, imitations=imitations)


def _to_json(plan: Plan, row: Row, seed: int, run: Run, stages: Mapping[str, Floats]) -> bytes:
    facts = {
        "row": row.name,
        "seed": seed,
        "settings": asdict(run.choice),
        "judged": judged_on(),
        "provenance": {**provenance(), "sessions": [each.get("git_commit") for each in run.sessions]},
        "validations": [{name: float(value) for name, value in line.items()} for line in run.rows],
        "stages": {
            stage: {name: [_rounded(value) for value in column] for name, column in zip(FIGURES, values.T, strict=True)}
            for stage, values in stages.items()
        },
    }
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(value, allow_nan=False)}" for name, value in facts.items())
    return f"{{\n{lines}\n}}\n".encode()


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")


def read_finished(plan: Plan, row: Row, seed: int) -> Finished | None:
    """A finished run, None if there is none; ValueError if it is of other settings, or damaged."""
    path = path_of(plan, row, seed)
    if not path.exists():
        return None
    told = read_json(path)
    found = _parsed(told) if isinstance(told, dict) else None
    if found is None or (found.row, found.seed) != (row.name, seed):
        raise ValueError(f"{path}: not a finished run of this ablation, or damaged; move it away to run it again")
    wanted = json.loads(json.dumps(asdict(row.of(plan.steps))))
    if _completed(found.settings) != wanted or told.get("judged") != judged_on():
        raise ValueError(f"{path}: made with other settings; move it away, or choose another --out or --steps")
    return found


def read_all(plan: Plan, rows: Iterable[Row], seeds: Iterable[int]) -> dict[str, list[Finished]]:
    """Every finished run by row, in the order of seeds; rows without one are left out."""
    wanted = list(seeds)
    found = {row.name: [run for seed in wanted if (run := read_finished(plan, row, seed))] for row in rows}
    return {name: runs for name, runs in found.items() if runs}


def _completed(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """The settings of a kept run, with those that did not exist yet."""
    for path, value in SINCE.items():
        place: Any = settings
        for name in path[:-1]:
            place = place.get(name) if isinstance(place, dict) else None
        if isinstance(place, dict):
            place.setdefault(path[-1], value)
    return settings


def _parsed(told: Mapping[str, Any]) -> Finished | None:
    try:
        stages = {
            str(stage): np.array([columns[name] for name in FIGURES], np.float64).T
            for stage, columns in told["stages"].items()
        }
        found = Finished(str(told["row"]), int(told["seed"]), dict(told["settings"]), stages)
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    shape = len(JUDGING), len(FIGURES)
    sound = all(values.shape == shape and math.isfinite(values.sum()) for values in stages.values())
    return found if sound and {"best", "last"} <= set(stages) else None
