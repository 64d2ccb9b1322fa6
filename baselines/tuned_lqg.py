"""The tuned LQGs: a record each."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from cz_gym.config import Config
from cz_gym.episodes.scenario import Distribution, Scenario, Sensor
from cz_gym.episodes.scenarios import PULLER, RANDOMIZED, find_distribution
from cz_gym.puller.file import DEFAULT
from cz_gym.spaces import HEATER_SLACK
from cz_gym.support.errors import CzError

from .lqg import LQG, LQGDesign
from .lqg_estimator import Hypotheses
from .lqg_filter import RingModel
from .tuned import TUNED, Figures, Goal, Parameter, Tuned, by_scenario, for_puller, for_scenario, with_values

MEAN_RIPPLE = 0.4
"""Standard deviation of a ripple whose amplitude is uniform from zero to A, in units of A: 1/sqrt(6), rounded."""
FACTORS = 0.2, 0.6, 1.0
"""Standard deviations of the fluctuations that adaptive LQGs consider possible, in units of the design's own [-]. Above
it the loop is unstable on some hot zones, and its own oscillation then speaks for still stronger fluctuations."""
ACTIVITIES = 0.005, 0.008, 0.013, 0.02, 0.03
"""Largest pull step RMS [mm/min] that the members of the family are tuned for."""
IN_TABLE = 0.02
"""Pull step RMS [mm/min] of the family's member that runs by default: on ``randomized`` the one of least radius error
that moves less than ``paper-tuned``. On a puller of the user's own its filter alone is searched, and the other LQGs
have the same one with their own weights."""
PARAMETERS = tuple(Parameter(path, 1e-4, 1e4) for path in by_scenario("lqg")[RANDOMIZED.name])
ON_PULLER = tuple(
    Parameter(path, 0.0, 0.0)
    for path in ("noise.heater_walk", "noise.thermal_walk", "weights.pull", "weights.pull_step", "weights.heater_step")
)
"""Parameters that are searched for a puller: how much the filter doubts the hot zone, and the LQG's activity."""
LEAST_PULL = 0.1
"""Least weight of the pull speed of an LQG whose drive has a window or a slew rate, which its regulator ignores: with
less it swings between them until the crystal is lost [-]."""
ERROR_SHARE = 0.5
"""Share of such a drive's window that the radius error alone may ask for [-]."""


def ring_of(sensor: Sensor) -> RingModel | None:
    """The model of a scenario's camera; None for one without latency and ripple."""
    if sensor.latency == 0.0 and not any(sensor.ripple):
        return None
    return RingModel(sensor.latency, MEAN_RIPPLE * sensor.ripple[1], rotation=sensor.rotation)


def scaled(design: LQGDesign, config: Config) -> LQGDesign:
    """An LQG's design for the default puller, with this one's camera, sensor noise and melt fluctuation.

    Its filter takes the camera to be no better than the file says, and a ripple that it does not track yet for noise:
    an overconfident filter can explain the ring by a wrong meniscus height, and lose the crystal.
    """
    scenario, known = config.scenario.scenarios[0], design.noise
    melt, sensor, drives = scenario.interface, scenario.sensor, scenario.actuators
    fluctuation = _rms(melt.sd) / _rms(RANDOMIZED.interface.sd)
    least, most = known.camera_sd_range
    noise = replace(
        known,
        fast_sd=fluctuation * known.fast_sd,
        slow_sd=fluctuation * known.slow_sd,
        fast_tau=melt.tau_fast,
        slow_tau=melt.tau_slow,
        pyrometer_sd=_rms(sensor.pyrometer_noise) / _rms(RANDOMIZED.sensor.pyrometer_noise) * known.pyrometer_sd,
        camera_sd=max(float(np.hypot(np.mean(sensor.camera_noise), MEAN_RIPPLE * sensor.ripple[1])), least),
        camera_sd_range=(max(sensor.camera_noise[0], least), most),
        heater_walk=known.heater_walk * config.heater_range / DEFAULT.power_range,
        start_radius_sd=max(scenario.pullers.start_radius_sd, known.start_radius_sd),
    )
    slack = HEATER_SLACK * drives.heater_step
    design = replace(design, noise=noise, ring=ring_of(sensor), heater_slack=slack, error_pull=None)
    if not (math.isfinite(drives.pull_window) or math.isfinite(drives.pull_slew)):
        return design
    weights = design.weights._replace(pull=max(design.weights.pull, LEAST_PULL))
    error_pull = ERROR_SHARE * min(drives.pull_window, config.parameters.v_0)
    return replace(design, weights=weights, error_pull=error_pull)


def _rms(sd: tuple[float, float]) -> float:
    """Root mean square of a standard deviation that is uniform in a range."""
    low, high = sd
    return float(np.sqrt((low * low + low * high + high * high) / 3.0)) or 1e-3


def lqg_goal(
    start: LQGDesign,
    parameters: tuple[Parameter, ...],
    survive: tuple[str, ...],
    rmse_mm: float,
    pull_step: float,
    by_return: bool,
) -> Goal:
    """Maximise the return, or minimise the radius error, within an observable RMSE and a pull step RMS [mm/min]."""

    def objective(figures: Figures) -> float:
        # Scores are about 10.
        cost = -figures.mean_return / figures.steps if by_return else figures.rmse_mm / rmse_mm
        return 10.0 * cost + 100.0 * figures.failure_rate

    limits = (
        lambda figures, _: 1.0 - figures.rmse_mm / rmse_mm,
        lambda figures, _: 1.0 - figures.pull_step / pull_step,
    )
    return Goal(start, parameters, survive, objective, limits, failure_price=100.0, miss_price=20.0)


