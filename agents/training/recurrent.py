"""PPO with a memory of its own: sb3-contrib's recurrent policy on the native batch, and its actor as one ONNX file.

Actor: observation -> normalise -> LSTM -> tanh layer -> two outputs; action = skip * (applied v_p, Q_H) + scale *
output. The LSTM's step is written out in plain operators, its hidden and cell values travel in the file's ``state``:
nothing in the file loops.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.vec_env import VecEnv

from cz_gym.agents.training.export import OnnxGraph

from . import recipes as settings
from .networks import Normalise


def make_recurrent(choice: settings.RecurrentPPO, env: VecEnv, rate: Any, seed: int, logs: str | None) -> RecurrentPPO:
    """The learner of these settings; ``env`` takes moves of the drives, ``rate`` is the learning rate's schedule."""
    hidden = list(choice.recipe.hidden)
    return RecurrentPPO(
        "MlpLstmPolicy",
        env,
        learning_rate=rate,
        n_steps=choice.n_steps,
        batch_size=choice.batch_size,
        n_epochs=choice.n_epochs,
        gamma=choice.gamma,
        gae_lambda=choice.gae_lambda,
        clip_range=choice.clip_range,
        ent_coef=choice.ent_coef,
        vf_coef=choice.vf_coef,
        max_grad_norm=choice.max_grad_norm,
        policy_kwargs={
            "net_arch": {"pi": hidden, "vf": hidden},
            "lstm_hidden_size": choice.units,
            "log_std_init": float(np.log(choice.noise)),
            "features_extractor_class": Normalise,
            "features_extractor_kwargs": {"drives": False},
        },
        seed=seed,
        device="cpu",
        tensorboard_log=logs,
    )


def recurrent_onnx(learner: RecurrentPPO) -> bytes:
    """The deterministic actor: observation (n, channels), state (n, 2 units) to action (n, 2), next_state."""
    policy: Any = learner.policy
    env: Any = learner.env
    normalise: Normalise = policy.pi_features_extractor
    graph = OnnxGraph()
    x = graph.normalised(normalise.mean.numpy(), (normalise.seen[:, None] * normalise.scaling).numpy())
    x = lstm_step(graph, x, policy.lstm_actor)
    x = graph.through(x, [*policy.mlp_extractor.policy_net, policy.action_net])
    x = graph.clip(x, -1.0, 1.0, "move")
    graph.drives(x, env.skip, env.scale)
    return graph.finished(len(normalise.mean), 2 * policy.lstm_actor.hidden_size)


def lstm_step(graph: OnnxGraph, x: str, lstm: torch.nn.LSTM) -> str:
    """One step of torch's LSTM from ``state`` to ``next_state``, (hidden, cell) side by side; the new hidden values.

    Gates (input, forget, cell, output) = W x + U h + b.
    """
    units = lstm.hidden_size
    half = graph.constant("halves", np.array([units, units], np.int64))
    graph.nodes_of("Split", ["state", half], ["hidden", "cell"], axis=1)
    gates = [parameter.detach().numpy() for parameter in (lstm.weight_ih_l0, lstm.weight_hh_l0)]
    bias = (lstm.bias_ih_l0 + lstm.bias_hh_l0).detach().numpy()
    seen = graph.gemm(x, gates[0], bias, "gates_seen")
    recalled = graph.gemm("hidden", gates[1], np.zeros_like(bias), "gates_recalled")
    quarters = graph.constant("quarters", np.full(4, units, np.int64))
    names = ["gate_in", "gate_forget", "gate_new", "gate_out"]
    graph.nodes_of("Split", [graph.node("Add", [seen, recalled], "gates"), quarters], names, axis=1)
    opened = [graph.node("Sigmoid", [name], f"{name}_open") for name in (names[0], names[1], names[3])]
    new = graph.node("Tanh", [names[2]], "new")
    kept = graph.node("Mul", [opened[1], "cell"], "kept_cell")
    gained = graph.node("Mul", [opened[0], new], "gained_cell")
    cell = graph.node("Add", [kept, gained], "next_cell")
    hidden = graph.node("Mul", [opened[2], graph.node("Tanh", [cell], "bent_cell")], "next_hidden")
    graph.node("Concat", [hidden, cell], "next_state", axis=1)
    return hidden
