"""The example of model-predictive control: the LQG where the plant is linear, and drives that obey."""

from dataclasses import replace

import numpy as np
import pytest

from cz_gym.config import make_config
from cz_gym.episodes.scenario import Actuators
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.evaluation.user_code import controller
from cz_gym.support.units import KILO, MINUTE, MM_PER_MIN
from cz_gym.tools.registry import make_controller
from tests.observed import PLAIN

SEEDS = range(1_000_000, 1_000_002)
PLACE = "examples/mpc.py:mpc"


def test_the_example_holds_a_crystal_as_lqg_does():
    pytest.importorskip("casadi")
    config = make_config(horizon=600.0, **PLAIN)
    own, lqg = (
        rollout(policy, config, SEEDS) for policy in (controller(PLACE).make(config), make_controller("lqg", config))
    )
    assert not own.failed.any()
    np.testing.assert_allclose(metrics(own).rmse_mm, metrics(lqg).rmse_mm, rtol=0.05)


def test_the_example_asks_for_nothing_beyond_the_limits_of_the_drives():
    pytest.importorskip("casadi")
    actuators = Actuators(
        pull_window=0.02 * MM_PER_MIN, pull_slew=0.05 * MM_PER_MIN / MINUTE, heater_slew=0.5 * KILO / MINUTE
    )
    config = make_config(replace(RANDOMIZED, name="narrow", actuators=actuators), horizon=300.0, **PLAIN)
    with pytest.warns(UserWarning, match=r"lqg was not tuned for actuators\.pull_window"):
        run = rollout(controller(PLACE).make(config), config, SEEDS)
    pull = run.signals.v_p - config.parameters.v_0
    assert not run.failed.any()
    assert np.abs(pull).max() == pytest.approx(actuators.pull_window, rel=1e-3)
