"""What ``ekf-mpc`` expects: disturbances and recipe ahead, and the plant under the regulator's law, for many slots."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.bounds.trajectory import SCALES
from cz_gym.baselines.lqg.controller import Gains
from cz_gym.baselines.lqg.model import DRIFT, FAST, HEATER, PLANT, SLOW, STATES
from cz_gym.baselines.lqg.regulator import Regulator
from cz_gym.baselines.policy import Floats
from cz_gym.physics.plant import hidden_load

from .model import OUTPUTS, Shape, U, Z, build

_OWN = DRIFT - PLANT


class Prediction(NamedTuple):
    """What happens under the law, by slot, and how corrections change it; all in SCALES."""

    last: Floats
    """State at the end, shape (n, 7)."""
    last_c: Floats
    """Its sensitivity, shape (n, 7, corrections)."""
    outputs: Floats
    """Radius error, inputs and moves of each stage, shape (n, stages, 5)."""
    outputs_c: Floats
    """Their sensitivity, shape (n, stages, 5, corrections)."""

    def of(self, slots: npt.NDArray[np.bool_]) -> Prediction:
        """That of some slots."""
        return Prediction(*(part[slots] for part in self))


def predict_under_law(
    z: Floats, plan: Floats, disturbances: Floats, gains: Gains, share: float, shape: Shape
) -> Prediction:
    """Roll the law out from z (in the prediction's units), shape (n, 7)."""
    n, N = len(z), shape.stages
    feedback = gains.regulator.feedback
    K = np.hstack([feedback[:, :PLANT], feedback[:, -U:]]) * SCALES / SCALES[PLANT:, None]
    forward = _feedforward(plan, gains.regulator, share, N) - disturbances[:, :-1] @ feedback[:, PLANT:-U].T
    reference = held(plan, N)[:, :, 0] / SCALES[0]
    given = [forward / SCALES[PLANT:], reference[:, :-1, None], reference[:, 1:, None]]
    data = np.concatenate([*given, _acting(disturbances, gains, shape)], axis=2)
    found = build(shape, n)(
        z.T, data.reshape(n * N, -1).T, np.tile(K, (1, n)), np.tile(_constants(gains, shape), (n, 1)).T
    )
    last, outputs, outputs_c = (part.full() for part in found)
    n_c = shape.corrections
    return Prediction(
        last[:Z].T,
        last[Z:].T.reshape(n, n_c, Z).swapaxes(1, 2),
        outputs.T.reshape(n, N, OUTPUTS),
        outputs_c.T.reshape(n, N, n_c, OUTPUTS).swapaxes(2, 3),
    )


def expected_disturbances(estimate: Floats, plan: Floats, gains: Gains, share: float, stages: int) -> Floats:
    """Disturbance states from now to the end of the horizon, SI units, shape (n, stages + 1, 5)."""
    decay = gains.filter.plant.A[PLANT : len(STATES), PLANT : len(STATES)]
    d = np.empty((len(estimate), stages + 1, len(decay)))
    d[:, 0] = estimate[:, PLANT : len(STATES)]
    followed = share * np.diff(held(plan, stages)[:, :, 1], axis=1)
    for k in range(stages):
        d[:, k + 1] = d[:, k] @ decay.T
        d[:, k + 1, _OWN] += followed[:, k]
    return d


def held(plan: Floats, stages: int) -> Floats:
    """Recipe r_ref [m] and T_1_ref [K] from now to the horizon's end, its last value held, shape (n, stages + 1, 2)."""
    index = np.minimum(np.arange(stages + 1), plan.shape[2] - 1)
    return plan[:, :, index].swapaxes(1, 2)


def _feedforward(plan: Floats, law: Regulator, share: float, stages: int) -> Floats:
    """The law's moves for what is known to come, at each stage, shape (n, stages, 2)."""
    ahead = np.diff(plan, axis=-1) * np.array([1.0, share])[:, None]
    samples = ahead.shape[2]
    both = np.stack([law.reference, law.drift])
    moves = np.zeros((len(plan), stages, U))
    for k in range(min(stages, samples)):
        moves[:, k] = np.einsum("nsj,sju->nu", ahead[:, :, k:], both[:, : samples - k])
    return moves


def _acting(disturbances: Floats, gains: Gains, shape: Shape) -> Floats:
    """What disturbs each stage, as the prediction takes it."""
    d = disturbances[:, :-1]
    if not shape.nonlinear:
        pushed: Floats = d @ gains.filter.plant.A[:PLANT, PLANT : len(STATES)].T / SCALES[:PLANT]
        return pushed
    load = hidden_load(d[..., _OWN], gains.filter.puller)
    dT_i = d[..., FAST - PLANT] + d[..., SLOW - PLANT]
    return np.stack([load, dT_i, d[..., HEATER - PLANT]], axis=-1)


def _constants(gains: Gains, shape: Shape) -> Floats:
    """The constants of the prediction."""
    if shape.nonlinear:
        return np.array(gains.filter.puller)
    both = np.hstack([gains.filter.plant.A[:PLANT, :PLANT], gains.filter.plant.B[:PLANT]])
    scaled: Floats = both * SCALES / SCALES[:PLANT, None]
    return scaled.T.ravel()
