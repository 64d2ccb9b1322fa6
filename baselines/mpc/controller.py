"""Nonlinear model-predictive control: the LQG's estimator, CasADi's prediction through the plant's own equations.

Every sample the next minutes are predicted under the regulator's law and the known recipe; corrections to the law's
moves, in blocks, are optimised in one Gauss-Newton step (Diehl's real-time iteration), with the drives' limits as a
quadratic programme by CasADi where they matter. Beyond the horizon stands the law's own cost. On a linear plant without
limits no correction helps and the moves are the LQR's: what is gained is gained by limits and curvature.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.bounds.trajectory import Limits, limits_of
from cz_gym.baselines.lqg import filter_bank as bank
from cz_gym.baselines.lqg import settings as lqg_settings
from cz_gym.baselines.lqg.controller import LQG, Gains, LQGSettings, act, moved_from
from cz_gym.baselines.lqg.filter_bank import Hypotheses
from cz_gym.baselines.lqg.model import PLANT, plant_model
from cz_gym.baselines.lqg.preview import look_ahead
from cz_gym.baselines.lqg.regulator import cost_to_go, quadratic_cost
from cz_gym.baselines.policy import Floats, batched, fresh, to_action
from cz_gym.config import Config
from cz_gym.episodes.scenario import Actuators
from cz_gym.observation import HEATER_SCALE, decode
from cz_gym.physics.plant import Puller
from cz_gym.units import MINUTE

from .limits import best_corrections
from .model import SCALES, Shape, U, casadi
from .prediction import Prediction, expected_disturbances, held, predict_under_law

LIVELY = 0.8
"""Share of ``lqg``'s weights on pull and moves: what the better estimate affords at the same pull activity."""


class Objective(NamedTuple):
    """The cost in :data:`cz_gym.baselines.mpc.model.SCALES`."""

    stage: Floats
    """Weights on the squares of what a stage shows, shape (stages, 5)."""
    P: Floats
    """Cost-to-go from the end, z' P z + 2 z' X d, shape (7, 7)."""
    X: Floats
    """Shape (7, 5), by disturbance states in SI units."""


class Memory(NamedTuple):
    """What the controller remembers; the first seven as in :class:`cz_gym.baselines.lqg.filter_bank.Believed`."""

    mean: Floats
    covariance: Floats
    camera_variance: Floats
    spectrum: Floats
    omega: Floats
    samples: Floats
    evidence: Floats
    plan: Floats
    """Recipe ahead, shape (n, 2, samples + 1): r_ref [m] and T_1_ref [K]."""
    asked: Floats
    """Inputs asked for last [m/s, W], deviations, shape (n, 2)."""
    begun: Floats
    """1 once the slot has seen a sample, shape (n,)."""


