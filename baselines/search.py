"""A search of a controller's settings: candidates, history, resume, choice on validation seeds.

SciPy's COBYLA proposes candidates, which are scored on training seeds and stored in a file; the best of the finalists
on validation seeds is chosen. COBYLA is deterministic: the same command meets the candidates of a search that was
stopped again, measures none of them again, and continues.
"""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.config import Config
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS
from cz_gym.puller.file import DEFAULT
from cz_gym.support.errors import CzError
from cz_gym.support.files import check_writable, name_file_in_errors, write_files

from .margins import MarginLimits, Openings, worst_margins
from .policy import Floats
from .tuned import Limit, Measure, Objective, value_at, with_values

FIRST_STEP = 0.5
"""COBYLA's first step, in natural logarithms of the parameters."""
QUICK_STEP = 0.05
"""Step of COBYLA below which a quick search ends, in the same units."""
FINALISTS = 3
"""Number of candidates that are scored on validation seeds, on twice as many episodes as training candidates."""
SURVIVAL_SEEDS = TRAINING_SEEDS[100_000:]
"""Training seeds of the episodes that only have to be survived: a fifth of the episodes of a candidate."""


class Trial(NamedTuple):
    """A scored candidate."""

    values: tuple[float, ...]
    """Values of the parameters, in their order."""
    score: float
    """Cost with the prices of missed limits and lost crystals."""
    facts: dict[str, Any]
    """Figures behind the score."""


class _Spent(Exception):
    """Ends COBYLA when all candidates are tried: by itself it tries at least its number of variables plus two."""


