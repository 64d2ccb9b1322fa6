"""Scenarios: frozen values that hold the distributions from which episodes are drawn.

A range is a pair ``(low, high)`` of a uniform distribution, in SI units; ``(x, x)`` is the value x. A family
left at its default is absent. Two scenarios with equal contents have equal :attr:`Scenario.hash`. The range of each
number is its :class:`cz_gym.physics.parameters.Quantity`'s; what belongs to the machine is in its table.
"""

import csv
import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from cz_gym.physics.parameters import MACHINE, MAX_DEAD_TIME, Quantity, Range
from cz_gym.physics.plant import DRAW_SPAN
from cz_gym.support.errors import CzError

NONE: Range = (0.0, 0.0)
ONE: Range = (1.0, 1.0)
GRID = 5.0
"""Interval [s] of the grid on which physical fluctuations live; held in between."""
MAX_FLAGGED, MAX_UNFLAGGED = 3, 1
"""Most freezes of each kind in an episode."""
_SECONDS = "s", 0.0, 1e6
_LENGTH = "mm", 0.0, 20.0  # of a change of the ring or of the reference; a crystal is lost long before
_CHANGE = "mm", -20.0, 20.0
_RATE = "K/min", -6.0, 6.0
_FACTOR = "1", 0.1, 10.0
_SHARE = "%", 0.0, 100.0
_SPREAD = "%", 0.0, 49.9


class Variation(Enum):
    """Condition under which a member of a scenario makes its episodes differ from each other."""

    NEVER = "never"
    """Constant, or a number that matters only beside another member: never varies."""
    RANGE = "range"
    """Range from which the value is drawn: varies if its ends differ."""
    NONZERO = "nonzero"
    """Size or number of something random: varies unless it is zero."""
    CHANCE = "chance"
    """Probability of an event: varies if it lies between 0 and 1."""

    def differs(self, value: Any) -> bool:
        """True if a member of this kind and value makes episodes differ."""
        if self is Variation.RANGE:
            return bool(value[0] != value[1])
        if self is Variation.CHANCE:
            return bool(0.0 < value < 1.0)
        return self is Variation.NONZERO and bool(np.any(value))


class Member(NamedTuple):
    """Metadata of a scenario's number, under the key ``member`` of its field."""

    draw: Variation
    quantity: Quantity
    """Unit, meaning and range of the number; the default may lie outside of the range."""


def member(default: Any, draw: Variation, limits: tuple[str, float, float], meaning: str, later: bool = False) -> Any:
    """A number of a scenario, with its shown unit and its least and largest plausible value in it."""
    unit, low, high = limits
    return field(
        default=default, metadata={"member": Member(draw, Quantity(unit, meaning, "", low, high, later=later))}
    )


def machine(symbol: str, default: Any, draw: Variation) -> Any:
    """A number of a scenario that belongs to the machine: a puller file may state it."""
    return field(default=default, metadata={"member": Member(draw, MACHINE[symbol])})


@dataclass(frozen=True)
class Pullers:
    """Spread of the pullers: factors on their design parameters, uniform in 1 +- spread, and the mix of models."""

    mix: Range = member(ONE, Variation.RANGE, ("1", 0.0, 1.0), "share of conduction lambda")
    capillary: float = member(0.0, Variation.NONZERO, _SPREAD, "spread of the capillary constant a")
    conductivity: float = member(0.0, Variation.NONZERO, _SPREAD, "spread of k_l")
    conductance: float = member(
        0.0, Variation.NONZERO, _SPREAD, "spread of kappa_12, G_1a, G_2b and kappa_b, each on its own"
    )
    start_radius_sd: float = member(0.0, Variation.NONZERO, _LENGTH, "standard deviation of r_c(0) - r_0")
    melt_loss: float = member(
        0.0, Variation.NEVER, ("%", 0.0, 99.9), "share of the melt's heat capacity lost, linearly over 3 h, then held"
    )
    capacity_factor: Range = member(
        ONE, Variation.RANGE, _FACTOR, "log-uniform factor on C_1 and C_2, each on its own", later=True
    )
    melt_capacity_factor: Range = member(ONE, Variation.RANGE, _FACTOR, "log-uniform factor on C_b", later=True)
    conductance_factor: Range = member(
        ONE,
        Variation.RANGE,
        _FACTOR,
        "log-uniform factor on kappa_12, G_1a, G_2b and kappa_b, each on its own, beside their uniform one",
        later=True,
    )
    boundary_layer: Range = member(
        NONE, Variation.RANGE, ("m2K/W", 0.0, 0.1), "resistance under the crystal, beside the puller's own", later=True
    )
    ring_slope: float = member(
        0.0, Variation.NEVER, ("deg", 0.0, 60.0), "slope of the meniscus at the ring, in place of phi_b; 0: phi_b",
        later=True,
    )  # fmt: skip


