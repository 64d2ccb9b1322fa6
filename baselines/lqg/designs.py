"""Tuned designs of the LQGs."""

from __future__ import annotations

from dataclasses import replace

from cz_gym.baselines.tuned_for import tuned
from cz_gym.config import Config
from cz_gym.episodes.scenario import Scenario, Sensor

from .controller import LQG, LQGDesign
from .multiple_model import Hypotheses
from .ring_model import RingModel

MEAN_RIPPLE = 0.4
"""Standard deviation of a ripple whose amplitude is uniform from zero to A, in units of A: 1/sqrt(6), rounded."""
FACTORS = 0.2, 0.6, 1.0
"""Standard deviations of the fluctuations that adaptive LQGs consider possible, in units of the design's own [-]. Above
it the loop is unstable on some hot zones, and its own oscillation then speaks for still stronger fluctuations."""
ACTIVITIES = 0.005, 0.008, 0.013, 0.02, 0.03
"""Largest pull step RMS [mm/min] that the members of the family are tuned for."""


def family_name(activity: float) -> str:
    """Name of the LQG tuned for the radius with a pull step RMS [mm/min] of at most ``activity``."""
    return f"lqg-at-{activity:g}"


FAMILY = ("lqg-quiet", *map(family_name, ACTIVITIES))
"""Names of the LQGs that are tuned for the radius: the reference family of :mod:`cz_gym.evaluation.equal_activity`."""
TOLD = "lqg-at-0.02-nominal"
"""Name of the LQG that was tuned on ``randomized`` alone, whose hot zone is the nominal one; elsewhere lqg-at-0.02."""
SHIPPED = ("lqg", *FAMILY, TOLD)
"""Names of all LQGs."""


def ring_of(sensor: Sensor) -> RingModel | None:
    """The model of a scenario's camera; None for one without latency and ripple."""
    if sensor.latency == 0.0 and not any(sensor.ripple):
        return None
    return RingModel(sensor.latency, MEAN_RIPPLE * sensor.ripple[1], rotation=sensor.rotation)


def design_of(controller: str, scenario: Scenario) -> LQGDesign:
    """The tuned design of an LQG for that scenario, with the model of its camera."""
    start, also = LQGDesign(ring=ring_of(scenario.sensor)), family_name(0.02) if controller == TOLD else ""
    design: LQGDesign = tuned(start, controller, scenario, also)
    return design


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
