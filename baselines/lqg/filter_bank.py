"""How rough is this crystal's melt? A bank of the LQG's filters, one a hypothesis, weighed by how well it predicts.

Crystals differ in the strength of their interface fluctuations, and a filter tuned to the middle trusts its camera too
little on a rough crystal and too much on a calm one. Each filter of the bank believes in one pair of standard
deviations; Bayes' rule on the ring's innovations gives their probabilities (Magill 1965), and the estimate is the mean
over them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cz_gym.baselines.policy import Floats
from cz_gym.observation import Measured
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.physics.plant import Puller

from . import estimator
from .estimator import Belief, Eye
from .late_ring import RingModel, augmented
from .model import NoiseModel, plant_model


@dataclass(frozen=True)
class Hypotheses:
    """Standard deviations that the bank holds possible; every pair of them, equally likely at first."""

    fast_sd: tuple[float, ...] = (0.1, 0.3, 0.5)
    """Of the fast interface fluctuation [K]."""
    slow_sd: tuple[float, ...] = (0.15, 0.35)
    """Of the slow one [K]; with one as large as 0.6 the heater chases the radius and slow drives lose crystals."""

    @property
    def count(self) -> int:
        """How many filters there are."""
        return len(self.fast_sd) * len(self.slow_sd)


class Believed(NamedTuple):
    """What the filters believe, by slot and hypothesis."""

    mean: Floats
    """Shape (n, m, states)."""
    covariance: Floats
    """Shape (n, m, states, states)."""
    camera_variance: Floats
    """Variance of the camera's noise [m2], shape (n, m)."""
    spectrum: Floats
    """As in :class:`cz_gym.baselines.lqg.late_ring.Search`, with the axis m, as the next two."""
    omega: Floats
    samples: Floats
    evidence: Floats
    """Logarithm of each hypothesis's probability, up to a constant, shape (n, m)."""

    @property
    def probability(self) -> Floats:
        """Probability of each hypothesis, shape (n, m)."""
        weight = np.exp(self.evidence - self.evidence.max(axis=1, keepdims=True))
        share: Floats = weight / weight.sum(axis=1, keepdims=True)
        return share

    @property
    def estimate(self) -> Floats:
        """The state, the mean over the hypotheses, shape (n, states)."""
        mean: Floats = np.einsum("nm,nmi->ni", self.probability, self.mean)
        return mean

    @property
    def rows(self) -> Belief:
        """All filters as one belief, slot by slot, hypothesis by hypothesis."""
        return Belief(*(part.reshape(self.evidence.size, *part.shape[2:]) for part in self[:-1]))

    def moved_to(self, rows: Belief) -> Believed:
        """The same evidence, another belief."""
        shaped = Belief(*(part.reshape(*self.evidence.shape, *part.shape[1:]) for part in rows))
        return Believed(*shaped, evidence=self.evidence)


def bank_eye(eye: Eye, hypotheses: Hypotheses, slots: int) -> Eye:
    """What the filters of that many slots know, row by row."""
    Q, start = _noises(eye.puller, eye.noise, eye.ring, eye.dt, eye.meniscus, hypotheses)
    rows = (slots, 1, 1)
    return eye._replace(model=eye.model._replace(Q=np.tile(Q, rows), start=np.tile(start, rows)))


def begin(slots: int, hypotheses: Hypotheses, eye: Eye) -> Believed:
    """Belief before the first sample; ``eye`` is that of :func:`bank_eye`."""
    rows, shape = estimator.begin(slots * hypotheses.count, eye), (slots, hypotheses.count)
    blank = Believed(*rows, evidence=np.zeros(shape))
    return blank.moved_to(rows)


def predict(believed: Believed, applied: Floats, drift_moved: Floats, eye: Eye) -> Believed:
    """One interval on; arguments as of :func:`cz_gym.baselines.lqg.estimator.predict`, one a slot."""
    m = believed.evidence.shape[1]
    rows = estimator.predict(believed.rows, np.repeat(applied, m, axis=0), np.repeat(drift_moved, m), eye)
    return believed.moved_to(rows)


def correct(believed: Believed, seen: Measured, eye: Eye) -> Believed:
    """Use the readings: to weigh the filters, then by each of them."""
    n, m = believed.evidence.shape
    repeated = Measured(*(np.repeat(channel, m) for channel in seen))
    evidence = believed.evidence + _likelihood(believed.rows, repeated, eye).reshape(n, m)
    corrected = believed.moved_to(estimator.correct(believed.rows, repeated, eye))
    return corrected._replace(evidence=evidence - evidence.max(axis=1, keepdims=True))


def _likelihood(belief: Belief, seen: Measured, eye: Eye) -> Floats:
    """Logarithm of the ring's likelihood under each filter, up to a constant; innovations count up to the gate."""
    ring, row = estimator.expected_reading(belief.mean, eye)
    variance = np.einsum("ri,rij,rj->r", row, belief.covariance, row) + belief.camera_variance
    square = np.minimum(np.square(seen.ring_error + seen.r_ref - ring) / variance, eye.gate**2)
    return np.where(seen.valid > 0.5, -0.5 * (square + np.log(variance)), 0.0)


@lru_cache(maxsize=8)
def _noises(
    puller: Puller,
    noise: NoiseModel,
    ring: RingModel | None,
    dt: float,
    meniscus: MeniscusModel,
    hypotheses: Hypotheses,
) -> tuple[Floats, Floats]:
    """Process noise and initial covariance of each hypothesis, shape (m, states, states)."""
    models = [
        plant_model(puller, replace(noise, fast_sd=fast, slow_sd=slow), dt, meniscus)
        for fast in hypotheses.fast_sd
        for slow in hypotheses.slow_sd
    ]
    if ring is not None:
        models = [augmented(model, ring, dt) for model in models]
    return np.stack([model.Q for model in models]), np.stack([model.start for model in models])
