"""The LQG, adaptive and privileged ones too, against the exact optimum and the nonlinear plant."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from cz_gym import HURLE, SCENARIOS, CzVectorEnv, decode, make_puller
from cz_gym.baselines import lqg
from cz_gym.baselines.analysis import close, linear_form
from cz_gym.baselines.clairvoyant import episodes_of, pullers_of
from cz_gym.baselines.lqg import CHARGED_PULL, LQG, LQGDesign, PrivilegedLQG, look_ahead, privileged, regulator, solve
from cz_gym.baselines.lqg_estimator import Hypotheses, multiple_model_filter
from cz_gym.baselines.lqg_filter import DRIFT, FAST, HEATER, PLANT, SLOW, STATES, NoiseModel, RingModel, plant_model
from cz_gym.baselines.tuned_controllers import FACTORS, FAMILY, adaptive
from cz_gym.body.signals import Measured, Weights, coefficients
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Interface, Told
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.plant import Disturbance, State, hidden_load, quintic, rates
from cz_gym.process import Inputs
from cz_gym.puller.file import find_puller
from cz_gym.support.errors import map_arrays
from cz_gym.support.units import HOUR, KILO, MINUTE, MM, MM_PER_MIN
from cz_gym.tools.registry import CONTROLLERS, find_controller, make_controller
from tests.observed import PLAIN, Watched, measured
from tests.samples import NOMINAL_LQG

PULLER = make_puller(lam=0.5)
NOISE = NoiseModel()


# The augmented plant


def test_the_sampled_plant_moves_as_the_equations_do():
    rng = np.random.default_rng(0)
    small = np.array([1e-6, 1e-6, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-6, 0.1])
    z, u, dt = rng.normal(size=len(STATES)) * small, np.array([1e-8, 1.0]), 20.0

    def motion(t, y):
        x = State(*(y[:PLANT] + np.array(PULLER.state_0)))
        drives = Inputs(PULLER.v_0 + u[0], PULLER.Q_H_0 + u[1] + y[HEATER])
        d = Disturbance(float(hidden_load(y[DRIFT], PULLER)), y[FAST] + y[SLOW], 1.0)
        rate = -y[DRIFT + 1] / NOISE.drift_rate_tau
        own = [-y[FAST] / NOISE.fast_tau, -y[SLOW] / NOISE.slow_tau, y[DRIFT + 1], rate, 0.0]
        return np.array([*rates(x, drives, d, PULLER, HURLE.slope), *own])

    exact = solve_ivp(motion, (0.0, dt), z, rtol=1e-10, atol=1e-14).y[:, -1]
    model = plant_model(PULLER, NOISE, dt)
    np.testing.assert_allclose(model.A @ z + model.B @ u, exact, rtol=2e-3, atol=1e-3 * small.min())


def test_the_fluctuations_keep_their_variance():
    model = plant_model(PULLER, NOISE, 5.0)
    for state, sd in ((FAST, NOISE.fast_sd), (SLOW, NOISE.slow_sd), (DRIFT + 1, NOISE.drift_rate_sd)):
        assert model.A[state, state] ** 2 * sd**2 + model.Q[state, state] == pytest.approx(sd**2, rel=1e-9)
    two = plant_model(PULLER, NOISE, 10.0)
    np.testing.assert_allclose(model.A @ model.Q @ model.A.T + model.Q, two.Q, rtol=1e-6, atol=1e-25)


# The regulator


def brute_force_first_move(model, weights, dt, z, steps, reference_steps, drift_steps):
    """The first optimal move by least squares over all moves of a long horizon."""
    n = len(model.A)
    A = np.block([[model.A, model.B], [np.zeros((2, n)), np.eye(2)]])
    B = np.vstack([model.B, np.eye(2)])
    free, forced, radius = z.copy(), np.zeros((n + 2, 2 * steps)), 0.0
    Q, _, R = lqg.quadratic_cost(weights, dt)
    pull, moves = Q[PLANT, PLANT], np.diag(R) - np.array([Q[PLANT, PLANT], 0.0])
    rows, targets = [], []
    for k in range(steps):
        move = np.zeros((2, 2 * steps))
        move[:, 2 * k : 2 * k + 2] = np.eye(2)
        forced, free = A @ forced + B @ move, A @ free
        if k < len(drift_steps):
            free[DRIFT] += drift_steps[k]
            radius += reference_steps[k]
        costs = (Q[0, 0], forced[0], free[0] - radius), (pull, forced[n], free[n])
        for weight, row, offset in (*costs, (moves[0], move[0], 0.0), (moves[1], move[1], 0.0)):
            rows.append(np.sqrt(weight) * row)
            targets.append(-np.sqrt(weight) * offset)
    unknown_scale = np.tile([1e-6, 1e3], steps)
    solution = np.linalg.lstsq(np.array(rows) * unknown_scale, np.array(targets), rcond=None)[0]
    return (solution * unknown_scale)[:2]


@pytest.mark.parametrize("what", ["state", "reference", "drift", "drift-rate"])
def test_the_first_move_is_that_of_the_whole_horizon(what):
    dt, ahead = 30.0, 10
    noise = replace(NOISE, drift_rate_tau=600.0)
    model, weights = plant_model(PULLER, noise, dt), Weights(heater_step=0.5)
    law = regulator(model, weights, dt)
    z, reference, drift = np.zeros(len(STATES) + 2), np.zeros(ahead), np.zeros(ahead)
    if what == "state":
        z[:] = [1e-4, 1e-4, 1.0, 0.5, 0.2, 0.1, 0.2, 0.0, 0.0, 10.0, 1e-6, 100.0]
    elif what == "reference":
        reference[:] = np.linspace(0.0, 1e-4, ahead)
    elif what == "drift":
        drift[:] = np.linspace(0.1, 0.0, ahead)
    else:
        z[[DRIFT, DRIFT + 1]] = 1.0, 1e-3
    expected = brute_force_first_move(model, weights, dt, z, 140, reference, drift)
    found = -law.feedback @ z + reference @ law.reference + drift @ law.drift
    # A shifted reference counts as an equilibrium of its own, though the free radius drifts off it by 9e-6 a second.
    rtol = 0.02 if what == "reference" else 2e-3
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=0.0)


# The preview


@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
def test_the_plan_is_the_recipe_five_minutes_ahead(dt):
    def recipe(t):
        return 1e-3 * quintic(np.clip((t - 400.0) / 1200.0, 0.0, 1.0))

    zeros = np.zeros(1)
    samples = lqg.samples_ahead(dt)
    plan = np.zeros((1, 2, samples + 1))
    for k in range(round(900.0 / dt)):
        shown = [np.array([recipe(k * dt + ahead)]) for ahead in (0.0, 60.0, 300.0)]
        seen = Measured(zeros, zeros, *shown, *(2.0 * value for value in shown), *[zeros] * 4)
        plan = look_ahead(plan, seen, np.array([k == 0]), dt)
        if k * dt >= 300.0:
            future = recipe((k + np.arange(samples + 1)) * dt)
            np.testing.assert_allclose(plan[0, 0], future, atol=1e-15)
            np.testing.assert_allclose(plan[0, 1], 2.0 * future, atol=1e-15)


def test_the_radius_estimate_is_limited_as_the_puller_s_radius_is():
    file = find_puller("silicon-300mm")
    plant_filter = solve(LQGDesign(), 5.0, make_puller(file.parameters))[0]
    mean = np.zeros((2, len(STATES)))
    mean[:, 0] = 1.0, -0.012
    assert plant_filter._clipped(mean)[:, 0] == pytest.approx([file.radius_limit, -0.012], rel=1e-12)


# The linear plant, with the filter in steady state, against theory: its cost by the covariance equation

LINEAR = LQGDesign(nonlinear=False, gate=np.inf, noise=NoiseModel(camera_memory=np.inf, recipe_share=0.0))
PER_SQUARE = np.array(coefficients(LINEAR.weights)._replace(pull=LINEAR.weights.pull / CHARGED_PULL**2))
"""Its cost of a unit square of radius error, pull speed and both steps; without bands."""
KNOWN = RingModel(5.0, 0.1 * MM, 10.0 * MINUTE, rotation=(10.0 / MINUTE, 10.0 / MINUTE))
SCALES = np.array([MM, MM, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0 / HOUR, KILO])
"""Units in which the plant's states are of one order: in SI the covariance equation is ill-conditioned."""


