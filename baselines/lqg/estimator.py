"""The LQG's eyes: the augmented plant's extended Kalman filter on bright ring and pyrometer.

It predicts through the plant's own equations (or, ``nonlinear=False``, through the linearised ones), with the
covariance of the linearised plant; the ring's slope is taken where the meniscus is believed to be, because a growing
radius nearly doubles it and halves the RHP zero. The camera's noise is estimated from the innovations.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats
from cz_gym.observation import Measured
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.physics.plant import Disturbance, Inputs, State, hidden_load, rk4
from cz_gym.task import HEIGHT_MAX_IN_A, HEIGHT_MIN, RADIUS_LIMIT
from cz_gym.units import KILO, MINUTE

from . import kalman, late_ring
from .kalman import Gaussian, Reading
from .late_ring import RIPPLE, RingModel, Search
from .model import DRIFT, FAST, HEATER, PLANT, SLOW, STATES, NoiseModel, PlantModel

_RADIUS, _HEIGHT, _PYROMETER = (STATES.index(name) for name in ("r_c", "h_c", "T_1"))
_LARGEST = np.array([RADIUS_LIMIT, 1.0, 50.0, 50.0, 50.0, 5.0, 5.0, 30.0, 1.0 / MINUTE, 5.0 * KILO])
"""Estimates are held within these, beyond which the equations mean nothing; the height has limits of its own."""
_INSIDE = 0.9
"""Share of the way to freezing or detachment that the estimated height may go [-]."""
_STEP = 1e-30


class Belief(NamedTuple):
    """What the estimator believes, by slot."""

    mean: Floats
    """State of the augmented plant, deviations in SI units, shape (n, states)."""
    covariance: Floats
    """Shape (n, states, states)."""
    camera_variance: Floats
    """Variance of the camera's noise [m2], shape (n,)."""
    spectrum: Floats
    """As in :class:`cz_gym.baselines.lqg.late_ring.Search`, as the next two."""
    omega: Floats
    samples: Floats


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
    ring: RingModel | None = None


def begin(n: int, eye: Eye) -> Belief:
    """Belief before the first sample of n slots."""
    states = eye.model.start.shape[-1]
    start = np.broadcast_to(eye.model.start, (n, states, states)).copy()
    if eye.ring is not None and eye.ring.shakes and not eye.ring.known:
        start = _without_ripple(start, np.ones(n, np.bool_))
    search = late_ring.begin(n, eye.ring, eye.dt)
    return Belief(np.zeros((n, states)), start, np.full(n, eye.noise.camera_sd**2), *search)


def predict(belief: Belief, applied: Floats, drift_moved: Floats, eye: Eye) -> Belief:
    """One interval on, under the inputs applied [m/s, W], shape (n, 2), and a known movement of the drift [K]."""
    mean = _moved_linearly(belief.mean, applied, eye)
    if eye.nonlinear:
        mean[:, :PLANT] = _moved_by_plant(belief.mean, applied, eye)
    mean[:, DRIFT] += drift_moved
    if eye.ring is None:
        covariance = kalman.predicted_covariance(belief.covariance, eye.model.A, eye.model.Q)
    else:
        mean[:, RIPPLE:], covariance = _ring_moved(belief, eye, eye.ring)
    return belief._replace(mean=_held(mean, eye), covariance=covariance)


def _ring_moved(belief: Belief, eye: Eye, ring: RingModel) -> tuple[Floats, Floats]:
    """Ripple and past rings one interval on, shape (n, states - 10), and the covariance of all states."""
    now, row = expected_ring(belief.mean, eye)
    A = late_ring.transition(eye.model.A, row, belief.omega, ring, eye.dt)
    mean = (A @ belief.mean[..., None])[..., 0]
    if ring.late < mean.shape[1]:
        mean[:, ring.late] = now
    covariance = kalman.predicted_covariance(belief.covariance, A, eye.model.Q)
    if ring.shakes:
        covariance = _without_ripple(covariance, belief.omega == 0.0)
    return mean[:, RIPPLE:], covariance


