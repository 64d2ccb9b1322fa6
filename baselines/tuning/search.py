"""A search of a controller's settings: candidates, history, resume, choice on validation seeds.

Candidates are scored on training seeds, and every one of them is kept in a file. The best ones, the finalists, are
scored on validation seeds; the best of these is chosen and written into the same file. Test seeds are never used. The
same command continues a search that was stopped.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from cz_gym.atomic_files import check_writable, naming, write_files
from cz_gym.baselines.lqg.regulator import STEP_TIME
from cz_gym.config import Config
from cz_gym.errors import CzError
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout

DIGITS = 4
"""Number of significant digits of a candidate's values."""
SURVIVAL_SEEDS = TRAINING_SEEDS[100_000:]
"""Training seeds of the episodes that only have to be survived."""


class Parameter(NamedTuple):
    """One number of a controller's settings and the range of its search."""

    path: str
    """Fields of the settings, joined by dots."""
    low: float
    high: float
    log: bool = True
    """Whether the range is searched logarithmically."""


class Figures(NamedTuple):
    """Mean figures over episodes."""

    rmse_mm: float
    """Observable radius error [mm]."""
    pull_step: float
    """Pull step RMS [mm/min]; at other control intervals than 5 s, that of steps of the same slope over 5 s."""
    heater_step: float
    """Heater step RMS [kW], likewise."""
    mean_return: float
    failure_rate: float
    steps: int
    """Number of steps of an episode."""


class Trial(NamedTuple):
    """A scored candidate."""

    values: tuple[float, ...]
    """Values of the parameters, in their order."""
    score: float
    """What the search minimises."""
    facts: dict[str, Any]
    """Figures behind the score."""


Measure = Callable[[Any, Config, Sequence[int]], Figures]


def measure(policy: Any, config: Config, seeds: Sequence[int]) -> Figures:
    """Run a controller on those episodes; figures have six digits, as in the history."""
    found, per_step = metrics(rollout(policy, config, seeds)), STEP_TIME / config.control_interval
    values = (
        found.rmse_observable_mm.mean(),
        per_step * found.pull_step_rms_mm_per_min.mean(),
        per_step * found.heater_step_rms_kw.mean(),
        found.return_.mean(),
        found.failure_rate.mean(),
    )
    return Figures._make([*(float(f"{value:.6g}") for value in values), config.steps])


def value_at(settings: Any, path: str) -> float:
    """The value of a parameter."""
    return float(attrgetter(path)(settings))


def with_value(settings: Any, path: str, value: float) -> Any:
    """The settings with another value of a parameter; settings are dataclasses or NamedTuples."""
    head, _, rest = path.partition(".")
    new = with_value(getattr(settings, head), rest, value) if rest else value
    change = settings._replace if hasattr(settings, "_replace") else partial(replace, settings)
    return change(**{head: new})


def rounded(values: Iterable[float]) -> tuple[float, ...]:
    """Values to the significant digits of a candidate."""
    return tuple(float(f"{value:.{DIGITS}g}") for value in values)


def file_name(controller: str, scenario: str) -> str:
    """Name of a search's file in results/tuning."""
    return f"{controller}.json" if scenario == "randomized" else f"{controller}-{scenario}.json"


@dataclass(frozen=True)
class Goal(ABC):
    """The aim of a controller's search on a scenario."""

    start: Any
    """Settings with which the search begins; what is no parameter stays as it is here."""
    parameters: tuple[Parameter, ...]
    survive: tuple[str, ...]
    """Scenarios that only have to be survived."""

    failure_price: ClassVar[float]
    """Cost of losing every crystal."""

    @abstractmethod
    def policy(self, settings: Any, config: Config) -> Any:
        """The controller with these settings."""

    @abstractmethod
    def cost(self, found: Figures, policy: Any) -> float:
        """Score of the figures on the scenario itself, failures included; less is better."""

    @abstractmethod
    def propose(self, search: Search) -> None:
        """Add candidates to the search, as its budget allows."""

    def finalists(self, best: list[Trial]) -> list[tuple[float, ...]]:
        """Values of the candidates that are scored on validation seeds."""
        return [trial.values for trial in best]


