"""From a trained network to an ONNX file: normalisation, layers and clipping in one graph.

The graph is built operator by operator, because torch's exporter without further packages is the deprecated one, whose
graphs hold operators that agent files may not (:mod:`cz_gym.agents.agent_file.graph`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from stable_baselines3.common.policies import ActorCriticPolicy

from cz_gym.observation import DRIVE_CHANNELS, HISTORY

from .networks import NORMALISED_LIMIT, Actor, Normalise, SkipConcat

OPSET, IR_VERSION = 17, 9
ACTIVATIONS: dict[type[torch.nn.Module], tuple[str, dict[str, str]]] = {
    torch.nn.Tanh: ("Tanh", {}),
    torch.nn.ReLU: ("Relu", {}),
    torch.nn.Sigmoid: ("Sigmoid", {}),
    torch.nn.ELU: ("Elu", {"alpha": "alpha"}),
    torch.nn.LeakyReLU: ("LeakyRelu", {"alpha": "negative_slope"}),
}
"""Modules that are one ONNX operator: its name, and its attributes with torch's names for them."""


class OnnxGraph:
    """Builds an agent's graph; every node is named after its output."""

    def __init__(self) -> None:
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self.tensors: dict[str, torch.Tensor] = {}
        """The tensors behind its constants, by the constants' names."""

    def unused(self, kind: str) -> str:
        """A name that is not used in the graph yet."""
        return f"{kind.lower()}_{len(self._nodes)}_{len(self._constants)}"

    def constant(self, name: str, value: Any) -> str:
        """Add a constant, from a tensor or from numbers; returns its name."""
        if isinstance(value, torch.Tensor):
            self.tensors[name] = value = value.detach()
        array = np.asarray(value)
        self._constants.append(numpy_helper.from_array(array, name))
        return name

    def node(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Add an operator with one output; returns its name."""
        self.nodes_of(operator, inputs, [output], **attributes)
        return output

    def nodes_of(self, operator: str, inputs: list[str], outputs: list[str], **attributes: Any) -> None:
        """Add an operator with several outputs."""
        self._nodes.append(helper.make_node(operator, inputs, outputs, **attributes))

    def linear(self, x: str, weight: torch.Tensor, bias: torch.Tensor | None, name: str) -> str:
        """Add a layer with weight (out, in) and bias (out,)."""
        parameters = {"weight": weight, "bias": torch.zeros(len(weight)) if bias is None else bias}
        return self.node("Gemm", [x, *(self.constant(f"{name}_{k}", v) for k, v in parameters.items())], name, transB=1)

    def apply(self, x: str, modules: Iterable[torch.nn.Module]) -> str:
        """Apply torch's modules to x, one after the other; TypeError for a module that cannot be exported."""
        for module in modules:
            name = f"module_{len(self._nodes)}"
            if isinstance(module, torch.nn.Sequential):
                x = self.apply(x, module)
            elif isinstance(module, torch.nn.Linear):
                x = self.linear(x, module.weight, module.bias, name)
            elif isinstance(module, torch.nn.Hardtanh):
                x = self.clip(x, module.min_val, module.max_val, name)
            elif isinstance(module, SkipConcat):
                x = self.node("Concat", [self.apply(x, [module.layers]), x], f"{name}_beside", axis=1)
            elif isinstance(module, torch.nn.SiLU):
                x = self.node("Mul", [x, self.node("Sigmoid", [x], f"{name}_gate")], name)
            elif type(module) in ACTIVATIONS:
                operator, attributes = ACTIVATIONS[type(module)]
                x = self.node(operator, [x], name, **{key: getattr(module, own) for key, own in attributes.items()})
            elif not isinstance(module, (torch.nn.Identity, torch.nn.Dropout)):
                raise TypeError(f"a network with {type(module).__name__} in it cannot be written as an agent file")
        return x

    def lstm_step(self, x: str, lstm: torch.nn.LSTM) -> str:
        """Add one step of torch's LSTM; returns the new hidden values.

        Gates (input, forget, cell, output) = W x + U h + b; the states are hidden and cell values, concatenated.
        """
        half = self.constant("halves", np.full(2, lstm.hidden_size))
        quarter = self.constant("quarters", np.full(4, lstm.hidden_size))
        weight_x, weight_h, bias_x, bias_h = lstm.all_weights[0]
        self.nodes_of("Split", ["state", half], ["hidden", "cell"], axis=1)
        seen = self.linear(x, weight_x, bias_x + bias_h, "gates_seen")
        recalled = self.linear("hidden", weight_h, None, "gates_recalled")
        names = ["gate_in", "gate_forget", "gate_new", "gate_out"]
        self.nodes_of("Split", [self.node("Add", [seen, recalled], "gates"), quarter], names, axis=1)
        gain, forget, emit = (self.node("Sigmoid", [names[i]], f"{names[i]}_open") for i in (0, 1, 3))
        old = self.node("Mul", [forget, "cell"], "old_cell")
        new = self.node("Mul", [gain, self.node("Tanh", ["gate_new"], "new")], "new_cell")
        cell = self.node("Add", [old, new], "next_cell")
        hidden = self.node("Mul", [emit, self.node("Tanh", [cell], "bent_cell")], "next_hidden")
        self.node("Concat", [hidden, cell], "next_state", axis=1)
        return hidden

    def acted(self, x: str, actor: Actor, name: str) -> str:
        """Add the actor's layers; their output is clipped to [-1, 1]."""
        x = x if actor.lstm is None else self.lstm_step(x, actor.lstm)
        return self.clip(self.apply(x, actor.layers), -1.0, 1.0, name)

    def clip(self, x: str, low: float, high: float, name: str) -> str:
        """Add a clip of x to [low, high]."""
        limits = [self.constant(f"{name}_{end}", np.float32(value)) for end, value in (("low", low), ("high", high))]
        return self.node("Clip", [x, *limits], name)

    def normalised(self, normalise: Normalise) -> str:
        """Add the normalisation of the channels that an actor may see."""
        n = min(len(normalise.mean), len(HISTORY))
        scaling = (normalise.visible[:n, None] * normalise.scaling[:n, :n]).contiguous()
        x = self.node("Sub", ["observation", self.constant("mean", normalise.mean[:n])], "centred")
        x = self.node("MatMul", [x, self.constant("scaling", scaling)], "scaled")
        return self.clip(x, -NORMALISED_LIMIT, NORMALISED_LIMIT, "normalised")

    def finished(self, channels: int, state: int = 0) -> bytes:
        """The model, checked and serialised; ``state`` is the length of its state."""

        def value(name: str, width: int) -> Any:
            return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", width])

        inputs, outputs = [value("observation", channels)], [value("action", len(DRIVE_CHANNELS))]
        if state:
            inputs, outputs = [*inputs, value("state", state)], [*outputs, value("next_state", state)]
        graph = helper.make_graph(self._nodes, "cz_gym_agent", inputs, outputs, self._constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        onnx.checker.check_model(model)
        serialised: bytes = model.SerializeToString()
        return serialised


def actor_of(policy: Any) -> Actor:
    """The actor of any algorithm's policy; TypeError if it has none, or one that an agent file cannot hold."""
    if isinstance(policy, ActorCriticPolicy):
        lstm, net = getattr(policy, "lstm_actor", None), policy.mlp_extractor.policy_net
        if lstm is not None and lstm.num_layers > 1:
            raise TypeError("a policy with more than one layer of LSTM cannot be written as an agent file")
        return Actor(policy.pi_features_extractor, lstm, [net, policy.action_net])
    actor = getattr(policy, "actor", None)
    if actor is None:
        raise TypeError(f"{type(policy).__name__} has no actor that gives two continuous actions")
    squashed = hasattr(actor, "latent_pi")
    layers = [actor.latent_pi, actor.mu, torch.nn.Tanh()] if squashed else [actor.mu]
    return Actor(actor.features_extractor, None, layers)


def actor_onnx(actor: Actor) -> bytes:
    """The ONNX model of an actor that begins with :class:`.networks.Normalise`."""
    assert isinstance(actor.extractor, Normalise)
    graph = OnnxGraph()
    graph.acted(graph.normalised(actor.extractor), actor, "action")
    return graph.finished(min(len(actor.extractor.mean), len(HISTORY)), actor.remembers)
