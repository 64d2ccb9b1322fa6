"""Latency and ripple in the LQG's model: against the environment's camera and known tones."""

from dataclasses import replace

import numpy as np
import pytest

from cz_gym import make_puller
from cz_gym.baselines import lqg_filter
from cz_gym.baselines.lqg import LQG, LQGDesign
from cz_gym.baselines.lqg_filter import STATES, NoiseModel, RingModel, frequencies, plant_model, ring_of, search_step
from cz_gym.baselines.tuned_controllers import BEST_RETURN
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Interface, Scenario, Sensor
from cz_gym.episodes.scenarios import PULLER_FRAMES, RANDOMIZED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.units import MINUTE, MM
from tests.observed import PLAIN

PULLER = make_puller(lam=0.5)
PULLER_RING = ring_of(PULLER_FRAMES.sensor)


@pytest.mark.parametrize("latency", [0.0, 2.0, 5.0, 7.0])
@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
def test_a_ring_that_grows_evenly_is_delivered_as_old_as_the_latency(latency, dt):
    ring, slope, steps = RingModel(latency), 3e-7, 20
    model = lqg_filter.augmented(plant_model(PULLER, NoiseModel(), dt), ring, dt)
    row = np.zeros((1, len(model.A)))
    row[0, 0] = 1.0
    A = lqg_filter.transition(np.eye(len(model.A)), row, np.zeros(1), ring, dt)[0]
    for state in range(ring.first_past, len(A)):
        A[state] = row[0] if state == ring.first_past else np.eye(len(A))[state - 1]
    x = np.zeros(len(A))
    for k in range(steps):
        x = A @ x
        x[0] = slope * (k + 1) * dt
    delivered = lqg_filter.delivered_row(row, ring, dt)[0] @ x
    assert delivered == pytest.approx(slope * (steps * dt - latency), rel=1e-12)


@pytest.mark.parametrize("dt", [5.0, 10.0])
def test_the_camera_of_the_environment_is_late_as_modelled(dt):
    late = Scenario("late", interface=Interface(sd=(0.3, 0.3)), sensor=Sensor(latency=5.0))
    run = rollout(LQG(control_interval=dt), make_config(late, control_interval=dt, horizon=1200.0, **PLAIN), [1])
    prompt, delivered = run.signals.r_br[:, 0], run.signals.r_br_measured[:, 0]
    samples, oldest = RingModel(5.0).delay(dt)
    assert samples == 1
    expected = oldest * prompt[:-1] + (1.0 - oldest) * prompt[1:]
    np.testing.assert_allclose(delivered[1:], expected, atol=1e-7 if dt == 5.0 else 5e-6)


# The search for the ripple


def heard(tone_hz, amplitude, noise, samples, dt=5.0, slots=40, ring=PULLER_RING):
    rng = np.random.default_rng(6)
    phase, search = rng.uniform(0.0, 2.0 * np.pi, slots), lqg_filter.search_at_rest(slots, ring, dt)
    for k in range(samples):
        rest = amplitude * np.sin(2.0 * np.pi * tone_hz * k * dt + phase) + noise * rng.normal(size=slots)
        search, _, ripple = search_step(search, rest, np.ones(slots, bool), ring, dt)
    return search, ripple, amplitude * np.sin(2.0 * np.pi * tone_hz * k * dt + phase)


@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
@pytest.mark.parametrize("rotation", [8.3, 11.2, 12.2, 14.9])
def test_a_tone_is_found_where_its_alias_is(rotation, dt):
    tone = rotation / MINUTE
    alias = abs(tone - round(tone * dt) / dt)
    search, ripple, now = heard(tone, 0.1 * MM, 0.05 * MM, round(1200.0 / dt), dt)
    half_a_bin = 0.125 / PULLER_RING.memory
    np.testing.assert_allclose(search.omega / (2.0 * np.pi), alias, atol=half_a_bin)
    assert np.sqrt(np.mean((ripple[:, 0] - now) ** 2)) < PULLER_RING.ripple_sd


def test_frequencies_as_slow_as_the_radius_are_not_searched():
    assert frequencies(PULLER_RING, 5.0).min() >= 2.0 * np.pi * PULLER_RING.lowest
    assert not len(frequencies(RingModel(5.0, 0.1 * MM, rotation=(0.2, 0.2)), 5.0))


def with_and_without_search(sensor):
    """Metrics on crystals with that camera: with the search for a ripple, and with the latency alone."""
    scenario = Scenario("camera", interface=Interface(sd=(0.2, 0.2)), sensor=sensor)
    config = make_config(scenario, horizon=3600.0, **PLAIN)
    designs = (replace(BEST_RETURN.settings(RANDOMIZED), ring=ring) for ring in (PULLER_RING, RingModel(5.0)))
    return [metrics(rollout(LQG(design=design), config, range(12))) for design in designs]


def test_where_there_is_no_ripple_the_search_for_one_costs_little():
    searching, knowing = with_and_without_search(Sensor(camera_noise=(5e-5, 5e-5), latency=5.0))
    assert searching.rmse_mm.mean() < 1.05 * knowing.rmse_mm.mean()