class Search:
    """The search of a controller's settings in an environment."""

    def __init__(
        self, controller: str, goal: Goal, config: Config, budget: Mapping[str, int], measure: Measure = measure
    ) -> None:
        """``budget`` holds the options of the command line that bound the search; tests replace ``measure``."""
        self.controller, self.goal, self.config, self.measure = controller, goal, config, measure
        self.parameters, self.budget, self.trials = goal.parameters, dict(budget), list[Trial]()
        self.path: Path | None = None
        """File of the trials; None for none."""

    def settings(self, values: Iterable[float]) -> Any:
        """The settings with these values of the parameters."""
        settings = self.goal.start
        for parameter, value in zip(self.parameters, values, strict=True):
            settings = with_value(settings, parameter.path, value)
        return settings

    def add(self, values: Iterable[float]) -> Trial:
        """Score a candidate on training episodes; one that would be the best must also survive other scenarios."""
        values = rounded(values)
        trial = self._scored(values, TRAINING_SEEDS[: self.budget["episodes"]], self.budget["survive"], self.best_score)
        self.trials.append(trial)
        self._write({})
        return trial

    def _scored(self, values: tuple[float, ...], seeds: Sequence[int], survive: int, below: float = math.inf) -> Trial:
        """The candidate's trial on those seeds; survival counts if its score is ``below`` a limit."""
        settings = self.settings(values)
        policy = self.goal.policy(settings, self.config)
        found = self.measure(policy, self.config, seeds)
        score = self.goal.cost(found, policy)
        lost: dict[str, float] = {}
        if survive and score < below:
            for name in self.goal.survive:
                config = self.config.with_scenario(name)
                other = self.goal.policy(settings, config)
                lost[name] = self.measure(other, config, SURVIVAL_SEEDS[:survive]).failure_rate
        facts = {"figures": found._asdict(), "lost": lost}
        return Trial(values, score + self.goal.failure_price * sum(lost.values()), facts)

    def best(self, count: int) -> list[Trial]:
        """The best candidates without repetition, best first."""
        each = {trial.values: trial for trial in self.trials}
        return sorted(each.values(), key=lambda trial: trial.score)[:count]

    @property
    def best_score(self) -> float:
        """The best score so far."""
        return min((trial.score for trial in self.trials), default=math.inf)

    def tune(self, path: Path) -> Trial:
        """Search, choose, and write the file at ``path``; a search that was stopped continues from its file."""
        check_writable(path.parent)
        self.path = path
        if path.exists():
            begun, self.trials = self._read(path)
            if begun != {name: self.budget[name] for name in begun}:
                raise CzError(f"{path} was begun with {begun}; ask for the same, or write another file")
        self.goal.propose(self)
        seeds = VALIDATION_SEEDS[: self.budget["validation"]]
        finalists = self.goal.finalists(self.best(self.budget["finalists"]))
        found = [self._scored(rounded(values), seeds, self.budget["finals"]) for values in finalists]
        judged = sorted(found, key=lambda trial: trial.score)
        self._write({"chosen": self._entry(judged[0]), "finalists": [self._entry(trial) for trial in judged]})
        return judged[0]

    def _read(self, path: Path) -> tuple[dict[str, int], list[Trial]]:
        """Training episodes and trials of a file; CzError if it is none, or of another search."""
        try:
            with naming(path):
                found = json.loads(path.read_text("utf-8"))
            begun = {name: found["budget"][name] for name in ("episodes", "survive")}
            if found["parameters"] != self._paths:
                raise CzError(f"its parameters are not those of {self.controller}")
            return begun, [Trial(tuple(values), score, facts) for values, score, facts in found["history"]]
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise CzError(f"{path} is no history of this search: {error!r}") from None

    def _entry(self, trial: Trial) -> dict[str, Any]:
        return {"score": trial.score, "values": dict(zip(self._paths, trial.values, strict=True)), **trial.facts}

    @property
    def _paths(self) -> list[str]:
        return [parameter.path for parameter in self.parameters]

    def _write(self, choice: Mapping[str, Any]) -> None:
        if self.path is None:
            return
        about = {
            "controller": self.controller,
            "scenario": self.config.scenario.name,
            "scenario_hash": self.config.scenario.hash,
            "budget": self.budget,
        }
        lines = ",\n  ".join(map(json.dumps, self.trials))
        head = json.dumps({**about, **choice, "parameters": self._paths}, indent=1).removesuffix("\n}")
        write_files({self.path: f'{head},\n "history": [\n  {lines}\n ]\n}}\n'.encode()})
