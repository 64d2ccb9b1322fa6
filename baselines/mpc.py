"""Nonlinear model-predictive control: a bank of the LQG's filters, and CasADi's prediction by the plant's equations.

At every sample the next minutes are predicted under the regulator's law with corrections c_k, constant in blocks,

    du_k = -K (z_k - (r_ref,k, 0, ...)) + f_k + c_k,    z_k = (plant's five states, previous inputs),

and one Gauss-Newton step finds the best corrections (docs/controllers/mpc.md). On a linear plant without limits they
are zero. The prediction's numbers are deviations from the operating point in the units of
:data:`cz_gym.baselines.bounds.trajectory.SCALES`.
"""

import hashlib
import math
import warnings
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.bounds.trajectory import SCALES, Limits, limits_of
from cz_gym.baselines.lqg.controller import LQG, Gains, LQGDesign
from cz_gym.baselines.lqg.model import DRIFT, FAST, HEATER, PLANT, SLOW, STATES
from cz_gym.baselines.lqg.multiple_model import Hypotheses
from cz_gym.baselines.lqg.regulator import Regulator, quadratic_cost
from cz_gym.baselines.policy import Floats
from cz_gym.body.cost import Weights
from cz_gym.body.plant import Disturbance, Inputs, Puller, State, hidden_load, rk4
from cz_gym.config import Config
from cz_gym.episodes.scenario import Actuators
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.support.units import MINUTE

WEIGHT_FACTOR = 0.8
"""Factor on the weights of ``lqg`` on pull and moves: the better estimate allows it at the same pull activity."""
LONGEST = 5.0
"""Longest integration step of the prediction [s]."""
SOLVER = "qrqp"
"""CasADi's own active-set solver of quadratic programmes."""
U, Z = 2, PLANT + 2
"""Numbers of inputs and of predicted states z."""
OUTPUTS = 5
"""Number of outputs of a stage: radius error after it, deviations of v_p and Q_H, moves of both."""
GIVEN = 4
"""Number of known inputs of a stage: feedforward of both moves, r_ref before and after it."""


class Shape(NamedTuple):
    """Size and model of a prediction."""

    dt: float
    """Control interval [s]."""
    stages: int
    blocks: tuple[int, ...]
    """Number of stages in each block of equal corrections; later stages have none."""
    meniscus: MeniscusModel
    nonlinear: bool

    @property
    def corrections(self) -> int:
        """Number of optimised corrections."""
        return U * len(self.blocks)


class Prediction(NamedTuple):
    """The prediction under the law by slot, with sensitivities to the corrections along a further, last axis.

    ``last`` is the state z at the end, shape (n, 7), ``outputs`` each stage's radius error, inputs and moves, shape
    (n, stages, 5).
    """

    last: Floats
    last_c: Floats
    outputs: Floats
    outputs_c: Floats

    def of(self, slots: npt.NDArray[np.bool_]) -> Self:
        """The prediction of some slots."""
        return type(self)(*(part[slots] for part in self))


@dataclass(frozen=True)
class EkfMpc(LQG):
    """The predictive controller on the LQG's filters, model, weights and cost-to-go; needs CasADi."""

    hypotheses: Hypotheses | None = field(default_factory=Hypotheses)
    actuators: Actuators = field(default_factory=Actuators)
    """Limits of this puller's drives."""
    horizon: float = 5.0 * MINUTE
    """Length of the prediction [s]."""
    blocks: tuple[int, ...] = (1, 1, 2, 4, 8, 16)
    """Number of samples in each block of equal corrections."""

    def __post_init__(self) -> None:
        super().__post_init__()
        casadi()

    @property
    def exportable(self) -> bool:
        """False: it solves an optimisation problem in each step."""
        return False

    @property
    def hash(self) -> str:
        """Hash of its settings (16 hex digits)."""
        plant = self.control_interval, self.parameters, self.meniscus.name
        chosen = self.design, plant, self.hypotheses, self.actuators, self.horizon, self.blocks
        return hashlib.sha256(repr(chosen).encode()).hexdigest()[:16]

    @property
    def shape(self) -> Shape:
        """Size and model of the prediction."""
        stages = max(round(self.horizon / self.control_interval), sum(self.blocks))
        return Shape(self.control_interval, stages, self.blocks, self.meniscus, self.design.nonlinear)

    @property
    def limits(self) -> Limits:
        """The drives' limits, in the prediction's units."""
        return limits_of(self.actuators, (self.v_0, self.heater_range), self.control_interval)

    def law(self, estimate: Floats, plan: Floats, previous: Floats) -> Floats:
        """The best inputs, as :meth:`LQG.law` returns them, whose own stand in slots where the prediction fails."""
        gains, shape, scale = self.gains, self.shape, SCALES[PLANT:]
        share = self.design.noise.recipe_share
        disturbances = expected_disturbances(estimate, plan, gains, share, shape.stages)
        z = np.concatenate([estimate[:, :PLANT], previous], axis=1) / SCALES
        prediction = predict_under_law(z, plan, disturbances, gains, share, shape)
        last = held(plan, shape.stages)[:, -1, 0], disturbances[:, -1]
        H, g = newton(prediction, *last, gains.regulator, self.design.weights, shape.dt)
        usable = np.isfinite(np.concatenate([H.reshape(len(H), -1), g], axis=1)).all(axis=1)
        corrections = np.zeros(g.shape)
        corrections[usable] = best_corrections(H[usable], g[usable], prediction.of(usable), self.blocks, self.limits)
        optimal = previous + scale * (prediction.outputs[:, 0, 3:] + corrections[:, :U])
        moved = np.where(usable[:, None], optimal, super().law(estimate, plan, previous))
        moved = np.clip(moved, previous - scale * self.limits.move, previous + scale * self.limits.move)
        return np.clip(moved, -scale * self.limits.span, scale * self.limits.span)