@dataclass(frozen=True)
class EkfMpc:
    """Acts on "measured" (or "history") observations; knows the nominal puller and its drives. Needs CasADi."""

    lqg: LQG = field(default_factory=LQG)
    """Whose model, filter, weights and cost-to-go it uses."""
    hypotheses: Hypotheses = field(default_factory=Hypotheses)
    """What the estimator holds possible."""
    actuators: Actuators = field(default_factory=Actuators)
    """Limits of this puller's drives."""
    horizon: float = 5.0 * MINUTE
    """Length of the prediction [s]."""
    blocks: tuple[int, ...] = (1, 1, 2, 4, 8, 16)
    """Samples in each block of equal corrections."""

    def __post_init__(self) -> None:
        casadi()

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
        return limits_of(self.actuators, self.lqg.parameters.v_0, self.lqg.control_interval)

    def predict(
        self, observation: Any, state: Memory | None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Memory]:
        """The action and what to remember."""
        array, single = batched(observation)
        lqg, gains, n = self.lqg, self.lqg.gains, len(array)
        seen = decode(array, lqg.parameters.v_0)
        eye = bank.bank_eye(gains.eye, self.hypotheses, n)
        blank = bank.begin(n, self.hypotheses, eye)
        ahead = len(gains.regulator.reference)
        rest = Memory(*blank, np.zeros((n, 2, ahead + 1)), np.zeros((n, U)), np.zeros(n))
        memory = fresh(state, rest, episode_start)
        begins = memory.begun == 0.0
        applied = np.stack([seen.v_p, seen.Q_H], axis=-1)
        followed = lqg.settings.noise.recipe_share * (memory.plan[:, 1, 1] - memory.plan[:, 1, 0])
        believed = bank.predict(bank.Believed(*memory[: len(bank.Believed._fields)]), applied, followed, eye)
        if begins.any():
            believed = fresh(believed, blank, begins)
        believed = bank.correct(believed, seen, eye)
        plan = look_ahead(memory.plan, seen, begins, lqg.control_interval)
        previous = moved_from(applied, memory.asked, begins, lqg.settings.heater_slack)
        inputs = self.moves(believed.estimate, plan, previous, gains)
        action = to_action(inputs[:, 0] / lqg.parameters.v_0, inputs[:, 1] / HEATER_SCALE, single)
        return action, Memory(*believed, plan, inputs, np.ones(n))

    def moves(self, estimate: Floats, plan: Floats, previous: Floats, gains: Gains) -> Floats:
        """Inputs [m/s, W], deviations; arguments as of the LQG's ``act``, the law where prediction fails."""
        settings, shape, scale = self.lqg.settings, self.shape, SCALES[PLANT:]
        share = settings.noise.recipe_share
        disturbances = expected_disturbances(estimate, plan, gains, share, shape.stages)
        z = np.concatenate([estimate[:, :PLANT], previous], axis=1) / SCALES
        prediction = predict_under_law(z, plan, disturbances, gains, share, shape)
        cost = objective(settings, gains.eye.puller, shape)
        H, g = newton(prediction, held(plan, shape.stages)[:, -1, 0], disturbances[:, -1], cost)
        usable = np.isfinite(np.concatenate([H.reshape(len(H), -1), g], axis=1)).all(axis=1)
        corrections = np.zeros(g.shape)
        corrections[usable] = best_corrections(H[usable], g[usable], prediction.of(usable), self.blocks, self.limits)
        law = act(estimate, plan, previous, gains.regulator, share, self.lqg.parameters.v_0)
        optimal = previous + scale * (prediction.shown[:, 0, 3:] + corrections[:, :U])
        moved = np.where(usable[:, None], optimal, law)
        moved = np.clip(moved, previous - scale * self.limits.move, previous + scale * self.limits.move)
        inputs: Floats = np.clip(moved, -scale * self.limits.span, scale * self.limits.span)
        return inputs


@lru_cache(maxsize=8)
def objective(settings: LQGSettings, puller: Puller, shape: Shape) -> Objective:
    """The regulator's cost over the horizon, its cost-to-go beyond."""
    cost = quadratic_cost(settings.weights, shape.dt)
    least = cost_to_go(plant_model(puller, settings.noise, shape.dt, shape.meniscus), settings.weights, shape.dt)
    pull = cost.Q[PLANT, PLANT]
    squares = np.array([SCALES[0], *SCALES[PLANT:], *SCALES[PLANT:]]) ** 2
    stage = np.tile(squares * np.array([cost.Q[0, 0], pull, 0.0, cost.R[0, 0] - pull, cost.R[1, 1]]), (shape.stages, 1))
    stage[-1, 0] = 0.0
    return Objective(stage, least.P * np.outer(SCALES, SCALES), least.X * SCALES[:, None])


def newton(prediction: Prediction, r_ref: Floats, d: Floats, cost: Objective) -> tuple[Floats, Floats]:
    """Curvature (n, c, c) and slope (n, c) of the cost by the corrections; r_ref [m] and d at the horizon's end."""
    n, _, _, n_c = prediction.shown_c.shape
    weighted = (cost.stage[..., None] * prediction.shown_c).reshape(n, -1, n_c)
    H = weighted.swapaxes(1, 2) @ prediction.shown_c.reshape(n, -1, n_c)
    g = (weighted.swapaxes(1, 2) @ prediction.shown.reshape(n, -1, 1))[:, :, 0]
    error = prediction.last.copy()
    error[:, 0] -= r_ref / SCALES[0]
    end = prediction.last_c.swapaxes(1, 2)
    H = H + end @ cost.P @ prediction.last_c
    g = g + (end @ (error @ cost.P.T + d @ cost.X.T)[:, :, None])[:, :, 0]
    return H, g


def ekf_mpc(config: Config) -> EkfMpc:
    """``ekf-mpc`` as it ships: ``lqg`` with livelier moves, the limits of the scenario's drives."""
    lqg = lqg_settings.lqg(config)
    w = lqg.settings.weights
    weights = replace(w, pull=LIVELY * w.pull, pull_step=LIVELY * w.pull_step, heater_step=LIVELY * w.heater_step)
    return EkfMpc(replace(lqg, settings=replace(lqg.settings, weights=weights)), actuators=config.scenario.actuators)
