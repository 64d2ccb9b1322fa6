"""The clairvoyant: the lowest bound, an optimal trajectory for known parameters, state and future disturbances.

The future of an episode comes from the environment's own draws and schedules, which only bounds may read. Newton steps
by Riccati sweeps find the trajectory, interior points keep it within limits. Its inputs are applied; the optimum's own
feedback on the true state corrects what the plan does not contain: a heater that moves in steps.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.signals import beyond_band, coefficients, moved_mean, newest_share
from cz_gym.config import Config
from cz_gym.engine.batch import Key, first_key
from cz_gym.episodes.draw import Episode, episode_from_key, factors_from_key, new_series, randomised
from cz_gym.episodes.scenario import GRID, Actuators
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.physics.plant import (
    HEIGHT_MAX_IN_A,
    HEIGHT_MIN,
    Disturbance,
    Puller,
    State,
    bias_offset,
    disturbance,
    make_puller,
    reference,
    rk4,
)
from cz_gym.process import Inputs, scales
from cz_gym.spaces import STATE, TargetEnv, tag
from cz_gym.support.errors import CzError, stack
from cz_gym.support.units import KILO, MM, MM_PER_MIN

from .policy import Floats, batched, reset_rows, to_action

_EPS = 1e-9


class Future(NamedTuple):
    """n episodes, known to their end; SI units."""

    puller: Puller
    """Fields of shape (n,)."""
    start: State
    """State at t = 0, fields of shape (n,)."""
    target: Floats
    """Radius of no cost at the end of each step [m]: the reference less the ring's hidden offset, shape (steps, n)."""
    disturbances: tuple[Disturbance, ...]
    """Disturbances by substep; fields of shape (steps, n)."""
    lengths: Floats
    """Length of each substep [s], shape (substeps, steps, 1)."""
    meniscus: MeniscusModel

    def advance(self, x: State, u: Inputs, steps: slice) -> State:
        """The state at the end of those steps, each from its own start; fields are real or complex, shape (..., n)."""
        for d, dt in zip(self.disturbances, self.lengths, strict=True):
            held = Disturbance(*(value[steps] for value in d))
            x = rk4(x, u, held, self.puller, dt[steps], self.meniscus.slope)
        return x


def pullers_of(config: Config, seeds: Sequence[int]) -> tuple[Puller, ...]:
    """The pullers of the first episode of each seed."""
    pullers = []
    for key in _keys(seeds):
        factors = factors_from_key(config.sole_scenario, config.mix, key)
        pullers.append(make_puller(randomised(config.parameters, factors), factors.lam, config.meniscus))
    return tuple(pullers)


def episodes_of(config: Config, seeds: Sequence[int]) -> tuple[Episode, ...]:
    """The constants of the first episode of each seed."""
    return tuple(episode_from_key(config.sole_scenario, key, new_series(1, 0)) for key in _keys(seeds))


def future_of(config: Config, seeds: Sequence[int]) -> Future:
    """The future of the first episode of each seed."""
    puller = stack(pullers_of(config, seeds))
    point, length = substeps_of(config.control_interval, config.steps)
    points = int(point.max()) + 1
    series = [new_series(points, 0) for _ in seeds]
    drawn = [episode_from_key(config.sole_scenario, *of) for of in zip(_keys(seeds), series, strict=True)]
    e, dT_i = stack(drawn), np.stack([each.interface for each in series], axis=1)
    on_grid = disturbance(np.arange(points)[:, None] * GRID, dT_i, e, puller)
    end = np.arange(1, config.steps + 1)[:, None] * config.control_interval
    start, target = puller.state_0._replace(r_c=puller.r_0 + e.r_c_start), puller.r_0 + reference(end, e)
    held = tuple(Disturbance(*(np.asarray(value)[column] for value in on_grid)) for column in point.T)
    return Future(puller, start, target - bias_offset(end, e), held, length.T[:, :, None], config.meniscus)


