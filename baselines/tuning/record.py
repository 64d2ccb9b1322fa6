"""The record of a tuned controller, and the aim of its searches."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple

from cz_gym.baselines.lqg.controller import LQG, LQGDesign
from cz_gym.config import Config
from cz_gym.episodes.mixture import Distribution, make_mixture
from cz_gym.episodes.scenario import Scenario
from cz_gym.episodes.scenarios import HOT_ZONE, RANDOMIZED
from cz_gym.evaluation.contender import Contender

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
