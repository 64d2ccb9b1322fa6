"""Tuned designs of the LQGs (``python -m cz_gym.baselines.tuning``); histories are in results/tuning.

Each was searched on training seeds and chosen on validation seeds of its scenario. Other scenarios have the design of
the tuned one that contains what they contain (:func:`cz_gym.baselines.tuned_for.tuned_scenario`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from cz_gym.baselines.tuned_for import tuned_scenario
from cz_gym.config import Config
from cz_gym.cost import Weights
from cz_gym.episodes.scenario import Scenario, Sensor

from .controller import LQG, LQGDesign
from .model import NoiseModel
from .multiple_model import Hypotheses
from .ring_model import RingModel

MEAN_RIPPLE = 0.4
"""Standard deviation of a ripple whose amplitude is uniform from zero to A, in units of A: 1/sqrt(6), rounded."""
FACTORS = 0.2, 0.6, 1.0
"""Standard deviations of the fluctuations that adaptive LQGs consider possible, in units of the design's own [-]. Above
it the loop is unstable on some hot zones, and its own oscillation then speaks for still stronger fluctuations."""
_WEIGHTS = "pull", "pull_step", "heater_step"
_NOISE = (
    *("fast_sd", "slow_sd", "drift_rate_sd", "drift_rate_tau"),
    *("heater_walk", "thermal_walk", "pyrometer_sd", "recipe_share"),
)
SEARCHED = (*(f"weights.{name}" for name in _WEIGHTS), *(f"noise.{name}" for name in _NOISE))
"""The fields of a design that are searched, joined by dots."""
SHIPPED: dict[str, dict[str, tuple[float, ...]]] = {}
"""The values of SEARCHED, by controller and scenario."""
SHIPPED["lqg"] = {
    "randomized": (0.03194, 0.07751, 14.08, 0.3707, 0.3495, 0.0004499, 1899.0, 0.7744, 0.009623, 0.05514, 0.2616),
    "sensor-fault": (0.1556, 0.06564, 1.712, 0.3106, 0.369, 0.0007519, 2113.0, 0.3833, 0.002862, 0.08655, 0.2398),
    "puller": (0.1095, 0.06209, 1.577, 0.5188, 0.2875, 0.001395, 3324.0, 2.462, 0.002528, 0.08621, 0.3956),
}
SHIPPED["lqg-quiet"] = {
    "randomized": (0.02548, 0.4161, 25.4, 0.2923, 0.3089, 0.0004767, 1874.0, 0.6151, 0.008708, 0.05749, 0.1519),
    "sensor-fault": (0.08919, 0.3056, 1.162, 0.2612, 0.3085, 0.0006116, 2265.0, 0.322, 0.002208, 0.06288, 0.2515),
    "puller": (0.0539, 0.3026, 18.05, 0.205, 0.1956, 0.001543, 4256.0, 0.7207, 0.001945, 0.06032, 0.4671),
}
SHIPPED["lqg-at-0.005"] = {
    "randomized": (0.0482, 3.088, 50.68, 0.2668, 0.2501, 0.0003531, 1685.0, 0.3604, 0.007213, 0.03941, 0.2476),
    "hard": (0.1203, 7.731, 65.77, 0.3968, 0.2511, 0.000434, 2081.0, 0.3209, 0.00168, 0.09346, 0.169),
    "sensor-fault": (0.08746, 2.219, 21.25, 0.2665, 0.2343, 0.000425, 2836.0, 0.2, 0.001301, 0.04757, 0.09942),
    "puller": (0.05424, 3.151, 32.13, 0.2817, 0.1474, 0.001524, 5017.0, 0.7618, 0.001187, 0.05227, 0.4436),
}
SHIPPED["lqg-at-0.008"] = {
    "randomized": (0.02317, 0.684, 28.51, 0.2856, 0.2789, 0.0004505, 2224.0, 0.5837, 0.008395, 0.05054, 0.123),
    "hard": (0.06182, 1.474, 17.77, 0.3521, 0.283, 0.0003514, 1758.0, 0.3411, 0.001205, 0.08939, 0.1761),
    "sensor-fault": (0.02854, 0.4296, 25.02, 0.25, 0.2397, 0.0004108, 2377.0, 0.1691, 0.001065, 0.04579, 0.1651),
    "puller": (0.04922, 0.6152, 17.81, 0.2598, 0.186, 0.001556, 5586.0, 0.8904, 0.002071, 0.04711, 0.3978),
}
SHIPPED["lqg-at-0.013"] = {
    "randomized": (0.007254, 0.1272, 38.28, 0.3059, 0.2493, 0.0005393, 1684.0, 0.4003, 0.008192, 0.03383, 0.1533),
    "hard": (0.02796, 0.3237, 23.68, 0.3443, 0.3294, 0.000469, 1856.0, 0.3631, 0.001409, 0.06889, 0.1616),
    "sensor-fault": (0.01784, 0.09144, 24.14, 0.2502, 0.2634, 0.0005843, 4219.0, 0.2024, 0.001317, 0.04976, 0.1323),
    "puller": (0.1034, 0.1998, 3.906, 0.4948, 0.3275, 0.001769, 3223.0, 2.171, 0.002446, 0.08341, 0.3781),
}
SHIPPED["lqg-at-0.02"] = {
    "randomized": (0.00695, 0.03725, 2.35, 0.3033, 0.3019, 0.0004482, 1894.0, 0.5977, 0.009791, 0.04286, 0.2236),
    "hard": (0.01486, 0.08585, 7.014, 0.3567, 0.3582, 0.000581, 1727.0, 0.3833, 0.001785, 0.09446, 0.1537),
    "sensor-fault": (0.009926, 0.02396, 3.646, 0.2531, 0.2771, 0.0005666, 1880.0, 0.1815, 0.001457, 0.0593, 0.1146),
    "puller": (0.1123, 0.02543, 4.599, 0.5263, 0.2761, 0.001387, 3231.0, 2.467, 0.002457, 0.08634, 0.396),
}
SHIPPED["lqg-at-0.03"] = {
    "randomized": (0.003853, 0.008577, 4.718, 0.2651, 0.2621, 0.0005223, 1929.0, 0.6967, 0.00827, 0.05599, 0.1939),
    "hard": (0.008398, 0.0236, 2.526, 0.3493, 0.3773, 0.0005131, 1658.0, 0.3898, 0.0015, 0.06514, 0.1722),
    "sensor-fault": (0.004386, 0.007273, 2.767, 0.2642, 0.2799, 0.0005114, 1688.0, 0.2092, 0.001668, 0.03648, 0.2068),
    "puller": (0.1095, 0.004902, 2.593, 0.5171, 0.2868, 0.001392, 3235.0, 2.462, 0.002528, 0.08625, 0.3957),
}
TOLD = "lqg-at-0.02-nominal"
"""Name of the LQG that was tuned on ``randomized`` alone, whose hot zone is the nominal one."""
SHIPPED[TOLD] = SHIPPED["lqg-at-0.02"] | {
    "randomized": (0.008875, 0.025, 2.578, 0.2618, 0.2928, 0.000594, 2651.0, 0.2195, 0.001497, 0.04472, 0.1782)
}
ACTIVITIES = 0.005, 0.008, 0.013, 0.02, 0.03
"""Largest pull step RMS [mm/min] that the members of the family are tuned for."""


def family_name(activity: float) -> str:
    """Name of the LQG tuned for the radius with a pull step RMS [mm/min] of at most ``activity``."""
    return f"lqg-at-{activity:g}"


FAMILY = ("lqg-quiet", *map(family_name, ACTIVITIES))
"""Names of the LQGs that are tuned for the radius: the reference family of :mod:`cz_gym.evaluation.equal_activity`."""


def ring_of(sensor: Sensor) -> RingModel | None:
    """The model of a scenario's camera; None for one without latency and ripple."""
    if sensor.latency == 0.0 and not any(sensor.ripple):
        return None
    return RingModel(sensor.latency, MEAN_RIPPLE * sensor.ripple[1], rotation=sensor.rotation)


def design_of(controller: str, scenario: Scenario) -> LQGDesign:
    """The tuned design of an LQG for that scenario, with the model of its camera."""
    shipped = SHIPPED[controller]
    chosen = shipped[tuned_scenario(scenario, shipped, controller)]
    values: dict[str, Any] = dict(zip(SEARCHED, chosen, strict=True))
    return LQGDesign(
        NoiseModel(**{name: values[f"noise.{name}"] for name in _NOISE}),
        Weights(**{name: values[f"weights.{name}"] for name in _WEIGHTS}),
        ring=ring_of(scenario.sensor),
    )


def lqg(name: str, config: Config) -> LQG:
    """The LQG of that name for an environment."""
    return LQG(design=design_of(name, config.sole_scenario)).for_config(config)


def adaptive(plain: LQG) -> LQG:
    """The same LQG with a bank of filters that estimates the strength of each crystal's interface fluctuations.

    Its filters assume FACTORS times the standard deviations of the design, each pair equally likely at first.
    """
    noise = plain.design.noise
    fast, slow = (tuple(factor * sd for factor in FACTORS) for sd in (noise.fast_sd, noise.slow_sd))
    return replace(plain, hypotheses=Hypotheses(fast, slow))
