"""Controllers of a whole crystal: PIDs on what the camera sees, their gains scheduled along it, and an LQG.

Where the camera shows a bright ring, they read it; in most of the crown, whose meniscus is too flat, the edge.

The ring moves with the meniscus height as well as with the radius, in the crown ten times as much as in the body. The
compensator predicts the height's deviation from the recipe from the applied pull speed and takes its share off the
ring, with both numbers scheduled on the length. Radii [m], speeds [m/s], temperatures [K], power [W].

The LQG solves its regulator for the linearisation at lengths of the recipe, as if the crystal stayed there, and
interpolates it and the filter's model between, once for each of several shares of conduction. The filter reads ring or
edge, pyrometer and load cell: a radius that is too small and a meniscus that is too high look alike in the ring, but
weigh differently. Its covariance moves on with the readings that there are. Three states are not the plant's: the
interface's slow fluctuation, the drift of the hot zone, which the given recipe follows, and the error of that recipe.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from cz_gym.crystal.process import CRYSTAL, LinearRecipe, linear_recipe
from cz_gym.crystal.signals import Measured, TrueState
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.process import Process, scales, signals
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.units import HOUR, KILO, MM, MM_PER_MIN

from .pid import HeaterMemory, PIDState, SeriesPID, TemperatureLoop
from .policy import Floats, MeasuredController, check_numbers

BLEND = 40.0 * MM
"""Length of body over which the gain changes after the crown and before the tail [m]."""


def in_cones(factor: float, L: Floats, q: Any) -> Floats:
    """A factor at a length: 1 in the body, ``factor`` in the cones; it changes within :data:`BLEND` of the body, as a
    jump would kick the pull.
    """
    ends = q.crown_length + q.body_length
    at = q.crown_length, q.crown_length + BLEND, ends - BLEND, ends
    return np.interp(L, at, (factor, 1.0, 1.0, factor))


class CrystalPIDMemory(NamedTuple):
    """The memory of :class:`CrystalPID`; each of shape (n,)."""

    height: Floats
    """Predicted deviation of the meniscus height from the recipe's [m]."""
    filtered: Floats
    """Filtered radius error [m]."""
    by_edge: Floats
    """1 if the last good frame showed the edge, 0 if the ring."""
    shift: Floats
    """Rest of the jump between the readings of ring and edge [m]."""
    share: Floats
    """Share of the edge's gain in the gain of now [-]."""
    pid: PIDState
    command: Floats
    """Last commanded pull speed above the recipe's [m/s]."""
    heat: HeaterMemory
    start: Floats
    """Pyrometer above the recipe at the first sample [K]."""