@dataclass(frozen=True, kw_only=True)
class TunedLQG(Tuned):
    """A tuned LQG."""

    per_parameter: ClassVar[int] = 2

    limits: Mapping[str, tuple[float, float]] = field(hash=False)
    """Largest observable RMSE [mm] and pull step RMS [mm/min] of its searches, by scenario."""
    by_return: bool = False
    """Whether it is tuned for the return, and not for the radius error."""

    def design(self, scenario: Scenario) -> LQGDesign:
        """The tuned design for a scenario, on the default puller, with the model of the scenario's camera."""
        start = LQGDesign(ring=ring_of(scenario.sensor))
        design: LQGDesign = with_values(start, for_scenario(self.name, scenario))
        return design

    def make(self, config: Config) -> LQG:
        """The LQG for an environment: tuned for its scenario, or scaled to its puller with the filter tuned for it."""
        if config.puller == DEFAULT:
            return LQG(design=self.design(config.sole_scenario)).for_config(config)
        values = for_puller(FILTER, config.puller)
        own = {path: value for path, value in values.items() if self.name == FILTER or path.startswith("noise.")}
        return LQG(design=with_values(scaled(self.design(RANDOMIZED), config), own)).for_config(config)

    def goal(self, scenario: Scenario) -> Goal:
        """Its search begins with the design that ships for the scenario."""
        if scenario.name not in self.limits:
            raise CzError(f"{self.name} has no goal on {scenario.name!r}, but on {', '.join(self.limits)}")
        hard = ("hard",) if scenario == RANDOMIZED and "hard" not in self.limits else ()
        survive = (self.crystals(scenario).scenarios[0].name, *hard)
        return lqg_goal(self.design(scenario), PARAMETERS, survive, *self.limits[scenario.name], self.by_return)

    def goal_on(self, config: Config) -> Goal:
        """Its search begins with the scaled design, and stays near it."""
        start = scaled(self.design(RANDOMIZED), config)
        near = tuple(each.near(start) for each in ON_PULLER)
        return lqg_goal(start, near, (), 0.3 * config.puller.scale, 0.02, False)


def family_name(activity: float) -> str:
    """Name of the LQG tuned for the radius with a pull step RMS [mm/min] of at most ``activity``."""
    return f"lqg-at-{activity:g}"


@dataclass(frozen=True, kw_only=True)
class OneDesign(TunedLQG):
    """An LQG with one design for every scenario: like an agent it is not told which one it meets."""

    def design(self, scenario: Scenario) -> LQGDesign:
        """The design, whatever the scenario; its camera may be as late as that of ``puller`` and ripple as much."""
        return replace(super().design(RANDOMIZED), ring=ring_of(PULLER.sensor))

    def make(self, config: Config) -> LQG:
        """The LQG for an environment, of several scenarios too."""
        one = config if config.puller != DEFAULT else config.with_scenario(RANDOMIZED)
        return super().make(one).for_config(config)

    def crystals(self, scenario: Scenario) -> Distribution:
        """The crystals that agents learn from."""
        return find_distribution("all")

    def goal(self, scenario: Scenario) -> Goal:
        """As of every LQG; no crystal of any scenario may be lost."""
        return replace(super().goal(scenario), survive=tuple(each.name for each in self.crystals(scenario).scenarios))


FILTER = family_name(IN_TABLE)
"""Name of the LQG whose filter is searched on a puller."""
BEST_RETURN = TunedLQG(
    name="lqg",
    meaning="Kalman filter and LQ regulator of pull and heater, for the reward",
    limits={"randomized": (0.062, 0.02), "puller": (0.09, 0.016), "sensor-fault": (0.063, 0.02)},
    by_return=True,
    searched_on_puller=False,
)
LQGS = (
    BEST_RETURN,
    TunedLQG(
        name="lqg-quiet",
        meaning="the same for low pull activity",
        limits={"randomized": (0.075, 0.0095), "puller": (0.1, 0.01), "sensor-fault": (0.076, 0.0095)},
        searched_on_puller=False,
    ),
    *(
        TunedLQG(
            name=family_name(activity),
            meaning=f"the same LQG, tuned for the radius error with pull steps of {activity:g} mm/min at most",
            limits={each.name: (0.3, activity) for each in TUNED},
            default=activity == IN_TABLE,
            quoted=activity == IN_TABLE,
            searched_on_puller=activity == IN_TABLE,
        )
        for activity in ACTIVITIES
    ),
    OneDesign(
        name="lqg-one-design",
        meaning="lqg with one design for every scenario: like agents it is not told which one it meets",
        limits={"randomized": (0.3, 0.02)},
        by_return=True,
        quoted=True,
        on_puller=False,
        searched_on_puller=False,
    ),
)
"""Every tuned LQG, in the order of tables."""
FAMILY = tuple(each.name for each in LQGS if not each.by_return)
"""Names of the LQGs that are tuned for the radius: the reference family of :mod:`cz_gym.evaluation.statistics`."""


def adaptive(plain: LQG) -> LQG:
    """The same LQG with a bank of filters, for FACTORS times its standard deviations of the interface fluctuations."""
    noise = plain.design.noise
    fast, slow = (tuple(factor * sd for factor in FACTORS) for sd in (noise.fast_sd, noise.slow_sd))
    return replace(plain, hypotheses=Hypotheses(fast, slow))