def substeps_of(interval: float, steps: int) -> tuple[npt.NDArray[np.int64], Floats]:
    """Integration steps of ``steps`` control intervals [s], split at the 5 s grid as in the environment.

    The grid point whose disturbance holds, and the length [s], 0 where an interval has fewer; shape (steps, substeps).
    """
    most = int(np.ceil(interval / GRID - _EPS)) + 1
    point, length = np.zeros((steps, most), np.int64), np.zeros((steps, most))
    for k in range(steps):
        t, end, at = k * interval, (k + 1) * interval, 0
        while t < end - _EPS:
            point[k, at:] = int(t / GRID + _EPS)
            upto = min((point[k, at] + 1) * GRID, end)
            length[k, at] = upto - t
            t, at = upto, at + 1
    used = length.any(axis=0)
    return point[:, used], length[:, used]


def _keys(seeds: Sequence[int]) -> list[Key]:
    """The key of each seed's first episode; seeds may be an array."""
    return [first_key(int(seed)) for seed in seeds]


# The optimal trajectory by direct multiple shooting (docs/controllers/bounds.md)
#
# All steps are linearised at once, by complex step through the environment's own equations, and solved in a time that
# grows with their number, not its cube.

STATES, INPUTS = len(State._fields), len(Inputs._fields)
SCALES = np.array([MM, MM, 1.0, 1.0, 1.0, MM_PER_MIN, KILO])
"""Units [m, m, K, K, K, m/s, W] in which state and inputs are of the same order."""
MEAN = STATES + INPUTS
"""Place of the mean pull speed in the state of a stage, after the plant's state and the held inputs."""
TOLERANCE = 1e-7
"""Largest last move, in SCALES, of a converged optimum."""
MOST_STEPS = 200
"""Limit of the number of Newton steps; most optima need ten to twenty."""
BARRIER, BARRIER_END, BARRIER_CUT = 1e-2, 1e-9, 0.1
"""Weight of the barrier at the start and at the end, in the cost of a step, and its factor from step to step."""
BOUNDARY = 0.99
"""Largest share of the distance to a limit that one step covers [-]."""
_STEP = 1e-30


class Stages(NamedTuple):
    """The problem of a Newton step: N stages for n slots, diagonal costs.

    Minimise sum_k 1/2 z' Q z + q' z (after each stage) + 1/2 w' R w + r' w with z_{k+1} = A z_k + B w_k + c_k. A has
    shape (N, n, states, states), B (N, n, states, inputs), c, Q and q (N, n, states), R and r (N, n, inputs).
    """

    A: Floats
    B: Floats
    c: Floats
    Q: Floats
    q: Floats
    R: Floats
    r: Floats


def sweep_back(stages: Stages) -> tuple[Floats, Floats]:
    """The optimal law w_k = feedback_k z_k + forward_k, of shapes (N, n, inputs, states) and (N, n, inputs)."""
    N, n, states, inputs = stages.B.shape
    feedback, forward = np.empty((N, n, inputs, states)), np.empty((N, n, inputs))
    P, p = np.zeros((n, states, states)), np.zeros((n, states))
    diagonal, own = np.arange(states), np.arange(inputs)
    for k in range(N - 1, -1, -1):
        A, B = stages.A[k], stages.B[k]
        P[:, diagonal, diagonal] += stages.Q[k]
        p = p + stages.q[k] + _times(P, stages.c[k])
        PA, PB = P @ A, P @ B
        H = np.swapaxes(B, 1, 2) @ PB
        H[:, own, own] += stages.R[k]
        G = np.swapaxes(B, 1, 2) @ PA
        g = stages.r[k] + _times(np.swapaxes(B, 1, 2), p)
        both = -np.linalg.solve(H, np.concatenate([G, g[:, :, None]], axis=2))
        K, w = both[:, :, :-1], both[:, :, -1]
        feedback[k], forward[k] = K, w
        P = np.swapaxes(A, 1, 2) @ PA + np.swapaxes(G, 1, 2) @ K
        P = 0.5 * (P + np.swapaxes(P, 1, 2))
        p = _times(np.swapaxes(A, 1, 2), p) + _times(np.swapaxes(G, 1, 2), w)
    return feedback, forward