def ekf_mpc(design: LQGDesign, config: Config) -> EkfMpc:
    """``ekf-mpc`` as it ships: that design with smaller weights on moves, and the limits of the scenario's drives."""
    radius, *others = design.weights
    weights = Weights(radius, *(WEIGHT_FACTOR * weight for weight in others))
    return EkfMpc(design=replace(design, weights=weights), actuators=config.sole_scenario.actuators).for_config(config)


def expected_disturbances(estimate: Floats, plan: Floats, gains: Gains, share: float, stages: int) -> Floats:
    """Disturbance states from now to the end of the horizon, SI units, shape (n, stages + 1, 5)."""
    decay = gains.filter.plant.A[PLANT : len(STATES), PLANT : len(STATES)]
    d = np.empty((len(estimate), stages + 1, len(decay)))
    d[:, 0] = estimate[:, PLANT : len(STATES)]
    followed = share * np.diff(held(plan, stages)[:, :, 1], axis=1)
    for k in range(stages):
        d[:, k + 1] = d[:, k] @ decay.T
        d[:, k + 1, DRIFT - PLANT] += followed[:, k]
    return d


def held(plan: Floats, stages: int) -> Floats:
    """Recipe r_ref [m] and T_1_ref [K] from now to the horizon's end, its last value held, shape (n, stages + 1, 2)."""
    index = np.minimum(np.arange(stages + 1), plan.shape[2] - 1)
    return plan[:, :, index].swapaxes(1, 2)


def predict_under_law(
    z: Floats, plan: Floats, disturbances: Floats, gains: Gains, share: float, shape: Shape
) -> Prediction:
    """The prediction from z, shape (n, 7), under the law."""
    n, N, n_c = len(z), shape.stages, shape.corrections
    feedback = gains.regulator.feedback
    K = np.hstack([feedback[:, :PLANT], feedback[:, -U:]]) * SCALES / SCALES[PLANT:, None]
    forward = _feedforward(plan, gains.regulator, share, N) - disturbances[:, :-1] @ feedback[:, PLANT:-U].T
    reference = held(plan, N)[:, :, 0] / SCALES[0]
    acting, constants = _model_data(disturbances[:, :-1], gains, shape.nonlinear)
    given = [forward / SCALES[PLANT:], reference[:, :-1, None], reference[:, 1:, None], acting]
    data = np.concatenate(given, axis=2).reshape(n * N, -1)
    results = build(shape, n)(z.T, data.T, np.tile(K, (1, n)), np.tile(constants, (n, 1)).T)
    last, outputs, outputs_c = (part.full() for part in results)
    return Prediction(
        last[:Z].T,
        last[Z:].T.reshape(n, n_c, Z).swapaxes(1, 2),
        outputs.T.reshape(n, N, OUTPUTS),
        outputs_c.T.reshape(n, N, n_c, OUTPUTS).swapaxes(2, 3),
    )


def _feedforward(plan: Floats, law: Regulator, share: float, stages: int) -> Floats:
    """The law's moves for the recipe ahead, at each stage, shape (n, stages, 2)."""
    ahead = np.diff(plan, axis=-1) * np.array([1.0, share])[:, None]
    samples = ahead.shape[2]
    both = np.stack([law.reference, law.drift])
    moves = np.zeros((len(plan), stages, U))
    for k in range(min(stages, samples)):
        moves[:, k] = np.einsum("nsj,sju->nu", ahead[:, :, k:], both[:, : samples - k])
    return moves


