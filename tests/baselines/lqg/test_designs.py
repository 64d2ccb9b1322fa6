"""The shipped designs on hot zones that they are not told."""

import pytest

from cz_gym.baselines.lqg.designs import FAMILY, TOLD
from cz_gym.baselines.registry import WITH_ADAPTIVE, make_controller
from cz_gym.config import make_config
from cz_gym.evaluation.rollout import rollout
from tests.observed import PLAIN

CRYSTALS = range(16)
BETWEEN = [pytest.param(name, marks=pytest.mark.slow) for name in FAMILY[1:-1]]
ADAPTIVE = [pytest.param(f"{name}-adaptive", marks=pytest.mark.slow) for name in WITH_ADAPTIVE]
"""That each of their filters holds the slowest hot zones, ``test_adaptive.py`` tests on the linear loop."""


@pytest.mark.parametrize("name", ["lqg", FAMILY[0], *BETWEEN, FAMILY[-1], *ADAPTIVE])
def test_no_lqg_loses_a_crystal(name):
    config = make_config("hot-zone", **PLAIN)
    assert not rollout(make_controller(name, config), config, CRYSTALS).failed.any()


def test_an_lqg_tuned_on_nominal_hot_zones_loses_crystals_of_others_unless_told_of_them():
    config = make_config("hot-zone", **PLAIN)
    tuned, told = (make_controller(name, config) for name in (TOLD, "lqg-at-0.02-told"))
    assert rollout(tuned, config, CRYSTALS).failed.sum() > 2
    assert not rollout(told, config, CRYSTALS).failed.any()
