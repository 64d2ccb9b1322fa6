"""Scenarios: frozen values that hold the distributions from which episodes are drawn.

A range is a pair ``(low, high)`` of a uniform distribution, in SI units; ``(x, x)`` is the value x. A family
left at its default is absent. Two scenarios with equal contents have equal :attr:`Scenario.hash`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from cz_gym.errors import CzError
from cz_gym.support.plausible import (
    IN_K_PER_MIN,
    IN_MM,
    IN_MM_PER_MIN,
    IN_MM_PER_MIN2,
    IN_PERCENT,
    IN_REV_PER_MIN,
    Slip,
    check_plausible,
)
from cz_gym.support.units import HOUR, MM

Range = tuple[float, float]
NONE: Range = (0.0, 0.0)
ONE: Range = (1.0, 1.0)
DRAW_SPAN = 3.0 * HOUR
"""Span [s] over which "uniform over the episode" is drawn, whatever the horizon: a draw never depends on it."""


MAX_LENGTH = 20.0 * MM
"""Largest error of the camera, and change of the reference [m]; a crystal is lost long before."""
MAX_NOISE = 2.0 * MM
"""Largest standard deviation of the camera's noise [m]."""
MAX_LATENCY = 60.0
"""Oldest camera frame a scenario may deliver [s]."""
MAX_LAG = 300.0
"""Largest time constant of the heater and of the pyrometer's filter [s]."""
MAX_DEAD_TIME = 60.0
"""Longest dead time of the heater [s]."""
MAX_FLAGGED, MAX_UNFLAGGED = 3, 1
"""Most freezes of each kind in an episode."""
_LONGEST = 1e6
_FACTORS = 0.1, 10.0
_BELOW_HALF, _BELOW_ONE = math.nextafter(0.5, 0.0), math.nextafter(1.0, 0.0)
_FASTEST_PULL, _FASTEST_SLEW, _FASTEST_RAMP = 1e-3, 1e-5, 0.1


class Draw(Enum):
    """When a member of a scenario makes its episodes differ from each other."""

    NEVER = "never"
    """It is a constant, or matters only beside another member."""
    RANGE = "range"
    """Where the ends of its range differ: the value is drawn between them."""
    NONZERO = "nonzero"
    """Wherever it is not zero: the size or the number of something random."""
    CHANCE = "chance"
    """Between 0 and 1: the probability that something happens."""

    def differs(self, value: Any) -> bool:
        """Whether a member of this kind and value makes episodes differ."""
        if self is Draw.RANGE:
            return bool(value[0] != value[1])
        if self is Draw.CHANCE:
            return bool(0.0 < value < 1.0)
        return self is Draw.NONZERO and bool(np.any(value))


class Member(NamedTuple):
    """Metadata of a scenario's number, under the key ``member`` of its field."""

    draw: Draw
    low: float
    """Smallest allowed value."""
    high: float
    """Largest allowed value, the default apart."""
    slip: Slip | None
    """Unit that users may have meant instead."""
    later: bool
    """Whether it was added after hashes were published; its default is then left out of the hash."""


def member(default: Any, draw: Draw, low: float, high: float, slip: Slip | None = None, later: bool = False) -> Any:
    """A dataclass field with :class:`Member` metadata: its randomness and its plausible range."""
    return field(default=default, metadata={"member": Member(draw, low, high, slip, later)})


