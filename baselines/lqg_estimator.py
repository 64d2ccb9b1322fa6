"""The LQG's state estimator: an extended Kalman filter of the augmented plant on bright ring and pyrometer.

The mean is predicted with the plant's own equations (or, with ``nonlinear=False``, with the linearised ones), the
covariance with the linearised plant, the ring's slope taken at the estimated meniscus (docs/controllers/lqg.md).
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.signals import Measured
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.physics.plant import HEIGHT_MAX_IN_A, HEIGHT_MIN, Disturbance, State, hidden_load, radius_limit, rk4
from cz_gym.process import Inputs
from cz_gym.support.errors import map_arrays, select
from cz_gym.support.units import KILO, MINUTE

from . import lqg_filter
from .policy import Floats

_RADIUS, _HEIGHT, _PYROMETER = (lqg_filter.STATES.index(name) for name in ("r_c", "h_c", "T_1"))
_LARGEST = np.array([np.inf, 1.0, 50.0, 50.0, 50.0, 5.0, 5.0, 30.0, 1.0 / MINUTE, 5.0 * KILO])
"""Limits of the estimates, SI units; beyond them the equations are meaningless. Radius and height have the puller's."""
_INSIDE = 0.9
"""Limit of the estimated height, as a share of the way to freezing or detachment [-]."""
_STEP = 1e-30


class FilterState(NamedTuple):
    """The memory of the filter, by slot."""

    mean: Floats
    """Estimated state of the augmented plant, deviations in SI units, shape (n, states)."""
    covariance: Floats
    """Covariance of the estimate, shape (n, states, states)."""
    camera_variance: Floats
    """Estimated variance of the camera's noise [m2], shape (n,)."""
    ripple: lqg_filter.RippleSearch
    surprise: Floats
    """Running means of the innovations of pyrometer and ring, in standard deviations, shape (n, 2)."""


SURPRISE_MEMORY = 10.0 * MINUTE
"""Averaging time of the surprise [s]."""


