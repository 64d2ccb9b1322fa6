"""The cost of a step: its four terms, their scales and weights, the reward that follows from it, and derivatives.

Reward, gradients, regulators, bounds and metrics all read this module; whoever weighs the terms otherwise passes
:class:`Weights` of their own. The benchmark's metrics never read the reward.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from cz_gym.jit.compile import jittable

from .units import KILO, MM, MM_PER_MIN


class Cost(NamedTuple):
    """One number for each term of the cost."""

    radius: Any
    """Error of the true radius."""
    pull: Any
    """Deviation of the pull speed from v_0."""
    pull_step: Any
    """Change of the pull speed from the last step to this one."""
    heater_step: Any
    """Change of the heater power from the last step to this one."""


class Weights(NamedTuple):
    """Weights of the four terms [-]; the defaults are the reward's."""

    radius: float = 1.0
    pull: float = 0.5
    pull_step: float = 0.25
    heater_step: float = 0.05


SCALES = Cost(0.5 * MM, 0.36 * MM_PER_MIN, 0.06 * MM_PER_MIN, 1.0 * KILO)
"""The deviations [m, m/s, m/s, W] at which a term equals its weight."""
WEIGHTS = Weights()
"""The weights of the environment's reward."""
COST_CAP = 10.0
"""Limit of the saturated cost of a step, however large its terms [-]."""
FAILURE_COST = 10.0
"""Cost of the failing step and of each step lost to it [-]."""


@jittable
def cost_terms(radius_error: Any, pull: Any, pull_step: Any, heater_step: Any, weights: Any = WEIGHTS) -> Any:
    """The weighted terms [-]; arguments: true radius error [m], v_p - v_0 [m/s], steps of v_p [m/s] and of Q_H [W]."""
    return Cost(
        weights.radius * (radius_error / SCALES.radius) ** 2,
        weights.pull * (pull / SCALES.pull) ** 2,
        weights.pull_step * (pull_step / SCALES.pull_step) ** 2,
        weights.heater_step * (heater_step / SCALES.heater_step) ** 2,
    )


@jittable
def cost_slopes(radius_error: Any, pull: Any, pull_step: Any, heater_step: Any, weights: Any = WEIGHTS) -> Any:
    """The derivative of each of :func:`cost_terms` by its own argument."""
    per_square = coefficients(weights)
    return Cost(
        2.0 * per_square.radius * radius_error,
        2.0 * per_square.pull * pull,
        2.0 * per_square.pull_step * pull_step,
        2.0 * per_square.heater_step * heater_step,
    )


@jittable
def coefficients(weights: Any = WEIGHTS) -> Any:
    """The factor of the squared argument in each of :func:`cost_terms`: its weight over its squared scale."""
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
def saturated_slope(total: Any) -> Any:
    """The derivative of :func:`saturated`."""
    return (COST_CAP / (COST_CAP + total)) ** 2


@jittable
def reward(cost: Any) -> Any:
    """The reward of a step with these cost terms, one minus their saturated sum: between -9 and 1."""
    return 1.0 - saturated(cost.radius + cost.pull + cost.pull_step + cost.heater_step)


@jittable
def failure_penalty(step: Any, steps: Any) -> Any:
    """Added to the reward when step ``step`` of ``steps`` (the first is 1) fails: -10 for it and for each step lost.

    A failing step earns at most 1 - 10 (steps - step + 1). Surviving it earns at least -9 (steps - step + 1), however
    badly: so dying never pays, in the last steps neither.
    """
    return -FAILURE_COST * (steps - step + 1)
