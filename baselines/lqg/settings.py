"""The LQGs that ship: chosen by ``python -m cz_gym.baselines.tuning.lqg``, frozen, hashed; histories in results/tuning.

Each was searched on training seeds and chosen on validation seeds of its scenario. Scenarios without settings of their
own use those of ``randomized``.
"""

from __future__ import annotations

from dataclasses import replace

from cz_gym.config import Config
from cz_gym.units import MM

from .controller import LQG, LQGSettings
from .model import NoiseModel
from .regulator import Weights
from .ring_model import RingModel

REWARD = LQGSettings(
    noise=NoiseModel(
        fast_sd=0.3106,
        slow_sd=0.369,
        drift_rate_sd=0.0007519,
        drift_rate_tau=2113.0,
        heater_walk=0.3833,
        thermal_walk=0.002862,
        recipe_share=0.2398,
        pyrometer_sd=0.08655,
    ),
    weights=Weights(pull=0.1556, pull_step=0.06564, heater_step=0.5706),
)
"""``lqg``: as much reward as a mean radius error of 0.062 mm allows."""
QUIET = LQGSettings(
    noise=NoiseModel(
        fast_sd=0.2614,
        slow_sd=0.311,
        drift_rate_sd=0.0005758,
        drift_rate_tau=2265.0,
        heater_walk=0.3219,
        thermal_walk=0.002207,
        recipe_share=0.2513,
        pyrometer_sd=0.06289,
    ),
    weights=Weights(pull=0.05482, pull_step=0.3051, heater_step=1.168),
)
"""``lqg-quiet``: the radius as well as pull steps of 0.0095 mm/min allow."""
PULLER_RING = RingModel(latency=5.0, ripple_sd=0.08 * MM)
"""The camera of ``puller``: its latency and rotation, and what amplitudes between 0 and 0.2 mm come to on average."""
PULLER_REWARD = LQGSettings(
    noise=NoiseModel(
        fast_sd=0.5188,
        slow_sd=0.2875,
        drift_rate_sd=0.001395,
        drift_rate_tau=3324.0,
        heater_walk=2.462,
        thermal_walk=0.002528,
        recipe_share=0.3956,
        pyrometer_sd=0.08621,
    ),
    weights=Weights(pull=0.1095, pull_step=0.06209, heater_step=1.577),
    ring=PULLER_RING,
)
"""``lqg`` on ``puller``: the observable radius as well as pull steps of 0.016 mm/min allow."""
PULLER_QUIET = LQGSettings(
    noise=NoiseModel(
        fast_sd=0.205,
        slow_sd=0.1956,
        drift_rate_sd=0.001543,
        drift_rate_tau=4256.0,
        heater_walk=0.7207,
        thermal_walk=0.001945,
        recipe_share=0.4671,
        pyrometer_sd=0.06032,
    ),
    weights=Weights(pull=0.0539, pull_step=0.3026, heater_step=18.05),
    ring=PULLER_RING,
)
"""``lqg-quiet`` on ``puller``: the same with pull steps of 0.01 mm/min."""
FAULTY_REWARD = replace(REWARD, weights=replace(REWARD.weights, heater_step=1.712))
"""``lqg`` on ``sensor-fault``: the reward there."""
FAULTY_QUIET = LQGSettings(
    noise=NoiseModel(
        fast_sd=0.2612,
        slow_sd=0.3085,
        drift_rate_sd=0.0006116,
        drift_rate_tau=2265.0,
        heater_walk=0.322,
        thermal_walk=0.002208,
        recipe_share=0.2515,
        pyrometer_sd=0.06288,
    ),
    weights=Weights(pull=0.08919, pull_step=0.3056, heater_step=1.162),
)
"""``lqg-quiet`` on ``sensor-fault``."""
ACTIVE_HARD = LQGSettings(
    noise=NoiseModel(
        fast_sd=0.42,
        slow_sd=0.534,
        drift_rate_sd=0.0007372,
        drift_rate_tau=2585.0,
        heater_walk=0.5908,
        thermal_walk=0.003217,
        recipe_share=0.2228,
        pyrometer_sd=0.09231,
    ),
    weights=Weights(pull=0.03605, pull_step=0.03241, heater_step=8.442),
)
"""``lqg-active`` on ``hard``: the radius as well as pull steps of 0.03 mm/min allow. No controller of its own: a
member of the family below."""
ACTIVE_FAULTY = LQGSettings(
    noise=NoiseModel(
        fast_sd=0.2746,
        slow_sd=0.3879,
        drift_rate_sd=0.0006,
        drift_rate_tau=1919.0,
        heater_walk=0.5296,
        thermal_walk=0.002281,
        recipe_share=0.2213,
        pyrometer_sd=0.08107,
    ),
    weights=Weights(pull=0.04006, pull_step=0.03163, heater_step=2.848),
)
"""``lqg-active`` on ``sensor-fault``: the observable radius as well as pull steps of 0.02 mm/min allow."""
SHIPPED: dict[tuple[str, str], LQGSettings] = {
    ("lqg", "randomized"): REWARD,
    ("lqg-quiet", "randomized"): QUIET,
    ("lqg", "puller"): PULLER_REWARD,
    ("lqg-quiet", "puller"): PULLER_QUIET,
    ("lqg", "sensor-fault"): FAULTY_REWARD,
    ("lqg-quiet", "sensor-fault"): FAULTY_QUIET,
    ("lqg-active", "hard"): ACTIVE_HARD,
    ("lqg-active", "sensor-fault"): ACTIVE_FAULTY,
}
"""By controller and scenario."""