@dataclass(frozen=True)
class CrystalPID(MeasuredController):
    """v_p = recipe + K F (gain e), e the error of the edge, or of the ring less c_h(L) dh if it compensates.

    dh' = v_p - recipe - (a_h(L) + slow) dh, F = 1/(1 + T_f s); gain is 1 in the body, ``cone_gain`` on the ring in
    crown and tail, ``edge_gain`` on the edge. Where ring and edge take turns, the difference of their errors is taken
    off and dies out within ``T_turn``, as does that of their gains; while the camera shows neither, the last error
    stays.
    The integrator follows the applied pull speed within ``T_track``. The recipe's temperature is shifted to what the
    pyrometer shows at the start, as an operator does: the crystal grows there.
    """

    process: ClassVar[Process] = CRYSTAL

    pid: SeriesPID = field(default_factory=SeriesPID)
    cone_gain: float = 1.0
    """Gain of the ring's error in crown and tail [-]."""
    edge_gain: float = 1.0
    """Gain of the edge's error [-]."""
    T_turn: float = 120.0
    """Time constant with which the difference of ring and edge dies out [s]."""
    compensates: bool = True
    """True if the predicted height is taken off the ring."""
    lam: float = 0.5
    """Share of conduction in its model [-]."""
    slow: float = 2.0e-4
    """Rate with which the predicted height is forgotten [rad/s]."""
    T_f: float = 20.0
    """Time constant of the measurement filter [s]; 0 for none."""
    T_track: float = 600.0
    """Time constant with which the integrator follows a limited drive [s]."""
    heater: TemperatureLoop = field(default_factory=TemperatureLoop)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(self, positive=("T_track", "T_turn"), not_negative=("cone_gain", "edge_gain", "slow", "T_f"))

    @cached_property
    def schedule(self) -> LinearRecipe:
        """The linearisation along the recipe."""
        return linear_recipe(self.parameters, self.meniscus, self.lam)

    def at_rest(self, seen: Any) -> CrystalPIDMemory:
        """The applied pull speed and power continue."""
        zero = np.zeros_like(seen.v_p)
        pid = PIDState(zero, zero, seen.v_p / self.pid.K_p)
        by_edge = np.where(seen.edge_valid > 0.5, 1.0, 0.0)
        return CrystalPIDMemory(
            zero, zero, by_edge, zero, by_edge, pid, seen.v_p, self.heater.at_rest(seen), seen.T_1 - seen.T_1_ref
        )

    def step(self, seen: Any, memory: CrystalPIDMemory) -> tuple[Floats, Floats, CrystalPIDMemory]:
        """Pull speed and heater power above the recipe's, and the new memory."""
        dt, at = self.control_interval, self.schedule
        forgets = np.interp(seen.L, at.L, at.a_h) + self.slow
        left = np.exp(-forgets * dt)
        height = left * memory.height + (1.0 - left) / forgets * seen.v_p
        error, by_edge, shift = self._error(seen, memory, np.interp(seen.L, at.L, at.c_h) * height)
        pace = -math.expm1(-dt / self.T_f) if self.T_f > 0.0 else 1.0
        filtered = memory.filtered + pace * (error - memory.filtered)
        share = memory.share - math.expm1(-dt / self.T_turn) * (by_edge - memory.share)
        missed = (seen.v_p - memory.command) / self.pid.K_p
        tracking = memory.pid.integral + min(dt / self.T_track, 1.0) * missed
        on_ring = in_cones(self.cone_gain, seen.L, self.parameters)
        gain = on_ring + share * (self.edge_gain - on_ring)
        pull, pid = self.pid.step(gain * filtered, memory.pid._replace(integral=tracking), dt)
        shifted = seen._replace(T_1_ref=seen.T_1_ref + memory.start)
        power, heat = self.heater.step(shifted, memory.heat, dt, self.v_0, self.heater_range)
        return pull, power, CrystalPIDMemory(height, filtered, by_edge, shift, share, pid, pull, heat, memory.start)

    def _error(self, seen: Any, memory: CrystalPIDMemory, risen: Floats) -> tuple[Floats, Floats, Floats]:
        """The radius error by ring or edge [m], without a jump where they take turns; whose it is, and what is left of
        the jump. ``risen`` is what the predicted height adds to the ring [m]."""
        ring, edge = seen.valid > 0.5, seen.edge_valid > 0.5
        by_edge = np.where(ring | edge, 1.0 * edge, memory.by_edge)
        now = np.where(edge, seen.edge_error, seen.ring_error - (risen if self.compensates else 0.0))
        fades = math.exp(-self.control_interval / self.T_turn) * memory.shift
        shift = np.where(by_edge != memory.by_edge, memory.filtered - now, fades)
        return np.where(ring | edge, now + shift, memory.filtered), by_edge, shift


@dataclass(frozen=True)
class TrueRadiusPID(CrystalPID):
    """PID on the true radius, which no sensor shows: a bound."""

    observation: ClassVar[str] = "state"

    compensates: bool = False

    def read(self, array: Floats) -> Any:
        """The true state in the measured channels."""
        channels = tuple(signals(TrueState).values())
        true = TrueState(*np.moveaxis(array * scales(channels, self.v_0, self.heater_range), -1, 0))
        known = {name: getattr(true, name) for name in Measured._fields if name in TrueState._fields}
        nothing = np.zeros_like(true.L)
        return Measured(**dict.fromkeys(Measured._fields, nothing) | known)._replace(
            ring_error=true.r_c_error, valid=nothing + 1.0
        )


# The LQG, in SI units