@dataclass(frozen=True)
class Pullers:
    """Spread of the pullers: factors on their design parameters, uniform in 1 +- spread, and the mix of models."""

    mix: Range = member(ONE, Draw.RANGE, 0.0, 1.0)
    """Share of conduction lambda [-]."""
    capillary: float = member(0.0, Draw.NONZERO, 0.0, _BELOW_HALF, IN_PERCENT)
    """Spread of the capillary constant a [-]."""
    conductivity: float = member(0.0, Draw.NONZERO, 0.0, _BELOW_HALF, IN_PERCENT)
    """Spread of k_l [-]."""
    conductance: float = member(0.0, Draw.NONZERO, 0.0, _BELOW_HALF, IN_PERCENT)
    """Spread of kappa_12, G_1a, G_2b and kappa_b, each on its own [-]."""
    start_radius_sd: float = member(0.0, Draw.NONZERO, 0.0, MAX_LENGTH, IN_MM)
    """Standard deviation of r_c(0) - r_0 [m]."""
    melt_loss: float = member(0.0, Draw.NEVER, 0.0, _BELOW_ONE, IN_PERCENT)
    """Share of the melt's heat capacity lost, linearly over 3 h, then held [-]."""
    capacity_factor: Range = member(ONE, Draw.RANGE, *_FACTORS, later=True)
    """Log-uniform factor on C_1 and C_2, each on its own [-]."""
    melt_capacity_factor: Range = member(ONE, Draw.RANGE, *_FACTORS, later=True)
    """Log-uniform factor on C_b [-]."""
    conductance_factor: Range = member(ONE, Draw.RANGE, *_FACTORS, later=True)
    """Log-uniform factor on kappa_12, G_1a, G_2b and kappa_b, each on its own, beside their uniform one [-]."""


@dataclass(frozen=True)
class Recipe:
    """Error e(t) of the temperature recipe: a linear ramp, then constant."""

    rate: Range = member(NONE, Draw.RANGE, -_FASTEST_RAMP, _FASTEST_RAMP, IN_K_PER_MIN)
    """Rate of T_1,ref [K/s]."""
    duration: Range = member(NONE, Draw.RANGE, 0.0, _LONGEST)
    """Length of the ramp [s]."""
    start: Range = member(NONE, Draw.RANGE, 0.0, _LONGEST)
    """Start of the ramp [s]."""


@dataclass(frozen=True)
class Drift:
    """Drift p(t) of the hot zone, hidden in the melt's heat load and followed by a perfect recipe."""

    amount: Range = member(NONE, Draw.RANGE, -500.0, 500.0)
    """Final drift [K]."""
    duration: Range = member(NONE, Draw.RANGE, 0.0, _LONGEST)
    """Length of the ramp [s]."""
    start: Range = member(NONE, Draw.RANGE, 0.0, _LONGEST)
    """Start of the ramp [s]."""
    rate: float = member(0.0, Draw.NEVER, -_FASTEST_RAMP, _FASTEST_RAMP, IN_K_PER_MIN)
    """Steady rate on top, from t = 0 on [K/s]."""


@dataclass(frozen=True)
class Interface:
    """Fluctuation dT_i of the interface temperature: two stationary Ornstein-Uhlenbeck processes."""

    sd: Range = member(NONE, Draw.NONZERO, 0.0, 100.0)
    """Standard deviation of each, drawn separately [K]."""
    tau_fast: float = member(30.0, Draw.NEVER, 1e-3, _LONGEST)
    """Correlation time of the fast one [s]."""
    tau_slow: float = member(780.0, Draw.NEVER, 1e-3, _LONGEST)
    """Correlation time of the slow one [s]."""


@dataclass(frozen=True)
class Reference:
    """Change of the radius reference along the quintic 10 s^3 - 15 s^4 + 6 s^5."""

    probability: float = member(0.0, Draw.CHANCE, 0.0, 1.0, IN_PERCENT)
    """Share of episodes with a change [-]."""
    amount: Range = member(NONE, Draw.RANGE, -MAX_LENGTH, MAX_LENGTH, IN_MM)
    """Change [m]."""
    duration: Range = member(NONE, Draw.RANGE, 0.0, _LONGEST)
    """Length [s]."""
    start: Range = member(NONE, Draw.RANGE, 0.0, _LONGEST)
    """Start [s]."""


