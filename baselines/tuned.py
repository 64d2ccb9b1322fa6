"""Tuned controllers: a record each, and the values that searches have chosen, by scenario or for a puller.

Values for the default puller are in ``cz_gym/puller/shipped/default``, a file a controller and scenario; those for
another puller are in the folder beside its file. Each file has the history of its search (``cz-gym tune``).
"""

import json
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from cz_gym.body.process import BODY
from cz_gym.config import Config, make_config
from cz_gym.episodes.scenario import Scenario
from cz_gym.episodes.scenarios import HARD, PULLER, RANDOMIZED, SENSOR_FAULT, find_scenario
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import Contender
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.plant import make_puller
from cz_gym.process import Process
from cz_gym.puller.file import DEFAULT, FOLDER, PullerFile
from cz_gym.support.errors import CzError

from .lqg import STEP_TIME, LQGDesign
from .lqg_filter import expect_errors, ring_of
from .margins import MarginLimits

TUNED = (RANDOMIZED, HARD, SENSOR_FAULT, PULLER)
"""Scenarios that controllers are tuned on, the least demanding first."""
MUST_COVER = {
    "sensor": ("pyrometer_drift", "ripple", "latency", "outlier_probability", "outlier_sd"),
    "faults": ("flagged", "flagged_duration", "unflagged", "unflagged_duration", "dropout"),
    "actuators": ("pull_window", "pull_slew", "heater_slew", "heater_step"),
}
"""Fields, by family, in which a tuned scenario must be as demanding as the one that its settings serve."""
PREFER_COVER = {"interface": ("sd",), "sensor": ("camera_noise", "pyrometer_noise")}
"""Fields in which the tuned scenario should be as demanding too, if there is such a one."""


def file_name(controller: str, scenario: str) -> str:
    """Name of the file of a search on the default puller."""
    return f"{controller}.json" if scenario == RANDOMIZED.name else f"{controller}-{scenario}.json"


def folder_of(puller: PullerFile) -> Path:
    """The folder of the searches for a puller: beside its file, with its name."""
    return (puller.file or Path(f"{puller.name}.toml")).with_suffix("")


@lru_cache(maxsize=128)
def by_scenario(controller: str) -> Mapping[str, Mapping[str, float]]:
    """The values chosen for a controller on the default puller, by tuned scenario and by path."""
    paths = {each.name: FOLDER / DEFAULT.name / file_name(controller, each.name) for each in TUNED}
    chosen = {name: path for name, path in paths.items() if path.is_file()}
    return {name: json.loads(path.read_text("utf-8"))["chosen"]["values"] for name, path in chosen.items()}


def for_scenario(controller: str, scenario: Scenario) -> Mapping[str, float]:
    """The values of the least demanding tuned scenario that covers this one; a warning names what none covers."""
    chosen = by_scenario(controller)
    known = [each for each in TUNED if each.name in chosen]
    fit = [each for each in known if not beyond(scenario, each)]
    if not fit:
        nearest = min(reversed(known), key=lambda each: len(beyond(scenario, each)))
        fields = ", ".join(beyond(scenario, nearest))
        warnings.warn(
            f"{controller} was not tuned for {fields} of scenario {scenario.name!r}: it has the settings "
            f"for {nearest.name!r}",
            stacklevel=2,
        )
        fit = [nearest]
    preferred = [each for each in fit if not beyond(scenario, each, PREFER_COVER)]
    return chosen[(preferred or fit)[0].name]


def for_puller(controller: str, puller: PullerFile) -> Mapping[str, float]:
    """The values that a search has chosen for a puller's file, by path; empty if there are none.

    CzError if they were chosen for other numbers of the puller.
    """
    path = folder_of(puller) / f"{controller}.json"
    if puller.file is None or path.parent == FOLDER / DEFAULT.name or not path.is_file():
        return {}
    try:
        search = json.loads(path.read_text("utf-8"))
        values = {name: float(value) for name, value in search.get("chosen", {"values": {}})["values"].items()}
        label, known = search["puller"], search.get("parameters", list(values))
        if not all(map(math.isfinite, values.values())) or not values.keys() <= set(known):
            raise ValueError
    except (AttributeError, KeyError, TypeError, ValueError):
        raise CzError(f"{path}: no choice of a search, or damaged") from None
    if label != puller.label:
        raise CzError(f"{path}: found for puller {label}, not for {puller.label}: tune again")
    return values


def with_values(settings: Any, values: Mapping[str, float]) -> Any:
    """The settings, dataclasses or NamedTuples, with other numbers, by their paths."""
    for path, value in values.items():
        head, _, rest = path.partition(".")
        new = with_values(getattr(settings, head), {rest: value}) if rest else value
        change = settings._replace if hasattr(settings, "_replace") else partial(replace, settings)
        settings = change(**{head: new})
    return settings


