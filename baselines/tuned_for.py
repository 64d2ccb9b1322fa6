"""Settings that a search has chosen: for a puller those beside its file, for a scenario those of one that contains it.

Those of the default puller are in ``cz_gym/machine/pullers/default``, a file a controller and scenario, with the
history of its search (``python -m cz_gym.baselines.tuning``). Each was searched on training seeds and chosen on
validation seeds.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from cz_gym.episodes.scenario import Scenario
from cz_gym.episodes.scenarios import HARD, PULLER, RANDOMIZED, SENSOR_FAULT
from cz_gym.errors import CzError
from cz_gym.machine.puller import DEFAULT, FOLDER, PullerFile

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


def file_name(controller: str, scenario: str) -> str:
    """Name of the file of a search on the default puller."""
    return f"{controller}.json" if scenario == RANDOMIZED.name else f"{controller}-{scenario}.json"


def tuned_folder(puller: PullerFile) -> Path:
    """The folder of what was found for a puller: beside its file, with its name."""
    return (puller.file or Path(f"{puller.name}.toml")).with_suffix("")


@lru_cache(maxsize=128)
def shipped(controller: str, also: str = "") -> Mapping[str, Mapping[str, float]]:
    """The values chosen for a controller on the default puller, by scenario; where it has none, those of ``also``."""
    found = dict(shipped(also)) if also else {}
    for scenario in (each.name for each in TUNED):
        path = FOLDER / DEFAULT.name / file_name(controller, scenario)
        if path.is_file():
            found[scenario] = json.loads(path.read_text("utf-8"))["chosen"]["values"]
    return found


def found_for(puller: PullerFile, name: str) -> Mapping[str, float]:
    """The values that a search has chosen for a puller, by their paths; empty if there are none.

    Those of the default puller are :func:`shipped`'s: a puller made of its file by other numbers has none. CzError if
    they were chosen for other numbers of the puller.
    """
    path = tuned_folder(puller) / f"{name}.json"
    if puller.file is None or path.parent == FOLDER / DEFAULT.name or not path.is_file():
        return {}
    try:
        kept = json.loads(path.read_text("utf-8"))
        values: dict[str, float] = kept.get("chosen", {"values": {}})["values"]
        made_for = kept["puller"]
    except (KeyError, TypeError, ValueError):
        raise CzError(f"{path}: no choice of a search, or damaged") from None
    if made_for != puller.label:
        raise CzError(f"{path}: found for puller {made_for}, not for {puller.label}: tune again")
    return values


def with_values(settings: Any, values: Mapping[str, float]) -> Any:
    """The settings, dataclasses or NamedTuples, with other numbers, by their paths."""
    for path, value in values.items():
        head, _, rest = path.partition(".")
        new = with_values(getattr(settings, head), {rest: value}) if rest else value
        change = settings._replace if hasattr(settings, "_replace") else partial(replace, settings)
        settings = change(**{head: new})
    return settings


def tuned(start: Any, controller: str, scenario: Scenario, also: str = "") -> Any:
    """The settings ``start`` with the values chosen for a controller; ``also`` as of :func:`shipped`.

    They are those of the first tuned scenario that goes as far as ``scenario`` in every field of KIND, and of SIZE if
    there is such a one. If none does, a warning names the fields.
    """
    chosen = shipped(controller, also)
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
    large_enough = [each for each in fit if not beyond(scenario, each, SIZE)]
    return with_values(start, chosen[(large_enough or fit)[0].name])


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
