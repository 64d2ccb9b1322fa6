"""The LQG's eyes: the augmented plant's extended Kalman filter on bright ring and pyrometer.

It predicts through the plant's own equations (or, ``nonlinear=False``, through the linearised ones), with the
covariance of the linearised plant; the ring's slope is taken where the meniscus is believed to be, because a growing
radius nearly doubles it and halves the RHP zero. The camera's noise is estimated from the innovations.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cz_gym.meniscus import MeniscusModel
from cz_gym.observation import Measured
from cz_gym.plant import Disturbance, Inputs, State, hidden_load, rk4
from cz_gym.task import HEIGHT_MAX_IN_A, HEIGHT_MIN, RADIUS_LIMIT
from cz_gym.units import KILO, MINUTE

from . import kalman
from .kalman import Gaussian, Reading
from .lqg_model import DRIFT, FAST, HEATER, PLANT, SLOW, STATES, NoiseModel, PlantModel
from .policy import Floats

_RADIUS, _HEIGHT, _PYROMETER = (STATES.index(name) for name in ("r_c", "h_c", "T_1"))
_LARGEST = np.array([RADIUS_LIMIT, 1.0, 50.0, 50.0, 50.0, 5.0, 5.0, 30.0, 1.0 / MINUTE, 5.0 * KILO])
"""Estimates are held within these, beyond which the equations mean nothing; the height has limits of its own."""
_INSIDE = 0.9
"""Share of the way to freezing or detachment that the estimated height may go [-]."""
_STEP = 1e-30


class Belief(NamedTuple):
    """What the estimator believes, by slot."""

    mean: Floats
    """State of the augmented plant, deviations in SI units, shape (n, 10)."""
    covariance: Floats
    """Shape (n, 10, 10)."""
    camera_variance: Floats
    """Variance of the camera's noise [m2], shape (n,)."""


class Eye(NamedTuple):
    """What the estimator knows; ``puller`` and ``model`` of one puller, or one a slot.

    For one a slot, fields of ``puller`` have shape (n,) and arrays of ``model`` a leading axis n.
    """

    puller: Any
    model: PlantModel
    noise: NoiseModel
    meniscus: MeniscusModel
    dt: float
    """Control interval [s]."""
    nonlinear: bool
    gate: float


def begin(n: int, eye: Eye) -> Belief:
    """Belief before the first sample of n slots."""
    start = np.broadcast_to(eye.model.start, (n, len(STATES), len(STATES))).copy()
    return Belief(np.zeros((n, len(STATES))), start, np.full(n, eye.noise.camera_sd**2))


def predict(belief: Belief, applied: Floats, drift_moved: Floats, eye: Eye) -> Belief:
    """One interval on, under the inputs applied [m/s, W], shape (n, 2), and a known movement of the drift [K]."""
    mean = _moved_linearly(belief.mean, applied, eye)
    if eye.nonlinear:
        mean[:, :PLANT] = _moved_by_plant(belief.mean, applied, eye)
    mean[:, DRIFT] += drift_moved
    covariance = kalman.predicted_covariance(belief.covariance, eye.model.A, eye.model.Q)
    return Belief(_held(mean, eye), covariance, belief.camera_variance)


def correct(belief: Belief, seen: Measured, eye: Eye) -> Belief:
    """Use pyrometer and, where the frame is valid, camera."""
    n = len(belief.mean)
    row = np.zeros((n, len(STATES)))
    row[:, _PYROMETER] = 1.0
    pyrometer = Reading(seen.T_1 - belief.mean[:, _PYROMETER], row, np.full(n, eye.noise.pyrometer_sd**2))
    gaussian = kalman.correct(Gaussian(belief.mean, belief.covariance), pyrometer, eye.gate)
    ring, row = expected_ring(gaussian.mean, eye)
    valid = seen.valid > 0.5
    variance = np.where(valid, belief.camera_variance, np.inf)
    camera = Reading(seen.ring_error + seen.r_ref - ring, row, variance)
    keep = 1.0 - eye.dt / (eye.noise.camera_memory + eye.dt)
    predicted = kalman.innovation_variance(gaussian, camera._replace(variance=np.zeros(n)))
    camera_variance = kalman.observed_noise(
        belief.camera_variance, camera.innovation, predicted, valid, keep,
        (eye.noise.camera_sd_range[0] ** 2, eye.noise.camera_sd_range[1] ** 2), eye.gate,
    )  # fmt: skip
    gaussian = kalman.correct(gaussian, camera, eye.gate)
    return Belief(_held(gaussian.mean, eye), gaussian.covariance, camera_variance)


def _moved_linearly(mean: Floats, applied: Floats, eye: Eye) -> Floats:
    moved: Floats = (eye.model.A @ mean[..., None] + eye.model.B @ applied[..., None])[..., 0]
    return moved


def _moved_by_plant(mean: Floats, applied: Floats, eye: Eye) -> Floats:
    p, z = eye.puller, mean.T
    x = State(*(value + nominal for value, nominal in zip(z[:PLANT], p.state_0, strict=True)))
    u = Inputs(p.v_0 + applied[:, 0], p.Q_H_0 + applied[:, 1] + z[HEATER])
    d = Disturbance(hidden_load(z[DRIFT], p), z[FAST] + z[SLOW], 1.0)
    new = rk4(x, u, d, p, eye.dt, eye.meniscus.slope)
    return np.stack([value - nominal for value, nominal in zip(new, p.state_0, strict=True)], axis=-1)


def expected_ring(mean: Floats, eye: Eye) -> tuple[Floats, Floats]:
    """Bright ring [m] less its nominal, shape (n,), and its derivative by the state, shape (n, 10)."""
    if not eye.nonlinear:
        row = np.broadcast_to(eye.model.H[..., 0, :], mean.shape)
        return np.einsum("ni,ni->n", mean, row), row
    p = eye.puller
    r_c, h_c = p.r_0 + mean[:, _RADIUS], p.h_0 + mean[:, _HEIGHT]
    offset = eye.meniscus.ring_offset(r_c, h_c + 1j * _STEP, p)
    row = np.zeros(mean.shape)
    row[:, _RADIUS], row[:, _HEIGHT] = eye.model.H[..., 0, _RADIUS], offset.imag / _STEP
    return mean[:, _RADIUS] + offset.real - p.ring_bias, row


def _held(mean: Floats, eye: Eye) -> Floats:
    """Estimates held where the plant's equations mean something."""
    if not eye.nonlinear:
        return mean
    p = eye.puller
    held = np.clip(mean, -_LARGEST, _LARGEST)
    held[:, _HEIGHT] = np.clip(
        mean[:, _HEIGHT], _INSIDE * (HEIGHT_MIN - p.h_0), _INSIDE * (HEIGHT_MAX_IN_A * p.a - p.h_0)
    )
    return held