class PlantFilter(NamedTuple):
    """The filter of one puller, or of one a slot: then ``puller`` and ``plant`` have a leading axis n."""

    puller: Any
    plant: lqg_filter.PlantModel
    """The linear model, augmented if ``ring`` is given."""
    noise: lqg_filter.NoiseModel
    meniscus: MeniscusModel
    dt: float
    """Control interval [s]."""
    nonlinear: bool
    gate: float
    """Limit of the innovations, in standard deviations [-]."""
    ring: lqg_filter.RingModel | None = None

    def at_rest(self, n: int) -> FilterState:
        """The state before the first sample of n slots."""
        states = self.plant.start.shape[-1]
        start = np.broadcast_to(self.plant.start, (n, states, states)).copy()
        if self.ring is not None and self.ring.has_ripple and not self.ring.frequency_known:
            start = _without_ripple(start, np.ones(n, np.bool_))
        search = lqg_filter.search_at_rest(n, self.ring, self.dt)
        return FilterState(np.zeros((n, states)), start, np.full(n, self.noise.camera_sd**2), search, np.zeros((n, 2)))

    def step(
        self, state: FilterState, applied: Floats, drift_moved: Floats, seen: Measured, starts: npt.NDArray[np.bool_]
    ) -> FilterState:
        """Predict one interval with the applied inputs, except where an episode starts, and correct by the sample."""
        predicted = self.predict(state, applied, drift_moved)
        return self.correct(select(starts, state, predicted) if starts.any() else predicted, seen)

    def predict(self, state: FilterState, applied: Floats, drift_moved: Floats) -> FilterState:
        """The state one interval later, under applied inputs [m/s, W], (n, 2), and a known step of the drift [K]."""
        mean = (self.plant.A @ state.mean[..., None] + self.plant.B @ applied[..., None])[..., 0]
        if self.nonlinear:
            mean[:, : lqg_filter.PLANT] = self._moved_plant(state.mean, applied)
        mean[:, lqg_filter.DRIFT] += drift_moved
        if self.ring is None:
            covariance = self.plant.A @ state.covariance @ np.swapaxes(self.plant.A, -1, -2) + self.plant.Q
        else:
            mean[:, lqg_filter.RIPPLE :], covariance = self._moved_ring(state, self.ring)
        return state._replace(mean=self._clipped(mean), covariance=covariance)

    def correct(self, state: FilterState, seen: Measured) -> FilterState:
        """The state after the pyrometer where it is finite, and the camera where its frame is valid.

        ``seen.valid`` is the frame's weight: 1/3 in each of three samples that have one frame in common.
        """
        noise, gate = self.noise, self.gate
        row = np.zeros_like(state.mean)
        row[:, _PYROMETER] = 1.0
        known = np.isfinite(seen.T_1)
        innovation = np.where(known, seen.T_1 - state.mean[:, _PYROMETER], 0.0)
        variance = np.where(known, noise.pyrometer_sd**2, np.inf)
        warmth = innovation / np.sqrt(lqg_filter.expected_variance(state.covariance, row) + noise.pyrometer_sd**2)
        mean, covariance = lqg_filter.correct(state.mean, state.covariance, row, innovation, variance, gate)
        ring, row = self.expected_frame(mean)
        innovation, valid = seen.ring_error + seen.r_ref - ring, seen.valid > 0.0
        expected = lqg_filter.expected_variance(covariance, row)
        keep = 1.0 - self.dt / (noise.camera_memory + self.dt)
        least, most = noise.camera_sd_range
        camera_variance = lqg_filter.matched_variance(
            state.camera_variance, innovation, expected, valid, keep, (least**2, most**2), gate
        )
        variance = np.where(valid, state.camera_variance / np.where(valid, seen.valid, 1.0), np.inf)
        corrected, covariance = lqg_filter.correct(mean, covariance, row, innovation, variance, gate)
        width = np.where(valid, innovation, 0.0) / np.sqrt(expected + state.camera_variance)
        newest = np.clip(np.stack([warmth, width], axis=-1), -gate, gate)
        surprise = state.surprise + min(self.dt / SURPRISE_MEMORY, 1.0) * (newest - state.surprise)
        new = FilterState(self._clipped(corrected), covariance, camera_variance, state.ripple, surprise)
        if self.ring is None or not state.ripple.spectrum.shape[1]:
            return new
        limit = gate * np.sqrt(expected + state.camera_variance)
        residual = np.clip(innovation, -limit, limit) + mean[:, lqg_filter.RIPPLE]
        return self._search_ripple(new, residual, valid, self.ring)

    def expected_frame(self, mean: Floats) -> tuple[Floats, Floats]:
        """The ring that the camera delivers [m], shape (n,), and its derivative by the state, shape (n, states)."""
        now, row = self._expected_ring(mean)
        if self.ring is None:
            return now, row
        delivered = lqg_filter.delivered_row(row, self.ring, self.dt)
        samples, oldest = self.ring.delay(self.dt)
        newest = (1.0, 1.0 - oldest, 0.0)[min(samples, 2)]
        return newest * now + np.einsum(
            "ni,ni->n", mean[:, lqg_filter.RIPPLE :], delivered[:, lqg_filter.RIPPLE :]
        ), delivered

    def _expected_ring(self, mean: Floats) -> tuple[Floats, Floats]:
        """The present ring minus its nominal [m], shape (n,), and its derivative by the state, shape (n, states)."""
        H = self.plant.H[..., 0, :]
        slope = H if self.ring is None else lqg_filter.undelayed_row(self.plant, self.ring, self.dt)
        if not self.nonlinear:
            row = np.broadcast_to(slope, mean.shape)
            return np.einsum("ni,ni->n", mean, row), row
        p = self.puller
        r_c, h_c = p.r_0 + mean[:, _RADIUS], p.h_0 + mean[:, _HEIGHT]
        offset = self.meniscus.ring_offset(r_c, h_c + 1j * _STEP, p)
        row = np.zeros_like(mean)
        row[:, _RADIUS], row[:, _HEIGHT] = slope[..., _RADIUS], offset.imag / _STEP
        return mean[:, _RADIUS] + offset.real - p.ring_bias, row

    def _moved_plant(self, mean: Floats, applied: Floats) -> Floats:
        p, z = self.puller, mean.T
        x = State(*(value + nominal for value, nominal in zip(z[: lqg_filter.PLANT], p.state_0, strict=True)))
        u = Inputs(p.v_0 + applied[:, 0], p.Q_H_0 + applied[:, 1] + z[lqg_filter.HEATER])
        d = Disturbance(hidden_load(z[lqg_filter.DRIFT], p), z[lqg_filter.FAST] + z[lqg_filter.SLOW], 1.0)
        new = rk4(x, u, d, p, self.dt, self.meniscus.slope)
        return np.stack([value - nominal for value, nominal in zip(new, p.state_0, strict=True)], axis=-1)

    def _moved_ring(self, state: FilterState, ring: lqg_filter.RingModel) -> tuple[Floats, Floats]:
        """Ripple and past rings one interval later, shape (n, states - 10), and the covariance of all states."""
        now, row = self._expected_ring(state.mean)
        A = lqg_filter.transition(self.plant.A, row, state.ripple.omega, ring, self.dt)
        mean = (A @ state.mean[..., None])[..., 0]
        if ring.first_past < mean.shape[1]:
            mean[:, ring.first_past] = now
        covariance = A @ state.covariance @ np.swapaxes(A, -1, -2) + self.plant.Q
        if ring.has_ripple:
            covariance = _without_ripple(covariance, state.ripple.omega == 0.0)
        return mean[:, lqg_filter.RIPPLE :], covariance

    def _search_ripple(
        self, state: FilterState, residual: Floats, valid: npt.NDArray[np.bool_], ring: lqg_filter.RingModel
    ) -> FilterState:
        """One more sample of the search for the ripple's frequency; slots that find it begin to estimate the ripple."""
        search, new, ripple = lqg_filter.search_step(state.ripple, residual, valid, ring, self.dt)
        if not new.any():
            return state._replace(ripple=search)
        mean, covariance = state.mean.copy(), _without_ripple(state.covariance, new)
        mean[new, lqg_filter.RIPPLE_STATES] = ripple[new]
        covariance[new, lqg_filter.RIPPLE_STATES, lqg_filter.RIPPLE_STATES] = ring.ripple_sd**2 * np.eye(2)
        least = self.noise.camera_sd_range[0] ** 2
        reduced = np.maximum(state.camera_variance - 0.5 * np.square(ripple).sum(axis=1), least)
        variance = np.where(new, reduced, state.camera_variance)
        return state._replace(mean=mean, covariance=covariance, camera_variance=variance, ripple=search)

    def _clipped(self, mean: Floats) -> Floats:
        """The estimates, clipped to where the plant's equations are meaningful."""
        if not self.nonlinear:
            return mean
        p, clipped = self.puller, mean.copy()
        clipped[:, : len(lqg_filter.STATES)] = np.clip(mean[:, : len(lqg_filter.STATES)], -_LARGEST, _LARGEST)
        lowest, highest = _INSIDE * (HEIGHT_MIN - p.h_0), _INSIDE * (HEIGHT_MAX_IN_A * p.a - p.h_0)
        clipped[:, _HEIGHT] = np.clip(mean[:, _HEIGHT], lowest, highest)
        clipped[:, _RADIUS] = np.clip(mean[:, _RADIUS], -radius_limit(p.r_0), radius_limit(p.r_0))
        return clipped


