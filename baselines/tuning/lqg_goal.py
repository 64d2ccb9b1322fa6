"""What the LQG is tuned to, and the numbers that are tuned."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cz_gym.baselines.lqg.controller import LQGSettings
from cz_gym.baselines.lqg.late_ring import RingModel
from cz_gym.baselines.lqg.model import NoiseModel
from cz_gym.baselines.lqg.regulator import Weights
from cz_gym.baselines.lqg.settings import PULLER_RING, QUIET, REWARD
from cz_gym.baselines.policy import Floats

FAILURE_PENALTY = 100.0
"""What losing every crystal costs, in units of a score of order ten."""
_MISS_PENALTY = 20.0
_EMPHASIS = 10.0
_BOUNDS = np.log(1e-4), np.log(1e4)
_GROUPS: dict[str, Any] = {"noise": NoiseModel, "weights": Weights, "ring": RingModel}


@dataclass(frozen=True)
class Knob:
    """One number that is tuned, on a logarithmic scale."""

    group: str
    """Member of :class:`cz_gym.baselines.lqg.controller.LQGSettings`, "noise" or "weights"."""
    name: str


KNOBS = (
    *(Knob("weights", name) for name in ("pull", "pull_step", "heater_step")),
    *(
        Knob("noise", name)
        for name in (
            "fast_sd",
            "slow_sd",
            "drift_rate_sd",
            "drift_rate_tau",
            "heater_walk",
            "thermal_walk",
            "pyrometer_sd",
            "recipe_share",
        )
    ),
)


@dataclass(frozen=True)
class Goal:
    """What a version of the controller is tuned to on a scenario, on mean figures over training episodes."""

    rmse_mm: float
    """Largest radius error that a sensor can show [mm]; missing it costs."""
    pull_step: float
    """Largest pull step RMS [mm/min]; missing it costs."""
    by_return: bool
    """Whether the rest is the mean return, or the radius error."""
    start: LQGSettings
    """Where the search begins."""
    scenario: str = "randomized"
    """Where it is tuned."""
    survive: tuple[str, ...] = ("hard", "puller")
    """Scenarios that only have to be survived, on training seeds of their own."""

    def worth(self, found: Figures) -> float:
        """What is minimised within the limits, failures last; of order one."""
        worth = -found.mean_return / found.steps if self.by_return else found.rmse_mm / self.rmse_mm
        return _EMPHASIS * worth + FAILURE_PENALTY * found.failure_rate

    def room(self, found: Figures) -> tuple[float, float]:
        """Relative distance to the limits, negative beyond them."""
        return 1.0 - found.rmse_mm / self.rmse_mm, 1.0 - found.pull_step / self.pull_step

    def score(self, found: Figures) -> float:
        """What candidates are ranked by: the worth, and what missing a limit costs."""
        return self.worth(found) + _MISS_PENALTY * sum(max(0.0, -room) for room in self.room(found))


@dataclass(frozen=True)
class Figures:
    """Mean figures over episodes."""

    rmse_mm: float
    """Radius error that a sensor can show [mm]."""
    pull_step: float
    heater_step: float
    mean_return: float
    failure_rate: float
    steps: int


_LIVELY = LQGSettings(weights=Weights(pull=0.12, pull_step=0.06, heater_step=0.08))
_CALM = LQGSettings(weights=Weights(pull=0.1, pull_step=0.2, heater_step=0.1))


def _on_puller(settings: LQGSettings) -> LQGSettings:
    """Where the search on ``puller`` begins: ``randomized``'s settings, that camera, and a pyrometer that drifts."""
    return replace(settings, noise=replace(settings.noise, heater_walk=1.0), ring=PULLER_RING)


GOALS = {
    ("lqg", "randomized"): Goal(0.062, 0.02, True, _LIVELY),
    ("lqg-quiet", "randomized"): Goal(0.075, 0.0095, False, _CALM),
    ("lqg", "puller"): Goal(0.09, 0.016, False, _on_puller(REWARD), "puller", ("puller",)),
    ("lqg-quiet", "puller"): Goal(0.1, 0.01, False, _on_puller(QUIET), "puller", ("puller",)),
    ("lqg", "sensor-fault"): Goal(0.063, 0.02, True, REWARD, "sensor-fault", ("sensor-fault",)),
    ("lqg-quiet", "sensor-fault"): Goal(0.076, 0.0095, False, QUIET, "sensor-fault", ("sensor-fault",)),
}
"""By name and scenario: what the shipped versions are tuned to."""


def knobs(settings: LQGSettings) -> Floats:
    """Logarithms of the tuned numbers."""
    return np.log([getattr(getattr(settings, knob.group), knob.name) for knob in KNOBS])


def with_knobs(settings: LQGSettings, values: Floats) -> LQGSettings:
    """The settings with those numbers, to four digits."""
    for knob, value in zip(KNOBS, np.exp(np.clip(values, *_BOUNDS)), strict=True):
        group = replace(getattr(settings, knob.group), **{knob.name: float(f"{value:.4g}")})
        settings = replace(settings, **{knob.group: group})
    return settings


def settings_from(data: dict[str, Any]) -> LQGSettings:
    """Settings from their form in JSON."""
    groups: dict[str, Any] = {}
    for member in dataclasses.fields(LQGSettings):
        value = data.get(member.name)
        if isinstance(value, dict):
            kind = _GROUPS[member.name]
            value = kind(**{name: tuple(part) if isinstance(part, list) else part for name, part in value.items()})
        groups[member.name] = value
    return LQGSettings(**groups)