@dataclass(frozen=True)
class Sensor:
    """Camera and pyrometer."""

    camera_noise: Range = member(NONE, Draw.NONZERO, 0.0, MAX_NOISE, IN_MM)
    """Standard deviation of the white noise on the ring [m]."""
    pyrometer_noise: Range = member(NONE, Draw.NONZERO, 0.0, 100.0)
    """Standard deviation of the white noise on T_1 [K]."""
    pyrometer_drift: Range = member(NONE, Draw.RANGE, -500.0, 500.0)
    """Drift of the pyrometer, linear over 3 h, then held [K]."""
    bias_offset: Range = member(NONE, Draw.RANGE, -MAX_LENGTH, MAX_LENGTH, IN_MM)
    """Constant offset of the ring from a wrong bias [m]."""
    level_offset: Range = member(NONE, Draw.RANGE, -MAX_LENGTH, MAX_LENGTH, IN_MM)
    """Constant offset of the ring from the melt level [m]."""
    ripple: Range = member(NONE, Draw.NONZERO, 0.0, MAX_LENGTH, IN_MM)
    """Amplitude of the rotation-synchronous ripple [m]."""
    rotation: Range = member(NONE, Draw.RANGE, 0.0, 2.0, IN_REV_PER_MIN)
    """Crystal rotation [rev/s]."""
    latency: float = member(0.0, Draw.NEVER, 0.0, MAX_LATENCY)
    """Age of the newest camera frame [s]; frames are taken at samples and on the 5 s grid."""
    outlier_probability: float = member(0.0, Draw.NONZERO, 0.0, 1.0, IN_PERCENT)
    """Share of samples that carry an outlier [-]."""
    outlier_sd: float = member(0.0, Draw.NEVER, 0.0, MAX_LENGTH, IN_MM)
    """Standard deviation of an outlier [m]."""
    pyrometer_filter: Range = member(NONE, Draw.RANGE, 0.0, MAX_LAG, later=True)
    """Time constant of the pyrometer's filter, a first-order lag of T_1 as it is read [s]."""


@dataclass(frozen=True)
class Faults:
    """Faults of the camera: freezes show the last value; starts are uniform over 3 h, freezes disjoint."""

    flagged: tuple[int, int] = member((0, 0), Draw.NONZERO, 0, MAX_FLAGGED)
    """Least and largest number of freezes with valid = 0; at most 3."""
    flagged_duration: Range = member(NONE, Draw.RANGE, 0.0, _LONGEST)
    """Their length [s]."""
    unflagged: int = member(0, Draw.NONZERO, 0, MAX_UNFLAGGED)
    """Number of freezes with valid = 1; at most 1."""
    unflagged_duration: Range = member(NONE, Draw.RANGE, 0.0, _LONGEST)
    """Its length [s]."""
    dropout: Range = member(NONE, Draw.NONZERO, 0.0, 1.0, IN_PERCENT)
    """Probability of a sample with valid = 0 [-]."""
    bias_drift: Range = member(NONE, Draw.NONZERO, -MAX_LENGTH, MAX_LENGTH, IN_MM)
    """Final unflagged drift of the ring [m]."""
    bias_drift_duration: Range = member(NONE, Draw.RANGE, 0.0, _LONGEST)
    """Its length [s]."""


@dataclass(frozen=True)
class Actuators:
    """Limits of the drives beyond the action box; infinite or zero where there are none."""

    pull_window: float = member(math.inf, Draw.NEVER, 0.0, _FASTEST_PULL, IN_MM_PER_MIN)
    """Largest |v_p - v_0| [m/s]."""
    pull_slew: float = member(math.inf, Draw.NEVER, 0.0, _FASTEST_SLEW, IN_MM_PER_MIN2)
    """Largest rate of change of v_p [m/s2]."""
    heater_slew: float = member(math.inf, Draw.NEVER, 0.0, 1e6)
    """Largest rate of change of Q_H [W/s]."""
    heater_step: float = member(0.0, Draw.NEVER, 0.0, 1e5)
    """Resolution of Q_H - Q_H0 [W]."""
    heater_lag: Range = member(NONE, Draw.RANGE, 0.0, MAX_LAG, later=True)
    """Time constant with which the power that heats follows the heater's setpoint, a first-order lag [s]."""
    heater_dead_time: Range = member(NONE, Draw.RANGE, 0.0, MAX_DEAD_TIME, later=True)
    """Time before the power that heats begins to follow the setpoint [s]."""