def _without_ripple(covariance: Floats, where: npt.NDArray[np.bool_]) -> Floats:
    """The covariance without the ripple's part in those slots, where the ripple is not estimated."""
    if not where.any():
        return covariance
    reduced = covariance.copy()
    reduced[where, lqg_filter.RIPPLE_STATES] = 0.0
    reduced[where, :, lqg_filter.RIPPLE_STATES] = 0.0
    return reduced


# Multiple-model estimation
#
# Each filter of a bank assumes one pair of standard deviations of the interface fluctuations, whose strength differs
# from crystal to crystal. Bayes' rule gives its probability (Magill 1965); the estimate is the mean over the filters.


@dataclass(frozen=True)
class Hypotheses:
    """Standard deviations of the fluctuations that are considered possible; each pair is equally likely at first."""

    fast_sd: tuple[float, ...] = (0.1, 0.3, 0.5)
    """Standard deviations of the fast interface fluctuation [K]."""
    slow_sd: tuple[float, ...] = (0.15, 0.35)
    """Standard deviations of the slow interface fluctuation [K]; with 0.6 slow drives lose crystals."""

    @property
    def count(self) -> int:
        """Number of filters."""
        return len(self.fast_sd) * len(self.slow_sd)


class MultipleModelState(NamedTuple):
    """The memory of the filters, by slot and hypothesis."""

    filters: FilterState
    """Arrays with leading axes (n, m)."""
    evidence: Floats
    """Logarithm of each hypothesis' probability, up to a constant, shape (n, m)."""

    @property
    def probability(self) -> Floats:
        """Probability of each hypothesis, shape (n, m)."""
        weight = np.exp(self.evidence - self.evidence.max(axis=1, keepdims=True))
        share: Floats = weight / weight.sum(axis=1, keepdims=True)
        return share

    @property
    def mean(self) -> Floats:
        """Mean of the estimated state over the hypotheses, shape (n, states)."""
        mean: Floats = np.einsum("nm,nmi->ni", self.probability, self.filters.mean)
        return mean


