"""The LQGs that ship: chosen by ``python -m baselines.lqg_tune``, frozen, hashed; histories in results/tuning."""

from __future__ import annotations

from cz_gym.config import Config

from .lqg import LQG, LQGSettings
from .lqg_bounds import FullInformation, ToldLQG
from .lqr import Weights

REWARD = LQGSettings(weights=Weights(pull=0.12, pull_step=0.06, heater_step=0.08))
"""``lqg``: as much reward as a mean radius error of 0.062 mm allows."""
QUIET = LQGSettings(weights=Weights(pull=0.1, pull_step=0.2, heater_step=0.1))
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
