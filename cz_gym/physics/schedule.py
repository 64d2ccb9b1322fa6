"""The signals of an episode that depend on time alone: reference, recipe, hidden drift and melt loss at t [s].

``e`` is an :class:`cz_gym.episodes.draw.Episode` or a record with its fields.
"""

from typing import Any

import numpy as np

from cz_gym.jit import jittable
from cz_gym.support.units import HOUR

DRAW_SPAN = 3.0 * HOUR
"""Span [s] over which "uniform over the episode" is drawn, whatever the horizon: a draw never depends on it."""


@jittable
def progress(t: Any, start: Any, duration: Any) -> Any:
    """Share of a ramp that is done at t [-], from 0 to 1."""
    return np.minimum(np.maximum((t - start) / duration, 0.0), 1.0)


@jittable
def quintic(s: Any) -> Any:
    """10 s^3 - 15 s^4 + 6 s^5: from 0 to 1 with zero rate and curvature at both ends."""
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


@jittable
def drift(t: Any, e: Any) -> Any:
    """Drift p(t) of the hot zone [K]."""
    return e.drift_amount * progress(t, e.drift_start, e.drift_duration) + e.drift_rate * t


@jittable
def recipe(t: Any, e: Any) -> Any:
    """T_1,ref(t) - T_1,0 = e(t) + p(t) [K]: the recipe: its error plus the drift."""
    return e.recipe_amount * progress(t, e.recipe_start, e.recipe_duration) + drift(t, e)


@jittable
def reference(t: Any, e: Any) -> Any:
    """r_ref(t) - r_0 [m]."""
    return e.reference_amount * quintic(progress(t, e.reference_start, e.reference_duration))


@jittable
def melt_left(t: Any, e: Any) -> Any:
    """Share of the melt's heat capacity left [-]."""
    return 1.0 - e.melt_loss * progress(t, 0.0, DRAW_SPAN)


@jittable
def bias_offset(t: Any, e: Any) -> Any:
    """Offset of the ring [m] that no sensor shows: wrong bias, melt level and drift."""
    return e.ring_offset + e.bias_drift_amount * progress(t, e.bias_drift_start, e.bias_drift_duration)


@jittable
def ripple(t: Any, e: Any) -> Any:
    """Rotation-synchronous ripple of the ring [m] in a frame taken at t [s]."""
    return e.ripple_amplitude * np.sin(e.ripple_omega * t + e.ripple_phase)


@jittable
def pyrometer_drift(t: Any, e: Any) -> Any:
    """Drift of the pyrometer [K]."""
    return e.pyrometer_drift * progress(t, 0.0, DRAW_SPAN)
