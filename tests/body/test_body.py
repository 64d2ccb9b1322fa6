"""A crystal's body: its plant against design, SciPy, balances and published transfer functions; cost and limits."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from cz_gym import SCENARIOS, CzEnv, CzVectorEnv, Parameters, State, decode, make_puller
from cz_gym.body.process import BODY, OUTPUTS, linearise, radius_model
from cz_gym.body.signals import PULL_TOLERANCE, Cost, Weights, coefficients, cost_slopes, cost_terms, reward
from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.engine.tangents import DifferentiableBatch
from cz_gym.episodes.scenario import Actuators, Told
from cz_gym.episodes.scenarios import TRACED_SLOPE
from cz_gym.physics import plant as equations
from cz_gym.physics.meniscus import hurle_slope
from cz_gym.physics.plant import NO_DISTURBANCE, Disturbance, disturbance, growth, hidden_load, rates, within_limits
from cz_gym.process import Inputs, jacobian
from cz_gym.puller.file import PullerFile
from cz_gym.support.units import HOUR, MM
from cz_gym.tools.registry import find_controller
from tests.equations import Truth, design_rates, drawn, fields, hold, integrated
from tests.observed import PLAIN

MIXES = [0.0, 0.3, 1.0]
SPREAD = st.floats(0.85, 1.15)
MELTING = replace(SCENARIOS["puller"], name="puller without limits", actuators=Actuators())


@pytest.fixture
def states(rng):
    p = make_puller()
    n = 200
    return State(
        rng.uniform(0.08, 0.095, n), rng.uniform(0.002, 1.24 * p.a, n), p.T_1_0 + rng.normal(0, 20, n),
        p.T_2_0 + rng.normal(0, 10, n), p.T_b_0 + rng.normal(0, 3, n),
    )  # fmt: skip


def drawn_inputs(rng, p, n):
    u = Inputs(rng.uniform(0, 4e-5, n), p.Q_H_0 + rng.uniform(-1e4, 1e4, n))
    return u, Disturbance(rng.normal(0, 1000, n), rng.normal(0, 1, n), rng.uniform(0.9, 1, n))


VARIED = ("sigma", "k_l", "kappa_12", "G_2b", "eps", "r_0", "v_0")


@given(st.sampled_from(MIXES), st.lists(SPREAD, min_size=len(VARIED), max_size=len(VARIED)), st.floats(0.0, 1e-3))
def test_operating_point_is_a_steady_state(lam, factors, R):
    """A boundary layer changes no flux at the interface, and makes the melt hotter by its own difference."""
    q = Parameters(R=R)
    changes = {name: getattr(q, name) * factor for name, factor in zip(VARIED, factors, strict=True)}
    p = make_puller(q._replace(**changes), lam)
    rate = rates(p.state_0, p.inputs_0, NO_DISTURBANCE, p, hurle_slope)
    assert abs(rate.r_c) < 1e-12 * p.v_0
    assert abs(rate.h_c) < 1e-12 * p.v_0
    heats = np.array([rate.T_1 * p.C_1, rate.T_2 * p.C_2, rate.T_b * p.C_b])
    assert np.abs(heats).max() < 1e-9 * p.Q_H_0
    bare = make_puller(q._replace(R=0.0, **changes), lam)
    assert bare.T_b_0 == q.T_m + q.dT_0
    assert p.Phi_s == bare.Phi_s
    assert p.T_b_0 - bare.T_b_0 == pytest.approx(R * bare.k_l * q.dT_0 / bare.h_0, rel=1e-9, abs=1e-12)


def test_without_a_boundary_layer_hashes_and_published_functions_are_as_before():
    """The hash with which agents and results were published; a layer has one of its own."""
    assert make_config().plant_hash == "d59b0a9eb69b5314"
    assert make_config(puller="germanium").puller.label == "germanium (ddb88ca42bc7e0a7)"
    hashes = {make_config(parameters=Parameters(R=R)).plant_hash for R in (0.0, 1e-9, 7e-4)}
    assert len(hashes) == 3
    assert PullerFile(parameters=Parameters(R=1e-4)).hash != PullerFile().hash
    thick = radius_model(make_puller(Parameters(R=7e-4)))
    thin = radius_model(make_puller())
    for name in ("numerator", "lead", "zero"):
        assert getattr(thick, name) == pytest.approx(getattr(thin, name), rel=1e-12)
    assert thick.poles[1] == pytest.approx(-2.2e-4, rel=0.02)
    assert radius_model(make_puller(Parameters(R=7e-4), 0.0)).poles[1] == 0.0


@pytest.mark.parametrize("process", [BODY, CRYSTAL])
def test_a_controller_is_told_wrong_nominal_values_and_the_crystal_starts_in_balance(process):
    told = replace(SCENARIOS["nominal"], told=Told(power_sd=1e3, temperature_sd=2.0))
    found = []
    for scenario in (told, SCENARIOS["nominal"]):
        env = CzVectorEnv(4, scenario, "I", process=process, info="all", **PLAIN)
        first, infos = env.reset(seed=3)
        channels = decode(first, *env.config.ranges, process)
        e = env._batch.memory.slots["episode"].copy()
        _, _, _, _, after = env.step(np.zeros((4, 2)))
        found.append((channels, infos, e, after))
    (wrong, begun, e, after), (right, exact, _, then) = found
    assert np.ptp(e["told_power"]) > 100.0
    assert pytest.approx(-e["told_power"], abs=0.01) == wrong.Q_H - right.Q_H
    assert pytest.approx(-e["told_temperature"], abs=1e-4) == wrong.T_1 - right.T_1
    assert wrong.T_1_ref == pytest.approx(right.T_1_ref, abs=1e-4)
    for name in ("T_1", "T_b", "Q_H", "r_c"):
        np.testing.assert_array_equal(begun[name], exact[name])
    assert begun["T_1_ref"] - exact["T_1_ref"] == pytest.approx(e["told_temperature"])
    assert after["Q_H"] - then["Q_H"] == pytest.approx(e["told_power"])


def test_the_traced_ring_is_the_plant_s_and_no_controller_s():
    """Where rays show the edge: 2.03 mm outside the crystal, gain 0.1965, zero 0.0252 rad/s; within 2 % on Hurle's."""
    env = CzEnv("randomized-traced", "I", **PLAIN)
    env.reset(seed=1)
    slot = env.get_state().slot.slot
    assert slot["puller"]["ring_bias"] == pytest.approx(2.03e-3, rel=0.05)
    assert find_controller("lqg").make(env.config).gains.filter.puller.ring_bias == make_puller(lam=0.5).ring_bias
    traced = make_puller(Parameters(phi_b=TRACED_SLOPE))
    assert traced.ring_bias == pytest.approx(2.03e-3, abs=0.005e-3)
    assert linearise(traced).C[OUTPUTS.index("r_br"), 1] == pytest.approx(0.1965, rel=0.02)
    assert radius_model(traced).zero == pytest.approx(0.0252, rel=0.02)