@dataclass(frozen=True)
class TemperatureRamp:
    """Error e(t) of the temperature recipe: a linear ramp, then constant."""

    rate: Range = member(NONE, Variation.RANGE, _RATE, "rate of T_1,ref")
    duration: Range = member(NONE, Variation.RANGE, _SECONDS, "duration of the ramp")
    start: Range = member(NONE, Variation.RANGE, _SECONDS, "start of the ramp")


@dataclass(frozen=True)
class Drift:
    """Drift p(t) of the hot zone, hidden in the melt's heat load and followed by a perfect recipe."""

    amount: Range = member(NONE, Variation.RANGE, ("K", -500.0, 500.0), "final drift")
    duration: Range = member(NONE, Variation.RANGE, _SECONDS, "duration of the ramp")
    start: Range = member(NONE, Variation.RANGE, _SECONDS, "start of the ramp")
    rate: float = member(0.0, Variation.NEVER, _RATE, "steady rate on top, from t = 0 on")


@dataclass(frozen=True)
class Interface:
    """Fluctuation dT_i of the interface temperature: two stationary Ornstein-Uhlenbeck processes."""

    sd: Range = machine("fluctuation_sd", NONE, Variation.NONZERO)
    tau_fast: float = machine("tau_fast", 30.0, Variation.NEVER)
    tau_slow: float = machine("tau_slow", 780.0, Variation.NEVER)


@dataclass(frozen=True)
class Reference:
    """Change of the radius reference along the quintic 10 s^3 - 15 s^4 + 6 s^5."""

    probability: float = member(0.0, Variation.CHANCE, _SHARE, "share of episodes with a change")
    amount: Range = member(NONE, Variation.RANGE, _CHANGE, "change of the reference")
    duration: Range = member(NONE, Variation.RANGE, _SECONDS, "duration of the change")
    start: Range = member(NONE, Variation.RANGE, _SECONDS, "start of the change")


@dataclass(frozen=True)
class Sensor:
    """Camera and pyrometer."""

    camera_noise: Range = machine("camera_noise", NONE, Variation.NONZERO)
    pyrometer_noise: Range = machine("pyrometer_noise", NONE, Variation.NONZERO)
    pyrometer_drift: Range = machine("pyrometer_drift", NONE, Variation.RANGE)
    bias_offset: Range = machine("bias_offset", NONE, Variation.RANGE)
    level_offset: Range = machine("level_offset", NONE, Variation.RANGE)
    ripple: Range = machine("ripple", NONE, Variation.NONZERO)
    rotation: Range = machine("rotation", NONE, Variation.RANGE)
    averaging: float = machine("averaging", 0.0, Variation.NEVER)
    latency: float = machine("latency", 0.0, Variation.NEVER)
    outlier_probability: float = machine("outlier_probability", 0.0, Variation.NONZERO)
    outlier_sd: float = machine("outlier_sd", 0.0, Variation.NEVER)
    pyrometer_filter: Range = machine("pyrometer_filter", NONE, Variation.RANGE)


@dataclass(frozen=True)
class Faults:
    """Faults of the camera: freezes show the last value; starts are uniform over 3 h, freezes disjoint."""

    flagged: tuple[int, int] = member(
        (0, 0),
        Variation.NONZERO,
        ("1", 0, MAX_FLAGGED),
        "least and largest number of freezes with valid = 0; at most 3",
    )
    flagged_duration: Range = member(NONE, Variation.RANGE, _SECONDS, "duration of each flagged freeze")
    unflagged: int = member(
        0, Variation.NONZERO, ("1", 0, MAX_UNFLAGGED), "number of freezes with valid = 1; at most 1"
    )
    unflagged_duration: Range = member(NONE, Variation.RANGE, _SECONDS, "duration of the unflagged freeze")
    dropout: Range = member(NONE, Variation.NONZERO, _SHARE, "probability of a sample with valid = 0")
    bias_drift: Range = member(NONE, Variation.NONZERO, _CHANGE, "final unflagged drift of the ring")
    bias_drift_duration: Range = member(NONE, Variation.RANGE, _SECONDS, "duration of the ring's drift")


