"""A torch module as an agent file: trained by any library, run by onnxruntime alone."""

import io
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from torch import nn

from cz_gym.config import Config, check_config
from cz_gym.env import CzVectorEnv
from cz_gym.evaluation.protocol import PLANT, REWARD, STATE, VALIDATION_SEEDS
from cz_gym.spaces import observations
from cz_gym.support.errors import require_type
from cz_gym.support.files import write_files

from .contract import AgentFileError, Contract, OnnxPolicy, agent_files, facts_of, make_contract, plain_graph
from .exported import IR_VERSION, OPSET
from .graph import INPUTS, OUTPUTS

SAMPLES, SLOTS = 50, 8
"""Samples, each of SLOTS crystals, on which file and module must agree."""
TOLERANCE = 1e-3
"""Largest difference between their actions [action units]."""


def save_agent(
    path: str | Path,
    module: nn.Module,
    config: Config,
    state_size: int = 0,
    *,
    name: str = "",
    training_steps: int = 0,
    training_seed: int = 0,
    learned_from: str = REWARD,
) -> Contract:
    """Write a torch module as an agent file; returns its contract, with figures on 200 validation crystals.

    ``module(observation)`` maps observations (n, channels), as an environment of ``config`` gives them, to actions
    (n, 2), which the file clips to [-1, 1]: put normalisation, squashing and the choice of the mean into it. With
    ``state_size`` k, ``module(observation, state)`` returns the action and the next state, (n, k), zero at a crystal's
    start. ``name`` (default: the file's) is what the agent is called. Steps [environment steps, repeats of an action
    counted], seed and source ("reward", "state", "plant") of its training are declared: nothing measures them.

    AgentFileError for a module that cannot be written, and where the file would not act as the module does.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise AgentFileError(f"{path}: an agent file ends in .onnx")
    require_type(nn.Module, module, "stable-baselines3's models have cz_gym.agents.from_sb3.save_agent")
    if learned_from not in (REWARD, STATE, PLANT):
        raise AgentFileError(f"learned_from must be {REWARD!r}, {STATE!r} or {PLANT!r}, not {learned_from!r}")
    channels = len(observations(check_config(config).process).get(config.observation, ()))
    if not channels:
        raise AgentFileError(f"an agent file reads channels, not {config.observation!r}")
    trained = module.training
    module.eval()
    try:
        content = to_onnx(module, channels, state_size)
        facts = {
            "algorithm": name or path.stem, "learned_from": learned_from, "training_seed": training_seed,
            "training_steps": training_steps, "validation_cost": 0.0, "validation_rmse_mm": 0.0,
        }  # fmt: skip
        agent = OnnxPolicy.of(make_contract(content, **facts_of(config), **facts), content, config, path)
        return write_validated(agent, config, path, "module", disagreement(agent, module, config))
    finally:
        module.train(trained)


def write_validated(agent: OnnxPolicy, config: Config, path: Path, kind: str, apart: float) -> Contract:
    """Write an agent of a "module" or "model", from whose actions its own are ``apart``, with its validation figures.

    AgentFileError where they are too far apart.
    """
    from .recipes import JUDGING_SEEDS, validate

    if not apart <= TOLERANCE:
        raise AgentFileError(f"{path}: the file would act otherwise than the {kind}, by up to {apart:.2g}")
    contract = validate(agent, config, JUDGING_SEEDS).put_into(agent.contract)
    write_files(agent_files(path, agent.content, contract))
    return contract


class Clipped(nn.Module):
    """A module whose first output is clipped to [-1, 1]."""

    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, *given: torch.Tensor) -> Any:
        """Return the action, and the next state if there is one."""
        result = self.inner(*given)
        if isinstance(result, torch.Tensor):
            return result.clamp(-1.0, 1.0)
        action, *state = result
        return (action.clamp(-1.0, 1.0), *state)


def to_onnx(module: nn.Module, channels: int, state_size: int = 0) -> bytes:
    """Export a module as an agent's graph; AgentFileError if that cannot be done."""
    device = next((each.device for each in module.parameters()), torch.device("cpu"))
    examples = [torch.zeros(2, width, device=device) for width in (channels, state_size) if width]
    name = type(module).__name__
    try:
        with torch.no_grad():
            result = module(*examples)
    except (RuntimeError, TypeError, ValueError, IndexError) as error:
        shapes = " and ".join(str(tuple(each.shape)) for each in examples)
        raise AgentFileError(f"{name} fails on inputs of shape {shapes}: {' '.join(str(error).split()):.200}") from None
    parts = [result] if isinstance(result, torch.Tensor) else list(result)
    given = [tuple(part.shape) if isinstance(part, torch.Tensor) else type(part).__name__ for part in parts]
    wanted = [(2, width) for width in (2, state_size) if width]
    if given != wanted:
        raise AgentFileError(
            f"{name} gives {given} for two crystals, not {wanted}: the action, shape (n, 2)"
            + (", and the next state" if state_size else "; with a memory say its state_size")
        )
    content = export(Clipped(module), examples, name)
    return plain_graph(content, channels, f"{name} cannot be written as an agent file")


def export(module: nn.Module, examples: Sequence[torch.Tensor], name: str) -> bytes:
    """Export a module of rows as a serialised ONNX model; AgentFileError if that cannot be done.

    torch's older exporter: the newer one needs more packages and takes a second.
    """
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
        raise AgentFileError(f"{name} cannot be written as an agent file: {error}") from None
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


def disagreement(agent: OnnxPolicy, module: nn.Module, config: Config) -> float:
    """Largest difference between the actions of file and module, on crystals that the file drives [action units]."""
    device = next((each.device for each in module.parameters()), torch.device("cpu"))
    clipped, state = Clipped(module), torch.zeros(SLOTS, agent.memory_length, device=device)

    def act(observation: Any, starts: Any) -> Any:
        nonlocal state
        state[torch.as_tensor(starts)] = 0.0
        given = [torch.as_tensor(observation, dtype=torch.float32, device=device), state]
        with torch.no_grad():
            wanted = clipped(*given[: 2 if agent.memory_length else 1])
        if agent.memory_length:
            wanted, state = wanted
        return wanted.cpu().numpy()

    return largest_difference(agent, act, config)


def largest_difference(agent: OnnxPolicy, act: Callable[[Any, Any], Any], config: Config) -> float:
    """Largest difference of an agent's actions from those of ``act(observation, starts)`` [action units]."""
    envs = CzVectorEnv.from_config(config, SLOTS)
    observation, _ = envs.reset(seed=list(VALIDATION_SEEDS[:SLOTS]))
    apart, memory, starts = 0.0, None, np.ones(SLOTS, bool)
    for _ in range(SAMPLES):
        wanted = act(observation, starts)
        action, memory = agent.predict(observation, memory, starts)
        apart = max(apart, float(np.abs(action - wanted).max()))
        observation, _, terminated, truncated, _ = envs.step(action)
        starts = terminated | truncated
    envs.close()
    return apart