def correct(belief: Belief, seen: Measured, eye: Eye) -> Belief:
    """Use pyrometer and, where the frame is valid, camera."""
    n = len(belief.mean)
    row = np.zeros(belief.mean.shape)
    row[:, _PYROMETER] = 1.0
    pyrometer = Reading(seen.T_1 - belief.mean[:, _PYROMETER], row, np.full(n, eye.noise.pyrometer_sd**2))
    gaussian = kalman.correct(Gaussian(belief.mean, belief.covariance), pyrometer, eye.gate)
    ring, row = expected_reading(gaussian.mean, eye)
    valid = seen.valid > 0.5
    variance = np.where(valid, belief.camera_variance, np.inf)
    camera = Reading(seen.ring_error + seen.r_ref - ring, row, variance)
    keep = 1.0 - eye.dt / (eye.noise.camera_memory + eye.dt)
    predicted = kalman.innovation_variance(gaussian, camera._replace(variance=np.zeros(n)))
    camera_variance = kalman.observed_noise(
        belief.camera_variance, camera.innovation, predicted, valid, keep,
        (eye.noise.camera_sd_range[0] ** 2, eye.noise.camera_sd_range[1] ** 2), eye.gate,
    )  # fmt: skip
    corrected = kalman.correct(gaussian, camera, eye.gate)
    new = belief._replace(
        mean=_held(corrected.mean, eye), covariance=corrected.covariance, camera_variance=camera_variance
    )
    if eye.ring is None or not belief.spectrum.shape[1]:
        return new
    limit = eye.gate * np.sqrt(predicted + belief.camera_variance)
    shaken = np.clip(camera.innovation, -limit, limit) + gaussian.mean[:, RIPPLE]
    return _listened(new, shaken, valid, eye, eye.ring)


def _listened(belief: Belief, shaken: Floats, valid: npt.NDArray[np.bool_], eye: Eye, ring: RingModel) -> Belief:
    """Go on with the search for the ripple's frequency; where one is found, begin to estimate it."""
    search = Search(belief.spectrum, belief.omega, belief.samples)
    found = late_ring.listen(search, shaken, valid, ring, eye.dt)
    if not found.new.any():
        return belief._replace(**found.search._asdict())
    new, both = found.new, slice(RIPPLE, RIPPLE + 2)
    mean, covariance = belief.mean.copy(), _without_ripple(belief.covariance, new)
    mean[new, both] = found.ripple[new]
    covariance[new, both, both] = ring.ripple_sd**2 * np.eye(2)
    least = eye.noise.camera_sd_range[0] ** 2
    calmer = np.maximum(belief.camera_variance - 0.5 * np.square(found.ripple).sum(axis=1), least)
    variance = np.where(new, calmer, belief.camera_variance)
    return Belief(mean, covariance, variance, *found.search)


def _without_ripple(covariance: Floats, where: npt.NDArray[np.bool_]) -> Floats:
    """The covariance with nothing known or asked of the ripple in those slots."""
    if not where.any():
        return covariance
    silent = covariance.copy()
    silent[where, RIPPLE : RIPPLE + 2] = 0.0
    silent[where, :, RIPPLE : RIPPLE + 2] = 0.0
    return silent


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


def expected_reading(mean: Floats, eye: Eye) -> tuple[Floats, Floats]:
    """What the camera delivers [m], shape (n,), and its derivative by the state, shape (n, states)."""
    now, row = expected_ring(mean, eye)
    if eye.ring is None:
        return now, row
    read = late_ring.reading_row(row, eye.ring, eye.dt)
    samples, oldest = eye.ring.delay(eye.dt)
    fresh_share = (1.0, 1.0 - oldest, 0.0)[min(samples, 2)]
    return fresh_share * now + np.einsum("ni,ni->n", mean[:, RIPPLE:], read[:, RIPPLE:]), read


def expected_ring(mean: Floats, eye: Eye) -> tuple[Floats, Floats]:
    """Bright ring now [m] less its nominal, shape (n,), and its derivative by the state, shape (n, states)."""
    slope = eye.model.H[..., 0, :] if eye.ring is None else late_ring.undelayed_row(eye.model, eye.ring, eye.dt)
    if not eye.nonlinear:
        row = np.broadcast_to(slope, mean.shape)
        return np.einsum("ni,ni->n", mean, row), row
    p = eye.puller
    r_c, h_c = p.r_0 + mean[:, _RADIUS], p.h_0 + mean[:, _HEIGHT]
    offset = eye.meniscus.ring_offset(r_c, h_c + 1j * _STEP, p)
    row = np.zeros(mean.shape)
    row[:, _RADIUS], row[:, _HEIGHT] = slope[..., _RADIUS], offset.imag / _STEP
    return mean[:, _RADIUS] + offset.real - p.ring_bias, row


def _held(mean: Floats, eye: Eye) -> Floats:
    """Estimates held where the plant's equations mean something."""
    if not eye.nonlinear:
        return mean
    p = eye.puller
    held = mean.copy()
    held[:, : len(STATES)] = np.clip(mean[:, : len(STATES)], -_LARGEST, _LARGEST)
    held[:, _HEIGHT] = np.clip(
        mean[:, _HEIGHT], _INSIDE * (HEIGHT_MIN - p.h_0), _INSIDE * (HEIGHT_MAX_IN_A * p.a - p.h_0)
    )
    return held
