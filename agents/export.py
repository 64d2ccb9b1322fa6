"""From a policy of stable-baselines3 to an ONNX model: normalisation, network and clipping in one graph."""

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from cz_gym.config import Config
from cz_gym.evaluation.protocol import PLANT, REWARD, STATE
from cz_gym.sb3 import environment_steps
from cz_gym.spaces import observations

from .apg import APG, RecurrentPolicy
from .asymmetric import Asymmetric
from .contract import AgentFileError, facts_of, make_contract
from .graph import INPUTS, OUTPUTS
from .policy import OnnxPolicy

OPSET, IR_VERSION = 17, 9


class DeterministicActor(nn.Module):
    """Deterministic action of a policy, clipped to [-1, 1], for observations as the environment gives them.

    A recurrent policy also takes its state, of length ``memory``, and returns the next one.
    """

    mean: torch.Tensor
    spread: torch.Tensor

    def __init__(self, policy: BasePolicy, normalisation: VecNormalize | None = None) -> None:
        super().__init__()
        self.policy: Any = policy
        self.limit, self.memory = 0.0, 0
        self.lstm: nn.LSTM | None = getattr(policy, "lstm_actor", None)
        """The LSTM of sb3-contrib's recurrent policies."""
        if isinstance(policy, RecurrentPolicy):
            self.memory = policy.initial_memory(1).shape[1]
        elif self.lstm is not None:
            if self.lstm.num_layers > 1:
                raise AgentFileError("a policy with more than one layer of LSTM cannot be written as an agent file")
            self.memory = 2 * self.lstm.hidden_size
        elif not isinstance(policy, ActorCriticPolicy) and not hasattr(policy, "actor"):
            raise AgentFileError(f"{type(policy).__name__} has no actor that gives two continuous actions")
        if normalisation is not None and normalisation.norm_obs:
            rms: Any = normalisation.obs_rms
            self.limit = normalisation.clip_obs
            self.register_buffer("mean", torch.as_tensor(rms.mean, dtype=torch.float32))
            self.register_buffer("spread", torch.as_tensor(np.sqrt(rms.var + normalisation.epsilon)).float())

    def forward(self, observation: torch.Tensor, *state: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Map observations (n, channels), with a memory its state too, to actions (n, 2) and the next state."""
        x, policy = observation, self.policy
        if self.limit:
            x = torch.clamp((x - self.mean) / self.spread, -self.limit, self.limit)
        after: list[torch.Tensor] = []
        if isinstance(policy, RecurrentPolicy):
            action, *after = policy(x, *state)
        elif isinstance(policy, ActorCriticPolicy):
            x = _features(policy.pi_features_extractor, x)
            if self.lstm is not None:
                x, *after = lstm_step(x, state[0], self.lstm)
            action = policy.action_net(policy.mlp_extractor.forward_actor(x))
        else:
            actor = policy.actor
            x = _features(actor.features_extractor, x)
            action = torch.tanh(actor.mu(actor.latent_pi(x))) if hasattr(actor, "latent_pi") else actor.mu(x)
        return (action.clamp(-1.0, 1.0), *after)


def _features(extractor: nn.Module, x: torch.Tensor) -> Any:
    """Observations of shape (n, channels) are flat already."""
    return x if isinstance(extractor, FlattenExtractor) else extractor(x)


def lstm_step(x: torch.Tensor, state: torch.Tensor, lstm: nn.LSTM) -> tuple[torch.Tensor, torch.Tensor]:
    """Advance an LSTM by a step: hidden values and the next state, which holds hidden and cell values.

    In plain operations: agent files may not have ONNX's LSTM, whose output has a time axis.
    """
    hidden, cell = torch.split(state, lstm.hidden_size, dim=1)
    weight_x, weight_h, bias_x, bias_h = lstm.all_weights[0]
    gates = nn.functional.linear(x, weight_x, bias_x) + nn.functional.linear(hidden, weight_h, bias_h)
    gain, forget, new, emit = torch.split(gates, lstm.hidden_size, dim=1)
    cell = torch.sigmoid(forget) * cell + torch.sigmoid(gain) * torch.tanh(new)
    hidden = torch.sigmoid(emit) * torch.tanh(cell)
    return hidden, torch.cat([hidden, cell], dim=1)


def to_onnx(policy: BasePolicy, channels: int, normalisation: VecNormalize | None = None) -> bytes:
    """Export a policy as a serialised ONNX model; AgentFileError if that cannot be done.

    torch's older exporter: the newer one needs more packages and takes a second.
    """
    policy.set_training_mode(False)
    module = DeterministicActor(policy, normalisation).eval()
    examples = [torch.zeros(2, channels), torch.zeros(2, module.memory)][: 2 if module.memory else 1]
    inputs, outputs = (list(names[: len(examples)]) for names in (INPUTS, OUTPUTS))
    rows = {name: {0: "n"} for name in (*inputs, *outputs)}
    file: Any = io.BytesIO()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it is the older one, and of values it takes as constants
            torch.onnx.export(
                module, tuple(examples), file, dynamo=False, opset_version=OPSET, input_names=inputs,
                output_names=outputs, dynamic_axes=rows,
            )  # fmt: skip
    except (torch.onnx.errors.OnnxExporterError, RuntimeError, TypeError, NotImplementedError) as error:
        raise AgentFileError(f"{type(policy).__name__} cannot be written as an agent file: {error}") from None
    model = onnx.load_from_string(file.getvalue())
    weights = [node for node in model.graph.node if node.op_type == "Constant"]
    for node in weights:
        value = node.attribute[0].t
        value.name = node.output[0]
        model.graph.initializer.append(value)
        model.graph.node.remove(node)
    model.ir_version = IR_VERSION
    onnx.checker.check_model(model)
    serialised: bytes = model.SerializeToString()
    return serialised


def to_agent(
    algorithm: BaseAlgorithm, name: str, seed: int, config: Config, normalisation: VecNormalize | None, path: str | Path
) -> OnnxPolicy:
    """Make an agent called ``name`` of the algorithm's policy, not validated yet; ``path`` names it in errors."""
    policy = algorithm.policy
    content = to_onnx(policy, len(observations(config.process)[config.observation]), normalisation)
    contract = make_contract(
        content,
        **facts_of(config),
        algorithm=name,
        learned_from=PLANT if isinstance(algorithm, APG) else STATE if isinstance(policy, Asymmetric) else REWARD,
        training_seed=seed,
        training_steps=environment_steps(algorithm),
        validation_cost=0.0,
        validation_rmse_mm=0.0,
    )
    return OnnxPolicy.of(contract, content, config, path)
