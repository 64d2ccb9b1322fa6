"""Sampled loops, linearised from the code that runs: a controller's ``predict`` and the plant.

The state space of a controller comes from its own ``predict``, called with one unit of each memory entry and of each
observation channel; its memory must be a NamedTuple of arrays. So the margins are those of the shipped code. Timing is
that of the environment: measure at t_k, act at once; the v_p and Q_H observed at t_k were applied before.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import bisect
from scipy.signal import cont2discrete

from cz_gym.action import HEATER_RANGE
from cz_gym.baselines.policy import Floats, State
from cz_gym.body.linearisation import OUTPUTS, STATES, linearise
from cz_gym.body.plant import Puller, make_puller
from cz_gym.errors import CzError
from cz_gym.observation import MEASURED, PULL_SCALE, Measured, scales
from cz_gym.physics.linearisation import StateSpace
from cz_gym.physics.parameters import Parameters
from cz_gym.support.nested import leaves, map_arrays

_SMALL = 1e-6
"""Observed amplitude below every limit, gate and dead zone [-]; float32 actions keep their relative precision."""
_SEEN = ("ring_error", "T_1", "v_p", "Q_H")
"""Channels through which the plant reaches the controller."""
_AT_REST = np.array([float(channel.name == "valid") for channel in MEASURED])
"""Observation at rest: zeros and a valid camera."""
_DISTURBED = ("v_p", "Q_H", "camera")
"""Inputs of a loop."""
HOT_ZONE = {name: name for name in ("C_1", "C_2", "C_b", "kappa_12", "G_1a", "G_2b")} | {"kappa_b": "eps"}
"""Constants of a puller that follow from estimates, and the parameter that each is proportional to."""
_NOMINAL = Parameters()
WIDEST = 4.0
"""Largest factor on a parameter for which a loop's stability is asked; the smallest is its inverse [-]."""
_ANSWERS = ("v_p", "Q_H", "r_br")
"""Outputs of a loop: both commands and the ring."""


class NotLinearError(CzError):
    """A controller that has no state space near rest."""


class Loop(NamedTuple):
    """Plant and controller together, z(k+1) = A z + B w, y = C z + D w, with w of _DISTURBED and y of _ANSWERS."""

    A: Floats
    B: Floats
    C: Floats
    D: Floats
    dt: float
    """Control interval [s]."""

    @property
    def stable(self) -> bool:
        """Whether every pole lies inside the unit circle."""
        return float(np.abs(np.linalg.eigvals(self.A)).max()) < 1.0

    def pick(self, output: str, inputs: tuple[str, ...]) -> StateSpace:
        """The system from some inputs to one output."""
        row, columns = _ANSWERS.index(output), [_DISTURBED.index(name) for name in inputs]
        return StateSpace(self.A, self.B[:, columns], self.C[[row]], self.D[np.ix_([row], columns)])


def linear_controller(
    policy: Any,
    ranges: tuple[float, float] = (PULL_SCALE, HEATER_RANGE),
    rest: Any = None,
    free: Sequence[str] | None = None,
) -> StateSpace:
    """The controller in discrete time: inputs the channels of Measured, outputs v_p - v_0 [m/s] and Q_H - Q_H0 [W].

    ``ranges`` [m/s, W] is what an action of 1 moves the drives by. ``rest`` is its memory at rest, by default that
    after one sample of zeros. ``free`` names the parts of it that move ("memory.filter.mean"), by default all but the
    last readings; the others, such as a covariance, keep their value.
    Raises NotLinearError if the controller does not rest there, or if twice the input does not double the answer.
    """
    channels, name = len(MEASURED), type(policy).__name__
    rest = policy.predict(_AT_REST[None])[1] if rest is None else rest
    rest = () if rest is None else rest
    if not isinstance(rest, tuple):
        raise NotLinearError(f"{name} has a memory that is no named tuple of arrays, so it has no state space here")
    parts = _parts(rest)
    if free is None:
        free = [part for part in parts if not (isinstance(rest, State) and part.startswith("readings."))]
    memory = sum(parts[part].size for part in free)
    probes = np.eye(memory + channels) * _SMALL
    still, once, twice = (_answer(policy, factor * probes, rest, free) for factor in (0.0, 1.0, 2.0))
    once, twice = once - still, twice - still
    largest = np.abs(once).max(axis=0)
    if np.any(np.abs(still) > 1e-3 * _SMALL):
        raise NotLinearError(f"{name} does not rest at zero")
    if np.any(np.abs(twice - 2.0 * once) > 1e-4 * largest):
        raise NotLinearError(f"{name} is not linear near rest")
    gains = once.T / _SMALL
    gains[:, memory:] /= scales(MEASURED, *ranges)
    gains[memory:] *= np.array(ranges)[:, None]
    (A, B), (C, D) = (np.split(rows, [memory], axis=1) for rows in np.split(gains, [memory]))
    return StateSpace(A, B, C, D)


