import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cz_gym import CzEnv, make_puller
from cz_gym.body.signals import Cost, cost_terms, reward
from cz_gym.physics.plant import within_limits
from tests.observed import PLAIN

MM, MM_PER_MIN = 1e-3, 1e-3 / 60
P = make_puller()


@given(st.floats(0, 8e-3), st.floats(1e-6, 1e-3), st.floats(-1.0, 1.0), st.floats(-2e4, 2e4))
def test_reward_saturates_and_is_never_flat(error, more, pull, heater):
    near, far = (reward(cost_terms(Cost(e, pull, 4e-5 * pull, heater)), True) for e in (error, error + more))
    assert -9.0 < far < near <= 1.0


def test_a_crystal_grows_within_its_limits_alone():
    for r_c in (P.r_0 - 7.9 * MM, P.r_0 + 7.9 * MM):
        for h_c in (1.21 * MM, 1.239 * P.a):
            assert within_limits(r_c, h_c, P.r_0, P.a)
    for beyond in (P.r_0 - 8.1 * MM, P.r_0 + 8.1 * MM, math.nan):
        assert not within_limits(beyond, P.h_0, P.r_0, P.a)
    for beyond in (1.19 * MM, 1.241 * P.a, math.nan):
        assert not within_limits(P.r_0, beyond, P.r_0, P.a)


@given(st.floats(0.0, 0.99), st.floats(0.0, 1e12))
def test_a_failing_step_earns_less_than_the_worst_life(discount, cost):
    """A failing step earns no more than the worst life without an end, discounted."""
    zero = Cost(0.0, 0.0, 0.0, 0.0)
    worst = reward(zero._replace(radius=cost), True)
    assert reward(zero, False) <= worst / (1.0 - discount)


def test_failure_inside_a_long_interval_is_latched():
    """Ten minutes at full pull detach the crystal; the state stays where it failed, finite and measured."""
    env = CzEnv("nominal", control_interval=600.0, horizon=6000.0, info="all", **PLAIN)
    env.reset(seed=0)
    observation, gained, terminated, _, info = env.step(np.array([1.0, 0.0], np.float32))
    assert terminated
    assert 1.24 * P.a < info["h_c"] < 1.26 * P.a
    assert all(math.isfinite(value) for value in info.values())
    assert np.isfinite(observation).all()
    assert gained < -999.0


def test_failing_at_the_horizon_is_a_failure():
    """The same flight with the horizon at its end: terminated, not truncated, and as dear."""
    flights = []
    for horizon in (10800.0, None):
        env = CzEnv("nominal", "II", horizon=horizon or 5.0 * len(flights[0]), **PLAIN)
        env.reset(seed=0)
        flights.append([])
        while not flights[-1] or flights[-1][-1][1:] == (False, False):
            flights[-1].append(env.step(np.array([1.0, 0.0], np.float32))[1:4])
    assert flights[0] == flights[1]
    assert flights[0][-1][1:] == (True, False)
