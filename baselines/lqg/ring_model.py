"""A camera with latency and a ring that ripples with the crystal's rotation, as states of the LQG's plant model.

Latency: the rings of past samples are states. Ripple: an oscillator with a slowly wandering phase, at the rotation's
frequency, aliased by sampling, which is found as the peak in the spectrum of the ring's residual.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats, check_numbers
from cz_gym.support.units import MINUTE, MM

from .model import STATES, PlantModel

RIPPLE = len(STATES)
"""Index of the first of the ripple's two states."""
RIPPLE_STATES = slice(RIPPLE, RIPPLE + 2)
"""Indices of the two ripple states."""


@dataclass(frozen=True)
class RingModel:
    """The numbers of such a camera, and of the search for the ripple's frequency."""

    latency: float = 0.0
    """Age of a frame when it is delivered [s]."""
    ripple_sd: float = 0.0
    """Standard deviation of the ripple [m]; 0 for no ripple."""
    ripple_tau: float = 60.0 * MINUTE
    """Correlation time of the ripple's phase and amplitude [s]."""
    rotation: tuple[float, float] = (8.0 / MINUTE, 15.0 / MINUTE)
    """Range of the crystal's rotation [rev/s]; both ends equal if it is known."""
    memory: float = 10.0 * MINUTE
    """Averaging time of the spectrum [s]."""
    lowest: float = 0.001
    """Lowest frequency of the search [Hz]; below it, ripple and radius cannot be told apart in time."""
    clear: float = 8.0
    """Least power of a peak that counts as a ripple, in multiples of the spectrum's mean [-]."""

    def __post_init__(self) -> None:
        check_numbers(self, ("ripple_tau", "memory"), ("latency", "ripple_sd"))

    @property
    def has_ripple(self) -> bool:
        """Whether there is a ripple."""
        return self.ripple_sd > 0.0

    @property
    def frequency_known(self) -> bool:
        """Whether the ripple's frequency is known."""
        return self.rotation[0] == self.rotation[1]

    @property
    def first_past(self) -> int:
        """Index of the first state that holds a past ring."""
        return RIPPLE + 2 * self.has_ripple

    def delay(self, dt: float) -> tuple[int, float]:
        """Number of past samples to keep, and the weight of the oldest in the delivered ring; the next has the rest."""
        samples = math.ceil(self.latency / dt - 1e-9)
        return samples, self.latency / dt - samples + 1.0

    def states(self, dt: float) -> int:
        """Number of states of plant, ripple and past rings."""
        return self.first_past + self.delay(dt)[0]


def augmented(model: PlantModel, ring: RingModel, dt: float) -> PlantModel:
    """The model with ripple and past rings, with the ripple at the middle of the rotation's range."""
    n, extra = len(STATES), ring.states(dt) - len(STATES)
    A, Q, start = (np.pad(matrix, (0, extra)) for matrix in (model.A, model.Q, model.start))
    B, H = np.pad(model.B, ((0, extra), (0, 0))), np.pad(model.H, ((0, 0), (0, extra)))
    undelayed = H[0].copy()
    H[0] = delivered_row(undelayed[None], ring, dt)[0]
    both = RIPPLE_STATES
    if ring.has_ripple:
        A[both, both] = oscillator(np.array([math.pi * sum(ring.rotation)]), ring, dt)[0]
        start[both, both] = ring.ripple_sd**2 * np.eye(2)
        Q[both, both] = -math.expm1(-2.0 * dt / ring.ripple_tau) * start[both, both]
    for state in range(ring.first_past, n + extra):
        A[state] = undelayed if state == ring.first_past else np.eye(n + extra)[state - 1]
    keep = np.eye(n + extra)
    keep[ring.first_past :] = undelayed
    keep[ring.first_past :, ring.first_past :] = 0.0
    return PlantModel(A, B, H, Q, keep @ start @ keep.T)


def undelayed_row(model: PlantModel, ring: RingModel, dt: float) -> Floats:
    """Derivative of the present ring by the state, shape (..., states), from an augmented model."""
    if ring.delay(dt)[0]:
        return model.A[..., ring.first_past, :]
    row = model.H[..., 0, :].copy()
    row[..., RIPPLE:] = 0.0
    return row


def oscillator(omega: Floats, ring: RingModel, dt: float) -> Floats:
    """Transition of the ripple's two states over dt [s] at frequencies omega [rad/s], shape (n, 2, 2)."""
    c, s = np.cos(omega * dt), np.sin(omega * dt)
    return math.exp(-dt / ring.ripple_tau) * np.stack([c, -s, s, c], axis=-1).reshape(*omega.shape, 2, 2)


