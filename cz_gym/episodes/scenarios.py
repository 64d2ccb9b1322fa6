"""The named scenarios, frozen: the distributions every controller and agent meets."""

from collections.abc import Mapping
from dataclasses import replace
from numbers import Real
from pathlib import Path

from cz_gym.support.errors import CzError
from cz_gym.support.names import unknown_name_message
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN

from .scenario import (
    Actuators,
    AnyScenario,
    Distribution,
    Drift,
    Faults,
    Interface,
    Mixture,
    Pullers,
    Reference,
    Scenario,
    Sensor,
    TemperatureRamp,
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
)

HOT_ZONE = replace(
    RANDOMIZED,
    name="hot-zone",
    pullers=replace(
        RANDOMIZED.pullers,
        conductance=0.0,
        capacity_factor=(0.5, 2.0),
        melt_capacity_factor=(0.7, 1.4),
        conductance_factor=(0.75, 1.33),
    ),
    sensor=replace(RANDOMIZED.sensor, pyrometer_filter=(0.0, 20.0)),
    actuators=replace(RANDOMIZED.actuators, heater_lag=(0.0, 10.0)),
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