@dataclass(frozen=True)
class Scenario:
    """A distribution of episodes, by family; frozen, comparable, hashed."""

    name: str
    pullers: Pullers = field(default_factory=Pullers)
    recipe: Recipe = field(default_factory=Recipe)
    drift: Drift = field(default_factory=Drift)
    interface: Interface = field(default_factory=Interface)
    reference: Reference = field(default_factory=Reference)
    sensor: Sensor = field(default_factory=Sensor)
    faults: Faults = field(default_factory=Faults)
    actuators: Actuators = field(default_factory=Actuators)

    def __post_init__(self) -> None:
        if not (self.name and isinstance(self.name, str)):
            raise CzError(f"a scenario needs a name, not {self.name!r}")
        for family in dataclasses.fields(Scenario)[1:]:
            value, kind = getattr(self, family.name), _kind(family)
            if not isinstance(value, kind):
                raise CzError(f"scenario {self.name!r}: {family.name} must be a {kind.__name__}, not {value!r}")
            for each in dataclasses.fields(kind):
                _check(f"scenario {self.name!r}: {family.name}.{each.name}", each, getattr(value, each.name))
        faults = self.faults
        longest = faults.flagged[1] * faults.flagged_duration[1] + faults.unflagged * faults.unflagged_duration[1]
        if longest > DRAW_SPAN:
            raise CzError(f"scenario {self.name!r}: freezes of {longest} s do not fit into {DRAW_SPAN} s")

    @property
    def scenarios(self) -> tuple[Scenario, ...]:
        """The scenario itself: a mixture has several (:class:`cz_gym.episodes.mixture.Mixture`)."""
        return (self,)

    @property
    def shares(self) -> tuple[float, ...]:
        """Its share of the episodes, 1."""
        return (1.0,)

    @property
    def hash(self) -> str:
        """SHA-256 of the scenario's contents (16 hex digits); a ``later`` member counts only off its default."""
        contents: dict[str, Any] = {"name": self.name}
        for family in dataclasses.fields(Scenario)[1:]:
            value = getattr(self, family.name)
            contents[family.name] = {
                each.name: _plain(each.default, getattr(value, each.name))
                for each in dataclasses.fields(value)
                if not each.metadata["member"].later or getattr(value, each.name) != each.default
            }
        text = json.dumps(contents, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def deterministic(self) -> bool:
        """Whether all its episodes are the same: no member makes them differ (``Draw`` at each member)."""
        families = (getattr(self, family.name) for family in dataclasses.fields(Scenario)[1:])
        members = ((family, each) for family in families for each in dataclasses.fields(family))
        return not any(each.metadata["member"].draw.differs(getattr(family, each.name)) for family, each in members)


def _kind(family: dataclasses.Field[Any]) -> type[Any]:
    """The class of a family of disturbances."""
    kind: Any = family.default_factory
    return kind  # type: ignore[no-any-return]


def _check(where: str, each: dataclasses.Field[Any], value: Any) -> None:
    """Raise CzError unless a member's value has its default's form and lies in its range."""
    _check_form(where, each.default, value)
    _, low, high, slip, _ = each.metadata["member"]
    if value != each.default:
        for number in value if isinstance(value, tuple) else (value,):
            check_plausible(where, number, low, high, slip=slip)


def _check_form(where: str, default: Any, value: Any) -> None:
    """Raise CzError unless the value has its default's form: a number, or a pair (low, high)."""
    if isinstance(default, tuple):
        if not (isinstance(value, tuple) and len(value) == 2):
            raise CzError(f"{where} must be a pair (low, high), not {value!r}")
        if isinstance(default[0], int) and not all(isinstance(part, int) for part in value):
            raise CzError(f"{where} must be a pair of whole numbers, not {value!r}")
        if not (all(_is_number(part) and math.isfinite(part) for part in value) and value[0] <= value[1]):
            raise CzError(f"{where} must be a pair of finite numbers low <= high, not {value!r}")
    elif not _is_number(value) or (math.isinf(value) and not math.isinf(default)):
        raise CzError(f"{where} must be a finite number, not {value!r}")
    elif isinstance(default, int) and not isinstance(value, int):
        raise CzError(f"{where} must be a whole number, not {value!r}")


def _plain(default: Any, value: Any) -> Any:
    """The value with its default's kind of number, so that equal values read alike: 1 as 1.0, -0.0 as 0.0."""
    if isinstance(default, tuple):
        return [_plain(default[0], part) for part in value]
    return int(value) if isinstance(default, int) else float(value) + 0.0


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)
