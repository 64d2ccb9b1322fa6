"""Multiple-model estimation: a bank of the LQG's filters, weighted by how well each predicts the ring.

Each filter assumes one pair of standard deviations of the interface fluctuations, whose strength differs from crystal
to crystal. Bayes' rule gives its probability (Magill 1965), and the estimate is the mean over the filters.
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats
from cz_gym.observation import Measured
from cz_gym.support.nested import map_arrays, select

from .estimator import FilterState, PlantFilter
from .model import plant_model
from .ring_model import augmented


@dataclass(frozen=True)
class Hypotheses:
    """Standard deviations of the fluctuations that are considered possible; each pair is equally likely at first."""

    fast_sd: tuple[float, ...] = (0.1, 0.3, 0.5)
    """Standard deviations of the fast interface fluctuation [K]."""
    slow_sd: tuple[float, ...] = (0.15, 0.35)
    """Standard deviations of the slow one [K]; with 0.6 the heater chases the radius and slow drives lose crystals."""

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
        model = plant_model(single.puller, noise, single.dt, single.meniscus)
        models.append(model if single.ring is None else augmented(model, single.ring, single.dt))
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
