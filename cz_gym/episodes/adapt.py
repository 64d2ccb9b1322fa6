"""Scenarios on a puller: what belongs to the machine is the puller file's, the rest is in proportion to it."""

import hashlib
import math
from dataclasses import dataclass, replace
from typing import Any

from cz_gym.physics.quantities import Quantity
from cz_gym.puller.file import DEFAULT, PullerFile, value_of
from cz_gym.support.errors import CzError

from .scenario import FAMILIES, Distribution, Mixture, Scenario


@dataclass(frozen=True)
class ScenarioOn(Scenario):
    """A scenario on a puller: :func:`adapt_scenario` makes one."""

    puller: str = ""
    """Hash of the puller."""

    @property
    def hash(self) -> str:
        """SHA-256 of the scenario's contents and its puller (16 hex digits)."""
        return hashlib.sha256(f"{super().hash} {self.puller}".encode()).hexdigest()[:16]


def adapt_scenario(puller: PullerFile, distribution: Distribution) -> Distribution:
    """The scenario, or each one of a mixture, on a puller.

    What the puller's file says of drives, sensors and melt stands in place of the scenario's. Of the rest, shares,
    temperatures and times stay as they are; lengths are in proportion to r_0, speeds to v_0, powers to the heater's
    range; changes of the reference to v_0 as well, so that the cone angle that they ask for stays. On the default
    puller nothing changes. CzError for a scenario on another puller.
    """
    if isinstance(distribution, Mixture):
        adapted: Any = tuple(adapt_scenario(puller, each) for each in distribution.scenarios)
        return replace(distribution, scenarios=adapted)
    there = getattr(distribution, "puller", DEFAULT.hash)
    if there == puller.hash:
        return distribution
    if isinstance(distribution, ScenarioOn):
        raise CzError(f"scenario {distribution.name!r} is on another puller ({there}) than {puller.label}")
    numbers: dict[str, dict[str, Any]] = {family: {} for family in FAMILIES}
    for family, each, value in distribution.members:
        quantity = each.metadata["member"].quantity
        size = _proportion(puller, "m/s" if (family, each.name) == ("reference", "amount") else quantity.unit)
        scaled = value if size == 1.0 else tuple(size * v for v in value) if isinstance(value, tuple) else size * value
        stated = _stated(puller, quantity)
        numbers[family][each.name] = scaled if stated is None else stated
    families: dict[str, Any] = {family: kind(**numbers[family]) for family, kind in FAMILIES.items()}
    return ScenarioOn(distribution.name, puller=puller.hash, series=distribution.series, **families)


def _proportion(puller: PullerFile, unit: str) -> float:
    """What a scenario's number of this SI unit is multiplied by [-]."""
    if unit in ("W", "W/s"):
        return puller.power_range / DEFAULT.power_range
    speed = puller.parameters.v_0 / DEFAULT.parameters.v_0
    return {"m": puller.scale, "m/s": speed, "m/s2": speed}.get(unit, 1.0)


def _stated(puller: PullerFile, quantity: Quantity) -> Any:
    """What the puller's file says of a scenario's number [SI units]; None: nothing."""
    if quantity.symbol == "pull_window":
        return puller.pull_room if math.isfinite(puller.pull_room) else None
    return value_of(puller, quantity) if quantity.symbol else None
