"""The shipped designs on hot zones whose numbers they do not know."""

import pytest

from cz_gym.baselines.lqg_bounds import privileged
from cz_gym.baselines.tuned_lqg import FAMILY
from cz_gym.config import make_config
from cz_gym.evaluation.rollout import rollout
from cz_gym.tools.registry import CONTROLLERS, make_controller
from tests.observed import PLAIN
from tests.samples import NOMINAL_LQG

CRYSTALS = range(16)
ADAPTIVE = [each.name for each in CONTROLLERS if each.name.endswith("-adaptive")]
"""That each of their filters holds the slowest hot zones, ``test_adaptive.py`` tests on the linear loop."""
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in (*FAMILY[1:-1], *ADAPTIVE)]


@pytest.mark.parametrize("name", ["lqg", FAMILY[0], FAMILY[-1], *SLOW])
def test_no_lqg_loses_a_crystal(name):
    config = make_config("hot-zone", **PLAIN)
    assert not rollout(make_controller(name, config), config, CRYSTALS).failed.any()


def test_an_lqg_tuned_on_nominal_hot_zones_loses_crystals_of_others_unless_it_knows_them():
    config = make_config("hot-zone", **PLAIN)
    assert rollout(NOMINAL_LQG, config, CRYSTALS).failed.sum() > 2
    assert not rollout(privileged(NOMINAL_LQG, knows_fluctuations=False), config, CRYSTALS).failed.any()


def test_one_design_serves_every_scenario_and_loses_no_crystal():
    """The design is the same whatever scenario it is asked for."""
    configs = [make_config(name, **PLAIN) for name in ("randomized", "puller", "hot-zone", "all")]
    policies = [make_controller("lqg-one-design", config) for config in configs]
    assert len({policy.design for policy in policies}) == 1
    assert make_controller("lqg", configs[0]).design != make_controller("lqg", configs[1]).design
    for config in configs:
        assert not rollout(policies[0], config, CRYSTALS).failed.any()
