"""Nonlinear model-predictive control: a bank of the LQG's filters, and CasADi's prediction by the plant's equations.

Every sample, the next minutes are predicted under the regulator's law and the known recipe. Corrections to the law's
moves, in blocks, are optimised in one Gauss-Newton step (Diehl's real-time iteration). Where the drives' limits matter,
CasADi solves a quadratic programme. The cost beyond the horizon is the law's own cost-to-go. On a linear plant without
limits no correction helps and the moves are the LQR's: limits and curvature are all that can be gained.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace

import numpy as np

from cz_gym.baselines.bounds.trajectory import SCALES, Limits, limits_of
from cz_gym.baselines.lqg.controller import LQG, Memory, memory_at_rest, optimal_inputs
from cz_gym.baselines.lqg.filter_bank import Hypotheses
from cz_gym.baselines.lqg.model import PLANT
from cz_gym.baselines.lqg.regulator import Regulator, Weights, quadratic_cost
from cz_gym.baselines.lqg.settings import lqg as shipped_lqg
from cz_gym.baselines.policy import Floats, MeasuredController
from cz_gym.config import Config
from cz_gym.episodes.scenario import Actuators
from cz_gym.observation import Measured
from cz_gym.units import MINUTE

from .limits import best_corrections
from .model import Shape, U, casadi
from .prediction import Prediction, expected_disturbances, held, predict_under_law

WEIGHT_FACTOR = 0.8
"""On ``lqg``'s weights on pull and moves: the better estimate allows it at the same pull activity."""


@dataclass(frozen=True)
class EkfMpc(MeasuredController):
    """Acts on "measured" (or "history") observations; knows the nominal puller and its drives. Needs CasADi."""

    lqg: LQG = field(default_factory=LQG)
    """Whose model, filter, weights and cost-to-go it uses."""
    hypotheses: Hypotheses = field(default_factory=Hypotheses)
    """What the filter bank holds possible."""
    actuators: Actuators = field(default_factory=Actuators)
    """Limits of this puller's drives."""
    horizon: float = 5.0 * MINUTE
    """Length of the prediction [s]."""
    blocks: tuple[int, ...] = (1, 1, 2, 4, 8, 16)
    """Samples in each block of equal corrections."""

    def __post_init__(self) -> None:
        casadi()

    @property
    def control_interval(self) -> float:
        """Time between actions [s]."""
        return self.lqg.control_interval

    @property
    def v_0(self) -> float:
        """Nominal pull speed [m/s]."""
        return self.lqg.v_0

    @property
    def hash(self) -> str:
        """Hash of its settings (16 hex digits)."""
        lqg = (self.lqg.settings.hash, self.lqg.control_interval, self.lqg.parameters, self.lqg.meniscus.name)
        settings = (lqg, self.hypotheses, self.actuators, self.horizon, self.blocks)
        return hashlib.sha256(repr(settings).encode()).hexdigest()[:16]

    @property
    def shape(self) -> Shape:
        """Size of the prediction."""
        dt = self.lqg.control_interval
        stages = max(round(self.horizon / dt), sum(self.blocks))
        return Shape(dt, stages, self.blocks, self.lqg.meniscus, self.lqg.settings.nonlinear)

    @property
    def limits(self) -> Limits:
        """The drives' limits, in the prediction's units."""
        return limits_of(self.actuators, self.v_0, self.lqg.control_interval)

    def at_rest(self, seen: Measured) -> Memory:
        """The filters at their initial covariance."""
        n = len(seen.v_p)
        return memory_at_rest(n, self.lqg.bank(self.hypotheses, n), self.lqg.control_interval)

    def step(self, seen: Measured, memory: Memory) -> tuple[Floats, Floats, Memory]:
        """Pull speed and heater power above nominal, and the new memory."""
        return self.lqg.step_with(self.lqg.bank(self.hypotheses, len(seen.v_p)), self.optimal_inputs, seen, memory)

    def optimal_inputs(self, estimate: Floats, plan: Floats, previous: Floats) -> Floats:
        """Inputs [m/s, W], deviations, shape (n, 2); the LQG's own where the prediction fails.

        Arguments are as of :func:`cz_gym.baselines.lqg.controller.optimal_inputs`.
        """
        gains, settings, shape, scale = self.lqg.gains, self.lqg.settings, self.shape, SCALES[PLANT:]
        share = settings.noise.recipe_share
        disturbances = expected_disturbances(estimate, plan, gains, share, shape.stages)
        z = np.concatenate([estimate[:, :PLANT], previous], axis=1) / SCALES
        prediction = predict_under_law(z, plan, disturbances, gains, share, shape)
        last = held(plan, shape.stages)[:, -1, 0], disturbances[:, -1]
        H, g = newton(prediction, *last, gains.regulator, settings.weights, shape)
        usable = np.isfinite(np.concatenate([H.reshape(len(H), -1), g], axis=1)).all(axis=1)
        corrections = np.zeros(g.shape)
        corrections[usable] = best_corrections(H[usable], g[usable], prediction.of(usable), self.blocks, self.limits)
        law = optimal_inputs(estimate, plan, previous, gains.regulator, share, self.v_0)
        optimal = previous + scale * (prediction.outputs[:, 0, 3:] + corrections[:, :U])
        moved = np.where(usable[:, None], optimal, law)
        moved = np.clip(moved, previous - scale * self.limits.move, previous + scale * self.limits.move)
        return np.clip(moved, -scale * self.limits.span, scale * self.limits.span)


def newton(
    prediction: Prediction, r_ref: Floats, d: Floats, law: Regulator, weights: Weights, shape: Shape
) -> tuple[Floats, Floats]:
    """Curvature (n, c, c) and slope (n, c) of the cost by the corrections.

    The cost is the regulator's over the horizon and its cost-to-go, z' P z + 2 z' X d, beyond. ``r_ref`` [m], shape
    (n,), and the disturbance states ``d``, shape (n, 5), are those at the horizon's end.
    """
    n, N, _, n_c = prediction.outputs_c.shape
    cost = quadratic_cost(weights, shape.dt)
    pull = cost.Q[PLANT, PLANT]
    squares = np.array([SCALES[0], *SCALES[PLANT:], *SCALES[PLANT:]]) ** 2
    stage = np.tile(squares * np.array([cost.Q[0, 0], pull, 0.0, cost.R[0, 0] - pull, cost.R[1, 1]]), (N, 1))
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


def ekf_mpc(config: Config) -> EkfMpc:
    """``ekf-mpc`` as it ships: ``lqg`` with smaller weights on moves, the limits of the scenario's drives."""
    lqg, f = shipped_lqg("lqg", config), WEIGHT_FACTOR
    w = lqg.settings.weights
    weights = replace(w, pull=f * w.pull, pull_step=f * w.pull_step, heater_step=f * w.heater_step)
    return EkfMpc(replace(lqg, settings=replace(lqg.settings, weights=weights)), actuators=config.scenario.actuators)