@pytest.mark.parametrize("R", [0.0, 7e-4])
@pytest.mark.parametrize("lam", MIXES)
def test_rates_are_the_equations_of_the_design(lam, R, states, rng):
    p = make_puller(Parameters(R=R), lam)
    u, d = drawn_inputs(rng, p, 200)
    expected = design_rates(np.array(states), Truth(u.v_p, u.Q_H, d.Q_d, d.dT_i, d.melt), p)
    actual = np.array(rates(states, u, d, p, hurle_slope))
    np.testing.assert_allclose(actual, expected, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("lam", MIXES)
def test_no_heat_appears_or_disappears(lam, states, rng):
    """Heater and latent heat in, insulation, surface and crystal out, the rest stored: none of it from ``rates``."""
    q, p = Parameters(), make_puller(lam=lam)
    u, d = drawn_inputs(rng, p, 200)
    rate, grown = rates(states, u, d, p, hurle_slope), growth(states, d, p, hurle_slope)
    crystal = np.pi * states.r_c**2
    surface = q.eps * q.sigma_SB * (np.pi * q.R_cr**2 - crystal) * (states.T_b**4 - q.T_e**4)
    into_crystal = crystal * (p.Phi_s - q.rho_s * q.dH * grown.v_g)
    stored = q.C_1 * rate.T_1 + q.C_2 * rate.T_2 + q.C_b * d.melt * rate.T_b
    out = q.G_1a * (states.T_1 - q.T_a) + surface + into_crystal + stored
    np.testing.assert_allclose(out, u.Q_H + d.Q_d, rtol=1e-12)


def test_the_crystal_halves_what_a_hotter_heater_does_to_the_melt():
    """Static change of T_b by that of T_1, radius and height held; heat flows through two links in a row."""
    q, p = Parameters(), make_puller()
    r_c, h_c, *hot = p.state_0
    by = jacobian(lambda *T: rates(State(r_c, h_c, *T), p.inputs_0, NO_DISTURBANCE, p, hurle_slope)[3:], hot)
    response = np.linalg.solve(by[:, 1:], -by[:, 0])[1]
    radiates = 4.0 * q.kappa_12 * np.array([p.T_1_0, p.T_2_0]) ** 3
    surface = 4.0 * np.pi * q.eps * q.sigma_SB * (q.R_cr**2 - q.r_0**2) * p.T_b_0**3

    def static(loss):
        return radiates[0] / (radiates[1] + loss * (1.0 + radiates[1] / q.G_2b))

    assert response == pytest.approx(static(surface + np.pi * q.r_0**2 * q.k_l / p.h_0), rel=1e-10)
    assert (round(response, 2), round(static(surface), 2)) == (0.37, 0.79)


def test_an_hour_with_a_heater_one_kelvin_too_hot_thins_the_crystal_by_nine_millimetres():
    p = make_puller()
    x = p.state_0
    for _ in range(720):
        x = equations.rk4(x._replace(T_1=p.T_1_0 + 1.0), p.inputs_0, NO_DISTURBANCE, p, 5.0, hurle_slope)
    assert x.r_c - p.r_0 == pytest.approx(-9.4e-3, abs=0.1e-3)


@pytest.mark.parametrize(("interval", "scenario"), [(5.0, "randomized"), (2.0, MELTING), (10.0, "hard")])
def test_an_hour_of_driven_motion_agrees_with_scipy(interval, scenario):
    env = CzEnv(scenario, control_interval=interval, horizon=HOUR, info="all")
    env.reset(seed=5)
    saved, interface = env.get_state().slot, drawn(env).interface
    p, e, x = fields(saved.slot["puller"]), fields(saved.slot["episode"]), np.array(saved.slot["x"].tolist())
    steps = round(HOUR / interval)
    worst, heights, feedback = 0.0, [], 0.0
    for k in range(steps):
        t = k * interval
        pull = 0.3 * np.sin(t / 70.0) + feedback
        _, _, terminated, _, info = env.step(np.array([pull, 0.3 * np.sin(t / 300.0)], np.float32))
        feedback = hold(info, p.h_0)
        while t < (k + 1) * interval - 1e-6:
            j = int(t // 5.0)
            upto = min(5.0 * (j + 1), (k + 1) * interval)
            d = disturbance(5.0 * j, interface[j], e, p)
            x = integrated(x, Truth(info["v_p"], info["Q_H"], *d), p, upto - t).y[:, -1]
            t = upto
        ours = [info["r_c"], info["h_c"], info["T_1"], x[3], info["T_b"]]
        worst = max(worst, np.abs(np.array(ours) / x - 1).max())
        heights.append(info["h_c"])
        assert not terminated
    assert max(heights) - min(heights) > 5e-4, "the hour must move the meniscus"
    assert worst < 1e-8
    end = np.array(env.get_state().slot.slot["x"].tolist())
    np.testing.assert_allclose(end, x, rtol=1e-8)


@pytest.mark.parametrize("drift", [-20.0, -5.0, 0.0, 1e-3, 5.0, 20.0])
def test_hidden_load_is_the_static_equivalent_of_a_drift(drift):
    p = make_puller()
    T_1 = p.T_1_0 + drift
    T_2 = brentq(lambda T: p.kappa_12 * (T_1**4 - T**4) - p.G_2b * (T - p.T_b_0), 1000, 3000, xtol=1e-12, rtol=1e-15)
    load = hidden_load(drift, p)
    assert load == pytest.approx(-p.G_2b * (T_2 - p.T_2_0), rel=1e-8, abs=1e-6)
    assert drift * load <= 0
    held = rates(State(p.r_0, p.h_0, T_1, T_2, p.T_b_0), p.inputs_0, Disturbance(load, 0.0, 1.0), p, hurle_slope)
    assert [held.T_2 * p.C_2, held.T_b * p.C_b] == pytest.approx([0.0, 0.0], abs=1e-5)


@pytest.mark.parametrize(("lam", "second_pole"), [(1.0, -1.684e-3), (0.0, 0.0)])
def test_published_transfer_functions(lam, second_pole):
    model = radius_model(make_puller(lam=lam))
    assert model.numerator == pytest.approx(-0.0048849, rel=1e-3)
    assert model.poles[0] == pytest.approx(8.78e-6, rel=6e-3)
    assert model.poles[1] == pytest.approx(second_pole, rel=1e-3, abs=1e-18)
    assert model.lead == pytest.approx(-46.0050, rel=5e-4)
    assert model.constant == pytest.approx(1.0041, abs=5e-4)
    assert model.zero == pytest.approx(0.0218, abs=5e-5)


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
    every, brief = (env.reset(seed=list(range(7, 7 + n)))[1] for env in (whole, lean))
    single = one.reset(seed=7)[1]
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
        env.reset(seed=list(range(4)))
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
