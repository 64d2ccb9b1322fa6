"""Every form of the environment refuses the actions of what was made for another one (trap 12)."""

import numpy as np
import pytest
from gymnasium.error import InvalidAction

from cz_gym import CzEnv, CzVectorEnv, Parameters
from cz_gym.action import mark
from cz_gym.body.cost import PULL_TOLERANCE, Cost, Weights, coefficients, cost_slopes, cost_terms
from cz_gym.config import make_config
from cz_gym.differentiable import DifferentiableBatch
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from tests.observed import PLAIN

OWN = make_config(horizon=600.0, **PLAIN)


@pytest.fixture(params=["scalar", "vector", "differentiable"])
def step(request):
    """The step of one form of the environment, with an action of its shape."""
    if request.param == "scalar":
        env = CzEnv.from_config(OWN)
        env.reset(seed=0)
        return env.step, np.zeros(2)
    many = CzVectorEnv.from_config(OWN, 2) if request.param == "vector" else DifferentiableBatch(OWN, 2)
    many.reset(seed=0) if isinstance(many, CzVectorEnv) else many.reset([0, 1])
    return many.step, np.zeros((2, 2))


@pytest.mark.parametrize(
    ("other", "named"),
    [
        ({"action": "smooth"}, "action='smooth'"),
        ({"control_interval": 2.0}, "control_interval=2"),
        ({"parameters": Parameters(v_0=3e-5)}, "plant [0-9a-f]{16}"),
        ({"meniscus": YOUNG_LAPLACE}, "plant [0-9a-f]{16}"),
    ],
)
def test_step_refuses_what_was_made_for_another_environment(step, other, named):
    take, action = step
    theirs = mark(action, make_config(horizon=600.0, **other).made_for)
    with pytest.raises(InvalidAction, match=f"was made for .*{named}.*; the environment has .*gym.make"):
        take(theirs)
    take(np.asarray(theirs))
    take(np.clip(2.0 * theirs, -1.0, 1.0))
    take(mark(action, make_config("hard", **PLAIN).made_for))
    take(mark(action, None))


@pytest.mark.parametrize("weights", [Weights(), Weights(2.0, 0.3, 0.7, 23.4)])
def test_slopes_are_the_derivatives_of_the_terms(weights):
    at = np.array([1e-4, -0.05, 3e-7, 150.0])
    for i in range(4):
        stepped = at.astype(complex)
        stepped[i] += 1e-30j
        found = np.imag(cost_terms(Cost(*stepped), weights)) / 1e-30
        np.testing.assert_allclose(found[i], cost_slopes(Cost(*at), weights)[i], rtol=1e-14)
    counted = at + np.array([0.0, PULL_TOLERANCE, 0.0, 0.0])
    np.testing.assert_allclose(coefficients(weights) * counted**2, cost_terms(Cost(*at), weights), rtol=1e-14)
    assert cost_terms(Cost(*at / 3.0), weights).pull == cost_slopes(Cost(*at / 3.0), weights).pull == 0.0
