"""What the adaptive notch takes from the ring's readings: ripples and outliers, and nothing else."""

import numpy as np
import pytest
import torch

from cz_gym.agents.training.notch import STATE, cleaned

INTERVAL, STEPS, CRYSTALS = 5.0, 2000, 16
SLOW = 0.1 * np.sin(2.0 * np.pi * np.arange(STEPS) * INTERVAL / 3600.0)[:, None]
"""What a controller has to see, in units of the observation's ring error."""


def taken(readings: np.ndarray) -> np.ndarray:
    """From readings of shape (steps, n)."""
    state, found = torch.zeros(readings.shape[1], STATE), []
    for k, reading in enumerate(torch.from_numpy(readings.astype(np.float32))):
        take, _, state = cleaned(reading[:, None], state, torch.full((len(reading), 1), float(k == 0)), INTERVAL)
        found.append(take[:, 0].numpy())
    assert bool(torch.isfinite(state).all())
    return np.stack(found)


def noise(deviation: float) -> np.ndarray:
    return np.random.default_rng(0).normal(0.0, deviation, (STEPS, CRYSTALS))


def rms(error: np.ndarray) -> float:
    """After the frequency is found."""
    return float(np.sqrt((error[STEPS // 2 :] ** 2).mean()))


@pytest.mark.parametrize("turn", [0.5, 1.2, 2.0, 2.8])
def test_a_ripple_is_taken(turn: float) -> None:
    """Of any frequency but a slow one [rad per reading], in noise: what stays is nearer to the truth by half."""
    ripple = 0.1 * np.sin(turn * np.arange(STEPS)[:, None] + np.arange(CRYSTALS))
    readings = SLOW + ripple + noise(0.03)
    left = readings - taken(readings) - SLOW - noise(0.03)
    assert rms(left) < 0.5 * rms(ripple)


def test_what_is_slow_stays() -> None:
    assert rms(taken(np.repeat(SLOW, CRYSTALS, axis=1))) < 0.01 * rms(SLOW)


def test_outliers_are_taken() -> None:
    """Eight in a thousand readings, thirty standard deviations off: all but a quarter of each."""
    at = np.random.default_rng(1).random((STEPS, CRYSTALS)) < 0.008
    readings = SLOW + noise(0.02) + 0.6 * at
    found = taken(readings)[100:][at[100:]]
    assert float(np.quantile(found, 0.1)) > 0.45


@pytest.mark.parametrize("reading", [0.0, 1.0, -10.0])
def test_a_constant_reading_stays_as_it_is(reading: float) -> None:
    assert float(np.abs(taken(np.full((STEPS, 1), reading))).max()) <= 1e-5 * abs(reading)