def sweep_forward(stages: Stages, feedback: Floats, forward: Floats) -> tuple[Floats, Floats]:
    """States after each stage, shape (N, n, states), and inputs, shape (N, n, inputs), of that law from z = 0."""
    after, inputs = np.empty(stages.c.shape), np.empty(forward.shape)
    z = np.zeros(stages.c.shape[1:])
    for k in range(len(after)):
        inputs[k] = _times(feedback[k], z) + forward[k]
        z = after[k] = _times(stages.A[k], z) + _times(stages.B[k], inputs[k]) + stages.c[k]
    return after, inputs


def _times(matrix: Floats, vector: Floats) -> Floats:
    return (matrix @ vector[..., None])[..., 0]


class Limits(NamedTuple):
    """The drives' limits, in :data:`SCALES`; each of shape (2,)."""

    span: Floats
    """Largest deviation from nominal."""
    move: Floats
    """Largest change from one step to the next; infinite where there is none."""


class Trajectory(NamedTuple):
    """The optimum of each slot, where ``converged``; SI units."""

    x: Floats
    """State at the start of each step and at the end, shape (N + 1, n, 5)."""
    u: Floats
    """Inputs v_p [m/s] and Q_H [W] of each step, shape (N, n, 2)."""
    feedback: Floats
    """Optimal moves of the inputs per deviation of state and previous inputs, shape (N, n, 2, 7)."""
    last_move: Floats
    """Largest last move of any unknown, in :data:`SCALES`, shape (n,)."""

    @property
    def converged(self) -> npt.NDArray[np.bool_]:
        """True where the search for the optimum ended, shape (n,)."""
        return self.last_move < TOLERANCE


def limits_of(actuators: Actuators, ranges: tuple[float, float], interval: float) -> Limits:
    """The limits of the action box, ``ranges`` [m/s, W], and of the drives, for a control interval [s]."""
    scale = SCALES[STATES:]
    span = np.array([min(ranges[0], actuators.pull_window), ranges[1]])
    return Limits(span / scale, np.array([actuators.pull_slew, actuators.heater_slew]) * interval / scale)


def optimise(future: Future, limits: Limits) -> Trajectory:
    """Minimise the reward's unsaturated cost over whole episodes within the drives' limits."""
    N, n = future.target.shape
    nominal = np.stack([np.broadcast_to(value, n) for value in future.puller.inputs_0], axis=-1)
    x = np.broadcast_to(np.stack(future.start, axis=-1), (N + 1, n, STATES)).copy()
    x[1:, :, 0] = future.target
    u = np.broadcast_to(nominal, (N, n, INPUTS)).copy()
    slack = _slacks(u, nominal, limits)
    force = BARRIER / slack
    barrier, moved = BARRIER, np.full(n, np.inf)
    for step in range(MOST_STEPS):
        if barrier <= BARRIER_END and moved.max() < TOLERANCE:
            break
        barrier = max(BARRIER_END, barrier * BARRIER_CUT) if step else barrier
        stages = _stages(future, x, u, nominal, slack, force, barrier)
        feedback, forward = sweep_back(stages)
        after, moves = sweep_forward(stages, feedback, forward)
        dz = after[:, :, :MEAN] * SCALES
        held = after[:, :, STATES:MEAN]
        ds = np.stack([-held, held, -moves, moves])
        df = barrier / slack - force - force / slack * ds
        fraction = np.minimum(_step_fraction(slack, ds), _height_fraction(x[1:, :, 1], dz[:, :, 1], future))
        x[1:] += fraction[:, None] * dz[:, :, :STATES]
        u += fraction[:, None] * dz[:, :, STATES:]
        slack = _slacks(u, nominal, limits)
        force = force + _step_fraction(force, df)[:, None] * df
        moved = np.abs(after).max(axis=(0, 2))
    return Trajectory(x, u, feedback[..., :MEAN] * (SCALES[STATES:, None] / SCALES), moved)