def test_a_ripple_that_was_identified_is_left_out_of_the_radius():
    rotation = PULLER_FRAMES.sensor.rotation
    found, ignored = with_and_without_search(Sensor(latency=5.0, ripple=(0.2 * MM, 0.2 * MM), rotation=rotation))
    assert found.rmse_mm.mean() < 0.75 * ignored.rmse_mm.mean()
    assert found.pull_step_rms_mm_per_min.mean() < ignored.pull_step_rms_mm_per_min.mean()


def test_a_ring_that_is_neither_late_nor_shaken_adds_nothing():
    model = plant_model(PULLER, NoiseModel(), 5.0)
    for plain, with_ring in zip(model, lqg_filter.augmented(model, RingModel(), 5.0), strict=True):
        np.testing.assert_allclose(with_ring, plain, rtol=1e-12, atol=1e-30)
    config = make_config("randomized", horizon=1200.0, **PLAIN)
    plain, with_ring = (rollout(LQG(design=LQGDesign(ring=ring)), config, [3]) for ring in (None, RingModel()))
    np.testing.assert_allclose(with_ring.signals.v_p, plain.signals.v_p, rtol=1e-6)


def test_the_ripple_keeps_its_variance():
    model = lqg_filter.augmented(plant_model(PULLER, NoiseModel(), 5.0), PULLER_RING, 5.0)
    both = slice(len(STATES), len(STATES) + 2)
    A, Q = model.A[both, both], model.Q[both, both]
    np.testing.assert_allclose(A @ A.T * PULLER_RING.ripple_sd**2 + Q, PULLER_RING.ripple_sd**2 * np.eye(2), atol=1e-18)


# The Kalman filter against the textbook's joint update and sensors of known noise

A = np.array([[1.0, 0.1], [0.0, 0.95]])
H = np.array([[1.0, 0.3], [0.0, 1.0]])
Q = np.diag([0.01, 0.04])
R = np.diag([0.25, 0.5])


def test_one_reading_at_a_time_is_the_joint_update():
    rng = np.random.default_rng(0)
    mean, y = rng.normal(size=(3, 2)), rng.normal(size=(3, 2))
    P = np.stack([np.diag(rng.uniform(0.5, 2.0, 2)) + 0.1 for _ in range(3)])
    now, covariance = mean, P
    for i in range(2):
        row = np.broadcast_to(H[i], mean.shape)
        now, covariance = lqg_filter.correct(now, covariance, row, y[:, i] - now @ H[i], np.full(3, R[i, i]), np.inf)
    for i in range(3):
        K = P[i] @ H.T @ np.linalg.inv(H @ P[i] @ H.T + R)
        np.testing.assert_allclose(now[i], mean[i] + K @ (y[i] - H @ mean[i]), rtol=1e-12)
        np.testing.assert_allclose(covariance[i], (np.eye(2) - K @ H) @ P[i], rtol=1e-12, atol=1e-15)


def test_no_reading_changes_nothing():
    mean, P = np.ones((2, 2)), np.broadcast_to(np.eye(2), (2, 2, 2))
    found, covariance = lqg_filter.correct(mean, P, np.ones((2, 2)), np.full(2, 5.0), np.array([np.inf, 1.0]), 4.0)
    np.testing.assert_array_equal(found[0], mean[0])
    np.testing.assert_array_equal(covariance[0], P[0])
    assert np.all(found[1] > mean[1])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_an_outlier_counts_as_the_gate_and_no_more(sign):
    P, row = np.broadcast_to(np.eye(2), (2, 2, 2)), np.broadcast_to(H[0], (2, 2))
    sd = np.sqrt(H[0] @ H[0] + 1.0)
    found, _ = lqg_filter.correct(np.zeros((2, 2)), P, row, sign * np.array([3.0 * sd, 1e6]), np.ones(2), 3.0)
    np.testing.assert_allclose(found[1], found[0])


def test_the_noise_of_a_sensor_is_found_from_the_innovations():
    rng, sds = np.random.default_rng(2), np.array([0.2, 1.0, 3.0])
    predicted, variance, averages = np.full(3, 0.3), np.ones(3), []
    for _ in range(20000):
        innovation = rng.normal(size=3) * np.sqrt(predicted + sds**2)
        how = np.ones(3, bool), 0.999, (1e-4, 100.0), np.inf
        averages.append(variance := lqg_filter.matched_variance(variance, innovation, predicted, *how))
    np.testing.assert_allclose(np.mean(averages[4000:], axis=0), sds**2, rtol=0.1)


def test_an_unseen_sample_and_the_range_bound_the_noise():
    args = (np.array([1e3, 1e3, 0.0]), np.zeros(3), np.array([False, True, True]), 0.0, (0.5, 2.0), np.inf)
    np.testing.assert_array_equal(lqg_filter.matched_variance(np.ones(3), *args), [1.0, 2.0, 0.5])