def _parts(memory: Any) -> dict[str, Floats]:
    """The arrays of a memory's first slot, by their names in the nested tuple."""
    return {name: np.asarray(part, np.float64)[:1] for name, part in leaves(memory, ".").items()}


def _answer(policy: Any, probes: Floats, rest: Any, free: Sequence[str]) -> Floats:
    """The next free memory and the action for rows of (free memory, observation), both relative to rest."""
    n, start, parts = len(probes), 0, {}
    for name, value in _parts(rest).items():
        parts[name] = np.repeat(value, n, axis=0)
        if name in free:
            parts[name] += probes[:, start : start + value.size].reshape(n, *value.shape[1:])
            start += value.size
    values = iter(parts.values())
    action, after = policy.predict(_AT_REST + probes[:, start:], state=map_arrays(lambda _: next(values), rest))
    moved = map_arrays(lambda new, old: np.reshape(new - old[:1], (1, n, -1)), rest if after is None else after, rest)
    return np.hstack([*(part[0] for name, part in _parts(moved).items() if name in free), action])


def sampled_plant(puller: Puller, dt: float) -> StateSpace:
    """The plant with held inputs v_p, Q_H and outputs r_br, T_1; deviations in SI units."""
    A, B, C, _ = linearise(puller)
    C = np.stack([C[OUTPUTS.index("r_br")], np.eye(len(STATES))[STATES.index("T_1")]])
    A_d, B_d, *_ = cont2discrete((A, B[:, :2], C, np.zeros((2, 2))), dt, method="zoh")
    return StateSpace(A_d, B_d, C, np.zeros((2, 2)))


def close(controller: StateSpace, puller: Puller, dt: float, broken: str = "") -> Loop:
    """The loop of controller and plant.

    Inputs: v_p (added to the command), Q_H (heat that the controller does not see), camera noise; references held.
    Outputs: v_p and Q_H (the commands), r_br. ``broken="camera"`` opens the loop at the camera: the controller reads
    only the input ``camera``. ``broken="v_p"`` opens it at the pull speed: plant and controller see only the input
    ``v_p``. ``broken="Q_H"`` opens it between heater and hot zone: the plant gets only the input ``Q_H``, and the
    controller sees its command applied. The state is (plant, last applied v_p and Q_H, controller).
    """
    plant, n, inputs = sampled_plant(puller, dt), len(STATES), len(_DISTURBED)
    at = [Measured._fields.index(name) for name in _SEEN]
    seen = np.zeros((len(_SEEN), n + 2))
    seen[0, :n], seen[1, :n] = plant.C[0] * (broken != "camera"), plant.C[1]
    seen[2, n], seen[3, n + 1] = 1.0, 1.0
    noise = np.zeros((len(_SEEN), inputs))
    noise[0, _DISTURBED.index("camera")] = 1.0
    B, D = controller.B[:, at], controller.D[:, at]
    command, direct = np.hstack([D @ seen, controller.C]), D @ noise
    pulls, heats = float(broken != "v_p"), float(broken != "Q_H")
    apply = np.vstack([plant.B @ np.diag([pulls, heats]), np.diag([pulls, 1.0])])
    own, disturbed = np.zeros((n + 2, n + 2)), np.zeros((n + 2, inputs))
    own[:n, :n], disturbed[:n, :2], disturbed[n, 0] = plant.A, plant.B, 1.0
    moved = np.hstack([own, np.zeros((n + 2, len(controller.A)))]) + apply @ command
    ring = np.hstack([plant.C[:1], np.zeros((1, command.shape[1] - n))])
    own, disturbed = np.vstack([moved, np.hstack([B @ seen, controller.A])]), disturbed + apply @ direct
    direct = np.vstack([direct, np.zeros((1, inputs))])
    return Loop(own, np.vstack([disturbed, B @ noise]), np.vstack([command, ring]), direct, dt)


def stable_range(
    controller: StateSpace, dt: float, parameter: str, lam: float, nominal: Parameters = _NOMINAL
) -> tuple[float, float]:
    """Range of a factor on that parameter, at most 1/WIDEST to WIDEST, in which the loop is stable; NaN if not at 1."""

    def stable(factor: float) -> bool:
        puller = make_puller(nominal._replace(**{parameter: factor * getattr(nominal, parameter)}), lam)
        return close(controller, puller, dt).stable

    def end(farthest: float) -> float:
        for inside, outside in pairwise(np.geomspace(1.0, farthest, 16)):
            if not stable(outside):
                edge = bisect(lambda factor: float(stable(factor)) - 0.5, inside, outside, rtol=1e-3)
                return float(edge)
        return farthest

    return (end(1.0 / WIDEST), end(WIDEST)) if stable(1.0) else (math.nan, math.nan)
