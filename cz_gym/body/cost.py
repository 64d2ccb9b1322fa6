"""The cost of a step: its four terms, their scales and weights, the reward that follows from it, and derivatives.

Reward, gradients, regulators, bounds and reports all read this module. The weights are chosen so that most of a good
controller's cost is its radius error; ``python -m studies.frontier`` shows how well the return ranks controllers.
"""

from typing import Any, NamedTuple

from cz_gym.jit.compile import jittable
from cz_gym.support.units import KILO, MM, MM_PER_MIN


class Cost(NamedTuple):
    """One number for each term of the cost."""

    radius: Any
    """Error of the true radius, less the offset of the bright ring that no sensor shows."""
    pull: Any
    """Deviation of the pull speed from v_0, beyond :data:`PULL_BAND`."""
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


SCALES = Cost(0.5 * MM, 0.36 * MM_PER_MIN, 0.06 * MM_PER_MIN, 1.0 * KILO)
"""The deviations [m, m/s, m/s, W] at which a term equals its weight."""
PULL_BAND = 0.24 * MM_PER_MIN
"""Deviation of the pull speed that costs nothing, a fifth of v_0 [m/s]: good controllers rarely leave this band; a
learner that does is led back before the pull speed meets the limits of its drive."""
WEIGHTS = Weights()
"""The weights of the environment's reward."""
COST_CAP = 10.0
"""Limit of the saturated cost of a step, however large its terms [-]."""
FAILURE_COST = 1000.0
"""Cost of a failure: that of the worst hundred steps, so that dying pays at no discount up to 0.99 [-]."""


@jittable
def beyond_band(pull: Any) -> Any:
    """The part of a pull speed's deviation that lies beyond :data:`PULL_BAND`, with its sign [m/s]."""
    return (pull - PULL_BAND) * (pull.real > PULL_BAND) + (pull + PULL_BAND) * (pull.real < -PULL_BAND)


@jittable
def cost_terms(radius_error: Any, pull: Any, pull_step: Any, heater_step: Any, weights: Any = WEIGHTS) -> Any:
    """The weighted terms [-]; arguments: radius error [m], v_p - v_0 [m/s], steps of v_p [m/s] and of Q_H [W]."""
    return Cost(
        weights.radius * (radius_error / SCALES.radius) ** 2,
        weights.pull * (beyond_band(pull) / SCALES.pull) ** 2,
        weights.pull_step * (pull_step / SCALES.pull_step) ** 2,
        weights.heater_step * (heater_step / SCALES.heater_step) ** 2,
    )


@jittable
def cost_slopes(radius_error: Any, pull: Any, pull_step: Any, heater_step: Any, weights: Any = WEIGHTS) -> Any:
    """The derivative of each of :func:`cost_terms` by its own argument."""
    per_square = coefficients(weights)
    return Cost(
        2.0 * per_square.radius * radius_error,
        2.0 * per_square.pull * beyond_band(pull),
        2.0 * per_square.pull_step * pull_step,
        2.0 * per_square.heater_step * heater_step,
    )


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
