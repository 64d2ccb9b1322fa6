"""Every form of the environment refuses the actions of what was made for another one (trap 12)."""

import numpy as np
import pytest
from gymnasium.error import InvalidAction

from cz_gym import CzEnv, CzVectorEnv, Parameters
from cz_gym.config import make_config
from cz_gym.engine.tangents import DifferentiableBatch
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.spaces import tag
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
    theirs = tag(action, make_config(horizon=600.0, **other).made_for)
    with pytest.raises(InvalidAction, match=f"was made for .*{named}.*; the environment has .*gym.make"):
        take(theirs)
    take(np.asarray(theirs))
    take(np.clip(2.0 * theirs, -1.0, 1.0))
    take(tag(action, make_config("hard", **PLAIN).made_for))
    take(tag(action, None))
