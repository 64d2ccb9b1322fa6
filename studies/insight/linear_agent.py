"""An agent near a point, as a linear system: the derivatives of its network and of its memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.errors import CzError
from cz_gym.observation import DRIVE_CHANNELS, MEASURED, scales
from cz_gym.physics.linearisation import Floats, StateSpace
from cz_gym.task import HEATER_RANGE, drives_of

_STEP = 1e-6


def linear_agent(
    onnx_bytes: bytes, observations: npt.ArrayLike, states: npt.ArrayLike, dt: float, action: str, v_0: float
) -> StateSpace:
    """The agent of these (checked) ONNX bytes near "measured" observations (n, channels) and states (n, width).

    Inputs are the channels of MEASURED, outputs the two drives, deviations in SI; the state is the agent's own, scaled.
    Of several points it is the mean derivative: for Gaussian ones the best linear approximation (Stein's lemma).
    ``action`` says what the outputs mean, v_0 [m/s] scales the pull speed. CzError for an agent without a memory.
    """
    n, drives = len(MEASURED), drives_of(action, dt)
    slopes = jacobian(onnx_bytes, np.asarray(observations, np.float64), np.asarray(states, np.float64))
    slopes[:2] *= np.array([[drives.pull], [drives.heater]])
    slopes[[0, 1], DRIVE_CHANNELS] += drives.keep
    slopes[:2] *= np.array([[v_0], [HEATER_RANGE]])
    slopes[:, :n] /= scales(MEASURED, v_0)
    return StateSpace(slopes[2:, n:], slopes[2:, :n], slopes[:2, n:], slopes[:2, :n])


def jacobian(onnx_bytes: bytes, observations: Floats, states: Floats) -> Floats:
    """Mean derivatives of action and next state by observation and state, (2 + width, channels + width), scaled."""
    evaluate = _in_double(onnx_bytes)
    rows = np.concatenate([observations, states], axis=1)
    steps = _STEP * np.eye(rows.shape[1])

    def outputs(points: Floats) -> Any:
        return np.concatenate(evaluate(*np.split(points, [observations.shape[1]], axis=1)), axis=1)

    slopes: Floats = np.mean([(outputs(row + steps) - outputs(row - steps)).T for row in rows], axis=0) / (2.0 * _STEP)
    return slopes


def _in_double(onnx_bytes: bytes) -> Any:
    """The graph as a function of observation and state in float64; float32 would round such small differences away."""
    import onnx
    from onnx import TensorProto, numpy_helper
    from onnx.reference import ReferenceEvaluator

    model = onnx.load_model_from_string(onnx_bytes)
    inputs = [value.name for value in model.graph.input]
    if inputs != ["observation", "state"]:
        raise CzError(
            "this study linearises agents that read an observation and a state of their own, as gradient does"
        )
    for weight in model.graph.initializer:
        if weight.data_type == TensorProto.FLOAT:
            weight.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weight).astype(np.float64), weight.name))
    for value in (*model.graph.input, *model.graph.output):
        value.type.tensor_type.elem_type = TensorProto.DOUBLE
    session: Any = ReferenceEvaluator(model)
    return lambda *rows: session.run(None, dict(zip(inputs, rows, strict=True)))