def gains_of(ring=None, dt=5.0):
    return solve(replace(LINEAR, ring=ring), dt, PULLER)


def stationary(plant):
    """The states that are stationary in a loop: plant, interface fluctuations, ripple and past rings."""
    return [*range(PLANT + 2), *range(len(STATES), len(plant.A))]


def noise_sds(gains):
    return np.array([gains.filter.noise.camera_sd, gains.filter.noise.pyrometer_sd])


def root(Q):
    """A matrix whose product with its transpose is the covariance Q."""
    values, vectors = np.linalg.eigh(Q)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def steady_gain(gains):
    """Kalman gain of (r_br, T_1) at which the filter settles, shape (states, 2)."""
    A, _, H, Q, _ = gains.filter.plant
    R = np.diag(noise_sds(gains) ** 2)
    P = solve_discrete_are(A.T, H.T, Q, R)
    return P @ H.T @ np.linalg.inv(H @ P @ H.T + R)


def closed_loop(gains):
    """A and B of s = (plant, x_hat before the reading, previous inputs), and rows giving r_c, v_p and input steps."""
    plant, K = gains.filter.plant, steady_gain(gains)
    moving, states = stationary(plant), len(plant.A)
    n, m = len(moving), states + 2
    A, B, H = plant.A[np.ix_(moving, moving)], plant.B[moving], plant.H[:, moving]
    F, K_u = np.split(gains.regulator.feedback, [len(STATES)], axis=1)
    F = np.pad(F, ((0, 0), (0, states - len(STATES))))
    corrected = np.eye(states) - K @ plant.H
    C, D = np.hstack([-F @ corrected, np.eye(2) - K_u]), -F @ K
    v, w = np.diag(noise_sds(gains)), root(plant.Q[np.ix_(moving, moving)])
    inputs = np.hstack([D @ H, C, np.zeros((2, n)), D @ v])
    state = np.hstack([A, np.zeros((n, m)), w, np.zeros((n, 2))]) + B @ inputs
    reading = np.hstack([H, np.zeros((2, m + n)), v])
    kept = np.hstack([np.zeros((states, n)), plant.A @ corrected, np.zeros((states, 2 + n + 2))])
    estimate = kept + plant.A @ K @ reading + plant.B @ inputs
    previous = np.pad(np.eye(2), ((0, 0), (n + m - 2, n + 2)))
    radius = np.eye(1, n + m + n + 2)
    both = np.vstack([state, estimate, inputs])
    return both[:, : n + m], both[:, n + m :], np.vstack([radius, inputs[:1], inputs - previous])