@dataclass(frozen=True)
class Actuators:
    """Limits of the drives beyond the action box; infinite or zero where there are none."""

    pull_window: float = machine("pull_window", math.inf, Variation.NEVER)
    pull_slew: float = machine("pull_slew", math.inf, Variation.NEVER)
    heater_slew: float = machine("heater_slew", math.inf, Variation.NEVER)
    heater_step: float = machine("heater_step", 0.0, Variation.NEVER)
    heater_lag: Range = machine("heater_lag", NONE, Variation.RANGE)
    heater_dead_time: Range = machine("heater_dead_time", NONE, Variation.RANGE)


_SCALE = "1", 0.5, 2.0


@dataclass(frozen=True)
class DriveReadings:
    """Errors with which the applied drives are read: scale * what was applied a delay ago + offset, in whole steps.

    The scale multiplies the absolute reading, before the nominal value is subtracted. Nothing errs by default.
    """

    pull_scale: Range = member(ONE, Variation.RANGE, _SCALE, "scale of the pull speed's reading", later=True)
    pull_offset: Range = member(NONE, Variation.RANGE, ("mm/min", -5.0, 5.0), "offset of that reading", later=True)
    pull_resolution: float = member(0.0, Variation.NEVER, ("mm/min", 0.0, 1.0), "step of that reading", later=True)
    heater_scale: Range = member(ONE, Variation.RANGE, _SCALE, "scale of the heater power's reading", later=True)
    heater_offset: Range = member(NONE, Variation.RANGE, ("kW", -50.0, 50.0), "offset of that reading", later=True)
    heater_resolution: float = member(0.0, Variation.NEVER, ("kW", 0.0, 10.0), "step of that reading", later=True)
    scale_sd: float = member(
        0.0, Variation.NONZERO, ("%", 0.0, 20.0), "standard deviation of both scales, each on its own", later=True
    )
    delay: float = member(0.0, Variation.NEVER, ("s", 0.0, MAX_DEAD_TIME), "age of both readings", later=True)


@dataclass(frozen=True)
class Told:
    """Errors of the nominal values that controllers are told: actions, observations and the recipe count from them."""

    power_sd: float = member(
        0.0, Variation.NONZERO, ("kW", 0.0, 50.0), "standard deviation of the nominal power's error", later=True
    )
    temperature_sd: float = member(
        0.0, Variation.NONZERO, ("K", 0.0, 100.0), "standard deviation of the nominal temperature's error", later=True
    )