def beyond(scenario: Scenario, tuned: Scenario, fields: Mapping[str, tuple[str, ...]] = MUST_COVER) -> list[str]:
    """The fields in which a scenario asks for more than a tuned one."""
    found = []
    for family, name in ((family, name) for family, several in fields.items() for name in several):
        asked, known = (getattr(each, family) for each in (scenario, tuned))
        sign = -1.0 if getattr(type(known)(), name) == math.inf else 1.0  # a lower limit is the harder one
        most, covered = (
            max(map(abs, value)) if isinstance(value, tuple) else abs(value)
            for value in (getattr(asked, name), getattr(known, name))
        )
        if sign * most > sign * covered:
            found.append(f"{family}.{name}")
    return found


# The record of a tuned controller, and the objective of its searches.

DIGITS = 4
"""Number of significant digits of a candidate's values."""
LINEAR = 5.0
"""Length of a range that is not searched logarithmically, in natural logarithms of the others."""
NEAR = 8.0
"""Factor that a search for a puller may go from the scaled settings [-]."""


class Parameter(NamedTuple):
    """One number of a controller's settings and the range of its search."""

    path: str
    """Fields of the settings, joined by dots."""
    low: float
    high: float
    log: bool = True
    """Searches the range logarithmically."""

    def coordinate(self, value: float) -> float:
        """The place of a value in the space of the search."""
        inside = min(max(value, self.low), self.high)
        return math.log(inside) if self.log else LINEAR * (inside - self.low) / (self.high - self.low)

    def value(self, coordinate: float) -> float:
        """The value at a place, within the range, with the digits of a candidate."""
        free = math.exp(coordinate) if self.log else self.low + (self.high - self.low) * coordinate / LINEAR
        return float(f"{min(max(free, self.low), self.high):.{DIGITS}g}")

    def near(self, settings: Any) -> "Parameter":
        """The parameter with a range around its value in those settings, if it is searched logarithmically."""
        value = value_at(settings, self.path)
        return self._replace(low=value / NEAR, high=value * NEAR) if self.log else self


def value_at(settings: Any, path: str) -> float:
    """The value of a parameter."""
    return float(attrgetter(path)(settings))


class Scores(NamedTuple):
    """Means over episodes that a candidate is judged by."""

    rmse_mm: float
    """Observable radius error [mm]."""
    pull_step: float
    """Pull step RMS [mm/min]; at other control intervals than 5 s, that of steps of the same slope over 5 s."""
    heater_step: float
    """Heater step RMS [kW], likewise."""
    pull_outside: float
    """Share of time in which the 30 min mean of the pull speed is off nominal by more than 3 % [-]."""
    mean_return: float
    failure_rate: float
    steps: int
    """Number of steps of an episode."""

    def __str__(self) -> str:
        lost = f"{100 * self.failure_rate:.0f} % lost"
        return f"RMSE {self.rmse_mm:.3f} mm, {lost} on validation crystals, half of them with other hot zones"


def measure(policy: Any, config: Config, seeds: Sequence[int]) -> Scores:
    """Run a controller on those episodes; scores have six digits, as in the history."""
    means, per_step = metrics(rollout(policy, config, seeds)), STEP_TIME / config.control_interval
    values = (
        means.rmse_observable_mm.mean(),
        per_step * means.pull_step_rms_mm_per_min.mean(),
        per_step * means.heater_step_rms_kw.mean(),
        1.0 - means.mean_pull_within_3pct.mean(),
        means.return_.mean(),
        means.failure_rate.mean(),
    )
    return Scores._make([*(float(f"{value:.6g}") for value in values), config.steps])


Measure = Callable[[Any, Config, Sequence[int]], Any]
"""Scores of a controller in an environment on the crystals of those seeds."""
Limit = Callable[[Any, Any], float]
"""Distance of a candidate to a limit, by its scores and controller; negative beyond it."""


@dataclass(frozen=True)
class Objective:
    """The least cost within limits: the aim of a search."""

    cost: Callable[[Any, Any], float]
    """Cost of a candidate within the limits, failures included, by its scores and controller; a search minimises it."""
    limits: tuple[Limit, ...]
    failure_price: float
    """Cost of losing every crystal."""
    miss_price: float
    """Price of a negative distance."""
    survive: tuple[str, ...] = ()
    """Scenarios that only have to be survived."""
    kind: type[Any] = Scores
    """Type of the scores that candidates are judged by."""
    measure: Measure = measure
    """Finds the scores of a candidate."""
    start: Any = None
    """Settings with which the search begins; numbers that are no parameters keep their value."""
    parameters: tuple[Parameter, ...] = ()

    def score(self, scores: Any, policy: Any) -> float:
        """The cost plus the price of missed limits."""
        missed = sum(max(0.0, -limit(scores, policy)) for limit in self.limits)
        return self.cost(scores, policy) + self.miss_price * missed


ANY, OWN_PULLER = "any", "own puller"
"""Keys of a controller's objectives: of every other scenario, and of a puller of the user's own."""