REGULATED, STATES, DRIVES = 8, 9, 2
"""r_c, h_c, T_1, T_2, T_b, then the fluctuation, the drift and the recipe's error [K], then the crystal's mass [kg],
which is estimated and not regulated."""
_T_1, _FLUCTUATION, _DRIFT, _MASS = 2, 5, 6, 8
_PLANT, _EXOGENOUS = [0, 1, 2, 3, 4, _MASS], slice(_FLUCTUATION, _MASS)
"""The states that are the plant's, in the order of its linearisation, and those that are not."""
SIZES = np.array([MM, MM, *[1.0] * 6, 0.1, MM_PER_MIN, KILO])
"""Sizes of the states and the drives, in SI units."""
_RING, _PYROMETER, _WEIGHT, _EDGE = range(4)
SENSORS = ("ring", "pyrometer", "weight", "edge")
"""Readings in their order: ring [m], heater [K], load cell [N], edge [m]."""
START_SD = np.array([0.2 * MM, 0.2 * MM, 1.0, 1.0, 0.3, 0.3, 1.0, 1.0, 0.01])
"""Standard deviations of the states when an episode begins, in SI units."""


class CrystalNoise(NamedTuple):
    """Noise and walks that the filter expects."""

    ring: float = 0.06 * MM
    """Noise of the ring [m]."""
    edge: float = 0.3 * MM
    """Noise of the crystal's edge, its bias included [m]."""
    pyrometer: float = 0.1
    """Noise of the pyrometer [K]."""
    weight: float = 0.4
    """Noise of the load cell [N]."""
    height: float = 2.0e-7
    """Walk of the height in the body, for what the model lacks [m/sqrt(s)]."""
    cones: float = 1.0
    """Walk of the height in crown and tail, in multiples of the body's [-]."""
    temperature: float = 3.0e-3
    """Walk of each temperature [K/sqrt(s)]."""
    mass: float = 1.0e-4
    """Walk of the crystal's mass, for what the model lacks [kg/sqrt(s)]."""
    fluctuation: float = 0.4
    """Standard deviation of the interface's fluctuation [K]."""
    tau: float = 400.0
    """Correlation time of the interface's fluctuation [s]."""
    drift: float = 3.0
    """Standard deviation of the drift of the hot zone [K]."""
    recipe: float = 4.0
    """Standard deviation of the recipe's error [K]."""
    slow: float = 2.0 * HOUR
    """Correlation time of drift and recipe's error [s]."""


class CrystalWeights(NamedTuple):
    """Deviations that cost 1 in the regulator."""

    radius: float = 0.5 * MM
    height: float = 0.4 * MM
    cones: float = 1.0
    """The height's deviation in crown and tail, in multiples of the body's [-]."""
    pull: float = 0.3 * MM_PER_MIN
    pull_step: float = 0.06 * MM_PER_MIN
    power: float = 4.0 * KILO
    power_step: float = 1.0 * KILO


class CrystalGains(NamedTuple):
    """Model, filter and regulator at lengths L [m]: each of shape (lengths, rows, columns)."""

    L: Floats
    A: Floats
    B: Floats
    C: Floats
    Q: Floats
    """Covariance that the states gain in an interval."""
    F: Floats
    """From states and last drives to drives."""


@lru_cache(maxsize=12)
def design(
    parameters: Any, meniscus: MeniscusModel, dt: float, lam: float, noise: CrystalNoise, weights: CrystalWeights
) -> CrystalGains:
    """Design filter and regulator for a control interval [s]."""
    at = linear_recipe(parameters, meniscus, lam)
    walks = noise.height * in_cones(noise.cones, at.L, parameters)
    heights = weights.height * in_cones(weights.cones, at.L, parameters)
    designs = [
        _at(A, B, C, at.load, dt, noise._replace(height=float(walk)), weights._replace(height=float(height)))
        for A, B, C, walk, height in zip(at.A, at.B, at.C, walks, heights, strict=True)
    ]
    return CrystalGains(at.L, *(np.stack(each) for each in zip(*designs, strict=True)))