def stationary_cost(gains):
    """Mean of the cost's terms by the covariance equation P = A P A' + B B'."""
    A, B, signals = closed_loop(gains)
    plant = gains.filter.plant
    own = np.concatenate([SCALES, np.full(len(plant.A) - len(STATES), MM)])
    scales = np.concatenate([own[stationary(plant)], own, [MM_PER_MIN, KILO]])
    A, B = A / scales[:, None] * scales, B / scales[:, None]
    P = solve_discrete_lyapunov(A, B @ B.T, method="direct") * np.outer(scales, scales)
    by_state, by_noise = np.split(signals, [len(A)], axis=1)
    return PER_SQUARE * np.diag(by_state @ P @ by_state.T + by_noise @ by_noise.T)


@pytest.mark.parametrize(("ring", "dt"), [(None, 5.0), (KNOWN, 5.0), (RingModel(5.0), 10.0)])
def test_cost_through_predict_matches_the_covariance_equation(ring, dt):
    """Mean cost under white noise is the sum of what one kick of each noise costs: one slot a kick."""
    gains = gains_of(ring, dt)
    plant = gains.filter.plant
    moving = stationary(plant)
    both, m = np.ix_(moving, moving), len(moving)
    A, B, H = plant.A[both], plant.B[moving], plant.H[:, moving]
    kicks = np.vstack([root(plant.Q[both]).T, np.zeros((2, m))])
    glitches = np.vstack([np.zeros((m, 2)), np.diag(noise_sds(gains))])
    x, u, state, cost, settle = np.zeros((m + 2, m)), np.zeros((m + 2, 2)), None, [], 700
    controller = LQG(dt, replace(LINEAR, ring=ring))
    for k in range(settle + 1200):
        y = x @ H.T + glitches * (k == settle)
        action, state = controller.predict(measured(ring_error=y[:, 0], T_1=y[:, 1], v_p=u[:, 0], Q_H=u[:, 1]), state)
        moved = action.astype(float) * [PULLER.v_0, 1e4]
        cost.append(PER_SQUARE * np.sum(np.square([x[:, 0], moved[:, 0], *(moved - u).T]), axis=1))
        x, u = x @ A.T + moved @ B.T + kicks * (k == settle), moved
    terms = np.sum(cost, axis=0)
    np.testing.assert_allclose(terms, stationary_cost(gains), rtol=1e-2)
    assert np.sum(cost[-100:]) < 1e-3 * np.sum(terms)