class Search:
    """The search of a controller's settings in an environment."""

    def __init__(
        self,
        controller: str,
        objective: Objective,
        config: Config,
        trials: int,
        episodes: int,
        measure: Measure | None = None,
        quick: bool = False,
        margins: MarginLimits | None = None,
    ) -> None:
        """At most ``trials`` candidates, each on ``episodes`` training episodes; a ``quick`` search ends at QUICK_STEP,
        and only its finalists have to survive other scenarios. Within ``margins`` no crystal may be lost either.
        """
        if margins:
            objective = replace(objective, limits=(*objective.limits, *robustness(margins, config)))
        self.margins = margins
        self.controller, self.objective, self.config, self.quick = controller, objective, config, quick
        self.measure = measure or objective.measure
        self.budget, self.trials = {"trials": trials, "episodes": episodes}, list[Trial]()
        self.path: Path | None = None
        """File of the trials; None for none."""
        self.progress: Callable[[int], Any] = lambda candidates: None
        """Called with the number of candidates done, finalists counted once more."""
        self._paths = [parameter.path for parameter in objective.parameters]

    @property
    def first(self) -> tuple[float, ...]:
        """The values with which the search begins: those of the objective's start, within their ranges."""
        return tuple(p.value(p.coordinate(value_at(self.objective.start, p.path))) for p in self.objective.parameters)

    def settings(self, values: Iterable[float]) -> Any:
        """The settings with these values of the parameters."""
        return with_values(self.objective.start, dict(zip(self._paths, values, strict=True)))

    def explore(self) -> None:
        """Minimise the objective with COBYLA while every limit is kept."""
        from scipy.optimize import NonlinearConstraint, minimize

        aim = self.objective

        def tried(point: Floats) -> tuple[tuple[float, ...], Any]:
            values = tuple(p.value(x) for p, x in zip(aim.parameters, point, strict=True))
            trial = {trial.values: trial for trial in self.trials}.get(values)
            if trial is None and len(self.trials) >= self.budget["trials"]:
                raise _Spent
            return values, aim.kind(**(trial or self.add(values)).facts["figures"])

        def cost(point: Floats) -> float:
            values, scores = tried(point)
            return aim.cost(scores, self.settings(values).for_config(self.config))

        def distances(point: Floats) -> tuple[float, ...]:
            values, scores = tried(point)
            policy = self.settings(values).for_config(self.config)
            return tuple(limit(scores, policy) for limit in aim.limits)

        start = np.array([p.coordinate(value) for p, value in zip(aim.parameters, self.first, strict=True)])
        limits: Any = [NonlinearConstraint(distances, 0.0, np.inf)] if aim.limits else []
        last_step = QUICK_STEP if self.quick else 1e-3
        most = max(self.budget["trials"], len(start) + 2)
        options: Any = {"maxiter": most, "rhobeg": FIRST_STEP, "tol": last_step}
        with suppress(_Spent):
            minimize(cost, start, method="COBYLA", constraints=limits, options=options)

    def add(self, values: tuple[float, ...]) -> Trial:
        """Score a candidate on training episodes; one that would be the best must also survive other scenarios."""
        episodes = self.budget["episodes"]
        best = min((trial.score for trial in self.trials), default=math.inf)
        trial = self._scored(values, TRAINING_SEEDS[:episodes], 0 if self.quick else episodes // 5, best)
        self.trials.append(trial)
        self._write({})
        self.progress(len(self.trials))
        return trial

    def _scored(self, values: tuple[float, ...], seeds: Sequence[int], survive: int, below: float = math.inf) -> Trial:
        """The candidate's trial on those seeds; survival counts if its score is ``below`` a limit."""
        settings = self.settings(values)
        policy = settings.for_config(self.config)
        scores = self.measure(policy, self.config, seeds)
        score = self.objective.score(scores, policy)
        lost: dict[str, float] = {}
        if survive and score < below:
            for name in self.objective.survive:
                config = self.config.with_scenario(name)
                lost[name] = self.measure(settings.for_config(config), config, SURVIVAL_SEEDS[:survive]).failure_rate
        facts = {"figures": scores._asdict(), "lost": lost}
        return Trial(values, score + self.objective.failure_price * sum(lost.values()), facts)

    def best(self, count: int) -> list[Trial]:
        """The best candidates, best first."""
        return sorted(self.trials, key=lambda trial: trial.score)[:count]

    def tune(self, path: Path) -> Trial:
        """Search, choose, and write the file at ``path``; a search that was stopped continues from its file."""
        check_writable(path.parent)
        self.path = path
        if path.exists():
            self._read(path)
        self.explore()
        twice = 2 * self.budget["episodes"]
        finalists = []
        for trial in self.best(FINALISTS):
            finalists.append(self._scored(trial.values, VALIDATION_SEEDS[:twice], twice))
            self.progress(len(self.trials) + len(finalists))
        judged = sorted(finalists, key=lambda trial: trial.score)
        entries = [
            {"score": trial.score, "values": dict(zip(self._paths, trial.values, strict=True)), **trial.facts}
            for trial in judged
        ]
        for entry, trial in zip(entries if self.margins else (), judged, strict=False):
            found = worst_margins(self.settings(trial.values).for_config(self.config), self.config)
            entry["margins"] = written(found)
        self._write({"chosen": entries[0], "finalists": entries})
        return judged[0]

    def _read(self, path: Path) -> None:
        """Take up the trials of a file; CzError if it is none, or of another search."""
        try:
            with name_file_in_errors(path):
                file = json.loads(path.read_text("utf-8"))
            parameters, puller = file["parameters"], file.get("puller", DEFAULT.label)
            crystals = file["scenario_hash"], file.get("control_interval_s", self.config.puller.control_interval)
            self.trials = [Trial(tuple(values), score, facts) for values, score, facts in file["history"]]
            episodes, margins = file["budget"]["episodes"], file.get("margins")
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise CzError(f"{path} is no history of this search: {error!r}") from None
        if parameters != self._paths:
            raise CzError(f"{path}: its parameters are not those of {self.controller}: remove it to begin anew")
        if puller != self.config.puller.label:
            raise CzError(f"{path}: found for puller {puller}: remove it to begin anew")
        if crystals != (self.config.scenario.hash, self.config.control_interval):
            raise CzError(f"{path} was begun on other crystals or at another control interval: write another file")
        if margins != (self.margins and list(self.margins)):
            was, now = (",".join(f"{each:g}" for each in limits or ()) or "off" for limits in (margins, self.margins))
            raise CzError(f"{path} was begun with --margins {was}, not {now}: write another file")
        if episodes != self.budget["episodes"]:
            raise CzError(f"{path} was begun with {episodes} episodes; ask for as many, or write another file")

    def _write(self, choice: Mapping[str, Any]) -> None:
        if self.path is None:
            return
        about: dict[str, Any] = {
            "controller": self.controller,
            "scenario": self.config.scenario.name,
            "scenario_hash": self.config.scenario.hash,
            "budget": self.budget,
        }
        if self.config.puller != DEFAULT:
            about["puller"] = self.config.puller.label
        if self.config.control_interval != self.config.puller.control_interval:
            about["control_interval_s"] = self.config.control_interval
        if self.margins:
            about["margins"] = list(self.margins)
        lines = ",\n  ".join(map(json.dumps, self.trials))
        head = json.dumps({**about, **choice, "parameters": self._paths}, indent=1).removesuffix("\n}")
        write_files({self.path: f'{head},\n "history": [\n  {lines}\n ]\n}}\n'.encode()})


def robustness(margins: MarginLimits, config: Config) -> tuple[Limit, ...]:
    """Limits of a search: the margins at every opening on the worse of Models I and II, and no crystal lost."""

    @lru_cache(maxsize=8)
    def slacks(policy: Any) -> tuple[float, ...]:
        return margins.slacks(worst_margins(policy, config))

    def slack(which: int) -> Limit:
        return lambda scores, policy: slacks(policy)[which]

    return (*map(slack, range(len(margins))), lambda scores, policy: -scores.failure_rate)


def written(openings: Openings) -> dict[str, dict[str, float | None]]:
    """Margins for a file, by opening; None for an infinite one."""
    return {
        place: {name: float(f"{value:.4g}") if math.isfinite(value) else None for name, value in each._asdict().items()}
        for place, each in openings._asdict().items()
    }
