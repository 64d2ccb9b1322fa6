"""Values that searches have chosen for controllers, by scenario for the default puller, or for another puller.

Those of the default puller are in ``cz_gym/puller/shipped/default``, a file a controller and scenario; those of
another puller are in the folder beside its file. Each file has the history of its search (``cz-gym tune``).
"""

import json
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from cz_gym.config import Config
from cz_gym.episodes.scenario import Distribution, Scenario, make_mixture
from cz_gym.episodes.scenarios import HARD, HOT_ZONE, PULLER, RANDOMIZED, SENSOR_FAULT
from cz_gym.evaluation.protocol import Contender
from cz_gym.puller.file import DEFAULT, FOLDER, PullerFile
from cz_gym.support.errors import CzError

from .lqg import LQG, LQGDesign

TUNED = (RANDOMIZED, HARD, SENSOR_FAULT, PULLER)
"""Scenarios that controllers are tuned on, the least demanding first."""
MUST_COVER = {
    "sensor": ("pyrometer_drift", "ripple", "latency", "outlier_probability", "outlier_sd"),
    "faults": ("flagged", "flagged_duration", "unflagged", "unflagged_duration", "dropout"),
    "actuators": ("pull_window", "pull_slew", "heater_slew", "heater_step"),
}
"""Fields, by family, in which a tuned scenario must be as demanding as the one that its settings serve."""
PREFER_COVER = {"interface": ("sd",), "sensor": ("camera_noise", "pyrometer_noise")}
"""Fields in which it should be, if there is such a tuned scenario."""


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
    names = [(family, name) for family, several in fields.items() for name in several]
    return [f"{family}.{name}" for family, name in names if _exceeds(getattr(scenario, family), tuned, family, name)]


def _exceeds(asked: Any, tuned: Scenario, family: str, name: str) -> bool:
    known = getattr(tuned, family)
    sign = -1.0 if getattr(type(known)(), name) == math.inf else 1.0  # a lower limit is the harder one
    return sign * _largest(getattr(asked, name)) > sign * _largest(getattr(known, name))


def _largest(value: Any) -> float:
    """The largest absolute value of a number or a range."""
    return float(max(map(abs, value)) if isinstance(value, tuple) else abs(value))


# The record of a tuned controller, and the aim of its searches.

DIGITS = 4
"""Number of significant digits of a candidate's values."""
LINEAR = 5.0
"""Length of a range that is not searched logarithmically, in natural logarithms of the others."""
NEAR = 8.0
"""How far, as a factor, a search for a puller goes from the scaled settings [-]."""


class Parameter(NamedTuple):
    """One number of a controller's settings and the range of its search."""

    path: str
    """Fields of the settings, joined by dots."""
    low: float
    high: float
    log: bool = True
    """Whether the range is searched logarithmically."""

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


class Figures(NamedTuple):
    """Mean figures over episodes."""

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


Limit = Callable[[Figures, Any], float]
"""Distance of a candidate to a limit, by its figures and controller; negative beyond it."""


@dataclass(frozen=True)
class Goal:
    """The aim of a search: the least objective within limits."""

    start: Any
    """Settings with which the search begins; numbers that are no parameters keep their value."""
    parameters: tuple[Parameter, ...]
    survive: tuple[str, ...]
    """Scenarios that only have to be survived."""
    objective: Callable[[Any], float]
    """Score within the limits, failures included; a search minimises it."""
    limits: tuple[Limit, ...]
    failure_price: float
    """Cost of losing every crystal."""
    miss_price: float
    """Price of a negative distance."""
    kind: type[Any] = Figures
    """Type of the figures that candidates are judged by."""

    def policy(self, settings: Any, config: Config) -> Any:
        """The controller with these settings, which are an LQG's design or a controller, for an environment."""
        return (LQG(design=settings) if isinstance(settings, LQGDesign) else settings).for_config(config)

    def cost(self, figures: Any, policy: Any) -> float:
        """The objective plus the price of missed limits: the score of the figures on the scenario itself."""
        missed = sum(max(0.0, -limit(figures, policy)) for limit in self.limits)
        return self.objective(figures) + self.miss_price * missed


@dataclass(frozen=True, kw_only=True)
class Tuned(ABC):
    """A tuned controller: the only record of its name, its settings everywhere, and the searches that choose them."""

    per_parameter: ClassVar[int]
    """Largest number of candidates of a search for a puller, for each parameter."""

    name: str
    meaning: str
    """Description in one line, for tables."""
    default: bool = True
    """Whether a benchmark that names no controllers runs it."""
    quoted: bool = False
    """Whether it stands in short tables."""
    on_puller: bool = True
    """Whether it has settings of its own on a puller of the user's."""
    searched_on_puller: bool = True
    """Whether ``cz-gym tune --puller`` searches its settings."""
    hot_zones: bool = True
    """Whether half of the crystals of its search on ``randomized`` are of ``hot-zone``."""

    @abstractmethod
    def make(self, config: Config) -> Any:
        """The controller for an environment."""

    @abstractmethod
    def goal(self, scenario: Scenario) -> Goal:
        """The goal of its search on a scenario with the default puller; CzError if there is none."""

    @abstractmethod
    def goal_on(self, config: Config) -> Goal:
        """The goal of its search for the puller of an environment."""

    def crystals(self, scenario: Scenario) -> Distribution:
        """The crystals on which the candidates of its search on a scenario are scored."""
        mixed = scenario == RANDOMIZED and self.hot_zones
        return make_mixture([(HOT_ZONE, 0.5), (RANDOMIZED, 0.5)]) if mixed else scenario

    @property
    def contender(self) -> Contender:
        """The controller as a row of the benchmark."""
        alike = "name", "make", "meaning", "default", "on_puller", "quoted"
        return Contender(observation="measured", **{each: getattr(self, each) for each in alike})