def _model_data(d: Floats, gains: Gains, nonlinear: bool) -> tuple[Floats, Floats]:
    """The disturbance of each stage and the constants, as :func:`build`'s function takes them."""
    models = gains.filter
    if nonlinear:
        load = hidden_load(d[..., DRIFT - PLANT], models.puller)
        dT_i = d[..., FAST - PLANT] + d[..., SLOW - PLANT]
        return np.stack([load, dT_i, d[..., HEATER - PLANT]], axis=-1), np.array(models.puller)
    A, B = models.plant.A, models.plant.B
    AB = np.hstack([A[:PLANT, :PLANT], B[:PLANT]]) * SCALES / SCALES[:PLANT, None]
    return d @ A[:PLANT, PLANT : len(STATES)].T / SCALES[:PLANT], AB.T.ravel()


def newton(
    prediction: Prediction, r_ref: Floats, d: Floats, law: Regulator, weights: Weights, dt: float
) -> tuple[Floats, Floats]:
    """Curvature (n, c, c) and slope (n, c) of the cost by the corrections.

    The cost is the regulator's over the horizon and its cost-to-go, z' P z + 2 z' X d, beyond. ``r_ref`` [m], shape
    (n,), and the disturbance states ``d``, shape (n, 5), are those at the horizon's end.
    """
    n, N, _, n_c = prediction.outputs_c.shape
    Q, _, R = quadratic_cost(weights, dt)
    pull = Q[PLANT, PLANT]
    squares = np.array([SCALES[0], *SCALES[PLANT:], *SCALES[PLANT:]]) ** 2
    stage = np.tile(squares * np.array([Q[0, 0], pull, 0.0, R[0, 0] - pull, R[1, 1]]), (N, 1))
    stage[-1, 0] = 0.0
    weighted = (stage[..., None] * prediction.outputs_c).reshape(n, -1, n_c)
    H = weighted.swapaxes(1, 2) @ prediction.outputs_c.reshape(n, -1, n_c)
    g = (weighted.swapaxes(1, 2) @ prediction.outputs.reshape(n, -1, 1))[:, :, 0]
    error = prediction.last.copy()
    error[:, 0] -= r_ref / SCALES[0]
    end = prediction.last_c.swapaxes(1, 2)
    P, X = law.P * np.outer(SCALES, SCALES), law.X * SCALES[:, None]
    H = H + end @ P @ prediction.last_c
    g = g + (end @ (error @ P.T + d @ X.T)[:, :, None])[:, :, 0]
    return H, g


def best_corrections(H: Floats, g: Floats, prediction: Prediction, blocks: tuple[int, ...], limits: Limits) -> Floats:
    """Minimise 1/2 c' H c + g' c for each slot, inputs and moves within limits where a block begins; shape (n, c).

    Only slots that reach a limit need the programme. Where not all limits can be kept at once (within a block the law's
    own moves are not limited), those of the first move are kept. Where these cannot be kept either, as when a drive
    starts beyond its limits, the step without limits stands, to be clipped.
    """
    corrections = np.array(-np.linalg.solve(H, g[:, :, None])[:, :, 0], np.float64)
    at = np.cumsum((0, *blocks[:-1]))
    n, n_c = g.shape
    rows = prediction.outputs_c[:, at, 1:].reshape(n, 2 * U * len(at), n_c)
    free = prediction.outputs[:, at, 1:].reshape(n, 2 * U * len(at))
    most = np.tile(np.concatenate([limits.span, limits.move]), len(at))
    reached = free + (rows @ corrections[:, :, None])[:, :, 0]
    for i in np.flatnonzero((np.abs(reached) > most).any(axis=1)):
        for kept in (len(most), 2 * U):
            solver = _solver(n_c, kept)
            solution = solver(
                h=H[i], g=g[i], a=rows[i, :kept], lba=-most[:kept] - free[i, :kept], uba=most[:kept] - free[i, :kept]
            )
            if solver.stats()["success"]:
                corrections[i] = solution["x"].full().ravel()
                break
    return corrections


def casadi() -> Any:
    """The module casadi; ModuleNotFoundError in one line names the extra that contains it."""
    try:
        import casadi
    except ModuleNotFoundError as error:
        said = "this needs the package casadi: pip install '.[mpc]'"
        raise ModuleNotFoundError(said, name=error.name) from None
    return casadi


@lru_cache(maxsize=4)
def _solver(corrections: int, limited: int) -> Any:
    """CasADi's quadratic programme of that many corrections and limits."""
    ca = casadi()
    dense = {"h": ca.Sparsity.dense(corrections, corrections), "a": ca.Sparsity.dense(limited, corrections)}
    quiet = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False}
    return ca.conic("programme", SOLVER, dense, quiet)