@dataclass(frozen=True)
class Scenario:
    """A distribution of episodes, by family; frozen, comparable, hashed."""

    name: str
    pullers: Pullers = field(default_factory=Pullers)
    recipe: TemperatureRamp = field(default_factory=TemperatureRamp)
    drift: Drift = field(default_factory=Drift)
    interface: Interface = field(default_factory=Interface)
    reference: Reference = field(default_factory=Reference)
    sensor: Sensor = field(default_factory=Sensor)
    faults: Faults = field(default_factory=Faults)
    actuators: Actuators = field(default_factory=Actuators)
    readings: DriveReadings = field(default_factory=DriveReadings)
    told: Told = field(default_factory=Told)
    series: tuple[tuple[float, float], ...] = ()
    """Heat load on the melt [W] and fluctuation of the interface [K] on the 5 s grid, in place of drawn ones; the last
    values stay (:mod:`cz_gym.episodes.scenario`)."""

    def __post_init__(self) -> None:
        if not (self.name and isinstance(self.name, str)):
            raise CzError(f"a scenario needs a name, not {self.name!r}")
        for family, kind in FAMILIES.items():
            if not isinstance(getattr(self, family), kind):
                given = getattr(self, family)
                raise CzError(f"scenario {self.name!r}: {family} must be a {kind.__name__}, not {given!r}")
        for family, each, value in self.members:
            _check(f"scenario {self.name!r}: {family}.{each.name}", each, value)
        faults = self.faults
        longest = faults.flagged[1] * faults.flagged_duration[1] + faults.unflagged * faults.unflagged_duration[1]
        if longest > DRAW_SPAN:
            raise CzError(f"scenario {self.name!r}: freezes of {longest} s do not fit into {DRAW_SPAN} s")

    @property
    def scenarios(self) -> tuple[Self, ...]:
        """The scenario itself: a mixture has several (:class:`cz_gym.episodes.scenario.Mixture`)."""
        return (self,)

    @property
    def shares(self) -> tuple[float, ...]:
        """Share of the episodes of the one scenario: 1."""
        return (1.0,)

    @property
    def members(self) -> list[tuple[str, dataclasses.Field[Any], Any]]:
        """Family, field and value of each number, in order."""
        return [
            (family, each, getattr(getattr(self, family), each.name))
            for family, kind in FAMILIES.items()
            for each in dataclasses.fields(kind)
        ]

    @property
    def hash(self) -> str:
        """SHA-256 of the scenario's contents (16 hex digits); a ``later`` member counts only off its default."""
        contents: dict[str, Any] = {"name": self.name}
        for family, each, value in self.members:
            if not each.metadata["member"].quantity.later or value != each.default:
                contents.setdefault(family, {})[each.name] = _plain(each.default, value)
        contents |= {"series": self.series} if self.series else {}
        text = json.dumps(contents, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def deterministic(self) -> bool:
        """True if no member makes episodes differ (:class:`Variation`): all are the same."""
        return not any(each.metadata["member"].draw.differs(value) for _, each, value in self.members)


FAMILIES: dict[str, Any] = {
    each.name: each.default_factory
    for each in dataclasses.fields(Scenario)
    if each.default_factory is not dataclasses.MISSING
}
"""The families of a scenario, and their classes."""


def _check(where: str, each: dataclasses.Field[Any], value: Any) -> None:
    """Raise CzError unless a member's value has its default's form, a number or a pair, and lies in its range."""
    default: Any = each.default
    pair = isinstance(default, tuple)
    parts, first = (value, default[0]) if pair else ((value,), default)
    kind = "whole" if isinstance(first, int) else "finite"
    if not (isinstance(parts, tuple) and len(parts) == 1 + pair and all(_is_number(part, first) for part in parts)):
        form = f"a pair (low, high) of {kind} numbers" if pair else f"a {kind} number"
        raise CzError(f"{where} must be {form}, not {value!r}")
    if parts[0] > parts[-1]:
        raise CzError(f"{where} must be a pair low <= high, not {value!r}")
    for part in parts if value != default else ():
        each.metadata["member"].quantity.check(where, part)


def _is_number(part: Any, default: Any) -> bool:
    """True for a number of the default's kind: whole, finite, or infinite where the default is."""
    if isinstance(part, bool) or not isinstance(part, int if isinstance(default, int) else int | float):
        return False
    return math.isfinite(part) or (math.isinf(default) and part == math.inf)


def _plain(default: Any, value: Any) -> Any:
    """The value with its default's kind of number, so that equal values read alike: 1 as 1.0, -0.0 as 0.0."""
    if isinstance(default, tuple):
        return [_plain(default[0], part) for part in value]
    return int(value) if isinstance(default, int) else float(value) + 0.0


# Several scenarios at once: each episode is drawn from one of them.


@dataclass(frozen=True)
class Mixture:
    """Scenarios with their shares of the episodes; frozen, comparable, hashed.

    An episode's scenario follows from its key, on a random stream of its own: it is bit for bit the episode that the
    same seed has in that scenario alone.
    """

    scenarios: tuple[Scenario, ...]
    """The scenarios, ordered by name."""
    shares: tuple[float, ...]
    """Share of the episodes of each scenario [-]; the sum is 1."""

    @property
    def name(self) -> str:
        """Shares and names."""
        return " + ".join(f"{share:.4g} {each.name}" for share, each in zip(self.shares, self.scenarios, strict=True))

    @property
    def hash(self) -> str:
        """SHA-256 of the scenarios' contents and their shares (16 hex digits)."""
        contents = [[each.hash, share] for each, share in zip(self.scenarios, self.shares, strict=True)]
        return hashlib.sha256(json.dumps(contents).encode()).hexdigest()[:16]

    @property
    def deterministic(self) -> bool:
        """True if all episodes are the same."""
        return len(self.scenarios) == 1 and self.scenarios[0].deterministic


Distribution = Scenario | Mixture
"""A scenario, or a mixture of several, from which episodes are drawn."""
AnyScenario = str | Path | Scenario | Mixture | Mapping[Any, float]
"""The environment's ``scenario`` argument: a name, a scenario, scenarios or names with their shares, or a CSV file of
disturbances from logs."""


def make_mixture(shares: list[tuple[Scenario, Any]]) -> Mixture:
    """Scenarios with positive shares, of whatever sum, as a mixture; CzError for anything else."""
    for scenario, share in shares:
        number = isinstance(share, Real) and not isinstance(share, bool)
        if not (number and 0.0 < share < math.inf):
            raise CzError(f"a mixture's shares must be positive numbers: that of {scenario.name!r} is {share!r}")
    ordered = sorted(shares, key=lambda pair: pair[0].name)
    scenarios = tuple(scenario for scenario, _ in ordered)
    names = [scenario.name for scenario in scenarios]
    if not names:
        raise CzError("a mixture needs at least one scenario with its share")
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        raise CzError(f"a mixture's scenarios need different names: {twice[0]!r} is there twice")
    whole = math.fsum(float(share) for _, share in ordered)
    return Mixture(scenarios, tuple(float(share) / whole for _, share in ordered))


# Series of disturbances from logs: a CSV file that ``cz-gym identify LOG --series FILE.csv`` writes, as a scenario.
#
# Each episode meets one of its series, drawn by the seed: the heat load on the melt and the fluctuation of the
# interface temperature stand in place of drawn ones. The sensors' noise is that of ``randomized``, or the puller
# file's.

Floats = npt.NDArray[np.float64]
COLUMNS = "series", "time_s", "load_W", "fluctuation_K"
MIX = 0.5
"""Share of conduction that an identification assumes where a log does not tell it [-]."""


def to_csv(series: Sequence[tuple[Floats, Floats, Floats]]) -> str:
    """The text of a file: of each series its times [s], loads [W] and fluctuations [K], each of shape (rows,)."""
    rows = [f"{k},{t:.10g},{q:.8g},{d:.8g}" for k, each in enumerate(series) for t, q, d in zip(*each, strict=True)]
    return "\n".join([",".join(COLUMNS), *rows, ""])


def read_series(path: Path, sensor: Sensor) -> Distribution:
    """The scenario of a file, a mixture if it holds several series; CzError for what is none."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            table = list(csv.DictReader(file))
        numbers = np.array([[float(row[name]) for name in COLUMNS] for row in table])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CzError(f"scenario {path}: must be a CSV file with columns {', '.join(COLUMNS)}: {error!r:.80}") from None
    if not len(numbers) or not np.isfinite(numbers).all():
        raise CzError(f"scenario {path}: every row needs four finite numbers, and there must be one")
    names = np.unique(numbers[:, 0])
    each = [_on_grid(numbers[numbers[:, 0] == name, 1:], path) for name in names]
    scenarios = [
        Scenario(
            path.stem if len(each) == 1 else f"{path.stem}-{name:g}", Pullers(mix=(MIX, MIX)), sensor=sensor, series=one
        )
        for name, one in zip(names, each, strict=True)
    ]
    return scenarios[0] if len(scenarios) == 1 else make_mixture([(one, 1.0) for one in scenarios])


def _on_grid(rows: Floats, path: Path) -> tuple[tuple[float, float], ...]:
    """Load and fluctuation of rows (time, load, fluctuation), straight between them, on the grid."""
    time = rows[:, 0]
    if (np.diff(time) <= 0.0).any() or time[0] < 0.0:
        raise CzError(f"scenario {path}: the times of a series must begin at 0 or later, and grow")
    at = GRID * np.arange(int(time[-1] / GRID) + 1)
    return tuple(zip(*(np.interp(at, time, column).tolist() for column in rows[:, 1:].T), strict=True))


def series_table(scenarios: Sequence[Scenario]) -> Any:
    """The series of scenarios as an array for the compiled loops, shape (scenarios, points, 2); no points: none."""
    points = max(len(each.series) for each in scenarios)
    table = np.full((len(scenarios), points, 2), np.nan)
    for row, each in zip(table, scenarios, strict=True):
        if each.series:
            row[:] = [*each.series, *[each.series[-1]] * (points - len(each.series))]
    return table
