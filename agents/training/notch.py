"""Removes outliers and ripple from the ring's readings: an adaptive notch filter (Dragosevic and Stankovic, 1995).

Rotation makes the ring ripple at a frequency that differs from crystal to crystal; sampled, it may look slow. A
resonator at the frequency found so far is driven by the readings less their slow part; what it does says how the
frequency should move. A notch at that frequency then takes the ripple from the readings.

Tensors or values of a graph (:mod:`.symbolic`), shape (n, 1). Lengths in units of the observation's ring error.
"""

from __future__ import annotations

from math import exp
from typing import Any

from .symbolic import clamp, concat, relu, root, split

SLOW = 25.0
"""Time constant of the two low-passes for the readings' slow part [s]."""
NOISE_TIME = 600.0
"""Time constant of the variance about it [s]."""
PATIENCE = 1600.0
"""Time constant of the frequency's estimate [s]."""
OUTLIER = 3.0
"""Limit of a reading, in standard deviations from the slow part [-]."""
RADIUS = 0.9
"""Radius of the poles of resonator and notch [-]."""
LEAST, MOST = -0.999, 0.98
"""Cosine of the turn from reading to reading: slower ripples, longer than 25 readings, are left alone."""
SEEN = 0.02
"""Amplitude of a ripple whose strength is one half."""
BEGIN = 0.05, 0.01
"""Initial standard deviations of the readings and of the resonator's output."""
STATE = 11
"""Length of its state."""


def cleaned(reading: Any, state: Any, first: Any, interval: float) -> tuple[Any, Any, Any]:
    """The part of a reading to remove, the strength of its ripple, from 0 to 1, and the next state, shape (n, STATE).

    ``first`` is 1 for a crystal's first reading, and 0 for all others.
    """
    mean, slow, excess, before, last, along, across, seen, delayed, earlier, power = split(state, [1] * STATE)
    share, noise_share, patience = (1.0 - exp(-interval / time) for time in (SLOW, NOISE_TIME, PATIENCE))
    variance, energy = BEGIN[0] ** 2, BEGIN[1] ** 2

    mean, slow = mean + (reading - mean) * first, slow + (reading - slow) * first
    off = reading - mean
    most = root(relu(excess + variance)) * OUTLIER
    off = off - relu(off - most) + relu(off * -1.0 - most)
    excess = excess + (off * off - excess - variance) * noise_share
    believed = mean + off
    mean = mean + off * share
    slow = slow + (mean - slow) * share

    turn = clamp(along / (across + (energy + 1e-8)), LEAST, MOST)
    now = believed - mean * 2.0 + slow + last * turn * (2.0 * RADIUS) - before * RADIUS**2
    along = along + (last * (now + before) - along) * patience
    across = across + (last * last * 2.0 - across - energy) * patience
    turn = clamp(along / (across + (energy + 1e-8)), LEAST, MOST)

    scale = (turn * (-2.0 * RADIUS) + (1.0 + RADIUS**2)) / (turn * -2.0 + 2.0)
    change = believed - seen - (reading - seen) * first
    ripple = change - scale * change + delayed
    delayed = scale * change - change * RADIUS**2 + turn * ripple * (2.0 * RADIUS) + earlier
    power = power + (ripple * ripple - power) * patience
    strength = power / (power + SEEN**2)
    return (
        reading - believed + ripple * strength,
        strength,
        concat([mean, slow, excess, last, now, along, across, believed, delayed, ripple * -(RADIUS**2), power]),
    )
