"""The named scenarios, frozen: the distributions every controller and agent meets; and how a puller changes them."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path
from typing import Any

from cz_gym.physics.parameters import Quantity
from cz_gym.puller.file import DEFAULT, PullerFile, value_of
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from .scenario import (
    FAMILIES,
    Actuators,
    AnyScenario,
    Distribution,
    Drift,
    DriveReadings,
    Faults,
    Interface,
    Mixture,
    Pullers,
    Reference,
    Scenario,
    Sensor,
    TemperatureRamp,
    Told,
    make_mixture,
    read_series,
)

K_PER_MIN = 1.0 / MINUTE


def _minutes(low: float, high: float) -> tuple[float, float]:
    return low * MINUTE, high * MINUTE


def _either_way(size: float) -> tuple[float, float]:
    return -size, size


_FALL = Reference(probability=1.0, duration=_minutes(30, 30), start=_minutes(10, 10))

NOMINAL = Scenario("nominal")

PAPER_RAMP = Scenario(
    "paper-ramp",
    recipe=TemperatureRamp(rate=(0.5 * K_PER_MIN, 0.5 * K_PER_MIN), duration=_minutes(10, 10), start=_minutes(10, 10)),
)

REFERENCE_A = Scenario("reference-a", reference=replace(_FALL, amount=(-2.5 * MM, -2.5 * MM)))
REFERENCE_B = Scenario("reference-b", reference=replace(_FALL, amount=(-0.5 * MM, -0.5 * MM)))

RANDOMIZED = Scenario(
    "randomized",
    pullers=Pullers(mix=(0.0, 1.0), capillary=0.03, conductivity=0.1, conductance=0.1, start_radius_sd=0.2 * MM),
    recipe=TemperatureRamp(rate=_either_way(0.5 * K_PER_MIN), duration=_minutes(5, 10), start=_minutes(10, 110)),
    drift=Drift(amount=_either_way(5.0), duration=_minutes(20, 100), start=_minutes(0, 100)),
    interface=Interface(sd=(0.0, 0.5)),
    reference=Reference(
        probability=0.5, amount=_either_way(2.5 * MM), duration=_minutes(20, 50), start=_minutes(10, 110)
    ),
    sensor=Sensor(camera_noise=(0.0, 0.05 * MM), pyrometer_noise=(0.0, 0.1)),
)

HARD = Scenario(
    "hard",
    pullers=Pullers(mix=(0.0, 1.0), capillary=0.045, conductivity=0.15, conductance=0.15, start_radius_sd=0.3 * MM),
    recipe=replace(RANDOMIZED.recipe, rate=_either_way(0.75 * K_PER_MIN)),
    drift=replace(RANDOMIZED.drift, amount=_either_way(7.5)),
    interface=Interface(sd=(0.0, 0.75)),
    reference=replace(RANDOMIZED.reference, amount=_either_way(3.75 * MM)),
    sensor=Sensor(camera_noise=(0.0, 0.1 * MM), pyrometer_noise=(0.0, 0.2)),
)

SENSOR_FAULT = replace(
    RANDOMIZED,
    name="sensor-fault",
    faults=Faults(
        flagged=(1, 3),
        flagged_duration=(30.0, 180.0),
        unflagged=1,
        unflagged_duration=(30.0, 60.0),
        dropout=(0.0, 0.05),
        bias_drift=_either_way(0.3 * MM),
        bias_drift_duration=(1.0 * HOUR, 2.0 * HOUR),
    ),
)

_ROUGHLY_TOLD = Told(power_sd=1.0 * KILO, temperature_sd=2.0)

PULLER = replace(
    RANDOMIZED,
    name="puller",
    pullers=replace(RANDOMIZED.pullers, melt_loss=0.1),
    drift=replace(RANDOMIZED.drift, rate=0.1 * K_PER_MIN),
    sensor=replace(
        RANDOMIZED.sensor,
        pyrometer_drift=_either_way(2.0),
        bias_offset=_either_way(0.3 * MM),
        level_offset=_either_way(0.1 * MM),
        ripple=(0.0, 0.2 * MM),
        rotation=(8.0 / MINUTE, 15.0 / MINUTE),
        averaging=1.0,
        latency=5.0,
        outlier_probability=0.005,
        outlier_sd=1.0 * MM,
    ),
    actuators=Actuators(
        pull_window=0.5 * MM_PER_MIN,
        pull_slew=0.3 * MM_PER_MIN / MINUTE,
        heater_slew=2.0 * KILO / MINUTE,
        heater_step=0.1 * KILO,
    ),
    readings=DriveReadings(scale_sd=0.01),
    told=_ROUGHLY_TOLD,
)
PULLER_FRAMES = replace(PULLER, name="puller-frames", sensor=replace(PULLER.sensor, averaging=0.0))

HOT_ZONE = replace(
    RANDOMIZED,
    name="hot-zone",
    pullers=replace(
        RANDOMIZED.pullers,
        conductance=0.0,
        capacity_factor=(0.5, 2.0),
        melt_capacity_factor=(0.7, 1.4),
        conductance_factor=(0.75, 1.33),
        boundary_layer=(0.0, 8e-4),
    ),
    sensor=replace(RANDOMIZED.sensor, pyrometer_filter=(0.0, 20.0)),
    actuators=replace(RANDOMIZED.actuators, heater_lag=(0.0, 10.0)),
    told=_ROUGHLY_TOLD,
)

MELT_LAYER = replace(RANDOMIZED, name="melt-layer", pullers=replace(RANDOMIZED.pullers, boundary_layer=(7e-4, 7e-4)))
TRACED_SLOPE = math.radians(39.3)
"""Slope of the meniscus at the edge of the bright area that rays through the exact meniscus show [rad]."""
RANDOMIZED_TRACED = replace(
    RANDOMIZED, name="randomized-traced", pullers=replace(RANDOMIZED.pullers, ring_slope=TRACED_SLOPE)
)

_ONE_FAMILY = (
    *(Scenario(f"only-{family}", **{family: getattr(RANDOMIZED, family)})
      for family in ("recipe", "drift", "interface", "sensor", "reference")),
    Scenario("only-parameters", pullers=RANDOMIZED.pullers),
)  # fmt: skip

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        NOMINAL, PAPER_RAMP, REFERENCE_A, REFERENCE_B, RANDOMIZED, HARD, SENSOR_FAULT, PULLER, HOT_ZONE, *_ONE_FAMILY,
        PULLER_FRAMES, MELT_LAYER, RANDOMIZED_TRACED,
    )
}  # fmt: skip
"""Every named scenario."""
ALIASES = {"unknown-puller": PULLER.name}
"""Aliases of scenario names. In unknown-puller, hot zone, camera and drives are not what controllers were told."""
ALL = make_mixture([(RANDOMIZED, 0.3), *((each, 0.175) for each in (HARD, SENSOR_FAULT, PULLER, HOT_ZONE))])
"""The mixture "all": every random scenario of the benchmark's default table."""

