"""Linear-quadratic-Gaussian control of pull speed and heater together: regulator, filter, their design, and bounds.

The regulator has costs on input moves, known disturbances and a previewed reference. The disturbance states, which
drive the plant and are not moved by it, enter by a Sylvester equation: in the Riccati equation an integrating
disturbance would be unstabilisable.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_are

from cz_gym.body.signals import PREVIEWS, WEIGHTS, Measured, Weights, coefficients
from cz_gym.config import Config
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.plant import Puller, hidden_load, make_puller
from cz_gym.process import scales
from cz_gym.spaces import STATE, tag
from cz_gym.support.errors import stack
from cz_gym.support.units import KILO, MM_PER_MIN

from .clairvoyant import episodes_of, pullers_of
from .lqg_estimator import Hypotheses, MultipleModelFilter, PlantFilter, multiple_model_filter
from .lqg_filter import (
    DRIFT,
    DRIFT_RATE,
    FAST,
    PLANT,
    SLOW,
    STATES,
    NoiseModel,
    PlantModel,
    RingModel,
    augmented,
    load_per_drift,
    plant_model,
)  # fmt: skip
from .policy import Floats, MeasuredController, batched, reset_rows, to_action

CHARGED_PULL = 0.36 * MM_PER_MIN
"""Deviation of the pull speed at which its quadratic term equals its weight [m/s]; the reward charges its mean, beyond
a band."""
STEP_TIME = 5.0
"""Control interval [s] of the weights on moves; at other intervals the continuous-time law stays the same."""


class Regulator(NamedTuple):
    """Moves du = -feedback (x_hat - (r_ref, 0, ...), v, q) + sum_j reference_j dr_ref_j + drift_j dp_j.

    dr_ref_j [m] and dp_j [K] are the known increments from t + j dt to t + (j + 1) dt. The least cost from
    z = (plant's five states, previous inputs) and disturbance states d on is z' P z + 2 z' X d, up to terms in d alone.
    ``feedback`` has shape (2, 12): the augmented plant's ten states, then the previous inputs; ``reference`` and
    ``drift`` have shape (samples ahead, 2), P (7, 7), X (7, 5).
    """

    feedback: Floats
    reference: Floats
    drift: Floats
    P: Floats
    X: Floats


def quadratic_cost(weights: Weights, dt: float) -> tuple[Floats, Floats, Floats]:
    """Q, N and R of the cost sum z' Q z + 2 z' N du + du' R du, z = (plant's states, previous inputs), for dt [s]."""
    Q, N = np.zeros((PLANT + 2, PLANT + 2)), np.zeros((PLANT + 2, 2))
    per_square, pull = coefficients(weights), weights.pull / CHARGED_PULL**2
    per_step = (STEP_TIME / dt) ** 2
    Q[0, 0] = per_square.radius
    Q[PLANT, PLANT] = N[PLANT, 0] = pull
    R = np.diag([pull + per_step * per_square.pull_step, per_step * per_square.heater_step])
    return Q, N, R


def regulator(model: PlantModel, weights: Weights, dt: float) -> Regulator:
    """The optimal moves for that plant and cost, with the preview of the observations.

    With P the Riccati solution, S = R + B' P B and A_c the closed loop, a known later change f_j of the state calls for
    -S^-1 B' (A_c')^j P f_j now; disturbances x_d' = A_d x_d entering by E add X = A_c' (P E + X A_d).
    """
    known = len(STATES)
    A = np.block([[model.A[:PLANT, :PLANT], model.B[:PLANT]], [np.zeros((2, PLANT)), np.eye(2)]])
    B = np.vstack([model.B[:PLANT], np.eye(2)])
    E = np.vstack([model.A[:PLANT, PLANT:known], np.zeros((2, known - PLANT))])
    A_d = model.A[PLANT:known, PLANT:known]
    Q, N, R = quadratic_cost(weights, dt)
    P = solve_discrete_are(A, B, Q, R, s=N)
    S = R + B.T @ P @ B
    K = np.linalg.solve(S, B.T @ P @ A + N.T)
    A_c = A - B @ K
    cross = np.eye(E.size) - np.kron(A_c.T, A_d.T)
    X = np.linalg.solve(cross, (A_c.T @ P @ E).ravel()).reshape(E.shape)
    K_d = np.linalg.solve(S, B.T @ (P @ E + X @ A_d))
    moves = np.linalg.solve(S, B.T)
    reference, drift = [], []
    later_reference, later_drift = P[:, 0], X[:, DRIFT - PLANT]
    for _ in range(samples_ahead(dt)):
        reference.append(moves @ later_reference)
        drift.append(-moves @ later_drift)
        later_reference, later_drift = A_c.T @ later_reference, A_c.T @ later_drift
    feedback = np.hstack([K[:, :PLANT], K_d, K[:, PLANT:]])
    return Regulator(feedback, np.array(reference), np.array(drift), P, X)


def samples_ahead(dt: float) -> int:
    """Number of samples in the preview; the nearest whole number if dt [s] does not divide it."""
    return max(1, round(PREVIEWS[-1] / dt))


def look_ahead(plan: Floats, seen: Measured, starts: npt.NDArray[np.bool_], dt: float) -> Floats:
    """The recipe ahead after one more sample.

    ``plan`` holds r_ref [m] and T_1_ref [K] (deviations) from now to the end of the preview, shape
    (n, 2, samples ahead + 1). In slots that start it is interpolated from the three previewed samples.
    """
    radius = seen.r_ref, seen.r_ref_1min, seen.r_ref_5min
    temperature = seen.T_1_ref, seen.T_1_ref_1min, seen.T_1_ref_5min
    previewed = np.stack([np.stack(radius), np.stack(temperature)]).transpose(2, 0, 1)
    moved = np.concatenate([plan[:, :, 1:], previewed[:, :, -1:]], axis=2)
    moved[:, :, 0] = previewed[:, :, 0]
    if starts.any():
        t = np.minimum(np.arange(plan.shape[2]) * dt, PREVIEWS[-1])
        shares = np.array([np.interp(t, PREVIEWS, one) for one in np.eye(len(PREVIEWS))])
        moved[starts] = (previewed[..., None] * shares).sum(axis=2)[starts]
    return moved


# The controller


@dataclass(frozen=True)
class LQGDesign:
    """Everything that is chosen about an LQG."""

    noise: NoiseModel = field(default_factory=NoiseModel)
    weights: Weights = WEIGHTS
    """Weights of the regulator's quadratic cost, whose term of the pull speed has no band."""
    lam: float = 0.5
    """Share of conduction at the design point [-]."""
    R: float = 0.0
    """Boundary layer that the filter expects under the crystal, beside the puller's own [m2 K/W]."""
    nonlinear: bool = True
    """Predicts with the plant's equations; False: with the linearised ones."""
    gate: float = 4.0
    """Limit of the innovations, in standard deviations [-]."""
    heater_slack: float = 0.06 * KILO
    """Difference between commanded and applied power [W] that is due to the resolution of the drive."""
    ring: RingModel | None = None
    """Model of a camera with latency or a ring with ripple; None for neither."""
    error_pull: float | None = None
    """Largest move of the pull speed that the radius error alone asks for [m/s]; None: any. What is left of the drive's
    window damps the meniscus height, without which narrow and slow drives swing between their limits until the crystal
    is lost (nested saturation, Teel 1992)."""

    def for_config(self, config: Config) -> "LQG":
        """The LQG of this design for the control interval and the puller of an environment."""
        return LQG(design=self).for_config(config)