def _at(
    A: Floats, B: Floats, C: Floats, load: float, dt: float, noise: CrystalNoise, weights: CrystalWeights
) -> tuple[Floats, ...]:
    """A, B and C in discrete time, Q and F at one length."""
    rates = 1.0 / np.array([noise.tau, noise.slow, noise.slow])
    whole = np.zeros((STATES + DRIVES, STATES + DRIVES))
    whole[np.ix_(_PLANT, _PLANT)], whole[_PLANT, STATES:] = A, B[:, :DRIVES]
    whole[_PLANT, _FLUCTUATION], whole[_PLANT, _DRIFT] = B[:, 3], load * B[:, 2]
    whole[_EXOGENOUS, _EXOGENOUS] = -np.diag(rates)
    moved = expm(whole * dt)
    F_d, B_d = moved[:STATES, :STATES], moved[:STATES, STATES:]
    seen = np.zeros((4, STATES))
    seen[np.ix_([_RING, _WEIGHT, _EDGE], _PLANT)] = C
    seen[_PYROMETER, _T_1], seen[_PYROMETER, _DRIFT:_MASS] = 1.0, -1.0
    walks = np.array([1e-9, noise.height, *[noise.temperature] * 3, 0.0, 0.0, 0.0, noise.mass])
    sizes = np.array([noise.fluctuation, noise.drift, noise.recipe])
    Q = np.diag(walks**2 * dt)
    Q[_EXOGENOUS, _EXOGENOUS] = np.diag(sizes**2 * (1.0 - np.exp(-2.0 * rates * dt)))
    F = np.zeros((DRIVES, STATES + DRIVES))
    acts = [*range(REGULATED), *range(STATES, STATES + DRIVES)]
    F[:, acts] = _regulator(F_d[:REGULATED, :REGULATED], B_d[:REGULATED], weights)
    return F_d, B_d, seen, Q, F


def variances(noise: CrystalNoise) -> Floats:
    """Variances of ring, pyrometer, load cell and edge, in SI units."""
    return np.square([noise.ring, noise.pyrometer, noise.weight, noise.edge])


def _regulator(A: Floats, B: Floats, weights: CrystalWeights) -> Floats:
    """From states, without the mass, and last drives to drives: least mean cost of radius, drives and their steps."""
    n = REGULATED + DRIVES
    move, act, cost, cross = np.zeros((n, n)), np.zeros((n, DRIVES)), np.zeros((n, n)), np.zeros((n, DRIVES))
    move[:REGULATED, :REGULATED], act[:REGULATED], act[REGULATED:] = A, B, np.eye(DRIVES)
    cost[0, 0], cost[1, 1] = weights.radius**-2.0, weights.height**-2.0
    steps = np.diag([weights.pull_step**-2.0, weights.power_step**-2.0])
    cost[REGULATED:, REGULATED:], cross[REGULATED:] = steps, -steps
    drives = steps + np.diag([weights.pull**-2.0, weights.power**-2.0])
    sizes = np.delete(SIZES, _MASS)
    S = _solve(move, act, cost, drives, sizes, sizes[REGULATED:], cross)
    gain = np.linalg.solve(drives + act.T @ S @ act, act.T @ S @ move + cross.T)
    return np.asarray(-gain, np.float64)


def _solve(A: Floats, B: Floats, Q: Floats, R: Floats, x: Floats, u: Floats, S: Floats | None = None) -> Floats:
    """Solve the Riccati equation in numbers of order one: x and u are the sizes of states and inputs."""
    scaled = solve_discrete_are(
        A * np.outer(1.0 / x, x), B * np.outer(1.0 / x, u), Q * np.outer(x, x), R * np.outer(u, u),
        s=None if S is None else S * np.outer(x, u),
    )  # fmt: skip
    solved: Floats = scaled * np.outer(1.0 / x, 1.0 / x)
    return solved


class CrystalLQGMemory(NamedTuple):
    """The memory of :class:`CrystalLQG`."""

    x: Floats
    """Estimated states by each model, shape (n, models, 9)."""
    P: Floats
    """Covariances of their errors, shape (n, models, 9, 9)."""
    evidence: Floats
    """Logarithm of how well each model has predicted, the best one's zero, shape (n, models)."""