_ROWS = {
    "I": "model='I'",
    "II": "model='II'",
    "2s": "control_interval=2.0",
    "10s": "control_interval=10.0",
    "exact": "meniscus=cz_gym.physics.young_laplace.YOUNG_LAPLACE",
}
"""Suffixes of the benchmark's rows, and the arguments of the environment that they stand for."""


def find_distribution(given: AnyScenario) -> Distribution:
    """The scenario or mixture that is meant by a name ("all" too), a scenario, a mixture, or scenarios with shares.

    A name that ends with .csv is a file of disturbances from logs.
    """
    if isinstance(given, str | Path) and str(given).endswith(".csv"):
        return read_series(Path(given), RANDOMIZED.sensor)
    if isinstance(given, str) and given == "all":
        return ALL
    if isinstance(given, Mapping):
        return make_mixture([(find_scenario(each), share) for each, share in given.items()])
    return given if isinstance(given, Mixture) else find_scenario(given)


def find_scenario(scenario: AnyScenario) -> Scenario:
    """Return the scenario of this name, or the given one; raise CzError if there is none, and for a mixture."""
    if isinstance(scenario, str | Path) and str(scenario).endswith(".csv"):
        scenario = find_distribution(scenario)
    if isinstance(scenario, Scenario):
        return scenario
    if isinstance(scenario, Mixture | Mapping) or scenario == "all":
        raise CzError(f"this needs one scenario, not the mixture {find_distribution(scenario).name!r}")
    if isinstance(scenario, str) and ALIASES.get(scenario, scenario) in SCENARIOS:
        return SCENARIOS[ALIASES.get(scenario, scenario)]
    name, _, row = scenario.rpartition("-") if isinstance(scenario, str) else ("", "", "")
    if name in SCENARIOS and row in _ROWS:
        raise CzError(f"{scenario!r} is a row of the benchmark: the scenario is {name!r}, with {_ROWS[row]}")
    also = "" if isinstance(scenario, str) else ", or pass a cz_gym.Scenario, or a dict of scenarios and their shares"
    raise CzError(unknown_name_message("scenario", scenario, [*SCENARIOS, *ALIASES, "all"], also))


def mix_of(model: str | float | None, distribution: Distribution) -> tuple[float, float]:
    """Range of lambda [-] for the environment's ``model`` argument; CzError for anything else."""
    if model is None:
        lows, highs = zip(*(scenario.pullers.mix for scenario in distribution.scenarios), strict=True)
        return min(lows), max(highs)
    if isinstance(model, str) and model in ("I", "II"):
        return (1.0, 1.0) if model == "I" else (0.0, 0.0)
    if isinstance(model, Real) and not isinstance(model, bool) and 0.0 <= model <= 1.0:
        return float(model), float(model)
    raise CzError(f'model must be "I", "II", a mix in [0, 1] or None, not {model!r}')


# A scenario on a puller: what belongs to the machine is the puller file's, the rest is in proportion to it.


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
    """Factor on a scenario's number of this SI unit [-]."""
    if unit in ("W", "W/s"):
        return puller.power_range / DEFAULT.power_range
    speed = puller.parameters.v_0 / DEFAULT.parameters.v_0
    return {"m": puller.scale, "m/s": speed, "m/s2": speed}.get(unit, 1.0)


def _stated(puller: PullerFile, quantity: Quantity) -> Any:
    """Value of a scenario's number in the puller's file [SI units]; None: the file has none."""
    if quantity.symbol == "pull_window":
        return puller.pull_room if math.isfinite(puller.pull_room) else None
    return value_of(puller, quantity) if quantity.symbol else None
