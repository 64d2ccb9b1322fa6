"""What every controller on "measured" observations has in common: batches, memories, shapes, control intervals."""

from dataclasses import replace

import numpy as np
import pytest

from cz_gym.baselines.policy import Policy, map_arrays
from cz_gym.baselines.registry import CONTROLLERS, find_controller, make_controller
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from tests.observed import observations

CASES = [(entry.name, "randomized") for entry in CONTROLLERS if entry.observation == "measured" and not entry.slow]
TUNED = ("pid-conventional", "paper-filtered", "paper-tuned", "industrial", "lqg")
CASES += [("paper-tuned", "puller"), ("lqg", "puller"), ("ekf-mpc", "puller")]


def make(name, scenario):
    if name == "ekf-mpc":
        pytest.importorskip("casadi", reason="needs the extra mpc")
    return make_controller(name, make_config(scenario))


@pytest.fixture(scope="module")
def seen():
    return list(observations(steps=8))


@pytest.mark.parametrize(("name", "scenario"), CASES)
def test_slots_do_not_disturb_each_other_and_begin_anew(name, scenario, seen):
    policy, together, alone = make(name, scenario), None, None
    assert isinstance(policy, Policy)
    for rows in seen:
        before = together
        copies = None if before is None else map_arrays(np.copy, before)
        actions, together = policy.predict(rows, together)
        action, alone = policy.predict(rows[1], alone)
        assert (actions.shape, actions.dtype, action.shape) == ((3, 2), np.float32, (2,))
        np.testing.assert_allclose(action, actions[1], rtol=1e-5, atol=1e-6)
        if before is not None:
            map_arrays(np.testing.assert_array_equal, before, copies)
    mixed, _ = policy.predict(seen[-1], together, np.array([True, False, True]))
    new, _ = policy.predict(seen[-1])
    going_on, _ = policy.predict(seen[-1], together)
    np.testing.assert_allclose(mixed[[0, 2]], new[[0, 2]], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(mixed[1], going_on[1], rtol=1e-5, atol=1e-6)
    assert name == "open-loop" or np.abs(new - going_on).max() > 1e-6


@pytest.mark.parametrize("name", ["open-loop", "paper", "paper-tuned", "industrial", "lqg"])
def test_history_is_read_like_measured(name):
    policy = make(name, "randomized")
    for measured, history in zip(observations(steps=2), observations(steps=2, observation="history"), strict=True):
        np.testing.assert_allclose(policy.predict(measured)[0], policy.predict(history)[0], rtol=1e-6)


@pytest.mark.parametrize("name", ["paper", "paper-filtered", "paper-tuned", "pid-conventional", "industrial", "lqg"])
def test_interval_and_pull_speed_are_the_environments(name):
    config = make_config("nominal", control_interval=2.0)
    policy = find_controller(name).make(config)
    assert (policy.control_interval, policy.v_0) == (2.0, config.parameters.v_0)
    with pytest.raises(ValueError, match="control_interval must be a positive number of seconds, not 0"):
        replace(policy, control_interval=0)


@pytest.mark.parametrize("name", TUNED)
@pytest.mark.parametrize("dt", [2.0, 10.0])
def test_every_control_interval_holds_the_radius_alike(name, dt):
    usual, other = (make_config("randomized", control_interval=each, horizon=5400.0) for each in (5.0, dt))
    found = [metrics(rollout(make_controller(name, config), config, range(8))) for config in (usual, other)]
    assert not np.any([m.failure_rate for m in found])
    assert found[1].rmse_mm.mean() == pytest.approx(found[0].rmse_mm.mean(), rel=0.25)


@pytest.mark.parametrize("name", TUNED)
def test_without_disturbance_it_stays_where_it_is(name):
    config = make_config("nominal", control_interval=2.0, horizon=3600.0)
    assert metrics(rollout(make_controller(name, config), config, [0])).max_error_mm[0] < 1e-3
