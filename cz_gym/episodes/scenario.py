"""What a scenario is: a frozen value that says what an episode's draw is made from.

A range is a pair ``(low, high)`` of a uniform distribution, in SI units; ``(x, x)`` is the value x. A family
left at its default is absent. Two scenarios with equal contents have equal :attr:`Scenario.hash`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from dataclasses import dataclass, field
from typing import Any

from cz_gym.errors import CzError
from cz_gym.units import HOUR, MM

Range = tuple[float, float]
NONE: Range = (0.0, 0.0)
DRAW_SPAN = 3.0 * HOUR
"""Span [s] over which "uniform over the episode" is drawn, whatever the horizon: a draw never depends on it."""


@dataclass(frozen=True)
class Pullers:
    """Spread of the pullers: a uniform factor 1 +- spread on each group, and the mix of models."""

    mix: Range = (1.0, 1.0)
    """Share of conduction lambda [-]."""
    capillary: float = 0.0
    """Spread of the capillary constant a [-]."""
    conductivity: float = 0.0
    """Spread of k_l [-]."""
    conductance: float = 0.0
    """Spread of kappa_12, G_1a, G_2b and kappa_b, each on its own [-]."""
    start_radius_sd: float = 0.0
    """Standard deviation of r_c(0) - r_0 [m]."""
    melt_loss: float = 0.0
    """Share of the melt's heat capacity lost, linearly over 3 h, then held [-]."""


@dataclass(frozen=True)
class Recipe:
    """Error e(t) of the temperature recipe: linear at a rate, for a while, then held."""

    rate: Range = NONE
    """Rate of T_1,ref [K/s]."""
    duration: Range = NONE
    """Length of the ramp [s]."""
    start: Range = NONE
    """Start of the ramp [s]."""


@dataclass(frozen=True)
class Drift:
    """Drift p(t) of the hot zone, hidden in the melt's heat load and followed by a perfect recipe."""

    amount: Range = NONE
    """Final drift [K]."""
    duration: Range = NONE
    """Length of the ramp [s]."""
    start: Range = NONE
    """Start of the ramp [s]."""
    rate: float = 0.0
    """Steady rate on top, from t = 0 on [K/s]."""


@dataclass(frozen=True)
class Interface:
    """Fluctuation dT_i of the interface temperature: two stationary Ornstein-Uhlenbeck processes."""

    sd: Range = NONE
    """Standard deviation of each, drawn separately [K]."""
    tau_fast: float = 30.0
    """Correlation time of the fast one [s]."""
    tau_slow: float = 780.0
    """Correlation time of the slow one [s]."""


@dataclass(frozen=True)
class Reference:
    """Change of the radius reference along the quintic 10 s^3 - 15 s^4 + 6 s^5."""

    probability: float = 0.0
    """Share of episodes with a change [-]."""
    amount: Range = NONE
    """Change [m]."""
    duration: Range = NONE
    """Length [s]."""
    start: Range = NONE
    """Start [s]."""


@dataclass(frozen=True)
class Sensor:
    """Camera and pyrometer."""

    camera_noise: Range = NONE
    """Standard deviation of the white noise on the ring [m]."""
    pyrometer_noise: Range = NONE
    """Standard deviation of the white noise on T_1 [K]."""
    pyrometer_drift: Range = NONE
    """Drift of the pyrometer, linear over 3 h, then held [K]."""
    bias_offset: Range = NONE
    """Constant offset of the ring from a wrong bias [m]."""
    level_offset: Range = NONE
    """Constant offset of the ring from the melt level [m]."""
    ripple: Range = NONE
    """Amplitude of the rotation-synchronous ripple [m]."""
    rotation: Range = NONE
    """Crystal rotation [rev/s]."""
    latency: float = 0.0
    """Age of the newest camera frame [s]; frames are taken at samples and on the 5 s grid."""
    outlier_probability: float = 0.0
    """Share of samples that carry an outlier [-]."""
    outlier_sd: float = 0.0
    """Standard deviation of an outlier [m]."""


@dataclass(frozen=True)
class Faults:
    """Faults of the camera: freezes show the last value; starts are uniform over 3 h, freezes disjoint."""

    flagged: tuple[int, int] = (0, 0)
    """Least and largest number of freezes with valid = 0; at most 3."""
    flagged_duration: Range = NONE
    """Their length [s]."""
    unflagged: int = 0
    """Number of freezes with valid = 1; at most 1."""
    unflagged_duration: Range = NONE
    """Its length [s]."""
    dropout: Range = NONE
    """Probability of a sample with valid = 0 [-]."""
    bias_drift: Range = NONE
    """Final unflagged drift of the ring [m]."""
    bias_drift_duration: Range = NONE
    """Its length [s]."""


@dataclass(frozen=True)
class Actuators:
    """Limits of the drives beyond the action box; infinite or zero where there are none."""

    pull_window: float = math.inf
    """Largest |v_p - v_0| [m/s]."""
    pull_slew: float = math.inf
    """Largest rate of change of v_p [m/s2]."""
    heater_slew: float = math.inf
    """Largest rate of change of Q_H [W/s]."""
    heater_step: float = 0.0
    """Resolution of Q_H - Q_H0 [W]."""


