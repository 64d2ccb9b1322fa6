"""Cost, reward and limits of a crystal's body: their numbers, and what an environment's weights change."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cz_gym import CzEnv, CzVectorEnv, make_puller
from cz_gym.body.signals import PULL_TOLERANCE, Cost, Weights, coefficients, cost_slopes, cost_terms, reward
from cz_gym.config import make_config
from cz_gym.engine.tangents import DifferentiableBatch
from cz_gym.physics.plant import within_limits
from cz_gym.support.units import MM
from tests.observed import PLAIN

P, V_0 = make_puller(), 1.2e-3 / 60


def test_each_term_is_its_weight_at_its_scale():
    """Radius 0.5 mm, mean pull speed twice the 3 % that are free, steps of 0.06 mm/min and 1 kW."""
    assert cost_terms(Cost(0.5e-3, -0.06, 0.06e-3 / 60, 1e3)) == pytest.approx(Weights(1.0, 0.5, 0.05, 0.5))


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


def test_info_says_in_every_form_whether_a_crystal_is_out_of_tolerance():
    """0.5 mm of radius, or 3 % of the mean pull speed; the scalar environment is the first slot."""
    n, kinds = 16, set()
    whole, lean, one = CzVectorEnv(n, "hard", info="all"), CzVectorEnv(n, "hard"), CzEnv("hard")
    every, brief, single = (env.reset(seed=7)[1] for env in (whole, lean, one))
    for k in range(240):
        off = np.abs(every["r_c"] - every["r_ref"]) > 0.5e-3
        fast = np.abs(every["v_p_mean"] / V_0 - 1.0) > 0.03
        np.testing.assert_array_equal(every["cost"], np.where(off | fast, 1.0, 0.0))
        np.testing.assert_array_equal(brief["cost"], every["cost"])
        assert single["cost"] == every["cost"][0]
        kinds |= set(zip(off.tolist(), fast.tolist(), strict=True))
        actions = np.outer(np.linspace(0.0, 0.8, n), [np.sin(k / 80.0), 0.0]).astype(np.float32)
        *_, every = whole.step(actions)
        *_, brief = lean.step(actions)
        *_, single = one.step(actions[0])
    assert len(kinds) == 4


def test_reward_and_gradients_follow_the_weights():
    usual, other = ({"info": "all", "weights": weights} for weights in (None, {"radius": 3.0, "pull": 0.0}))
    weighed, plain = CzVectorEnv(4, "randomized", **other), CzVectorEnv(4, "randomized", **usual)
    batch = DifferentiableBatch(make_config("randomized", weights=other["weights"]), 4)
    for env in (weighed, plain):
        env.reset(seed=0)
    batch.reset(range(4))
    for _ in range(50):
        action = np.full((4, 2), 0.3, np.float32)
        _, reward, *_, info = weighed.step(action)
        *_, known = plain.step(action)
        terms = 3.0 * known["term_radius"], 0.0 * known["term_pull"], known["term_pull_step"], known["term_heater_step"]
        step, total = batch.step(action), sum(terms)
        np.testing.assert_allclose(step.cost.T, terms, rtol=1e-12)
        np.testing.assert_allclose(reward, 1.0 - 10.0 * total / (10.0 + total), rtol=1e-9)
    assert known["term_pull"].min() > 0.0
    assert not info["term_pull"].any()


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"pul": 0.1}, "unknown weight 'pul': did you mean 'pull'"),
        *(
            ({"pull": value}, "the weight 'pull' must be a number of at least 0")
            for value in (-0.1, np.nan, np.inf, "1")
        ),
        ([0.5], "this needs a Mapping, not .0.5.: weights="),
    ],
)
def test_weights_that_are_none_are_refused(weights, message):
    with pytest.raises(ValueError, match=message):
        CzEnv(weights=weights)


def test_weights_change_the_reward_s_hash_and_the_identity_and_not_the_plant():
    usual, same, other = (make_config(weights=weights) for weights in (None, {"pull": 0.5}, {"pull": 0.5 + 1e-9}))
    assert (usual.hash, usual.reward_hash) == (same.hash, same.reward_hash)
    assert usual.reward_hash != other.reward_hash
    assert usual.plant_hash == other.plant_hash
    assert usual.reward_hash == make_config("hard", observation="state").reward_hash
    assert usual.identity.difference(other.identity).startswith("weights radius 1.0, pull 0.5, ")
    state = CzEnv.from_config(usual)
    state.reset(seed=0)
    with pytest.raises(ValueError, match="weights"):
        CzEnv.from_config(other).set_state(state.get_state())


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
