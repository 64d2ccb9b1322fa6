"""Settings found by ``python -m baselines.tune``, frozen; their histories are in results/tuning.

Each was searched on training seeds and chosen on validation seeds of its scenario. Scenarios without settings of their
own use those of ``randomized``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

from cz_gym.config import Config

from .compensated_pid import Compensator, SeriesPID
from .filtered_pid import FilteredPID
from .industrial import Industrial
from .policy import Policy
from .temperature_loop import TemperatureLoop


class Tuned(NamedTuple):
    """A controller's settings for a scenario."""

    controller: str
    scenario: str
    policy: Any


TUNED: tuple[Tuned, ...] = (
    Tuned(
        "industrial",
        "randomized",
        Industrial(
            T_f=1.338,
            heater=TemperatureLoop(K=407.2, T_i=64.27, share=0.8326, K_pull=36.0, T_pull=6343.0, T_mean=1611.0),
        ),
    ),
    Tuned("paper-filtered", "randomized", FilteredPID(T_f=53.88)),
)
"""All settings; for each controller those of ``randomized`` come first."""


def tuned(controller: str, config: Config) -> Policy:
    """The controller with the settings for that environment; ValueError if it has none."""
    found = {entry.scenario: entry.policy for entry in TUNED if entry.controller == controller}
    if not found:
        raise ValueError(
            f"no settings for {controller!r}; choose from {', '.join(sorted({e.controller for e in TUNED}))}"
        )
    policy = found.get(config.scenario.name, found["randomized"])
    settled: Policy = replace(policy, control_interval=config.control_interval, v_0=config.parameters.v_0)
    return settled
