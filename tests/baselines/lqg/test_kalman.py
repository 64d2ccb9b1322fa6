"""The Kalman filter against the textbook's joint update and sensors of known noise."""

import numpy as np
import pytest

from cz_gym.baselines import lqg_filter

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