MISMATCH = 1.0
"""Mean of the ring's innovations over ten minutes, in standard deviations, that no good model has; of the pyrometer's,
which may also stick or drift, twice as much [-]."""


class LQGGains(NamedTuple):
    """Filter and regulator of one puller, or of one puller a slot."""

    filter: PlantFilter
    regulator: Regulator
    """Arrays with a leading axis n for one puller a slot."""


class LQGMemory(NamedTuple):
    """The memory of an LQG."""

    filter: Any
    """State of the filter or of the filter bank."""
    plan: Floats
    """Recipe ahead, shape (n, 2, samples + 1): r_ref [m] and T_1_ref [K]."""
    command: Floats
    """Last commanded inputs [m/s, W], deviations, shape (n, 2)."""
    started: Floats
    """1 once the slot has seen a sample, shape (n,)."""


@lru_cache(maxsize=16)
def solve(design: LQGDesign, dt: float, puller: Puller, meniscus: MeniscusModel = HURLE) -> LQGGains:
    """Linearise at the puller's operating point and solve the regulator's Riccati equation."""
    model = plant_model(puller, design.noise, dt, meniscus)
    if design.ring is not None:
        model = augmented(model, design.ring, dt)
    chosen = design.nonlinear, design.gate, design.ring
    state_filter = PlantFilter(puller, model, design.noise, meniscus, dt, *chosen)
    return LQGGains(state_filter, regulator(model, design.weights, dt))


