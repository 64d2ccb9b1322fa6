"""What each LQG is tuned to on each scenario, and the parameters that are searched."""

from __future__ import annotations

from dataclasses import dataclass, replace

from cz_gym.baselines.lqg.controller import LQGSettings
from cz_gym.baselines.lqg.regulator import Weights
from cz_gym.baselines.lqg.settings import ACTIVITIES, PULLER_RING, SEARCHED, family_name, settings_of

from .harness import Figures, Parameter

FAILURE_PENALTY = 100.0
"""What losing every crystal costs, in units of a score of order ten."""
_MISS_PENALTY = 20.0
_EMPHASIS = 10.0
_QUIET_STEP = 0.0095
_ANY_ERROR = 0.3
SCENARIOS = "randomized", "hard", "sensor-fault", "puller"
"""Where the family has members of its own."""
PARAMETERS = tuple(Parameter(path, 1e-4, 1e4) for path in SEARCHED)
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
_REWARD, _QUIET = settings_of("lqg", "randomized"), settings_of("lqg-quiet", "randomized")
_QUIET_START = LQGSettings(weights=Weights(pull=0.1, pull_step=0.2, heater_step=0.1))


def _on_puller(settings: LQGSettings) -> LQGSettings:
    """Where the search on ``puller`` begins: ``randomized``'s settings, that camera, and a pyrometer that drifts."""
    return replace(settings, noise=replace(settings.noise, heater_walk=1.0), ring=PULLER_RING)


def _member(activity: float, scenario: str) -> Goal:
    """A member of the family: the search begins from a shipped LQG, its weight on pull steps by a rule of thumb."""
    quiet = scenario != "puller" or activity < _QUIET_STEP
    base, step = (settings_of("lqg-quiet", scenario), _QUIET_STEP) if quiet else (settings_of("lqg", scenario), 0.016)
    pull_step = base.weights.pull_step * (step / activity) ** 4
    start = replace(base, weights=replace(base.weights, pull_step=pull_step))
    return Goal(_ANY_ERROR, activity, False, start, scenario, (scenario,))


GOALS = {
    ("lqg", "randomized"): Goal(0.062, 0.02, True, _AGGRESSIVE_START),
    ("lqg-quiet", "randomized"): Goal(0.075, _QUIET_STEP, False, _QUIET_START),
    ("lqg", "puller"): Goal(0.09, 0.016, False, _on_puller(_REWARD), "puller", ("puller",)),
    ("lqg-quiet", "puller"): Goal(0.1, 0.01, False, _on_puller(_QUIET), "puller", ("puller",)),
    ("lqg", "sensor-fault"): Goal(0.063, 0.02, True, _REWARD, "sensor-fault", ("sensor-fault",)),
    ("lqg-quiet", "sensor-fault"): Goal(0.076, _QUIET_STEP, False, _QUIET, "sensor-fault", ("sensor-fault",)),
    **{(family_name(each), scenario): _member(each, scenario) for scenario in SCENARIOS for each in ACTIVITIES},
}
"""By name and scenario: what the shipped versions are tuned to."""
