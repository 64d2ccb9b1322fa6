"""The cost of a step: its four terms, their scales and weights, the reward that follows from it, and derivatives.

Reward, gradients, regulators, bounds and reports all read this module. The weights are chosen so that most of a good
controller's cost is its radius error; ``python -m studies.frontier`` shows how well the return ranks controllers.
"""

from typing import Any, NamedTuple

import numpy as np

from cz_gym.jit.compile import jittable
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN


class Cost(NamedTuple):
    """One number for each term of the cost."""

    radius: Any
    """Error of the true radius, less the offset of the bright ring that no sensor shows."""
    pull: Any
    """Deviation of the mean pull speed from v_0, beyond :data:`PULL_TOLERANCE`: it spoils the crystal (v/G)."""
    pull_step: Any
    """Change of the pull speed from the last step to this one."""
    heater_step: Any
    """Change of the heater power from the last step to this one."""


class Weights(NamedTuple):
    """Weights of the four terms [-]; the defaults are the reward's."""

    radius: float = 1.0
    pull: float = 0.5
    pull_step: float = 0.05
    heater_step: float = 0.5


TOLERANCE = 0.5 * MM
"""Half width of the radius' tolerance band [m]."""
PULL_TOLERANCE = 0.03
"""Deviation of the mean pull speed that costs nothing, relative to v_0 [-]."""
PULL_MEMORY = 30.0 * MINUTE
"""Averaging time of that mean, which is exponential [s]."""
SCALES = Cost(TOLERANCE, PULL_TOLERANCE, 0.06 * MM_PER_MIN, 1.0 * KILO)
"""The deviations [m, -, m/s, W] at which a term equals its weight; of the mean pull speed, those beyond its band."""
WEIGHTS = Weights()
"""The weights of the environment's reward."""
COST_CAP = 10.0
"""Limit of the saturated cost of a step, however large its terms [-]."""
FAILURE_COST = 1000.0
"""Cost of a failure: that of the worst hundred steps, so that dying pays at no discount up to 0.99 [-]."""


@jittable
def newest_share(interval: Any) -> Any:
    """Share of an interval [s] in the exponential mean at its end [-]."""
    return 1.0 - np.exp(-interval / PULL_MEMORY)


@jittable
def moved_mean(mean: Any, value: Any, interval: Any) -> Any:
    """The exponential mean after an interval [s] at this value."""
    return mean + newest_share(interval) * (value - mean)


@jittable
def beyond_band(pull: Any) -> Any:
    """The part of a relative deviation that lies beyond :data:`PULL_TOLERANCE`, with its sign [-]."""
    return (pull - PULL_TOLERANCE) * (pull.real > PULL_TOLERANCE) + (pull + PULL_TOLERANCE) * (
        pull.real < -PULL_TOLERANCE
    )


@jittable
def cost_terms(at: Any, weights: Any = WEIGHTS) -> Any:
    """The weighted terms [-] at a radius error [m], a relative deviation of the mean pull speed [-] and steps of both
    drives [m/s, W]."""
    return Cost(
        weights.radius * (at.radius / SCALES.radius) ** 2,
        weights.pull * (beyond_band(at.pull) / SCALES.pull) ** 2,
        weights.pull_step * (at.pull_step / SCALES.pull_step) ** 2,
        weights.heater_step * (at.heater_step / SCALES.heater_step) ** 2,
    )


@jittable
def cost_slopes(at: Any, weights: Any = WEIGHTS) -> Any:
    """The derivative of each of :func:`cost_terms` by its own number."""
    per_square = coefficients(weights)
    return Cost(
        2.0 * per_square.radius * at.radius,
        2.0 * per_square.pull * beyond_band(at.pull),
        2.0 * per_square.pull_step * at.pull_step,
        2.0 * per_square.heater_step * at.heater_step,
    )


@jittable
def outside(radius_error: Any, pull: Any) -> Any:
    """1 where true radius error [m] or mean pull speed, relative [-], is out of tolerance; else 0."""
    return 1.0 * ((np.abs(radius_error) > TOLERANCE) | (np.abs(pull) > PULL_TOLERANCE))


@jittable
def coefficients(weights: Any = WEIGHTS) -> Any:
    """The factor of the square in each of :func:`cost_terms`: its weight over its squared scale."""
    return Cost(
        weights.radius / SCALES.radius**2,
        weights.pull / SCALES.pull**2,
        weights.pull_step / SCALES.pull_step**2,
        weights.heater_step / SCALES.heater_step**2,
    )


@jittable
def saturated(total: Any) -> Any:
    """The cost of a step that learners see, 10 c / (10 + c) for the sum c of its terms: below 10, never flat."""
    return COST_CAP * total / (COST_CAP + total)


@jittable
def reward(cost: Any, grows: Any) -> Any:
    """The reward of a step with these cost terms: one minus their saturated sum, 1,000 less if the crystal is lost."""
    earned = 1.0 - saturated(cost.radius + cost.pull + cost.pull_step + cost.heater_step)
    return earned if grows else earned - FAILURE_COST