def solve_each(
    designs: Sequence[LQGDesign], dt: float, pullers: Sequence[Puller], meniscus: MeniscusModel = HURLE
) -> LQGGains:
    """The gains of one design and one puller a slot; the designs may differ in the noise that drives the plant."""
    pairs = zip(designs, pullers, strict=True)
    filters, laws = zip(*(solve.__wrapped__(each, dt, puller, meniscus) for each, puller in pairs), strict=True)
    plant = stack([each.plant for each in filters])
    return LQGGains(filters[0]._replace(puller=stack(pullers), plant=plant), stack(laws))


@dataclass(frozen=True)
class LQG(MeasuredController):
    """The LQG of the nominal puller; with ``hypotheses``, one that estimates the strength of the fluctuations."""

    accepts_missing_temperature: ClassVar[bool] = True
    observes: ClassVar[bool] = True

    design: LQGDesign = LQGDesign()
    hypotheses: Hypotheses | None = None
    """Fluctuations that a bank of filters considers possible; None for a single filter."""

    @property
    def exportable(self) -> bool:
        """True for an LQG with a single filter."""
        return self.hypotheses is None

    @cached_property
    def gains(self) -> LQGGains:
        """Gains of the design point."""
        parameters = self.parameters._replace(R=self.parameters.R + self.design.R)
        puller = make_puller(parameters, self.design.lam, self.meniscus)
        return solve(self.design, self.control_interval, puller, self.meniscus)

    def estimator(self, n: int) -> PlantFilter | MultipleModelFilter:
        """The filter, or the bank of filters, for n slots."""
        return self.gains.filter if self.hypotheses is None else _bank(self, self.hypotheses, n)

    def at_rest(self, seen: Measured) -> LQGMemory:
        """The filter at its initial covariance."""
        n = len(seen.v_p)
        plan = np.zeros((n, 2, samples_ahead(self.control_interval) + 1))
        return LQGMemory(self.estimator(n).at_rest(n), plan, np.zeros((n, 2)), np.zeros(n))

    def step(self, seen: Measured, memory: LQGMemory) -> tuple[Floats, Floats, LQGMemory]:
        """Pull speed and heater power above nominal, and the new memory."""
        starts = memory.started == 0.0
        applied = np.stack([seen.v_p, seen.Q_H], axis=-1)
        drift_moved = self.design.noise.recipe_share * (memory.plan[:, 1, 1] - memory.plan[:, 1, 0])
        state = self.estimator(len(applied)).step(memory.filter, applied, drift_moved, seen, starts)
        plan = look_ahead(memory.plan, seen, starts, self.control_interval)
        # Moves start from the applied inputs, the heater's corrected by the resolution of its drive.
        slack = np.array([0.0, self.design.heater_slack])
        previous = applied + np.where(starts[:, None], 0.0, np.clip(memory.command - applied, -slack, slack))
        inputs = self.law(state.mean, plan, previous)
        return inputs[:, 0], inputs[:, 1], LQGMemory(state, plan, inputs, np.ones(len(inputs)))

    def model_mismatch(self, memory: LQGMemory) -> Any:
        """True where the model does not explain the readings: the innovations have a mean that noise has not."""
        warmth, width = np.abs(memory.filter.surprise).T
        return np.maximum(0.5 * warmth, width) > MISMATCH

    def law(self, estimate: Floats, plan: Floats, previous: Floats) -> Floats:
        """The regulator's inputs [m/s, W], deviations within the drives' range, shape (n, 2).

        ``estimate`` has shape (n, states), ``plan`` (n, 2, samples + 1), ``previous`` (n, 2). The drift is expected to
        follow the noise model's ``recipe_share`` of the recipe's movement.
        """
        law, recipe_share = self.gains.regulator, self.design.noise.recipe_share
        error = estimate[:, : len(STATES)].copy()
        error[:, 0] -= plan[:, 0, 0]
        if self.design.error_pull is not None:
            reach = abs(self.design.error_pull * law.feedback[..., 0, len(STATES)] / law.feedback[..., 0, 0])
            error[:, 0] = np.clip(error[:, 0], -reach, reach)
        ahead = np.diff(plan, axis=-1)
        moves = -(law.feedback @ np.concatenate([error, previous], axis=-1)[..., None])[..., 0]
        moves += (ahead[:, :1] @ law.reference)[:, 0] + recipe_share * (ahead[:, 1:] @ law.drift)[:, 0]
        limit = np.array([self.v_0, self.heater_range])
        inputs: Floats = np.clip(previous + moves, -limit, limit)
        return inputs


