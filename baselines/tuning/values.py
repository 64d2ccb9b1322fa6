"""Values that searches have chosen for controllers, by scenario for the default puller, or for another puller.

Those of the default puller are in ``cz_gym/machine/pullers/default``, a file a controller and scenario; those of
another puller are in the folder beside its file. Each file has the history of its search (``cz-gym tune``).
"""

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