@dataclass(frozen=True)
class CrystalLQG(MeasuredController):
    """Filters and regulators for several shares of conduction, the drives weighted by how well each filter predicts.

    Ring and edge are read where the camera shows them; while it is blind, pyrometer and load cell are.
    """

    process: ClassVar[Process] = CRYSTAL

    models: tuple[float, ...] = (0.0, 0.1, 0.35, 0.9)
    """Shares of conduction that the controller considers possible [-]."""
    forgets: float = 2.0 * HOUR
    """Time after which a model's mistakes are forgotten [s]."""
    noise: CrystalNoise = field(default_factory=CrystalNoise)
    weights: CrystalWeights = field(default_factory=CrystalWeights)
    jump: float = 1.0 * MM
    """Largest innovation of ring and edge that counts [m]."""
    sensors: tuple[str, ...] = SENSORS
    """Readings of :data:`SENSORS` that the filter uses."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if odd := set(self.sensors) - set(SENSORS):
            raise CzError(unknown_name_message("sensor", min(odd), SENSORS))

    def at_rest(self, seen: Any) -> CrystalLQGMemory:
        """On the recipe, as far as the first sample tells; no model is better than the others."""
        x = np.zeros((len(seen.L), len(self.models), STATES))
        x[:, :, REGULATED - 1] = (seen.T_1_ref - seen.T_1)[:, None]
        P = np.broadcast_to(np.diag(START_SD**2), (*x.shape, STATES)).copy()
        return CrystalLQGMemory(x, P, np.zeros(x.shape[:2]))

    def step(self, seen: Any, memory: CrystalLQGMemory) -> tuple[Floats, Floats, CrystalLQGMemory]:
        """Pull speed and heater power above the recipe's, and the new memory."""
        u = np.stack([seen.v_p, seen.Q_H], axis=1)
        told = np.stack([seen.ring_error, seen.T_1 - seen.T_1_ref, seen.weight, seen.edge_error], axis=1)
        always = np.ones_like(seen.L)
        reads = np.stack([seen.valid > 0.5, always, always, seen.edge_valid > 0.5], axis=1)
        reads *= [name in self.sensors for name in SENSORS]
        limits = np.array([self.jump, np.inf, np.inf, self.jump])
        states, errors = np.empty_like(memory.x), np.empty_like(memory.P)
        drives = np.empty((*memory.x.shape[:2], DRIVES))
        evidence = memory.evidence * math.exp(-self.control_interval / self.forgets)
        for number, lam in enumerate(self.models):
            at = design(self.parameters, self.meniscus, self.control_interval, lam, self.noise, self.weights)
            near, share = _between(at.L, seen.L)
            A, B, C, Q, F = (_mix(each, near, share) for each in at[1:])
            P, K, S = filtered(A @ memory.P[:, number] @ A.swapaxes(1, 2) + Q, C, reads, variances(self.noise))
            x = _times(A, memory.x[:, number]) + _times(B, u)
            new = reads * np.clip(told - _times(C, x), -limits, limits)
            evidence[:, number] += 0.5 * (np.log(np.linalg.det(S)) - np.sum(new * _times(S, new), axis=1))
            states[:, number], errors[:, number] = x + _times(K, new), P
            drives[:, number] = _times(F, np.concatenate([states[:, number], u], axis=1))
        evidence -= evidence.max(axis=1, keepdims=True)
        weights = np.exp(evidence)[:, :, None]
        acts = (weights * drives).sum(axis=1) / weights.sum(axis=1)
        return acts[:, 0], acts[:, 1], CrystalLQGMemory(states, errors, evidence)


def filtered(P: Floats, C: Floats, reads: Floats, noise: Floats) -> tuple[Floats, Floats, Floats]:
    """Covariance after the readings, their gains, and the inverse of their covariance.

    What is not read has no gain, and noise alone. ``noise`` are the variances of all readings.
    """
    C = C * reads[:, :, None]
    cross = P @ C.swapaxes(1, 2)
    S: Floats = np.asarray(np.linalg.inv(C @ cross + np.diag(noise)), np.float64)
    K = cross @ S
    after = P - K @ cross.swapaxes(1, 2)
    return 0.5 * (after + after.swapaxes(1, 2)), K, S


def _between(L: Floats, at: Floats) -> tuple[Any, Floats]:
    """The design before each length, and the share of the way to the next."""
    place = np.clip((at - L[0]) / (L[1] - L[0]), 0.0, len(L) - 1.0 - 1e-9)
    near = place.astype(np.int64)
    return near, (place - near)[:, None, None]


def _mix(gains: Floats, near: Any, share: Floats) -> Floats:
    mixed: Floats = gains[near] + share * (gains[near + 1] - gains[near])
    return mixed


def _times(matrices: Floats, vectors: Floats) -> Floats:
    """A matrix a crystal times a vector a crystal."""
    product: Floats = np.einsum("nij,nj->ni", matrices, vectors)
    return product