@lru_cache(maxsize=2)
def _bank(controller: LQG, hypotheses: Hypotheses, n: int) -> MultipleModelFilter:
    return multiple_model_filter(controller.gains.filter, hypotheses, n)


# Privileged LQGs: bounds on the worth of a perfect model, and of a perfect view of the present. Their method
# ``for_episodes``, which a rollout calls, tells them of the episodes what no controller can know.

_LEAST_SD = 0.01
"""Least standard deviation of a fluctuation [K]: a filter that expects none cannot follow what its model leaves out."""
_TINY = 1e-9
"""Uncertainty of the sum of the fluctuations in Riccati's equation, as a share of its variance [-]."""


@dataclass(frozen=True)
class PrivilegedLQG(LQG):
    """The LQG with each slot's own puller as its model: a bound on the worth of the parameters.

    With ``knows_fluctuations`` its filter has the strength of each crystal's interface fluctuations too. Before
    ``for_episodes`` it is the LQG of the nominal puller.
    """

    gains_by_slot: LQGGains | None = None
    told: tuple[Floats, Floats] = (np.zeros(1), np.zeros(1))
    """Nominal power [W] and temperature [K] that controllers are told, minus the puller's own, each of shape (n,)."""
    knows_fluctuations: bool = False

    @cached_property
    def gains(self) -> LQGGains:
        """Gains of the slots' own pullers."""
        return super().gains if self.gains_by_slot is None else self.gains_by_slot

    def estimator(self, n: int) -> PlantFilter | MultipleModelFilter:
        """The filter; ValueError for another number of slots than of known pullers."""
        known = n if self.gains_by_slot is None else len(self.gains_by_slot.filter.plant.A)
        if known != n:
            raise ValueError(f"{known} pullers are known, got {n} slots: one puller a slot is needed")
        return super().estimator(n)

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> Self:
        """Return the controller that knows those episodes, one a slot."""
        drawn = episodes_of(config, seeds)
        exact = replace(self.design.noise, told_power_sd=0.0, told_temperature_sd=0.0)
        designs = [replace(self.design, noise=exact)] * len(seeds)
        if self.knows_fluctuations:
            sds = np.maximum([(each.sd_fast, each.sd_slow) for each in drawn], _LEAST_SD).tolist()
            noises = [replace(exact, fast_sd=fast, slow_sd=slow) for fast, slow in sds]
            designs = [replace(self.design, noise=noise) for noise in noises]
        solved = solve_each(designs, config.control_interval, pullers_of(config, seeds), config.meniscus)
        told = (np.array([each.told_power for each in drawn]), np.array([each.told_temperature for each in drawn]))
        return replace(self, gains_by_slot=solved, told=told)

    def step(self, seen: Measured, memory: LQGMemory) -> tuple[Floats, Floats, LQGMemory]:
        """Pull speed and heater power above what is told as nominal, and the new memory."""
        power, warmer = self.told
        own = seen._replace(Q_H=seen.Q_H + power, T_1=seen.T_1 + warmer, **{
            name: getattr(seen, name) + warmer for name in ("T_1_ref", "T_1_ref_1min", "T_1_ref_5min")
        })  # fmt: skip
        pull, heat, memory = super().step(own, memory)
        return pull, heat - power, memory


class ExactState(NamedTuple):
    """The true state in place of an estimate."""

    mean: Floats
    """State of the augmented plant, deviations in SI units, shape (n, 10)."""


