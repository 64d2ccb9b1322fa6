"""Choice of tuned settings by what a scenario contains, whatever its name is."""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Mapping
from typing import Any

from cz_gym.episodes.scenario import Scenario
from cz_gym.episodes.scenarios import HARD, PULLER, RANDOMIZED, SENSOR_FAULT

TUNED = (RANDOMIZED, HARD, SENSOR_FAULT, PULLER)
"""Scenarios that controllers are tuned on, the least demanding first."""
KIND = {
    "sensor": ("pyrometer_drift", "ripple", "latency", "outlier_probability", "outlier_sd"),
    "faults": ("flagged", "flagged_duration", "unflagged", "unflagged_duration", "dropout"),
    "actuators": ("pull_window", "pull_slew", "heater_slew", "heater_step"),
}
"""Fields, by family, that settings must have been tuned for: sensors, camera faults and limits of the drives."""
SIZE = {"interface": ("sd",), "sensor": ("camera_noise", "pyrometer_noise")}
"""Fields by which settings are chosen where those for larger disturbances exist."""


def tuned_scenario(scenario: Scenario, among: Collection[str], controller: str) -> str:
    """Name of the tuned scenario whose settings a controller should have on another one.

    It is the first of those in ``among`` that goes as far in every field of KIND, and of SIZE if there is such a one.
    If none does, a warning names the fields.
    """
    tuned = [each for each in TUNED if each.name in among]
    fit = [each for each in tuned if not beyond(scenario, each)]
    if not fit:
        nearest = min(reversed(tuned), key=lambda each: len(beyond(scenario, each)))
        fields = ", ".join(beyond(scenario, nearest))
        warnings.warn(
            f"{controller} was not tuned for {fields} of scenario {scenario.name!r}: it has the settings "
            f"for {nearest.name!r}",
            stacklevel=2,
        )
        return nearest.name
    large_enough = [each for each in fit if not beyond(scenario, each, SIZE)]
    return (large_enough or fit)[0].name


def beyond(scenario: Scenario, tuned: Scenario, fields: Mapping[str, tuple[str, ...]] = KIND) -> list[str]:
    """The fields in which a scenario asks for more than a tuned one."""
    found = []
    for family, names in fields.items():
        asked, known = getattr(scenario, family), getattr(tuned, family)
        for name in names:
            sign = -1.0 if getattr(type(known)(), name) == math.inf else 1.0  # a lower limit is the harder one
            if sign * _largest(getattr(asked, name)) > sign * _largest(getattr(known, name)):
                found.append(f"{family}.{name}")
    return found


def _largest(value: Any) -> float:
    """The largest absolute value of a number or a range."""
    return float(max(map(abs, value)) if isinstance(value, tuple) else abs(value))