MEMBERS: dict[str, dict[float, tuple[str, float]]] = {
    "randomized": {
        0.003: ("lqg-quiet", 23.83),
        0.005: ("lqg-quiet", 3.011),
        0.008: ("lqg-quiet", 0.4969),
        0.013: ("lqg-quiet", 0.07386),
        0.02: ("lqg-quiet", 0.01232),
        0.03: ("lqg-quiet", 0.004767),
    },
    "hard": {
        0.003: ("lqg", 16.8),
        0.005: ("lqg-active", 21.99),
        0.008: ("lqg-active", 3.874),
        0.013: ("lqg-active", 0.672),
        0.02: ("lqg-active", 0.1405),
        0.03: ("lqg-active", 0.03068),
    },
    "sensor-fault": {
        0.003: ("lqg", 29.58),
        0.005: ("lqg-quiet", 3.599),
        0.008: ("lqg-quiet", 0.591),
        0.013: ("lqg-active", 0.1511),
        0.02: ("lqg-active", 0.0291),
        0.03: ("lqg-active", 0.005465),
    },
    "puller": {
        0.003: ("lqg-quiet", 40.07),
        0.005: ("lqg-quiet", 4.025),
        0.008: ("lqg-quiet", 0.556),
        0.013: ("lqg", 0.1428),
        0.02: ("lqg", 0.00467),
        0.03: ("lqg", 0.0009702),
    },
}
"""By scenario and pull step RMS [mm/min]: a shipped LQG, and the weight on pull steps that makes it a member of the
family; chosen by ``python -m cz_gym.baselines.tuning.lqg_frontier``."""
ACTIVITIES = tuple(MEMBERS["randomized"])
"""Pull step RMS [mm/min] that the members are made for."""


def family_name(activity: float) -> str:
    """Name of the LQG made for that pull step RMS [mm/min]."""
    return f"lqg-at-{activity:g}"


FAMILY = ("lqg-quiet", *map(family_name, ACTIVITIES))
"""Names of the LQGs that are tuned for the radius: the reference family of :mod:`cz_gym.evaluation.equal_activity`."""


def settings_of(controller: str, scenario: str) -> LQGSettings:
    """The frozen settings of "lqg", "lqg-quiet" or "lqg-active" for that scenario."""
    where = scenario if (controller, scenario) in SHIPPED else "randomized"
    return SHIPPED[controller, where]


def member_settings(activity: float, scenario: str) -> LQGSettings:
    """The frozen settings of the member for that pull step RMS [mm/min], one of ACTIVITIES, on that scenario."""
    where = scenario if scenario in MEMBERS else "randomized"
    base, pull_step = MEMBERS[where][activity]
    return with_pull_step(settings_of(base, where), pull_step)


def with_pull_step(settings: LQGSettings, weight: float) -> LQGSettings:
    """The same settings with another weight on pull steps."""
    return replace(settings, weights=replace(settings.weights, pull_step=weight))


def _lqg(settings: LQGSettings, config: Config) -> LQG:
    return LQG(settings, config.control_interval, config.parameters, config.meniscus)


def lqg(config: Config) -> LQG:
    """The LQG tuned to the reward."""
    return _lqg(settings_of("lqg", config.scenario.name), config)


def lqg_quiet(config: Config) -> LQG:
    """The LQG tuned to low pull activity."""
    return _lqg(settings_of("lqg-quiet", config.scenario.name), config)


def lqg_at(activity: float, config: Config) -> LQG:
    """The LQG made for that pull step RMS [mm/min]."""
    return _lqg(member_settings(activity, config.scenario.name), config)
