"""From a trained network to an ONNX file: normalisation, layers, action head and clipping in one graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from cz_gym.observation import HISTORY

from .network import DRIVES, NORMALISED_LIMIT, Normalise

Floats = npt.NDArray[np.float32]
OPSET, IR_VERSION = 17, 9


@dataclass(frozen=True)
class Actor:
    """An actor as arrays: action = clip(skip * drives + scale * squash(layers(x) + direct(x))).

    x is the normalised observation, (observation - mean) @ scaling within +-10.
    """

    mean: Floats
    scaling: Floats
    direct: tuple[Floats, Floats] | None
    """Weight (out, in) and bias (out,) of the linear path."""
    layers: tuple[tuple[Floats, Floats], ...]
    """Weight (out, in) and bias (out,) of each layer; the activation follows all but the last."""
    activation: str
    """ONNX operator: Tanh or Relu."""
    squash: bool
    """Whether a tanh follows the last layer."""
    skip: float
    scale: Floats


def _linear(module: torch.nn.Linear) -> tuple[Floats, Floats]:
    return module.weight.detach().numpy().copy(), module.bias.detach().numpy().copy()


def actor_of(learner: Any) -> Actor:
    """The deterministic actor of a PPO or SAC learner made by :mod:`agents.training`."""
    policy = learner.policy
    if hasattr(policy, "mlp_extractor"):
        normalise: Normalise = policy.features_extractor
        head = policy.action_net
        torso, last, activation, squash = policy.mlp_extractor.actor, head.linear, "Tanh", False
        direct = _linear(policy.mlp_extractor.direct)
        skip, scale = head.skip, head.scale.numpy().copy()
    else:
        normalise = policy.actor.features_extractor
        torso, last, activation, squash = policy.actor.latent_pi, policy.actor.mu, "Relu", True
        direct = None
        skip, scale = learner.env.skip, learner.env.scale.astype(np.float32)
    visible = min(len(normalise.mean), len(HISTORY))
    layers = [_linear(module) for module in torso if isinstance(module, torch.nn.Linear)]
    first_weight, first_bias = layers[0]
    layers[0] = first_weight[:, :visible].copy(), first_bias
    seen = normalise.seen[:visible, None] * normalise.scaling[:visible, :visible]
    mean, scaling = normalise.mean.numpy()[:visible].copy(), seen.numpy()
    return Actor(mean, scaling, direct, (*layers, _linear(last)), activation, squash, skip, scale)


def to_onnx(actor: Actor) -> bytes:
    """The actor as a serialised ONNX model: observation (n, channels) to action (n, 2), float32."""
    nodes: list[Any] = []
    constants: list[Any] = []

    def constant(name: str, value: npt.ArrayLike) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def node(operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(operator, inputs, [output], **attributes))
        return output

    channels = len(actor.mean)
    x = node("Sub", ["observation", constant("mean", actor.mean)], "centred")
    x = node("MatMul", [x, constant("scaling", actor.scaling)], "scaled")
    limits = [constant("least", np.float32(-NORMALISED_LIMIT)), constant("most", np.float32(NORMALISED_LIMIT))]
    x = seen = node("Clip", [x, *limits], "normalised")
    for depth, (weight, bias) in enumerate(actor.layers):
        parameters = [constant(f"weight_{depth}", weight), constant(f"bias_{depth}", bias)]
        x = node("Gemm", [x, *parameters], f"linear_{depth}", transB=1)
        if depth < len(actor.layers) - 1:
            x = node(actor.activation, [x], f"active_{depth}")
    if actor.direct:
        parameters = [constant("weight_direct", actor.direct[0]), constant("bias_direct", actor.direct[1])]
        x = node("Add", [x, node("Gemm", [seen, *parameters], "direct", transB=1)], "bent")
    if actor.squash:
        x = node("Tanh", [x], "squashed")
    x = node("Mul", [x, constant("scale", actor.scale.astype(np.float32))], "move")
    drives = node("Gather", ["observation", constant("drives", np.array(DRIVES, np.int64))], "applied", axis=1)
    drives = node("Mul", [drives, constant("skip", np.float32(actor.skip))], "kept")
    x = node("Add", [x, drives], "wanted")
    node("Clip", [x, constant("low", np.float32(-1.0)), constant("high", np.float32(1.0))], "action")
    graph = helper.make_graph(
        nodes,
        "cz_gym_agent",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["n", channels])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["n", 2])],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    onnx.checker.check_model(model)
    serialised: bytes = model.SerializeToString()
    return serialised