MAX_FLAGGED, MAX_UNFLAGGED = 3, 1
MAX_LENGTH = 5.0 * MM
"""Largest error of the camera [m]; a crystal is lost long before."""
MAX_NOISE = 2.0 * MM
"""Largest standard deviation of the camera's noise [m]."""
MAX_LATENCY = 60.0
"""Oldest camera frame a scenario may deliver [s]."""


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
        for family in dataclasses.fields(self)[1:]:
            expected, value = _FAMILIES[family.name], getattr(self, family.name)
            if not isinstance(value, expected):
                raise CzError(f"scenario {self.name!r}: {family.name} must be a {expected.__name__}, not {value!r}")
            for member in dataclasses.fields(value):
                _check(
                    f"scenario {self.name!r}: {family.name}.{member.name}", member.default, getattr(value, member.name)
                )
        self._check_sense()

    def _check_sense(self) -> None:
        def need(fact: bool, what: str) -> None:
            if not fact:
                raise CzError(f"scenario {self.name!r}: {what}")

        need(bool(self.name) and isinstance(self.name, str), "needs a name")
        need(
            0.0 <= self.pullers.mix[0] <= self.pullers.mix[1] <= 1.0,
            f"pullers.mix = {self.pullers.mix} must lie in [0, 1]",
        )
        for spread in ("capillary", "conductivity", "conductance"):
            need(0.0 <= getattr(self.pullers, spread) < 0.5, f"pullers.{spread} must lie in [0, 0.5)")
        need(0.0 <= self.pullers.melt_loss < 1.0, "pullers.melt_loss must lie in [0, 1)")
        need(0.0 <= self.reference.probability <= 1.0, "reference.probability must lie in [0, 1]")
        need(0.0 <= self.sensor.outlier_probability <= 1.0, "sensor.outlier_probability must lie in [0, 1]")
        need(0.0 <= self.faults.dropout[0] <= self.faults.dropout[1] <= 1.0, "faults.dropout must lie in [0, 1]")
        need(
            0 <= self.faults.flagged[0] <= self.faults.flagged[1] <= MAX_FLAGGED,
            f"faults.flagged must lie in 0..{MAX_FLAGGED}",
        )
        need(0 <= self.faults.unflagged <= MAX_UNFLAGGED, f"faults.unflagged must lie in 0..{MAX_UNFLAGGED}")
        longest = (
            self.faults.flagged[1] * self.faults.flagged_duration[1]
            + self.faults.unflagged * self.faults.unflagged_duration[1]
        )
        need(longest <= DRAW_SPAN, f"freezes of {longest} s do not fit into {DRAW_SPAN} s")
        need(
            self.interface.tau_fast > 0 and self.interface.tau_slow > 0, "interface correlation times must be positive"
        )
        need(0.0 <= self.sensor.latency <= MAX_LATENCY, f"sensor.latency must lie in [0, {MAX_LATENCY}] s")
        need(min(vars(self.actuators).values()) >= 0, "actuator limits must not be negative")
        for family, names in _LENGTHS.items():
            for name in names:
                value = getattr(getattr(self, family), name)
                length = max(map(abs, value if isinstance(value, tuple) else (value,)))
                said = f"{family}.{name} of {length:g} m is {1e3 * length:g} mm: did you mean {length:g} * MM?"
                need(length <= (MAX_NOISE if name == "camera_noise" else MAX_LENGTH), said)
        for family, names in _NOT_NEGATIVE.items():
            for name in names:
                value = getattr(getattr(self, family), name)
                need(
                    min(value if isinstance(value, tuple) else (value,)) >= 0,
                    f"{family}.{name} = {value} must not be negative",
                )

    @property
    def hash(self) -> str:
        """SHA-256 of the scenario's contents (16 hex digits)."""
        contents: dict[str, Any] = {"name": self.name}
        for family in dataclasses.fields(self)[1:]:
            value = getattr(self, family.name)
            contents[family.name] = {
                member.name: _plain(member.default, getattr(value, member.name)) for member in dataclasses.fields(value)
            }
        text = json.dumps(contents, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def deterministic(self) -> bool:
        """Whether every draw is the same."""
        return all(not _is_random(getattr(self, family.name)) for family in dataclasses.fields(self)[1:])


_FAMILIES: dict[str, type[Any]] = {
    "pullers": Pullers,
    "recipe": Recipe,
    "drift": Drift,
    "interface": Interface,
    "reference": Reference,
    "sensor": Sensor,
    "faults": Faults,
    "actuators": Actuators,
}
_LENGTHS = {
    "pullers": ("start_radius_sd",),
    "reference": ("amount",),
    "sensor": ("camera_noise", "bias_offset", "level_offset", "ripple", "outlier_sd"),
    "faults": ("bias_drift",),
}
_NOT_NEGATIVE = {
    "pullers": ("start_radius_sd",),
    "recipe": ("duration", "start"),
    "drift": ("duration", "start"),
    "interface": ("sd",),
    "reference": ("duration", "start"),
    "sensor": ("camera_noise", "pyrometer_noise", "ripple", "rotation", "outlier_sd"),
    "faults": ("flagged_duration", "unflagged_duration", "bias_drift_duration"),
}
_ALWAYS_RANDOM = ("start_radius_sd", "capillary", "conductivity", "conductance", "outlier_probability", "unflagged")
_RANDOM_UNLESS_ZERO = ("sd", "camera_noise", "pyrometer_noise", "dropout", "ripple", "flagged", "bias_drift")


def _check(where: str, default: Any, value: Any) -> None:
    """Raise ValueError unless the value has its default's form: a number, or a pair (low, high)."""
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


def _is_random(family: Any) -> bool:
    for member, value in vars(family).items():
        if member in _ALWAYS_RANDOM and value:
            return True
        if member == "probability" and 0.0 < value < 1.0:
            return True
        if isinstance(value, tuple) and (value[0] != value[1] or (member in _RANDOM_UNLESS_ZERO and any(value))):
            return True
    return False
