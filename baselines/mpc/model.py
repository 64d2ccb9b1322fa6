"""The nonlinear prediction of ``ekf-mpc`` as CasADi functions, built from the plant's own equations.

The functions of :mod:`cz_gym.physics.plant` take CasADi's symbols as they take numbers, so no equation is written
twice and the derivatives are CasADi's. A stage moves the plant by one control interval (RK4 steps of at most 5 s)
under

    du_k = -K (z_k - (r_ref,k, 0, ...)) + f_k + c_k,    z_k = (plant's five states, previous inputs)

with the regulator's feedback K, its known feedforward f_k and the correction c_k that is optimised; it carries the
sensitivities dz/dc along. All numbers are deviations from the operating point, in the units of
:data:`cz_gym.baselines.bounds.trajectory.SCALES`.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from cz_gym.baselines.bounds.trajectory import SCALES
from cz_gym.baselines.lqg.model import PLANT
from cz_gym.baselines.policy import Floats
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.physics.plant import Disturbance, Inputs, Puller, State, rk4

Z, U = PLANT + 2, 2
LONGEST = 5.0
"""Longest integration step [s]."""
OUTPUTS = 5
"""Outputs of a stage: radius error after it, deviations of v_p and Q_H, moves of both."""
GIVEN = 4
"""First inputs of a stage: feedforward of both moves, r_ref before and after it."""


@dataclass(frozen=True)
class Shape:
    """Size of a prediction."""

    dt: float
    """Control interval [s]."""
    stages: int
    blocks: tuple[int, ...]
    """Stages in each block of equal corrections; later stages have none."""
    meniscus: MeniscusModel
    nonlinear: bool = True

    @property
    def corrections(self) -> int:
        """Numbers optimised."""
        return U * len(self.blocks)

    @property
    def selectors(self) -> Floats:
        """Which corrections a stage adds to its moves, shape (stages, 2, corrections)."""
        chosen = np.zeros((self.stages, U, self.corrections))
        for stage, block in enumerate(np.repeat(np.arange(len(self.blocks)), self.blocks)):
            chosen[stage, :, U * block : U * block + U] = np.eye(U)
        return chosen


def casadi() -> Any:
    """CasADi; ImportError in one line names the extra that holds it."""
    try:
        import casadi
    except ImportError:
        raise ImportError("this needs the package casadi: pip install '.[mpc]'") from None
    return casadi


@lru_cache(maxsize=8)
def build(shape: Shape, slots: int) -> Any:
    """The prediction of n slots, a CasADi function ``(z, data, K, constants) -> (last, outputs, slopes)``.

    Columns run over slots, within a slot over stages. Arguments: z, shape (7, n); data, (7, n stages), what every stage
    is given, then Q_d [W], dT_i [K] and an unknown heater power; K, (2, 7 n); constants, the fields of a puller,
    (27, n). Results: last, the state and the columns of its sensitivity at the end, (7 + 7 corrections, n); outputs,
    (5, n stages); slopes, the columns of their sensitivity, (5 corrections, n stages). For the linear prediction the
    data end in what disturbs the five states, and the constants are the columns of A and B, (35, n).
    """
    ca = casadi()
    with warnings.catch_warnings():
        # CasADi 3.8 announces that NumPy's functions of its symbols may return another type one day.
        warnings.simplefilter("ignore", FutureWarning)
        stage = _stage(ca, shape)
    z, K = ca.MX.sym("z", Z), ca.MX.sym("K", U, Z)
    data = ca.MX.sym("data", stage.size1_in(1), shape.stages)
    constants = ca.MX.sym("constants", stage.size1_in(4))
    selectors = ca.DM(np.concatenate(list(shape.selectors), axis=1))
    after, outputs, slopes = stage.mapaccum("trajectory", shape.stages)(
        ca.vertcat(z, ca.MX.zeros(Z * shape.corrections)),
        data,
        selectors,
        ca.repmat(K, 1, shape.stages),
        ca.repmat(constants, 1, shape.stages),
    )
    slot = ca.Function("slot", [z, data, K, constants], [after[:, -1], outputs, slopes])
    return slot.map(slots)


def _stage(ca: Any, shape: Shape) -> Any:
    """One stage: from state and sensitivity, data, selector, feedback and constants to what follows and its outputs."""
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
    """The plant over one interval: (x, u), disturbances and constants to the new x and its derivative by (x, u)."""
    xu = ca.SX.sym("xu", Z)
    if shape.nonlinear:
        d, constants = ca.SX.sym("d", 3), ca.SX.sym("constants", len(Puller._fields))
        new = _advance(ca, shape, xu, d, Puller(*ca.vertsplit(constants)))
    else:
        d, constants = ca.SX.sym("d", PLANT), ca.SX.sym("constants", PLANT * Z)
        new = ca.reshape(constants, PLANT, Z) @ xu + d
    return ca.Function("plant", [xu, d, constants], [new, ca.jacobian(new, xu)])


def _advance(ca: Any, shape: Shape, xu: Any, d: Any, p: Puller) -> Any:
    nominal = (*p.state_0, *p.inputs_0)
    values = [n + float(scale) * value for n, scale, value in zip(nominal, SCALES, ca.vertsplit(xu), strict=True)]
    x, u = State(*values[:PLANT]), Inputs(values[PLANT], values[PLANT + 1] + d[2])
    parts = math.ceil(shape.dt / LONGEST)
    for _ in range(parts):
        x = rk4(x, u, Disturbance(d[0], d[1], 1.0), p, shape.dt / parts, shape.meniscus.slope)
    return ca.vertcat(*((value - n) / float(scale) for value, n, scale in zip(x, nominal, SCALES, strict=False)))
