"""The logged law against a literal transcription."""

import math

import numpy as np
import pytest

from cz_gym.baselines.pid.industrial import Industrial
from cz_gym.observation import PULL_SCALE
from cz_gym.support.units import MM, MM_PER_MIN
from tests.observed import measured, pulls


def literal(diameters):
    """The law from its description: lists, mm and mm/min, one increment every 5 s; diameters relative to the target."""
    pull, rate, found = 0.0, 0.0, []
    for k, now in enumerate(diameters):
        before = diameters[max(k - 12, 0)]
        last = diameters[max(k - 1, 0)]
        rate += ((now - last) * 2.0 - rate) / 24.0
        E = 2.0 * now if abs(now) < 1.0 else math.copysign(2.0 if abs(now) < 2.0 else 3.0, now)
        pull += 1.15 * (0.0004 * E + 0.16 * (now - before) / 6.0 - 0.1064 * rate)
        found.append(pull)
    return np.array(found)


def follow(policy, diameters):
    """Pull speeds [mm/min above nominal] when every command is applied."""
    state, pull, found = None, 0.0, []
    for diameter in diameters:
        action, state = policy.predict(measured(ring_error=diameter / 2.0 * MM, v_p=pull * PULL_SCALE), state)
        pull = float(action[0, 0])
        found.append(pull * PULL_SCALE / MM_PER_MIN)
    return np.array(found)


def test_the_industrial_law_is_the_one_described(rng):
    diameters = np.cumsum(rng.normal(0.0, 0.1, 150))
    assert np.abs(diameters).max() > 1.0
    found = follow(Industrial(T_f=1e-9), diameters)
    np.testing.assert_allclose(found, literal(diameters), atol=2e-5)


def test_no_wind_up_on_a_stuck_drive():
    found = pulls(Industrial(), [measured(ring_error=0.4 * MM, v_p=0.2 * PULL_SCALE)] * 500)
    increment = found[-1] - 0.2 * PULL_SCALE
    assert increment == pytest.approx(1.15 * 0.0004 * 1.6 * MM_PER_MIN, rel=1e-3)


def test_a_held_diameter_and_a_moving_target():
    """The rates are those of the diameter itself; a falling target shows in the error alone."""
    policy, state = Industrial(T_f=1e-9), None
    for k in range(30):
        _, state = policy.predict(measured(r_ref=-0.01 * k * MM, ring_error=0.01 * k * MM), state)
    assert abs(state.memory.rate[0]) < 1e-9
    np.testing.assert_allclose(state.memory.diameters, 0.0, atol=1e-9)