def transition(A: Floats, row: Floats, omega: Floats, ring: RingModel, dt: float) -> Floats:
    """The model's A with the ripple frequency and the ring's slope of each slot, shape (n, states, states)."""
    n, states = row.shape
    moved = np.zeros_like(row, shape=(n, states, states))
    moved[:] = A
    if ring.has_ripple:
        moved[:, RIPPLE_STATES, RIPPLE_STATES] = oscillator(omega, ring, dt)
    if ring.first_past < states:
        moved[:, ring.first_past] = row
    return moved


def delivered_row(row: Floats, ring: RingModel, dt: float) -> Floats:
    """Derivative of the delivered ring by the state, shape (n, states), from that of the present ring."""
    samples, oldest = ring.delay(dt)
    delivered = row.copy()
    if samples:
        delivered = (1.0 - oldest) * row if samples == 1 else np.zeros_like(row)
        delivered[:, ring.first_past + samples - 1] = oldest
        if samples > 1:
            delivered[:, ring.first_past + samples - 2] = 1.0 - oldest
    if ring.has_ripple:
        delivered[:, RIPPLE] = 1.0
    return delivered


class RippleSearch(NamedTuple):
    """The memory of the search for the ripple's frequency, by slot."""

    spectrum: Floats
    """Real and imaginary parts of the running Fourier sums, shape (n, frequencies, 2)."""
    omega: Floats
    """Frequency of the ripple [rad/s], 0 before it is found, shape (n,)."""
    samples: Floats
    """Number of samples so far, shape (n,)."""


@lru_cache(maxsize=16)
def frequencies(ring: RingModel, dt: float) -> Floats:
    """Frequencies of the search [rad/s], aliased by sampling every dt [s]."""
    spacing = 0.25 / ring.memory
    if not ring.has_ripple or ring.frequency_known:
        return np.zeros(0)
    real = np.linspace(*ring.rotation, 1 + math.ceil((ring.rotation[1] - ring.rotation[0]) / spacing))
    aliased = np.abs(real - np.round(real * dt) / dt)
    return 2.0 * math.pi * np.arange(max(aliased.min(), ring.lowest), aliased.max() + spacing, spacing)


def search_at_rest(n: int, ring: RingModel | None, dt: float) -> RippleSearch:
    """The search before the first sample of n slots."""
    if ring is None:
        return RippleSearch(np.zeros((n, 0, 2)), np.zeros(n), np.zeros(n))
    omega = math.pi * sum(ring.rotation) if ring.frequency_known else 0.0
    return RippleSearch(np.zeros((n, len(frequencies(ring, dt)), 2)), np.full(n, omega), np.zeros(n))


def search_step(
    search: RippleSearch, residual: Floats, valid: npt.NDArray[np.bool_], ring: RingModel, dt: float
) -> tuple[RippleSearch, npt.NDArray[np.bool_], Floats]:
    """The search after one more ``residual`` [m] of the ring, shape (n,), which counts where ``valid``.

    Also whether this sample shows a ripple for the first time, or at another frequency, shape (n,); and the two states
    of the ripple at the spectrum's peak [m], shape (n, 2).

    Running sums Z <- (1 - 1/m) e^(i omega dt) Z + residual/m with m samples of memory, fewer at the start. A parabola
    through the log power of the peak and its neighbours refines the frequency. The ends of the spectrum, where slow
    transients appear, do not count as peaks.
    """
    omega = frequencies(ring, dt)
    samples = search.samples + 1.0
    new_share = np.maximum(1.0 / samples, dt / ring.memory)[:, None]
    Z = search.spectrum.view(np.complex128)[..., 0] * np.exp(1j * omega * dt)
    Z *= 1.0 - new_share
    Z += new_share * np.where(valid, residual, 0.0)[:, None]
    power = np.square(Z.real) + np.square(Z.imag)
    slot, peak = np.arange(len(Z)), power.argmax(axis=1)
    inside = np.clip(peak, 1, len(omega) - 2)
    clear = (power[slot, peak] > ring.clear * power.mean(axis=1)) & (inside == peak)
    left, top, right = (np.log(power[slot, inside + side] + MM**2 * 1e-12) for side in (-1, 0, 1))
    bend = 2.0 * top - left - right
    shift = np.where(bend > 0.0, 0.5 * (right - left) / np.where(bend > 0.0, bend, 1.0), 0.0)
    spacing = omega[1] - omega[0]
    refined = np.take_along_axis(omega, inside, axis=0) + spacing * np.clip(shift, -1.0, 1.0)
    new = clear & (np.abs(refined - search.omega) > 1.5 * spacing)
    ripple = 2.0 * np.stack([Z.real[slot, peak], Z.imag[slot, peak]], axis=-1)
    spectrum = Z.view(np.float64).reshape(search.spectrum.shape)
    return RippleSearch(spectrum, np.where(clear, refined, search.omega), samples), new, ripple