class MultipleModelFilter(NamedTuple):
    """The filters of n slots and m hypotheses, computed as one filter of n m rows, slot by slot."""

    rows: PlantFilter
    hypotheses: Hypotheses

    def at_rest(self, n: int) -> MultipleModelState:
        """The state before the first sample of n slots."""
        m = self.hypotheses.count
        return MultipleModelState(_by_slot(self.rows.at_rest(n * m), m), np.zeros((n, m)))

    def step(
        self,
        state: MultipleModelState,
        applied: Floats,
        drift_moved: Floats,
        seen: Measured,
        starts: npt.NDArray[np.bool_],
    ) -> MultipleModelState:
        """Predict and correct by one sample; arguments as of :meth:`PlantFilter.step`, one a slot."""
        m = self.hypotheses.count
        rows = self.rows.predict(_by_row(state.filters), np.repeat(applied, m, axis=0), np.repeat(drift_moved, m))
        predicted = MultipleModelState(_by_slot(rows, m), state.evidence)
        if starts.any():
            predicted = select(starts, state, predicted)
        # The measurements weight the filters, and then correct each of them.
        rows, repeated = _by_row(predicted.filters), Measured(*(np.repeat(channel, m) for channel in seen))
        evidence = predicted.evidence + self._log_likelihood(rows, repeated).reshape(predicted.evidence.shape)
        corrected = _by_slot(self.rows.correct(rows, repeated), m)
        return MultipleModelState(corrected, evidence - evidence.max(axis=1, keepdims=True))

    def _log_likelihood(self, state: FilterState, seen: Measured) -> Floats:
        """Log likelihood of the ring under each filter, up to a constant, with innovations clipped to the gate."""
        ring, row = self.rows.expected_frame(state.mean)
        variance = np.einsum("ri,rij,rj->r", row, state.covariance, row) + state.camera_variance
        square = np.minimum(np.square(seen.ring_error + seen.r_ref - ring) / variance, self.rows.gate**2)
        return np.where(seen.valid > 0.0, -0.5 * seen.valid * (square + np.log(variance)), 0.0)


def multiple_model_filter(single: PlantFilter, hypotheses: Hypotheses, n: int) -> MultipleModelFilter:
    """The bank of n slots: one filter, with the process noise and initial covariance of each hypothesis."""
    models = []
    for fast, slow in product(hypotheses.fast_sd, hypotheses.slow_sd):
        noise = replace(single.noise, fast_sd=fast, slow_sd=slow)
        model = lqg_filter.plant_model(single.puller, noise, single.dt, single.meniscus)
        models.append(model if single.ring is None else lqg_filter.augmented(model, single.ring, single.dt))
    Q, start = (np.tile([getattr(model, name) for model in models], (n, 1, 1)) for name in ("Q", "start"))
    return MultipleModelFilter(single._replace(plant=single.plant._replace(Q=Q, start=start)), hypotheses)


def _by_row(state: FilterState) -> FilterState:
    """The state with one axis n m in place of the leading axes (n, m)."""
    joined: FilterState = map_arrays(lambda part: part.reshape(part.shape[0] * part.shape[1], *part.shape[2:]), state)
    return joined


def _by_slot(state: FilterState, m: int) -> FilterState:
    """The reverse of :func:`_by_row`."""
    split: FilterState = map_arrays(lambda part: part.reshape(len(part) // m, m, *part.shape[1:]), state)
    return split
