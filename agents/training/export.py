"""From a trained network to an ONNX file: normalisation, layers, action head and clipping in one graph."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from cz_gym.agents.training.networks import DRIVES, NORMALISED_LIMIT, Normalise
from cz_gym.observation import HISTORY

Floats = npt.NDArray[np.float32]
OPSET, IR_VERSION = 17, 9
ACTIVATIONS: dict[type[torch.nn.Module], tuple[str, dict[str, str]]] = {
    torch.nn.Tanh: ("Tanh", {}),
    torch.nn.ReLU: ("Relu", {}),
    torch.nn.Sigmoid: ("Sigmoid", {}),
    torch.nn.ELU: ("Elu", {"alpha": "alpha"}),
    torch.nn.LeakyReLU: ("LeakyRelu", {"alpha": "negative_slope"}),
}
"""Modules of one ONNX operator, with its attributes and what torch calls them."""


@dataclass(frozen=True)
class Actor:
    """An actor as arrays: action = clip(skip * drives + scale * squash(layers(x) + direct(x))).

    x is the normalised observation, (observation - mean) @ scaling within +-30.
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


def linear_of(module: torch.nn.Linear) -> tuple[Floats, Floats]:
    """Weight (out, in) and bias (out,) of a layer."""
    return module.weight.detach().numpy().copy(), module.bias.detach().numpy().copy()


def actor_of(learner: Any) -> Actor:
    """The deterministic actor of a PPO or SAC learner made by :mod:`cz_gym.agents.training.learners`."""
    policy = learner.policy
    if hasattr(policy, "mlp_extractor"):
        normalise: Normalise = policy.features_extractor
        head = policy.action_net
        torso, last, activation, squash = policy.mlp_extractor.actor, head.linear, "Tanh", False
        direct = linear_of(policy.mlp_extractor.direct)
        skip, scale = head.skip, head.scale.numpy().copy()
    else:
        normalise = policy.actor.features_extractor
        torso, last, activation, squash = policy.actor.latent_pi, policy.actor.mu, "Relu", True
        direct = None
        skip, scale = learner.env.skip, learner.env.scale.astype(np.float32)
    visible = min(len(normalise.mean), len(HISTORY))
    layers = [linear_of(module) for module in torso if isinstance(module, torch.nn.Linear)]
    first_weight, first_bias = layers[0]
    layers[0] = first_weight[:, :visible].copy(), first_bias
    seen = normalise.seen[:visible, None] * normalise.scaling[:visible, :visible]
    mean, scaling = normalise.mean.numpy()[:visible].copy(), seen.numpy()
    return Actor(mean, scaling, direct, (*layers, linear_of(last)), activation, squash, skip, scale)


def exported(learner: Any) -> bytes:
    """The deterministic actor of a learner of :mod:`cz_gym.agents.training.learners`, as a serialised ONNX model."""
    if hasattr(learner.policy, "lstm_actor"):
        from cz_gym.agents.training.recurrent import recurrent_onnx

        return recurrent_onnx(learner)
    return to_onnx(actor_of(learner))


