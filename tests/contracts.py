"""Graphs of agents and the facts of their contracts, for tests that write agents of their own."""

from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from cz_gym.agents.contract import facts_of
from cz_gym.config import make_config

LINEAR = helper.make_node("Gemm", ["observation", "weight", "bias"], ["action"])


def value(name: str, *shape: Any) -> Any:
    """An input or output of a graph."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def graph_of(nodes: list[Any], weights: dict[str, Any], channels: int, **changes: Any) -> Any:
    """A graph from an observation of ``channels`` numbers to an action, unless ``inputs`` or ``outputs`` are given."""
    inputs = changes.get("inputs", [value("observation", "n", channels)])
    outputs = changes.get("outputs", [value("action", "n", 2)])
    tensors = [numpy_helper.from_array(np.asarray(array), name) for name, array in weights.items()]
    return helper.make_graph(nodes, "graph", inputs, outputs, tensors)


def model_of(nodes: list[Any], weights: dict[str, Any], channels: int, **changes: Any) -> Any:
    """The same as an ONNX model."""
    opsets = [helper.make_opsetid("", changes.get("opset", 17))]
    return helper.make_model(graph_of(nodes, weights, channels, **changes), opset_imports=opsets, ir_version=9)


def facts(observation: str = "history", **changes: Any) -> dict[str, Any]:
    """Arguments of :func:`cz_gym.agents.contract.make_contract` for an agent trained on "randomized"."""
    config = make_config(observation=observation)
    known = {
        **facts_of(config),
        "algorithm": "ppo",
        "learned_from": "reward",
        "training_seed": 0,
        "training_steps": 64,
        "validation_cost": 0.1,
        "validation_rmse_mm": 1.0,
    }
    return {**known, **changes}