def linearised(future: Future, x: Floats, u: Floats) -> tuple[Floats, Floats]:
    """The state after each step, shape (N, n, 5), and its derivatives by state and inputs, shape (N, n, 5, 7)."""
    N, n = future.target.shape
    after, slopes = np.empty((N, n, STATES)), np.empty((N, n, STATES, STATES + INPUTS))
    point = np.concatenate([x[:-1], u], axis=-1)
    for first in range(0, N, _BLOCK):
        part = slice(first, first + _BLOCK)
        for j in range(STATES + INPUTS):
            values = [point[part, :, i] + (1j * _STEP if i == j else 0.0) for i in range(STATES + INPUTS)]
            new = np.stack(future.advance(State(*values[:STATES]), Inputs(*values[STATES:]), part), axis=-1)
            slopes[part, :, :, j] = new.imag / _STEP
        after[part] = new.real
    return after, slopes


_BLOCK = 128
"""Number of steps that are linearised together: they fit a processor's cache."""
_CURVATURE = 2.0 * np.array(coefficients()) * np.array([MM, 1.0, MM_PER_MIN, KILO]) ** 2
"""Second derivatives of the cost's terms by one unit of :data:`SCALES`, or by the relative mean pull speed."""
_MOVE_CURVATURE = _CURVATURE[2:]


def mean_pull(v_p: Floats, v_0: Floats, interval: float) -> Floats:
    """The mean pull speed after each step, relative to v_0 [-]; v_p [m/s] has shape (N, n), v_0 shape (n,)."""
    relative, mean = v_p / v_0 - 1.0, np.zeros(len(v_0))
    means = np.empty_like(relative)
    for k, now in enumerate(relative):
        mean = means[k] = moved_mean(mean, now, interval)
    return means


def _stages(
    future: Future, x: Floats, u: Floats, nominal: Floats, slack: Floats, force: Floats, barrier: float
) -> Stages:
    """The problem of a Newton step in deviations from (x, u); its states are x, the held inputs and the mean pull."""
    after, slopes = linearised(future, x, u)
    N, n = future.target.shape
    slopes = slopes * (SCALES / SCALES[:STATES, None])
    interval, v_0 = float(future.lengths[:, 0].sum()), nominal[:, 0] / SCALES[STATES]
    share = newest_share(interval)
    A = np.zeros((N, n, MEAN + 1, MEAN + 1))
    A[:, :, :STATES, :MEAN] = slopes
    A[:, :, STATES:MEAN, STATES:MEAN] = np.eye(INPUTS)
    A[:, :, MEAN, MEAN], A[:, :, MEAN, STATES] = 1.0 - share, share / v_0
    c = np.zeros((N, n, MEAN + 1))
    c[:, :, :STATES] = (after - x[1:]) / SCALES[:STATES]
    moves = np.diff(u, axis=0, prepend=nominal[None]) / SCALES[STATES:]
    upper, lower, up, down = range(4)
    curvature, slope = force / slack, barrier / slack
    Q, q = np.zeros(c.shape), np.zeros(c.shape)
    beyond = beyond_band(mean_pull(u[:, :, 0], nominal[:, 0], interval))
    Q[:, :, 0], q[:, :, 0] = _CURVATURE[0], _CURVATURE[0] * (x[1:, :, 0] - future.target) / MM
    Q[:, :, STATES:MEAN], q[:, :, STATES:MEAN] = curvature[upper] + curvature[lower], slope[upper] - slope[lower]
    Q[:, :, MEAN], q[:, :, MEAN] = _CURVATURE[1] * (beyond != 0.0), _CURVATURE[1] * beyond
    R = _MOVE_CURVATURE + curvature[up] + curvature[down]
    r = _MOVE_CURVATURE * moves + slope[up] - slope[down]
    return Stages(A, A[:, :, :, STATES:MEAN], c, Q, q, R, r)


def _slacks(u: Floats, nominal: Floats, limits: Limits) -> Floats:
    """Distances to the limits: above, below, of moves up, of moves down; shape (4, N, n, 2)."""
    held = (u - nominal) / SCALES[STATES:]
    moves = np.diff(u, axis=0, prepend=nominal[None]) / SCALES[STATES:]
    return np.stack([limits.span - held, limits.span + held, limits.move - moves, limits.move + moves])