class OnnxGraph:
    """An agent's graph in the making; every node is named after its output."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, name: str, value: npt.ArrayLike) -> str:
        """A weight; its name."""
        self._constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def node(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """An operator with one output; its name."""
        self.nodes_of(operator, inputs, [output], **attributes)
        return output

    def nodes_of(self, operator: str, inputs: list[str], outputs: list[str], **attributes: Any) -> None:
        """An operator with several outputs."""
        self._nodes.append(helper.make_node(operator, inputs, outputs, **attributes))

    def gemm(self, x: str, weight: Floats, bias: Floats, name: str) -> str:
        """A layer of weight (out, in) and bias (out,)."""
        parameters = [self.constant(f"{name}_weight", weight), self.constant(f"{name}_bias", bias)]
        return self.node("Gemm", [x, *parameters], name, transB=1)

    def through(self, x: str, modules: Iterable[torch.nn.Module]) -> str:
        """x through torch's modules, one after the other; TypeError for one that is not known here."""
        for module in modules:
            name = f"module_{len(self._nodes)}"
            if isinstance(module, torch.nn.Sequential):
                x = self.through(x, module)
            elif isinstance(module, torch.nn.Linear):
                weight, bias = module.weight.detach().numpy(), module.bias
                offset = np.zeros(len(weight), np.float32) if bias is None else bias.detach().numpy()
                x = self.gemm(x, weight, offset, name)
            elif isinstance(module, torch.nn.Hardtanh):
                x = self.clip(x, module.min_val, module.max_val, name)
            elif isinstance(module, torch.nn.SiLU):
                x = self.node("Mul", [x, self.node("Sigmoid", [x], f"{name}_gate")], name)
            elif type(module) in ACTIVATIONS:
                operator, attributes = ACTIVATIONS[type(module)]
                x = self.node(operator, [x], name, **{key: getattr(module, own) for key, own in attributes.items()})
            elif not isinstance(module, (torch.nn.Identity, torch.nn.Dropout)):
                raise TypeError(f"a network with {type(module).__name__} in it cannot be written as an agent file")
        return x

    def clip(self, x: str, low: float, high: float, name: str) -> str:
        """x within [low, high]."""
        limits = [self.constant(f"{name}_{end}", np.float32(value)) for end, value in (("low", low), ("high", high))]
        return self.node("Clip", [x, *limits], name)

    def normalised(self, mean: Floats, scaling: Floats) -> str:
        """The normalised observation."""
        x = self.node("Sub", ["observation", self.constant("mean", mean)], "centred")
        x = self.node("MatMul", [x, self.constant("scaling", scaling)], "scaled")
        return self.clip(x, -NORMALISED_LIMIT, NORMALISED_LIMIT, "normalised")

    def drives(self, x: str, skip: float, scale: npt.ArrayLike) -> None:
        """The action: skip * (applied drives) + scale * x, within the box."""
        x = self.node("Mul", [x, self.constant("scale", np.asarray(scale, np.float32))], "scaled_move")
        at = self.constant("drives", np.array(DRIVES, np.int64))
        applied = self.node("Gather", ["observation", at], "applied", axis=1)
        kept = self.node("Mul", [applied, self.constant("skip", np.float32(skip))], "kept")
        x = self.node("Add", [x, kept], "wanted")
        self.clip(x, -1.0, 1.0, "action")

    def finished(self, channels: int, state: int = 0) -> bytes:
        """The model, checked and serialised; ``state`` is the length of what it remembers, 0 if nothing."""

        def value(name: str, width: int) -> Any:
            return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", width])

        given, answers = [value("observation", channels)], [value("action", len(DRIVES))]
        if state:
            given, answers = [*given, value("state", state)], [*answers, value("next_state", state)]
        graph = helper.make_graph(self._nodes, "cz_gym_agent", given, answers, self._constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        onnx.checker.check_model(model)
        serialised: bytes = model.SerializeToString()
        return serialised


def to_onnx(actor: Actor) -> bytes:
    """The actor as a serialised ONNX model: observation (n, channels) to action (n, 2), float32."""
    graph = OnnxGraph()
    x = seen = graph.normalised(actor.mean, actor.scaling)
    for depth, (weight, bias) in enumerate(actor.layers):
        x = graph.gemm(x, weight, bias, f"linear_{depth}")
        if depth < len(actor.layers) - 1:
            x = graph.node(actor.activation, [x], f"active_{depth}")
    if actor.direct:
        x = graph.node("Add", [x, graph.gemm(seen, *actor.direct, "direct")], "bent")
    if actor.squash:
        x = graph.node("Tanh", [x], "squashed")
    graph.drives(x, actor.skip, actor.scale)
    return graph.finished(len(actor.mean))
