"""Nonlinear model-predictive control with CasADi: ``cz-gym benchmark --controller examples/mpc.py:mpc`` (extra mpc).

The state is the estimate of the LQG's Kalman filter. At every sample the plant's own equations, called with CasADi's
symbols, predict the next five minutes under the regulator's law with corrections c_k, constant in blocks of samples,

    du_k = -K (z_k - (r_ref,k, 0, ...)) - K_d d_k + c_k,    z = (r_c, h_c, T_1, T_2, T_b, v_p, Q_H),

and one Gauss-Newton step finds the corrections of least cost within the drives' limits. The cost is the regulator's
over the prediction and its cost-to-go beyond, so that on a linear plant without limits and with a constant reference
the corrections are zero. Numbers are deviations from the operating point in units of SCALE.
"""

import warnings
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from cz_gym.baselines.lqg import LQG, quadratic_cost, samples_ahead
from cz_gym.baselines.lqg_filter import DRIFT, HEATER, PLANT, STATES
from cz_gym.baselines.policy import Floats
from cz_gym.baselines.tuned_controllers import BEST_RETURN
from cz_gym.config import Config
from cz_gym.episodes.scenario import Actuators
from cz_gym.physics.plant import Disturbance, State, hidden_load, rk4
from cz_gym.process import Inputs
from cz_gym.support.units import KILO, MM, MM_PER_MIN

SCALE = np.array([MM, MM, 1.0, 1.0, 1.0, MM_PER_MIN, KILO])
"""Units of z: [m], [m], [K], [K], [K], [m/s], [W]."""
BLOCKS = (0, 1, 2, 4, 8, 16, 32)
"""Samples at which blocks of equal corrections begin; none from the last one on."""
QUIET = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False}


