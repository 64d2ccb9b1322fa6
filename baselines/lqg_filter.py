"""Parts of the LQG's filter: the Kalman update, the model of the plant, and the model of a late, rippling ring.

The update takes one scalar measurement at a time, for a batch of slots, each with its own covariance.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm
from scipy.signal import cont2discrete

from cz_gym.body.process import INPUTS, OUTPUTS, linearise
from cz_gym.episodes.scenario import Distribution, Sensor
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.plant import Puller, hidden_load
from cz_gym.support.units import MINUTE, MM

from .policy import Floats, check_numbers


def correct(
    mean: Floats, P: Floats, row: Floats, innovation: Floats, variance: Floats, gate: float
) -> tuple[Floats, Floats]:
    """The mean and the covariance after one measurement, with the gain K = P h / (h' P h + R).

    ``innovation`` is the measured less the expected value, shape (n,), ``row`` (h) the derivative of the expected value
    by the state, shape (n, states), ``variance`` (R) that of the noise, infinite where nothing was measured.
    Innovations are clipped to +-``gate`` standard deviations (Huber's limit).
    """
    Ph = (P @ row[..., None])[..., 0]
    S = expected_variance(P, row) + variance
    limit = gate * np.sqrt(S)
    with np.errstate(invalid="ignore"):
        used = np.where(np.isfinite(S), np.clip(innovation, -limit, limit), 0.0) / S
    K = Ph / S[:, None]
    return mean + Ph * used[:, None], P - K[:, :, None] * Ph[:, None, :]


def expected_variance(P: Floats, row: Floats) -> Floats:
    """Variance h' P h of the expected value of a measurement, shape (n,)."""
    variance: Floats = np.einsum("ni,ni->n", (P @ row[..., None])[..., 0], row)
    return variance


def matched_variance(
    variance: Floats,
    innovation: Floats,
    predicted: Floats,
    valid: npt.NDArray[np.bool_],
    keep: float,
    limits: tuple[float, float],
    gate: float,
) -> Floats:
    """Variance of a sensor's noise by covariance matching: a running mean of innovation^2 - h' P h (Mehra 1972).

    ``variance`` is the old value and ``keep`` its weight in the new one; ``predicted`` is h' P h. Innovations are
    clipped to +-``gate`` standard deviations, the variance to ``limits``; samples that are not ``valid`` are left out.
    """
    square = np.minimum(np.square(innovation), gate**2 * (predicted + variance))
    matched = keep * variance + (1.0 - keep) * (square - predicted)
    return np.where(valid, np.clip(matched, *limits), variance)


# The model of the plant: linearised, sampled, and augmented by disturbance states
#
# x = (r_c, h_c, T_1, T_2, T_b, fast, slow, drift, drift_rate, heater), deviations from the operating point, SI units:
# two Ornstein-Uhlenbeck fluctuations of the interface temperature [K], the hot zone's drift p [K], its rate [K/s] (a
# slow Ornstein-Uhlenbeck process, so the drift is a slowly bending ramp), and an unknown heater power [W] (a random
# walk that removes the offset between T_1 and the pyrometer). The drift also follows a share of the recipe's known
# movement.

STATES = ("r_c", "h_c", "T_1", "T_2", "T_b", "fast", "slow", "drift", "drift_rate", "heater")
"""States of the augmented plant."""
PLANT = 5
"""Number of the plant's own states, which come first."""
FAST, SLOW, DRIFT, DRIFT_RATE, HEATER = range(PLANT, len(STATES))
_T_1, _T_2 = STATES.index("T_1"), STATES.index("T_2")
_STEP = 1e-30


@dataclass(frozen=True)
class NoiseModel:
    """The Kalman filter's model of disturbances and sensors; tuned, not derived from a scenario."""

    fast_sd: float = 0.25
    """Standard deviation of the fast interface fluctuation [K]."""
    fast_tau: float = 30.0
    """Correlation time of the fast interface fluctuation [s]."""
    slow_sd: float = 0.3
    """Standard deviation of the slow interface fluctuation [K]."""
    slow_tau: float = 780.0
    """Correlation time of the slow interface fluctuation [s]."""
    drift_rate_sd: float = 0.02 / MINUTE
    """Standard deviation of the drift's rate [K/s]; the loop fails if it is too large."""
    drift_rate_tau: float = 40.0 * MINUTE
    """Correlation time of the drift's rate [s]."""
    heater_walk: float = 1.0
    """Random walk of the heater's power balance [W/sqrt(s)]."""
    thermal_walk: float = 0.004
    """Random walk of the three temperatures, for the puller's unknown conductances [K/sqrt(s)]."""
    recipe_share: float = 0.5
    """Share of the recipe's movement that the drift follows [-]."""
    camera_sd: float = 0.025 * MM
    """Initial estimate of the camera noise's standard deviation [m]."""
    camera_sd_range: tuple[float, float] = (0.005 * MM, 0.2 * MM)
    """Limits of the estimated standard deviation of the camera's noise [m]."""
    camera_memory: float = 10.0 * MINUTE
    """Averaging time of the estimated camera noise [s]; infinite for a constant one."""
    pyrometer_sd: float = 0.1
    """Standard deviation of the pyrometer's noise [K]."""
    start_radius_sd: float = 0.2 * MM
    """Standard deviation of the initial radius [m]."""
    told_power_sd: float = 0.0
    """Standard deviation of the told nominal power, and of the power's reading [W]."""
    told_temperature_sd: float = 0.0
    """Standard deviation of the told nominal temperature [K]."""

    def __post_init__(self) -> None:
        taus = ("fast_tau", "slow_tau", "drift_rate_tau", "camera_memory")
        walks = ("heater_walk", "thermal_walk", "start_radius_sd", "told_power_sd", "told_temperature_sd")
        check_numbers(self, (*taus, "camera_sd", "pyrometer_sd"), ("fast_sd", "slow_sd", "drift_rate_sd", *walks))


def expect_errors(noise: NoiseModel, crystals: Distribution, power: float) -> NoiseModel:
    """The noise model with the largest errors of told values and readings on crystals, at this nominal power [W]."""
    alike = crystals.scenarios
    powers = [math.hypot(each.told.power_sd, each.readings.scale_sd * power) for each in alike]
    return replace(
        noise, told_power_sd=max(powers), told_temperature_sd=max(each.told.temperature_sd for each in alike)
    )


class PlantModel(NamedTuple):
    """x_{k+1} = A x_k + B u_k + w_k, y_k = H x_k + v_k with u = (v_p, Q_H) and y = (r_br, T_1); SI units.

    A has shape (10, 10), B (10, 2), H (2, 10). Q is the covariance of w over one interval, ``start`` that of x at the
    start of an episode.
    """

    A: Floats
    B: Floats
    H: Floats
    Q: Floats
    start: Floats


def load_per_drift(puller: Puller) -> Any:
    """dQ_d/dp at p = 0 [W/K] for one puller or many, by complex step through :func:`hidden_load`."""
    return np.imag(hidden_load(complex(0.0, _STEP), puller)) / _STEP


def plant_model(puller: Puller, noise: NoiseModel, dt: float, meniscus: MeniscusModel = HURLE) -> PlantModel:
    """The augmented plant at the puller's operating point, with inputs held over dt [s] and exactly sampled noise."""
    F, G, H = _continuous(puller, noise, meniscus)
    W = np.zeros(len(STATES))
    W[2:PLANT] = noise.thermal_walk**2
    W[FAST] = 2.0 * noise.fast_sd**2 / noise.fast_tau
    W[SLOW] = 2.0 * noise.slow_sd**2 / noise.slow_tau
    W[DRIFT_RATE] = 2.0 * noise.drift_rate_sd**2 / noise.drift_rate_tau
    W[HEATER] = noise.heater_walk**2
    start = np.zeros(len(STATES))
    start[0] = noise.start_radius_sd
    start[[FAST, SLOW, DRIFT_RATE]] = noise.fast_sd, noise.slow_sd, noise.drift_rate_sd
    start[HEATER] = noise.told_power_sd
    A, B, *_ = cont2discrete((F, G, H, np.zeros((2, 2))), dt, method="zoh")
    warmer = noise.told_temperature_sd * _warmer(F, G)
    return PlantModel(A, B, H, sampled_noise(F, np.diag(W), dt), np.diag(start**2) + np.outer(warmer, warmer))


def _warmer(F: Floats, G: Floats) -> Floats:
    """The state of a crystal in balance whose heater is a kelvin warmer than what is told: the drift's, at any power.

    The melt is nominal. Heater and crucible stand still under the drift; a heater state makes up for the power.
    """
    x = np.zeros(len(STATES))
    x[_T_1] = x[DRIFT] = 1.0
    x[_T_2] = -F[_T_2, _T_1] / F[_T_2, _T_2]
    x[HEATER] = -(F[_T_1] @ x) / G[_T_1, 1]
    return x


def sampled_noise(F: Floats, W: Floats, dt: float) -> Floats:
    """Integral of exp(F s) W exp(F' s) over dt [s], with W the intensity of white noise (Van Loan 1978)."""
    n = len(F)
    both = expm(np.block([[-F, W], [np.zeros((n, n)), F.T]]) * dt)
    Q: Floats = both[n:, n:].T @ both[:n, n:]
    return 0.5 * (Q + Q.T)


def _continuous(puller: Puller, noise: NoiseModel, meniscus: MeniscusModel) -> tuple[Floats, Floats, Floats]:
    plant = linearise(puller, meniscus)
    column = {name: plant.B[:, INPUTS.index(name)] for name in INPUTS}
    n = len(STATES)
    F, G, H = np.zeros((n, n)), np.zeros((n, 2)), np.zeros((2, n))
    F[:PLANT, :PLANT] = plant.A
    F[:PLANT, FAST] = F[:PLANT, SLOW] = column["dT_i"]
    F[:PLANT, DRIFT] = column["Q_d"] * load_per_drift(puller)
    F[:PLANT, HEATER] = column["Q_H"]
    F[FAST, FAST], F[SLOW, SLOW] = -1.0 / noise.fast_tau, -1.0 / noise.slow_tau
    F[DRIFT, DRIFT_RATE], F[DRIFT_RATE, DRIFT_RATE] = 1.0, -1.0 / noise.drift_rate_tau
    G[:PLANT, 0], G[:PLANT, 1] = column["v_p"], column["Q_H"]
    H[0, :PLANT] = plant.C[OUTPUTS.index("r_br")]
    H[1, STATES.index("T_1")] = 1.0
    return F, G, H


# A camera with latency, and a ring that ripples with the crystal's rotation, as states of that model
#
# Latency: the rings of past samples are states. Ripple: an oscillator with a slowly wandering phase, at the rotation's
# frequency, aliased by sampling, which is found as the peak in the spectrum of the ring's residual.

RIPPLE = len(STATES)
"""Index of the first of the ripple's two states."""
RIPPLE_STATES = slice(RIPPLE, RIPPLE + 2)
"""Indices of the two ripple states."""


@dataclass(frozen=True)
class RingModel:
    """Numbers of a camera with latency or ripple, and of the search for the ripple's frequency."""

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
        """True for a ring with ripple."""
        return self.ripple_sd > 0.0

    @property
    def frequency_known(self) -> bool:
        """True for a rotation that is known, and so the ripple's frequency."""
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


MEAN_RIPPLE = 0.4
"""Standard deviation of a ripple whose amplitude is uniform from zero to A, in units of A: 1/sqrt(6), rounded."""


LEAST_RIPPLE = 1e-6
"""A ripple below it is none [m]: whole revolutions average it out."""


def ripple_left(sensor: Sensor) -> float:
    """Standard deviation of the ripple that a scenario's averaging leaves in the ring's readings [m]."""
    left = MEAN_RIPPLE * sensor.ripple[1] * abs(float(np.sinc(sensor.averaging)))
    return left if left > LEAST_RIPPLE else 0.0


def ring_of(sensor: Sensor) -> RingModel | None:
    """The model of a scenario's camera; None for one without latency and ripple."""
    ripple = ripple_left(sensor)
    return RingModel(sensor.latency, ripple, rotation=sensor.rotation) if sensor.latency or ripple else None


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