class TrueStateFilter(NamedTuple):
    """A filter that sees the state and the present disturbances.

    It separates the two interface fluctuations, of which the sum is seen, by a noise-free Kalman filter.
    """

    models: PlantFilter

    def at_rest(self, n: int) -> ExactState:
        """The state before the first sample of n slots."""
        return ExactState(np.zeros((n, len(STATES))))

    def step(
        self, state: ExactState, applied: Floats, drift_moved: Floats, seen: Any, starts: npt.NDArray[np.bool_]
    ) -> ExactState:
        """The state at a sample, given the one before."""
        dt, before, mean = self.models.dt, state.mean, np.zeros(state.mean.shape)
        radius = seen.r_c_error + seen.r_ref + seen.ring_offset  # of no cost where the ring shows r_ref
        mean[:, :PLANT] = np.stack([radius, seen.h_c, seen.T_1, seen.T_2, seen.T_b], axis=-1)
        mean[:, [FAST, SLOW]] = _separated(before[:, [FAST, SLOW]], seen.dT_i, starts, self.models.noise, dt)
        mean[:, DRIFT] = _drift(seen.Q_d, self.models.puller)
        mean[:, DRIFT_RATE] = np.where(starts, 0.0, mean[:, DRIFT] - before[:, DRIFT]) / dt
        return ExactState(mean)


@dataclass(frozen=True)
class FullInformation(PrivilegedLQG):
    """The LQG's regulator on the true state and the present disturbances ("state" observations), without the future."""

    observation: ClassVar[str] = "state"

    def estimator(self, n: int) -> Any:
        """The true state of n slots."""
        super().estimator(n)
        return TrueStateFilter(self.gains.filter)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Return the action and the next memory; arguments as of :class:`cz_gym.baselines.policy.Policy`."""
        array, single = batched(observation)
        values = (array * scales(STATE, self.v_0, self.heater_range)).T
        seen: Any = SimpleNamespace(**dict(zip((channel.name for channel in STATE), values, strict=True)))
        pull, power, memory = LQG.step(self, seen, reset_rows(state, self.at_rest(seen), episode_start))
        heat = (power - self.told[0]) / self.heater_range
        return tag(to_action(pull / self.v_0, heat, single), self.made_for), memory


@lru_cache(maxsize=16)
def _separation(noise: NoiseModel, dt: float) -> tuple[Floats, Floats, Floats]:
    """Decay of the two fluctuations over dt [s], Kalman gain on their exactly seen sum, and gain at the start."""
    keep = np.array([math.exp(-dt / noise.fast_tau), math.exp(-dt / noise.slow_tau)])
    variance = np.array([noise.fast_sd, noise.slow_sd]) ** 2
    tiny = _TINY * variance.sum()
    P = solve_discrete_are(np.diag(keep), np.ones((2, 1)), np.diag((1.0 - keep**2) * variance), np.array([[tiny]]))
    return keep, P.sum(axis=1) / (P.sum() + tiny), variance / variance.sum()


def _separated(old: Floats, total: Floats, starts: npt.NDArray[np.bool_], noise: NoiseModel, dt: float) -> Floats:
    """The fast and the slow part of the fluctuation [K], shape (n, 2), from its ``total`` and the ``old`` parts."""
    keep, gain, first = _separation(noise, dt)
    predicted = old * keep
    parts: Floats = predicted + np.where(starts[:, None], first, gain) * (total - predicted.sum(axis=-1))[:, None]
    return parts


def _drift(Q_d: Floats, p: Any) -> Floats:
    """The drift [K] whose static load is Q_d [W], by Newton's method from the linearised one."""
    slope = load_per_drift(p)
    drift: Floats = Q_d / slope
    for _ in range(3):
        drift = drift - (hidden_load(drift, p) - Q_d) / slope
    return drift


def privileged(plain: LQG, knows_fluctuations: bool = True) -> PrivilegedLQG:
    """Bound: an LQG with each puller's parameters and, by default, the strength of each crystal's fluctuations."""
    known = {each.name: getattr(plain, each.name) for each in fields(plain) if each.name != "hypotheses"}
    return PrivilegedLQG(**known, knows_fluctuations=knows_fluctuations)


def full_information(design: LQGDesign, config: Config) -> FullInformation:
    """Bound: an LQG's regulator on the true state and the present disturbances."""
    exact = replace(design, noise=replace(design.noise, recipe_share=0.0), heater_slack=0.0)
    return FullInformation(design=exact).for_config(config)
