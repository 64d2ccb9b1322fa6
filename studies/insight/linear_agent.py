"""An agent near a point: the exact derivative of its network, and what that makes of the past as a linear system.

An agent on "history" is a static function of channels that are themselves linear in the past: near a point its whole
behaviour is one matrix of derivatives.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.errors import CzError
from cz_gym.observation import (
    DRIVE_CHANNELS,
    HEATER_SCALE,
    HISTORY,
    LAGGED,
    LAGS,
    MEASURED,
    PULL_SCALE,
    lags,
    scales,
    undo_differences,
)
from cz_gym.physics.linearisation import Floats, StateSpace
from cz_gym.task import drives_of

SEEN = ("ring_error", "T_1", "v_p", "Q_H")
"""Readings through which the plant reaches an agent: ring [m], pyrometer [K], applied drives [m/s, W]."""
_STEP = 1e-6
AT = [[channel.name for channel in MEASURED].index(name) for name in SEEN]
"""Where they stand among the channels of MEASURED."""


def linear_agent(
    onnx_bytes: bytes, observations: npt.ArrayLike, dt: float, action: str, v_0: float = PULL_SCALE
) -> StateSpace:
    """The agent of these (checked) ONNX bytes near "history" observations; v_0 [m/s] scales the pull speed.

    ``action`` says what its outputs mean; the drives asked for follow from them and from those applied.

    Of several observations, shape (n, channels), it is the mean derivative: for Gaussian ones the best linear
    approximation there is (Stein's lemma). Inputs are the channels of MEASURED, outputs the two drives, deviations in
    SI; the states are past samples of the remembered channels, newest first, channel by channel, then the integral.
    ValueError if the file reads another observation or remembers something.
    """
    rows = np.atleast_2d(np.asarray(observations, np.float64))
    if rows.shape[1] != len(HISTORY):
        raise CzError(f'an agent without a state is linear here only on "history" ({len(HISTORY)} channels)')
    slopes = _asked(jacobian(onnx_bytes, rows), dt, action, v_0) / scales(HISTORY, v_0)
    slopes = slopes @ np.linalg.inv(undo_differences()).T
    now, integral, means = np.split(slopes, (len(MEASURED), len(MEASURED) + 1), axis=1)
    lagged, (newest, oldest) = means.reshape(2, len(LAGS), len(LAGGED)), lags(dt)
    depth = int(oldest[-1])
    n = depth * len(LAGGED) + 1
    A, B, C = np.zeros((n, n)), np.zeros((n, len(MEASURED))), np.zeros((2, n))
    for channel, name in enumerate(LAGGED):
        first = channel * depth
        A[first + 1 : first + depth, first : first + depth - 1] = np.eye(depth - 1)
        B[first, AT[SEEN.index(name)]] = 1.0
        for lag, (new, old) in enumerate(zip(newest, oldest, strict=True)):
            C[:, first + new - 1 : first + old] += lagged[:, lag, channel, None] / (old - new + 1)
    A[-1, -1], B[-1, AT[0]], C[:, -1] = 1.0, dt, integral[:, 0]
    now[:, AT[0]] += integral[:, 0] * dt
    return StateSpace(A, B, C, now)


def remembering_agent(
    onnx_bytes: bytes,
    observations: npt.ArrayLike,
    states: npt.ArrayLike,
    dt: float,
    action: str,
    v_0: float = PULL_SCALE,
) -> StateSpace:
    """An agent that remembers, near "measured" observations, shape (n, channels), and its own states there.

    Inputs are the channels of MEASURED, outputs the two drives, deviations in SI; the state is the agent's own, scaled.
    ValueError if the file reads another observation.
    """
    seen, n = np.asarray(observations, np.float64), len(MEASURED)
    if seen.shape[1] != n:
        raise CzError(f'an agent that remembers is linear here only on "measured" ({n} channels)')
    found = jacobian(onnx_bytes, seen, np.asarray(states, np.float64))
    asked = _asked(found[:2], dt, action, v_0)
    found[2:, :n] /= scales(MEASURED, v_0)
    asked[:, :n] /= scales(MEASURED, v_0)
    return StateSpace(found[2:, n:], found[2:, :n], asked[:, n:], asked[:, :n])


def _asked(slopes: Floats, dt: float, action: str, v_0: float) -> Floats:
    """Derivatives of the drives asked for [m/s, W] from those of the action; both by scaled channels."""
    drives = drives_of(action, dt)
    slopes = slopes * np.array([[drives.pull], [drives.heater]])
    slopes[[0, 1], DRIVE_CHANNELS] += drives.keep
    return np.array([[v_0], [HEATER_SCALE]]) * slopes


def jacobian(onnx_bytes: bytes, observations: Floats, states: Floats | None = None) -> Floats:
    """Mean derivatives of the action, and of the next state, by the observation and by the state if there is one.

    Of observations, shape (n, channels), and states, (n, width): shape (2 + width, channels + width), all scaled.
    """
    evaluate = _in_double(onnx_bytes, ("observation",) if states is None else ("observation", "state"))
    rows = observations if states is None else np.concatenate([observations, states], axis=1)
    ends = [] if states is None else [observations.shape[1]]
    steps = _STEP * np.eye(rows.shape[1])

    def answers(points: Floats) -> Any:
        return np.concatenate(evaluate(*np.split(points, ends, axis=1)), axis=1)

    found: Floats = np.mean([(answers(row + steps) - answers(row - steps)).T for row in rows], axis=0) / (2.0 * _STEP)
    return found


def _in_double(onnx_bytes: bytes, inputs: tuple[str, ...]) -> Any:
    """The graph as a function of its inputs in float64: float32 would round such small differences away."""
    import onnx
    from onnx import TensorProto, numpy_helper
    from onnx.reference import ReferenceEvaluator

    model = onnx.load_model_from_string(onnx_bytes)
    if tuple(value.name for value in model.graph.input) != inputs:
        raise CzError(f"the agent must read {' and '.join(inputs)}, and nothing else")
    for weight in model.graph.initializer:
        if weight.data_type == TensorProto.FLOAT:
            weight.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weight).astype(np.float64), weight.name))
    for value in (*model.graph.input, *model.graph.output):
        value.type.tensor_type.elem_type = TensorProto.DOUBLE
    session: Any = ReferenceEvaluator(model)
    return lambda *rows: session.run(None, dict(zip(inputs, rows, strict=True)))