@lru_cache(maxsize=8)
def build(shape: Shape, slots: int) -> Any:
    """The prediction of n slots, a CasADi function ``(z, data, K, constants) -> (last, outputs, slopes)``.

    Columns run over slots, within a slot over stages. Arguments: z, shape (7, n); data, (GIVEN + 3, n stages): the
    known inputs of each stage, then Q_d [W], dT_i [K] and an unknown heater power; K, (2, 7 n); constants, the
    fields of a puller, (27, n). Results: last, the state and the columns of its sensitivity at the end,
    (7 + 7 corrections, n); outputs, (5, n stages); slopes, the columns of their sensitivity, (5 corrections, n stages).
    For the linear prediction the disturbances are those of the five states, and the constants the columns of A and B.
    """
    ca = casadi()
    with warnings.catch_warnings():
        # CasADi 3.8 announces that NumPy's functions of its symbols may return another type one day.
        warnings.simplefilter("ignore", FutureWarning)
        stage = _stage(ca, shape)
    z, K = ca.MX.sym("z", Z), ca.MX.sym("K", U, Z)
    data = ca.MX.sym("data", stage.size1_in(1), shape.stages)
    constants = ca.MX.sym("constants", stage.size1_in(4))
    selectors = np.zeros((U, shape.stages, shape.corrections))
    for k, block in enumerate(np.repeat(np.arange(len(shape.blocks)), shape.blocks)):
        selectors[:, k, U * block : U * block + U] = np.eye(U)
    after, outputs, slopes = stage.mapaccum("trajectory", shape.stages)(
        ca.vertcat(z, ca.MX.zeros(Z * shape.corrections)),
        data,
        ca.DM(selectors.reshape(U, -1)),
        ca.repmat(K, 1, shape.stages),
        ca.repmat(constants, 1, shape.stages),
    )
    slot = ca.Function("slot", [z, data, K, constants], [after[:, -1], outputs, slopes])
    return slot.map(slots)


def _stage(ca: Any, shape: Shape) -> Any:
    """One stage: from state with sensitivity, data, selector, feedback and constants to the next state and outputs."""
    n_c, plant = shape.corrections, _plant(ca, shape)
    start, chosen = ca.SX.sym("start", Z * (1 + n_c)), ca.SX.sym("chosen", U, n_c)
    data = ca.SX.sym("data", GIVEN + plant.numel_in(1))
    K, constants = ca.SX.sym("K", U, Z), ca.SX.sym("constants", plant.numel_in(2))
    z, S = start[:Z], ca.reshape(start[Z:], Z, n_c)
    error = ca.vertcat(z[0] - data[2], z[1:])
    moves, moves_c = data[:2] - K @ error, chosen - K @ S
    u, u_c = z[PLANT:] + moves, S[PLANT:, :] + moves_c
    x, slope = plant(ca.vertcat(z[:PLANT], u), data[GIVEN:], constants)
    x_c = slope @ ca.vertcat(S[:PLANT, :], u_c)
    after = ca.vertcat(x, u, ca.vec(ca.vertcat(x_c, u_c)))
    outputs = ca.vertcat(x[0] - data[3], u, moves)
    outputs_c = ca.vertcat(x_c[0, :], u_c, moves_c)
    return ca.Function("stage", [start, data, chosen, K, constants], [after, outputs, ca.vec(outputs_c)])


def _plant(ca: Any, shape: Shape) -> Any:
    """The plant over one interval: from (x, u), disturbances and constants to the new x and its derivative."""
    xu = ca.SX.sym("xu", Z)
    if shape.nonlinear:
        d, constants = ca.SX.sym("d", 3), ca.SX.sym("constants", len(Puller._fields))
        new = _advance(ca, shape, xu, d, Puller(*ca.vertsplit(constants)))
    else:
        d, constants = ca.SX.sym("d", PLANT), ca.SX.sym("constants", PLANT * Z)
        new = ca.reshape(constants, PLANT, Z) @ xu + d
    return ca.Function("plant", [xu, d, constants], [new, ca.jacobian(new, xu)])


def _advance(ca: Any, shape: Shape, xu: Any, d: Any, p: Puller) -> Any:
    """The plant's equations over one interval, by RK4 steps of at most LONGEST."""
    nominal = (*p.state_0, *p.inputs_0)
    values = [n + float(scale) * value for n, scale, value in zip(nominal, SCALES, ca.vertsplit(xu), strict=True)]
    x, u = State(*values[:PLANT]), Inputs(values[PLANT], values[PLANT + 1] + d[2])
    parts = math.ceil(shape.dt / LONGEST)
    for _ in range(parts):
        x = rk4(x, u, Disturbance(d[0], d[1], 1.0), p, shape.dt / parts, shape.meniscus.slope)
    return ca.vertcat(*((value - n) / float(scale) for value, n, scale in zip(x, nominal, SCALES, strict=False)))