@dataclass(frozen=True)
class MPC(LQG):
    """Predictive controller on the LQG's filter, weights and cost-to-go."""

    actuators: Actuators = field(default_factory=Actuators)
    """Limits of the drives."""

    @cached_property
    def programme(self) -> ca.Function:
        """Quadratic programme of the corrections by z, the samples' data (7, N) and d at the end.

        Returns curvature H, slope g, and the limited drives and moves where blocks begin, with their derivatives.
        """
        law, N = self.gains.regulator, samples_ahead(self.control_interval)
        starts = [k for k in BLOCKS[:-1] if k < N]
        selector = np.array(
            [[low <= k < high for k in range(N)] for low, high in zip(starts, BLOCKS[1:], strict=False)]
        )
        c, z = ca.MX.sym("c", 2 * len(starts)), ca.MX.sym("z", PLANT + 2)
        data, d = ca.MX.sym("data", 7, N), ca.MX.sym("d", len(STATES) - PLANT)
        chosen = ca.reshape(c, 2, len(starts)) @ ca.DM(selector.astype(float))
        states, drives = self.stage.mapaccum(N)(z, ca.vertcat(chosen, data))
        Q, _, R = quadratic_cost(self.design.weights, self.control_interval)
        pull = Q[PLANT, PLANT]
        weights = np.sqrt([Q[0, 0], pull, 0.0, R[0, 0] - pull, R[1, 1]]) * SCALE[[0, 5, 6, 5, 6]]
        errors = states[0, :] - data[3, :]
        errors[N - 1] = 0.0  # that of the last sample stands in the cost-to-go
        residual = ca.vec(ca.vertcat(errors, drives) * ca.DM(weights))
        end = ca.vertcat(states[0, N - 1] - data[3, N - 1], states[1:, N - 1])
        P, X = law.P * np.outer(SCALE, SCALE), law.X * SCALE[:, None]
        slopes, last = ca.jacobian(residual, c), ca.jacobian(end, c)
        H = slopes.T @ slopes + last.T @ ca.DM(P) @ last
        g = slopes.T @ residual + last.T @ (ca.DM(P) @ end + ca.DM(X) @ d)
        limited = ca.vec(drives[:, starts])
        results = ca.substitute([H, g, limited, ca.jacobian(limited, c)], [c], [ca.MX.zeros(c.shape)])
        return ca.Function("programme", [z, data, d], results)

    @property
    def stage(self) -> ca.Function:
        """Advance one sample: from z, and correction with data, to the new z, and drives with their moves."""
        puller, law, n = self.gains.filter.puller, self.gains.regulator, PLANT + 2
        nominal = np.array([*puller.state_0, *puller.inputs_0])
        K = np.hstack([law.feedback[:, :PLANT], law.feedback[:, -2:]]) * SCALE / SCALE[PLANT:, None]
        z, given = ca.SX.sym("z", n), ca.SX.sym("given", 9)
        correction, forward, r_ref, acting = given[:2], given[2:4], given[4], given[6:]
        moves = correction + forward - ca.DM(K) @ ca.vertcat(z[0] - r_ref, z[1:])
        u = z[PLANT:] + moves
        values = ca.vertsplit(ca.DM(nominal) + ca.DM(SCALE) * ca.vertcat(z[:PLANT], u))
        x, inputs = State(*values[:PLANT]), Inputs(values[PLANT], values[PLANT + 1] + acting[2])
        with warnings.catch_warnings():
            # CasADi 3.8 announces that NumPy's functions of its symbols may return another type one day.
            warnings.simplefilter("ignore", FutureWarning)
            d = Disturbance(acting[0], acting[1], 1.0)
            x = rk4(x, inputs, d, puller, self.control_interval, self.meniscus.slope)
        after = (ca.vertcat(*x) - nominal[:PLANT]) / SCALE[:PLANT]
        return ca.Function("stage", [z, given], [ca.vertcat(after, u), ca.vertcat(u, moves)])

    def law(self, estimate: Floats, plan: Floats, previous: Floats) -> Floats:
        """Optimise the inputs [m/s, W], deviations, shape (n, 2); the LQG's where the prediction is not finite."""
        inputs, scale = super().law(estimate, plan, previous), SCALE[PLANT:]
        span = np.array([min(self.v_0, self.actuators.pull_window), self.heater_range]) / scale
        slew = np.array([self.actuators.pull_slew, self.actuators.heater_slew]) * self.control_interval / scale
        for i in range(len(estimate)):
            d, data = self.known_ahead(estimate[i], *plan[i])
            z = np.concatenate([estimate[i, :PLANT], previous[i]]) / SCALE
            H, g, free, rows = (part.full() for part in self.programme(z, data, d[-1]))
            if all(np.isfinite(part).all() for part in (H, g, free, rows)):
                moves = free[2:4, 0] + best_corrections(H, g, free, rows, np.concatenate([span, slew]))[:2]
                now = previous[i] / scale
                inputs[i] = scale * np.clip(now + np.clip(moves, -slew, slew), -span, span)
        return inputs

    def known_ahead(self, estimate: Floats, r_ref: Floats, T_1_ref: Floats) -> tuple[Floats, Floats]:
        """Disturbance states now and later, shape (N + 1, 5), and the data of each sample, shape (7, N)."""
        law, model, puller = self.gains.regulator, self.gains.filter.plant, self.gains.filter.puller
        decay = model.A[PLANT : len(STATES), PLANT : len(STATES)]
        d = np.tile(estimate[PLANT : len(STATES)], (len(r_ref), 1))
        for k, followed in enumerate(self.design.noise.recipe_share * np.diff(T_1_ref)):
            d[k + 1] = decay @ d[k]
            d[k + 1, DRIFT - PLANT] += followed
        forward = -(d[:-1] @ law.feedback[:, PLANT:-2].T) / SCALE[PLANT:]
        acting = hidden_load(d[:-1, DRIFT - PLANT], puller), d[:-1, 0] + d[:-1, 1], d[:-1, HEATER - PLANT]
        return d, np.vstack([forward.T, r_ref[:-1] / MM, r_ref[1:] / MM, *acting])


def best_corrections(H: Floats, g: Floats, free: Floats, rows: Floats, most: Floats) -> Any:
    """Minimise 1/2 c' H c + g' c within the limits of drives and moves; without limits where these cannot be kept."""
    best, most = -np.linalg.solve(H, g), np.tile(most, len(free) // len(most))[:, None]
    if (np.abs(free + rows @ best) > most).any():
        dense = {"h": ca.Sparsity.dense(*H.shape), "a": ca.Sparsity.dense(*rows.shape)}
        solver = ca.conic("solver", "qrqp", dense, QUIET)
        found = solver(h=H, g=g, a=rows, lba=-most - free, uba=most - free)
        best = found["x"].full() if solver.stats()["success"] else best
    return best[:, 0]


def mpc(config: Config) -> MPC:
    """Make the controller for an environment, with the design of ``lqg``."""
    scenario = config.sole_scenario
    return MPC(design=BEST_RETURN.settings(scenario), actuators=scenario.actuators).for_config(config)
