"""The LQGs that ship: chosen by ``python -m baselines.lqg_tune``, frozen, hashed; histories in results/tuning."""

from __future__ import annotations

from cz_gym.config import Config

from .lqg import LQG, LQGSettings
from .lqg_bounds import FullInformation, ToldLQG
from .lqg_model import NoiseModel
from .lqr import Weights

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


def lqg(config: Config) -> LQG:
    """The LQG tuned to the reward."""
    return LQG(REWARD, config.control_interval, config.parameters, config.meniscus)


def lqg_quiet(config: Config) -> LQG:
    """The LQG tuned to low pull activity."""
    return LQG(QUIET, config.control_interval, config.parameters, config.meniscus)


def lqg_true(config: Config) -> ToldLQG:
    """Bound: the LQG told each puller's parameters."""
    return ToldLQG(REWARD, config.control_interval, config.parameters, config.meniscus)


def full_information(config: Config) -> FullInformation:
    """Bound: the LQG's regulator on the true state and the present disturbances."""
    return FullInformation(lqg_true(config))