@dataclass(frozen=True, kw_only=True)
class TunedController:
    """A tuned controller: the only record of its name, its settings everywhere, and the searches that choose them.

    Its settings are its ``start`` with the values that a search has chosen; ``for_config`` of them makes the controller
    for an environment.
    """

    name: str
    meaning: str
    """Description in one line, for tables."""
    start: Any
    """Settings before any search: a controller, or the design of an LQG."""
    parameters: tuple[Parameter, ...]
    """Numbers that a search varies."""
    robust: tuple[Parameter, ...] = ()
    """Numbers that a search varies too on scenarios that are more demanding than ``randomized``."""
    near: tuple[Parameter, ...] = ()
    """Numbers that ``cz-gym tune --puller`` varies around the scaled settings; none: it leaves the controller out."""
    objectives: Mapping[str, Objective] = field(hash=False)
    """Objectives of its searches, by scenario, with the keys ``ANY`` and ``OWN_PULLER`` too."""
    scale: Callable[[Any, Config], Any] | None
    """Puts settings in proportion to the puller of an environment; None keeps them."""
    margins: MarginLimits | None = None
    """Margins that its searches on scenarios keep; None for none."""
    crystals: Any = RANDOMIZED
    """Crystals of its search on ``randomized``."""
    crystals_on_puller: Any = field(default_factory=lambda: {"randomized": 0.5, "hot-zone": 0.5}, hash=False)
    """Crystals of its search for a puller."""
    stages: Mapping[str, float] | None = field(default=None, hash=False)
    """Shares of the stages among those crystals; None for a controller of the body."""
    begins_with: str = ""
    """Scenario whose settings its searches begin with; by default the scenario of the search, "start" for the start."""
    one_for_all: bool = False
    """Has the settings for ``randomized`` on every scenario."""
    filter_of: str = ""
    """Controller whose filter, searched for a puller, it has there; empty if the search is its own."""
    candidates: int = 6
    """Largest number of candidates of a search for a puller, for each parameter."""
    episodes: int = 20
    """Training episodes of a candidate of a search for a puller."""
    default: bool = True
    """Runs in a benchmark that names no controllers."""
    quoted: bool = False
    """Stands in short tables."""
    on_puller: bool = True
    """Runs in a benchmark on a puller of the user's own that names no controllers."""

    @property
    def process(self) -> Process:
        """Process that the controller acts on."""
        process: Process = getattr(self.start, "process", BODY)
        return process

    def settings(self, scenario: Scenario) -> Any:
        """Tuned settings for a scenario on the default puller; a design has the model of the scenario's instruments."""
        start = self.start
        if isinstance(start, LQGDesign):
            met = PULLER if self.one_for_all else scenario
            noise = expect_errors(start.noise, met, make_puller().Q_H_0)
            start = replace(start, ring=ring_of(met.sensor), noise=noise)
        return with_values(start, for_scenario(self.name, RANDOMIZED if self.one_for_all else scenario))

    def make(self, config: Config) -> Any:
        """The controller for an environment: tuned for its scenario, or scaled to its puller and tuned for that."""
        if self.scale is None or (config.puller == DEFAULT and self.process == BODY):
            scenario = RANDOMIZED if self.one_for_all else config.sole_scenario
            return self.settings(scenario).for_config(config)
        values = for_puller(self.filter_of or self.name, config.puller)
        own = {path: value for path, value in values.items() if not self.filter_of or path.startswith("noise.")}
        return with_values(self.scale(self.settings(RANDOMIZED), config), own).for_config(config)

    def objective(self, scenario: Scenario) -> Objective:
        """The objective of its search on a scenario with the default puller; CzError if there is none."""
        objective = self.objectives.get(scenario.name, self.objectives.get(ANY))
        if objective is None:
            known = (name for name in self.objectives if name != OWN_PULLER)
            raise CzError(f"{self.name} has no goal on {scenario.name!r}, but on {', '.join(known)}")
        begins = find_scenario(self.begins_with) if self.begins_with not in ("", "start") else scenario
        start = self.start if self.begins_with == "start" else self.settings(begins)
        if isinstance(start, LQGDesign):
            met = self.crystals if scenario == RANDOMIZED else scenario
            start = replace(start, noise=expect_errors(start.noise, met, make_puller().Q_H_0))
        more = self.robust if beyond(scenario, RANDOMIZED) else ()
        return replace(objective, start=start, parameters=(*self.parameters, *more))

    def objective_on(self, config: Config) -> Objective:
        """The objective of its search for the puller of an environment, near the settings in proportion to it."""
        assert self.scale is not None
        start = self.scale(self.settings(RANDOMIZED), config)
        near = tuple(each.near(start) for each in self.near)
        return replace(self.objectives[OWN_PULLER], start=start, parameters=near)

    def search_config(self, scenario: Scenario, interval: float | None = None, puller: Any = None) -> Config:
        """The environment of its search on a scenario, or for a puller of the user's own."""
        crystals = self.crystals if scenario == RANDOMIZED else scenario
        return make_config(
            crystals if puller is None else self.crystals_on_puller, None, "measured", interval,
            action="direct", puller=puller, process=self.process, stage=self.stages,
        )  # fmt: skip

    @property
    def contender(self) -> Contender:
        """The controller as a row of the benchmark."""
        alike = "name", "make", "meaning", "default", "on_puller", "quoted"
        return Contender(
            observation="measured", told=not self.one_for_all, **{each: getattr(self, each) for each in alike}
        )