def test_to_know_of_the_latency_costs_less_than_to_ignore_it():
    costs = [sum(stationary_cost(gains_of(RingModel(latency)))) for latency in (0.0, 5.0, 10.0)]
    assert costs[0] == pytest.approx(sum(stationary_cost(gains_of())), rel=1e-9)
    assert costs[0] < costs[1] < costs[2]


# The shipped designs on hot zones whose numbers they do not know

CRYSTALS = range(16)
ADAPTIVE = [each.name for each in CONTROLLERS if each.name.endswith("-adaptive")]
"""That each of their filters holds the slowest hot zones is tested on the linear loop below."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lqg", *FAMILY, *ADAPTIVE])
def test_no_lqg_loses_a_crystal(name):
    config = make_config("hot-zone", **PLAIN)
    assert not rollout(make_controller(name, config), config, CRYSTALS).failed.any()


@pytest.mark.slow
def test_an_lqg_tuned_on_nominal_hot_zones_loses_crystals_of_others_unless_it_knows_them():
    over = replace(SCENARIOS["hot-zone"].pullers, boundary_layer=(0.0, 0.0))
    config = make_config(replace(SCENARIOS["hot-zone"], pullers=over, told=Told()), **PLAIN)
    assert rollout(NOMINAL_LQG, config, CRYSTALS).failed.sum() > 2
    assert not rollout(privileged(NOMINAL_LQG, knows_fluctuations=False), config, CRYSTALS).failed.any()


@pytest.mark.slow
def test_one_design_serves_every_scenario_and_loses_no_crystal():
    """The design is the same whatever scenario it is asked for."""
    configs = [make_config(name, **PLAIN) for name in ("randomized", "puller", "hot-zone", "all")]
    policies = [make_controller("lqg-one-design", config) for config in configs]
    assert len({policy.design for policy in policies}) == 1
    assert make_controller("lqg", configs[0]).design != make_controller("lqg", configs[1]).design
    for config in configs:
        assert not rollout(policies[0], config, CRYSTALS).failed.any()


# Adaptive: with one hypothesis it is the LQG; with many it finds out how strong fluctuations are


@pytest.mark.parametrize("scenario", ["sensor-fault", "puller"])
def test_the_adaptive_lqg_with_one_hypothesis_is_the_lqg(scenario):
    config = make_config(scenario, horizon=1800.0, **PLAIN)
    plain = make_controller("lqg-at-0.02", config)
    noise = plain.design.noise
    one = replace(plain, hypotheses=Hypotheses((noise.fast_sd,), (noise.slow_sd,)))
    ours, theirs = (rollout(each, config, range(4)) for each in (one, plain))
    np.testing.assert_allclose(ours.signals.v_p, theirs.signals.v_p, rtol=1e-6)


def test_the_bank_weights_its_filters_by_bayes_rule():
    single, hypotheses = LQG(design=LQGDesign(nonlinear=False)).gains.filter, Hypotheses((0.05, 0.5), (0.3,))
    bank = multiple_model_filter(single, hypotheses, 1)
    state, evidence, row = bank.at_rest(1), np.zeros(2), single.plant.H[0]
    random = np.random.default_rng(3)
    for _ in range(5):
        rows = bank.rows.predict(map_arrays(lambda part: part[0], state.filters), np.zeros((2, 2)), np.zeros(2))
        seen = decode(measured(ring_error=random.normal() * 0.02 * MM))
        for j in range(2):
            variance = row @ rows.covariance[j] @ row + rows.camera_variance[j]
            innovation = seen.ring_error[0] - row @ rows.mean[j]
            evidence[j] += -0.5 * innovation**2 / variance - 0.5 * np.log(variance)
        state = bank.step(state, np.zeros((1, 2)), np.zeros(1), seen, np.zeros(1, bool))
    weight = np.exp(evidence - evidence.max())
    assert state.probability[0] == pytest.approx(weight / weight.sum(), rel=1e-9)
    assert state.mean[0] == pytest.approx(state.probability[0] @ state.filters.mean[0])


@pytest.mark.slow
@pytest.mark.parametrize(("strength", "factor"), [(0.05, 0.2), (0.5, 1.0)])
def test_the_adaptive_lqg_estimates_how_strong_the_fluctuations_are(strength, factor):
    """After an hour nine of ten crystals are at the nearest hypothesis; the design is that for known hot zones."""
    config = make_config("randomized", horizon=HOUR, **PLAIN)
    config = config.with_scenario(replace(config.scenario, name="one", interface=Interface(sd=(strength, strength))))
    watched = Watched(adaptive(NOMINAL_LQG.for_config(config)), 1)
    rollout(watched, config, range(20))
    expected = watched.states[-1].memory.filter.probability @ np.repeat(FACTORS, len(FACTORS))
    assert (np.abs(expected - factor) < 0.4).mean() >= 0.9


def test_the_adaptive_lqg_holds_the_slowest_hot_zones():
    """Two of 500 validation crystals, on which a filter that expects stronger slow fluctuations is unstable."""
    config = make_config("hot-zone", **PLAIN)
    plain, seeds = make_controller("lqg-at-0.02", config), (1_000_102, 1_000_275)
    assert not rollout(adaptive(plain).for_config(config), config, seeds).failed.any()
    noise = replace(plain.design.noise, slow_sd=1.4 * plain.design.noise.slow_sd)
    form = linear_form(replace(plain, design=replace(plain.design, noise=noise)))
    assert not any(close(form.controller, puller, form.dt).stable for puller in pullers_of(config, seeds))


# Privileged: what they know is what the environment brings, and is worth something


def test_the_bounds_know_the_pullers_and_fluctuations_that_the_environment_draws():
    config, seeds = make_config("randomized", horizon=600.0, **PLAIN), (5, 9, 2_000_000)
    env = CzVectorEnv(3, horizon=600.0, **PLAIN)
    env.reset(seed=list(seeds))
    slots = env._batch.memory.slots
    for drawn, puller in zip(slots["puller"], pullers_of(config, seeds), strict=True):
        np.testing.assert_allclose([drawn[name] for name in puller._fields], puller, rtol=1e-12)
    drawn = np.stack([slots["episode"]["sd_fast"], slots["episode"]["sd_slow"]], axis=1)
    known = [(each.sd_fast, each.sd_slow) for each in episodes_of(config, seeds)]
    np.testing.assert_array_equal(known, drawn)
    assert len(np.unique(drawn)) == 6


def test_each_filter_has_the_noise_of_its_own_crystal():
    config = make_config("only-interface", horizon=900.0, **PLAIN)
    bound = PrivilegedLQG(design=LQGDesign(lam=1.0), knows_fluctuations=True)
    known = bound.for_episodes(config, np.arange(3)).gains.filter.plant.Q
    for slot, drawn in enumerate(episodes_of(config, [0, 1, 2])):
        noise = replace(LQGDesign().noise, fast_sd=drawn.sd_fast, slow_sd=drawn.sd_slow)
        puller = pullers_of(config, [slot])[0]
        np.testing.assert_allclose(known[slot], plant_model(puller, noise, config.control_interval).Q, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("names", [("lqg-at-0.02", "lqg-at-0.02-privileged"), ("lqg", "full-information")])
def test_knowing_more_lowers_the_error_and_the_regulator_s_own_cost_on_the_same_episodes(names):
    """The puller and its fluctuations, or the whole state. Of activity nothing follows: who knows more may use it."""
    found = []
    for entry in map(find_controller, names):
        config = make_config("randomized", observation=entry.observation, action="direct", horizon=2.0 * HOUR)
        policy = entry.make(config)
        m, weights = metrics(rollout(policy, config, range(20))), policy.design.weights
        squares = coefficients(weights)
        moves = squares.pull_step * (m.pull_step_rms_mm_per_min * MM_PER_MIN) ** 2
        moves += squares.heater_step * (m.heater_step_rms_kw * KILO) ** 2
        away = weights.pull * (m.pull_rms_mm_per_min * MM_PER_MIN / CHARGED_PULL) ** 2
        found.append((m.rmse_mm.mean(), np.mean(squares.radius * (m.rmse_mm * MM) ** 2 + away + moves)))
    plain, privileged = found
    assert privileged[0] < plain[0]
    assert privileged[1] < plain[1]


@pytest.mark.parametrize("name", ["lqg-true", "full-information", "clairvoyant"])
def test_bounds_know_that_what_they_are_told_as_nominal_is_wrong(name):
    """A wrong nominal power and temperature move none of their drives."""
    entry, found = find_controller(name), []
    for told in (Told(power_sd=3e3, temperature_sd=5.0), Told()):
        scenario = replace(SCENARIOS["only-interface"], name="mine", told=told)
        config = make_config(scenario, observation=entry.observation, action="direct", horizon=900.0)
        found.append(rollout(entry.make(config), config, range(3)).signals)
    for signal in ("v_p", "Q_H", "r_c"):
        np.testing.assert_allclose(*(getattr(each, signal) for each in found), rtol=1e-5)
    assert np.ptp(found[0].Q_H) > 1.0


@pytest.mark.parametrize("error_pull", [None, 2e-7])
def test_the_privileged_lqg_of_a_nominal_puller_is_the_lqg(error_pull):
    """Also where a share of a narrow drive is left to the meniscus, which bounds on such pullers could not run with."""
    design, config = LQGDesign(lam=1.0, error_pull=error_pull), make_config("only-interface", horizon=900.0, **PLAIN)
    privileged, plain = (rollout(kind(design=design), config, [0, 1, 2]) for kind in (PrivilegedLQG, LQG))
    np.testing.assert_allclose(privileged.signals.v_p, plain.signals.v_p, rtol=1e-5)
