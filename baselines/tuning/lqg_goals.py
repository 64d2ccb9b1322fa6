"""What each LQG is tuned to on each scenario, and the parameters that are searched."""

from __future__ import annotations

from dataclasses import dataclass, replace

from cz_gym.baselines.lqg.controller import LQGSettings
from cz_gym.baselines.lqg.regulator import Weights
from cz_gym.baselines.lqg.settings import PULLER_RING, QUIET, REWARD

from .harness import Figures, Parameter

FAILURE_PENALTY = 100.0
"""What losing every crystal costs, in units of a score of order ten."""
_MISS_PENALTY = 20.0
_EMPHASIS = 10.0
PARAMETERS = tuple(
    Parameter(path, 1e-4, 1e4)
    for path in (
        *(f"weights.{name}" for name in ("pull", "pull_step", "heater_step")),
        *(f"noise.{name}" for name in ("fast_sd", "slow_sd", "drift_rate_sd", "drift_rate_tau")),
        *(f"noise.{name}" for name in ("heater_walk", "thermal_walk", "pyrometer_sd", "recipe_share")),
    )
)
"""Searched on logarithmic scales."""


@dataclass(frozen=True)
class Goal:
    """What a version of the controller is tuned to on a scenario, in mean figures over training episodes."""

    rmse_mm: float
    """Largest radius error that a sensor can show [mm]; more is penalised."""
    pull_step: float
    """Largest pull step RMS [mm/min]; more is penalised."""
    by_return: bool
    """Whether the mean return is maximised within these limits, or the radius error minimised."""
    start: LQGSettings
    """Where the search begins."""
    scenario: str = "randomized"
    """Where it is tuned."""
    survive: tuple[str, ...] = ("hard", "puller")
    """Scenarios that only have to be survived, on training seeds of their own."""

    def objective(self, found: Figures) -> float:
        """What is minimised within the limits, failures included; of order ten."""
        cost = -found.mean_return / found.steps if self.by_return else found.rmse_mm / self.rmse_mm
        return _EMPHASIS * cost + FAILURE_PENALTY * found.failure_rate

    def slack(self, found: Figures) -> tuple[float, float]:
        """Relative distances to the limits, negative beyond them."""
        return 1.0 - found.rmse_mm / self.rmse_mm, 1.0 - found.pull_step / self.pull_step

    def score(self, found: Figures) -> float:
        """What candidates are ranked by: the objective, and the penalty for missed limits."""
        return self.objective(found) + _MISS_PENALTY * sum(max(0.0, -slack) for slack in self.slack(found))


_AGGRESSIVE_START = LQGSettings(weights=Weights(pull=0.12, pull_step=0.06, heater_step=0.08))
_QUIET_START = LQGSettings(weights=Weights(pull=0.1, pull_step=0.2, heater_step=0.1))


def _on_puller(settings: LQGSettings) -> LQGSettings:
    """Where the search on ``puller`` begins: ``randomized``'s settings, that camera, and a pyrometer that drifts."""
    return replace(settings, noise=replace(settings.noise, heater_walk=1.0), ring=PULLER_RING)


GOALS = {
    ("lqg", "randomized"): Goal(0.062, 0.02, True, _AGGRESSIVE_START),
    ("lqg-quiet", "randomized"): Goal(0.075, 0.0095, False, _QUIET_START),
    ("lqg-active", "hard"): Goal(0.12, 0.03, False, REWARD, "hard", ("hard",)),
    ("lqg-active", "sensor-fault"): Goal(0.06, 0.02, False, REWARD, "sensor-fault", ("sensor-fault",)),
    ("lqg", "puller"): Goal(0.09, 0.016, False, _on_puller(REWARD), "puller", ("puller",)),
    ("lqg-quiet", "puller"): Goal(0.1, 0.01, False, _on_puller(QUIET), "puller", ("puller",)),
    ("lqg", "sensor-fault"): Goal(0.063, 0.02, True, REWARD, "sensor-fault", ("sensor-fault",)),
    ("lqg-quiet", "sensor-fault"): Goal(0.076, 0.0095, False, QUIET, "sensor-fault", ("sensor-fault",)),
}
"""By name and scenario: what the shipped versions are tuned to."""