def _step_fraction(values: Floats, changes: Floats) -> Floats:
    """Largest fraction of the changes that keeps positive values positive, at most 1, shape (n,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(changes < 0.0, -BOUNDARY * values / changes, math.inf)
    fraction: Floats = np.minimum(ratio.min(axis=(0, 1, 3)), 1.0)
    return fraction


def _height_fraction(h_c: Floats, change: Floats, future: Future) -> Floats:
    """Largest fraction that keeps the meniscus halfway from its limits, at most 1, shape (n,)."""
    with np.errstate(divide="ignore"):
        upward = (HEIGHT_MAX_IN_A * future.puller.a - h_c) / np.maximum(change, 0.0)
        downward = (h_c - HEIGHT_MIN) / np.maximum(-change, 0.0)
    fraction: Floats = np.minimum(0.5 * np.minimum(upward, downward).min(axis=0), 1.0)
    return fraction


# The controller that follows it

_CHANNELS = tuple(channel.name for channel in STATE)
_X = ("r_c_error", "h_c", "T_1", "T_2", "T_b")


class ClairvoyantMemory(NamedTuple):
    """The memory of the clairvoyant."""

    step: Floats
    """Number of steps taken, shape (n,)."""
    correction: Floats
    """Last inputs minus the planned ones [m/s, W], shape (n, 2)."""


class Clairvoyant:
    """The bound before it knows any episode; :meth:`for_episodes` finds their optimal inputs."""

    hash = ""
    """Hash of its settings, of which there are none."""

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> "OptimalInputs":
        """The optimal inputs of each seed's first episode, one a slot; CzError names the seeds that have none."""
        future = future_of(config, seeds)
        limits = limits_of(config.sole_scenario.actuators, config.ranges, config.control_interval)
        best = optimise(future, limits)
        if not best.converged.all():
            lost = ", ".join(str(seed) for seed, reached in zip(seeds, best.converged, strict=True) if not reached)
            raise CzError(
                f"clairvoyant is no bound on {config.scenario.name!r}: after {MOST_STEPS} Newton steps the optimum of "
                f"seed {lost} was not reached (last move {best.last_move.max():.1g}, at most {TOLERANCE:g} is allowed)"
            )
        p = future.puller
        state_0, inputs_0 = (np.stack(np.broadcast_arrays(*values), axis=-1) for values in (p.state_0, p.inputs_0))
        inputs_0[:, 1] += [each.told_power for each in episodes_of(config, seeds)]
        return OptimalInputs(best, state_0, inputs_0, np.array(config.ranges), config.made_for)


@dataclass(frozen=True)
class OptimalInputs:
    """The policy that applies the optimal inputs of known episodes, one a slot, on "state" observations."""

    best: Trajectory
    state_0: Floats
    """Each puller's operating point, shape (n, 5)."""
    inputs_0: Floats
    """Inputs that actions count from, shape (n, 2)."""
    ranges: Floats
    """Range of an action: pull speed [m/s] and heater power [W] that 1 stands for."""
    made_for: TargetEnv

    def predict(
        self,
        observation: Any,
        state: ClairvoyantMemory | None = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[npt.NDArray[np.float32], ClairvoyantMemory]:
        """Return the action and the next memory; arguments as of :class:`cz_gym.baselines.policy.Policy`."""
        array, single = batched(observation)
        n, best = len(array), self.best
        if n != len(self.inputs_0):
            raise CzError(f"clairvoyant has a plan for {len(self.inputs_0)} episodes, not {n}")
        memory = reset_rows(state, ClairvoyantMemory(np.zeros(n), np.zeros((n, INPUTS))), episode_start)
        k, slot = np.minimum(memory.step.astype(int), len(best.u) - 1), np.arange(n)
        seen = array * scales(STATE, *self.ranges)
        x = seen[:, [_CHANNELS.index(name) for name in _X]] + self.state_0
        x[:, 0] += seen[:, _CHANNELS.index("r_ref")]
        deviation = np.concatenate([x - best.x[k, slot], memory.correction], axis=-1)
        correction = memory.correction + (best.feedback[k, slot] @ deviation[:, :, None])[:, :, 0]
        pull, power = ((best.u[k, slot] + correction - self.inputs_0) / self.ranges).T
        return tag(to_action(pull, power, single), self.made_for), ClairvoyantMemory(memory.step + 1.0, correction)
