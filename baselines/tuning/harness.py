"""What the tuning commands share: budget, history, resume, choice on validation seeds, report.

A search scores candidates on training seeds and keeps every one of them in a file. The best, the finalists, are scored
on validation seeds, and the best there is chosen and written into the same file. Test seeds are never touched. The same
command goes on where it stopped.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from cz_gym.atomic_files import check_writable, naming, write_files
from cz_gym.config import Config, make_config
from cz_gym.errors import CzError
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout

DIGITS = 4
"""Significant digits of a candidate's values."""


class Parameter(NamedTuple):
    """One number of a controller's settings, searched over a range."""

    path: str
    """Where it stands, fields joined by dots."""
    low: float
    high: float
    log: bool = True
    """Whether the range is searched logarithmically."""


class Figures(NamedTuple):
    """Mean figures over episodes."""

    rmse_mm: float
    """Radius error that a sensor can show [mm]."""
    pull_step: float
    """Pull step RMS [mm/min]."""
    heater_step: float
    """Heater step RMS [kW]."""
    mean_return: float
    failure_rate: float
    steps: int
    """Steps of an episode."""


class Trial(NamedTuple):
    """A candidate with its score, which is minimised, and what else is known of it."""

    values: tuple[float, ...]
    """In the order of the parameters."""
    score: float
    facts: dict[str, Any]


Score = tuple[float, dict[str, Any]]
"""Score and facts."""


def measure(policy: Any, config: Config, seeds: Sequence[int]) -> Figures:
    """Run a controller on those episodes; figures to six digits, as the history keeps them."""
    found = metrics(rollout(policy, config, seeds))
    names = "rmse_observable_mm", "pull_step_rms_mm_per_min", "heater_step_rms_kw", "return_", "failure_rate"
    return Figures._make([*(float(f"{getattr(found, name).mean():.6g}") for name in names), config.steps])


def value_at(settings: Any, path: str) -> float:
    """The value of a parameter."""
    return float(attrgetter(path)(settings))


def with_value(settings: Any, path: str, value: float) -> Any:
    """The settings with another value of a parameter; AttributeError if there is no such parameter."""
    head, _, rest = path.partition(".")
    inner = getattr(settings, head)
    return replace(settings, **{head: with_value(inner, rest, value) if rest else value})


def rounded(values: Iterable[float]) -> tuple[float, ...]:
    """Values as candidates have them: to a few significant digits."""
    return tuple(float(f"{value:.{DIGITS}g}") for value in values)


def file_name(controller: str, scenario: str) -> str:
    """The file of that search in results/tuning."""
    return f"{controller}.json" if scenario == "randomized" else f"{controller}-{scenario}.json"


class Search(ABC):
    """A controller's search on a scenario; subclasses say how it is scored and how candidates are found."""

    def __init__(
        self, controller: str, scenario: str, base: Any, parameters: Sequence[Parameter], budget: Mapping[str, int]
    ) -> None:
        """``base`` are the settings in which the parameters are searched; ``budget`` is checked."""
        self.controller, self.config, self.base, self.parameters = controller, make_config(scenario), base, parameters
        self.budget, self.trials = dict(budget), list[Trial]()
        self.path: Path | None = None
        """Where every trial is written; None: nowhere."""

    @abstractmethod
    def training_score(self, settings: Any) -> Score:
        """Score on training episodes."""

    @abstractmethod
    def validation_score(self, settings: Any) -> Score:
        """Score on validation episodes."""

    @abstractmethod
    def run(self) -> None:
        """Add candidates to the trials, as the budget allows."""

    def finalists(self) -> Iterable[Iterable[float]]:
        """Values of the candidates that meet the validation seeds."""
        return [trial.values for trial in self.best(self.budget["finalists"])]

    def settings(self, values: Iterable[float]) -> Any:
        """The settings with these values of the parameters."""
        settings = self.base
        for parameter, value in zip(self.parameters, values, strict=True):
            settings = with_value(settings, parameter.path, value)
        return settings

    def add(self, values: Iterable[float]) -> Trial:
        """Try a candidate; its values are rounded."""
        values = rounded(values)
        self.trials.append(Trial(values, *self.training_score(self.settings(values))))
        self._write({})
        return self.trials[-1]

    def best(self, count: int) -> list[Trial]:
        """The best candidates, best first, each once."""
        each = {trial.values: trial for trial in self.trials}
        return sorted(each.values(), key=lambda trial: trial.score)[:count]

    @property
    def best_score(self) -> float:
        """The best score so far."""
        return min((trial.score for trial in self.trials), default=math.inf)

    def tune(self, path: Path, history: Path | None = None) -> Trial:
        """Search, choose and write the file at ``path``; or choose from the ``history`` of an earlier search."""
        check_writable(path.parent)
        self.path = path
        if history is not None:
            begun, self.trials = self._read(history)
            self.budget |= begun
        elif path.exists():
            begun, self.trials = self._read(path)
            if begun != {name: self.budget[name] for name in begun}:
                raise CzError(f"{path} was begun with {begun}; ask for the same, or write another file")
        if history is None:
            self.run()
        found = (
            Trial(values, *self.validation_score(self.settings(values))) for values in map(rounded, self.finalists())
        )
        judged = sorted(found, key=lambda trial: trial.score)
        self._write({"chosen": self._entry(judged[0]), "finalists": [self._entry(trial) for trial in judged]})
        return judged[0]

    def _read(self, path: Path) -> tuple[dict[str, int], list[Trial]]:
        """Training episodes and trials of a file; ValueError if it is none, or of another search."""
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
