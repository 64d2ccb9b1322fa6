"""Controllers and agents by name, each in its shell: for exports, and for the virtual puller.

A classical controller is NumPy code already. A trained agent becomes a controller of the shell by :class:`Agent`: its
ONNX graph in NumPy, its observation, and the drives that its actions mean.
"""

import re
import unicodedata
from collections.abc import Callable
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from cz_gym import agents
from cz_gym.agents.contract import check_environment
from cz_gym.baselines.fallback import fallback
from cz_gym.body.process import BODY
from cz_gym.body.signals import Measured
from cz_gym.config import Config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.engine.kernels import update_history, write_history
from cz_gym.process import scales
from cz_gym.puller.file import DEFAULT
from cz_gym.spaces import CLIP, HEATER_SLACK, HISTORY, INTEGRAL_SCALE, LAGGED, MEASURED, drives_of, lags
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.tools.registry import CONTROLLERS, CRYSTAL_CONTROLLERS

from .shell import Block


def _gemm(a: Any, b: Any, c: Any = 0.0, alpha: float = 1.0, beta: float = 1.0, transA: int = 0, transB: int = 0) -> Any:
    return alpha * ((a.T if transA else a) @ (b.T if transB else b)) + beta * c


def _slice(x: Any, starts: Any, ends: Any, axes: Any = None, steps: Any = None) -> Any:
    key = [slice(None)] * x.ndim
    for at, axis in enumerate(range(len(starts)) if axes is None else axes):
        key[int(axis)] = slice(int(starts[at]), int(ends[at]), 1 if steps is None else int(steps[at]))
    return x[tuple(key)]


OPERATORS: dict[str, Callable[..., Any]] = {
    "Add": np.add, "Sub": np.subtract, "Mul": np.multiply, "Div": np.divide, "MatMul": np.matmul, "Gemm": _gemm,
    "Slice": _slice, "Concat": lambda *x, axis: np.concatenate(x, axis=axis), "Identity": lambda x: x,
    "Clip": lambda x, low=None, high=None: np.clip(x, low, high), "Tanh": np.tanh,
    "Relu": lambda x: np.maximum(x, 0.0), "Sigmoid": lambda x: 0.5 + 0.5 * np.tanh(0.5 * x),
    "Split": lambda x, lengths=None, axis=0, parts=1: np.split(
        x, parts if lengths is None else np.cumsum(lengths)[:-1].tolist(), axis),
}  # fmt: skip
"""ONNX operators of MLPs, GRUs and LSTMs with tanh, relu and sigmoid, in NumPy."""


def network_of(content: bytes) -> Callable[..., list[Any]]:
    """An agent's checked ONNX graph as a function of NumPy arrays of shape (n, width), in double precision.

    CzError for an operator beyond :data:`OPERATORS`.
    """
    import onnx
    from onnx import helper, numpy_helper

    graph = onnx.load_from_string(content).graph
    if others := sorted({node.op_type for node in graph.node} - OPERATORS.keys()):
        allowed = "MLP, GRU or LSTM with tanh, relu or sigmoid"
        raise CzError(f"an agent with the operator {others[0]} cannot be exported: its network must be an {allowed}")
    tensors = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    weights = {name: each.astype(np.float64) if each.dtype == np.float32 else each for name, each in tensors.items()}

    def network(**inputs: Any) -> list[Any]:
        values: dict[str, Any] = {"": None} | weights | inputs
        for node in graph.node:
            extra = {a.name: helper.get_attribute_value(a) for a in node.attribute}
            extra |= {"parts": len(node.output)} if node.op_type == "Split" else {}
            result = OPERATORS[node.op_type](*(values[name] for name in node.input), **extra)
            values.update(zip(node.output, result if node.op_type == "Split" else [result], strict=True))
        return [values[value.name] for value in graph.output]

    return network


class AgentMemory(NamedTuple):
    """The memory of an agent outside Python; the first two belong to the observation "history"."""

    sums: Any
    """Running sums of the remembered channels less the newest ones, the newest first, shape (n, depth, channels)."""
    integral: Any
    """Integral of the scaled ring error, shape (n,)."""
    command: Any
    """Last commanded inputs in shares of their ranges, shape (n, 2)."""
    network: Any
    """The network's recurrent state, shape (n, k)."""


class Agent:
    """A trained agent as a controller of the shell."""

    accepts_missing_temperature, observes = False, True

    def __init__(self, policy: Any, config: Config) -> None:
        contract, ranges = policy.contract, config.ranges
        if contract.observation not in ("measured", "history"):
            raise CzError(f"an agent that reads {contract.observation!r} cannot be exported: no plant has that")
        self.network, self.remembers, self.ranges = network_of(policy.content), policy.memory_length, ranges
        self.v_0, self.heater_range = ranges
        self.slack = HEATER_SLACK * max(each.actuators.heater_step for each in config.scenario.scenarios)
        self.dt = contract.control_interval
        self.newest, self.before = lags(self.dt)[0], lags(self.dt)[1] + 1
        self.depth = int(self.before.max()) + 1 if contract.observation == "history" else 0
        self.drives = drives_of(contract.action, contract.control_interval, self.heater_range)

    def at_rest(self, seen: Measured) -> AgentMemory:
        """The network's state at zero, the applied drives as the last command, the first ring error as the past."""
        ring = self._measured(seen)[:, :1]
        ages = np.zeros((self.depth, len(LAGGED)))
        ages[:, 0] = np.arange(self.depth)[::-1]
        step = self.dt * MEASURED[0].scale / INTEGRAL_SCALE
        integral = -ring[:, 0] * step if self.depth else np.zeros((len(ring), 0))
        network = np.zeros((len(ring), self.remembers))
        return AgentMemory(-ring[:, :, None] * ages, integral, self._applied(seen), network)

    def step(self, seen: Measured, memory: AgentMemory) -> tuple[Any, Any, AgentMemory]:
        """Pull speed and heater power above nominal, and the new memory."""
        observation = self._measured(seen)
        if self.depth:
            observation, memory = self._history(seen, observation, memory)
        action, *state = self.network(observation=observation, **({"state": memory.network} if self.remembers else {}))
        applied = self._applied(seen)
        slack = np.array([0.0, self.slack / self.heater_range])
        before = applied + np.clip(memory.command - applied, -slack, slack)
        gains = np.array([self.drives.pull, self.drives.heater])
        command = np.clip(self.drives.keep * before + gains * np.clip(action, -1.0, 1.0), -1.0, 1.0)
        memory = memory._replace(command=command, network=state[0] if state else memory.network)
        return command[:, 0] * self.v_0, command[:, 1] * self.heater_range, memory

    def _applied(self, seen: Measured) -> Any:
        return np.stack([seen.v_p / self.v_0, seen.Q_H / self.heater_range], axis=-1)

    def _measured(self, seen: Measured) -> Any:
        return np.clip(np.stack(seen, axis=-1) / scales(MEASURED, *self.ranges), -CLIP, CLIP)

    def _history(self, seen: Measured, measured: Any, past: AgentMemory) -> tuple[Any, AgentMemory]:
        """The observation "history" and its memory, by the engine's own functions.

        The engine's circular table is turned so that the newest sample stands at 0; the slots stand in the last axis.
        """
        slot = SimpleNamespace(k=self.depth, integral=past.integral)
        sums, n = np.moveaxis(past.sums, 0, -1).copy(), len(measured)
        out = np.concatenate([measured.T, np.zeros((len(HISTORY) - len(MEASURED), n))])
        share = 1.0 / (self.before - self.newest)
        sizes = 1.0 / scales(MEASURED, *self.ranges)
        constants = SimpleNamespace(newest=self.newest, before=self.before, share=share, measured=sizes)
        _uncompiled(update_history, sums)(slot, sums, self.dt, out, BODY)
        _uncompiled(write_history, sums)(slot, seen, sums, constants, out, BODY)
        table = np.concatenate([sums[1:] - sums[0], np.zeros((1, len(LAGGED), n))])
        return out.T, past._replace(sums=np.moveaxis(table, -1, 0), integral=slot.integral)


def _uncompiled(function: Any, like: Any) -> Any:
    """An engine's function for arrays with slots in the last axis, which records limits where it would branch."""
    n = like.shape[-1]
    own = {
        "clip": lambda value, limit: np.clip(value, -limit, limit),
        "scratch": lambda *shape: np.zeros_like(like, shape=(*shape, n)),
    }
    return FunctionType(function.__code__, function.__globals__ | own)


FALLBACK = "fallback"
"""Name of the PID that takes over, as a controller of its own."""


def make_block(name: str, config: Config) -> Block:
    """Put a controller or agent into its shell, whose fallback is a PID searched for the puller.

    CzError if there is none of that name, if it cannot be exported, or if an agent is of another puller.
    """
    known = {entry.name: entry for entry in CONTROLLERS if not entry.bound}
    crystal = {*(entry.name for entry in CRYSTAL_CONTROLLERS), *agents.shipped_names(CRYSTAL.name)} - known.keys()
    plant = f"Puller {config.puller.label}; plant {config.plant_hash}; control interval {config.control_interval:g} s."
    if name in crystal:
        raise CzError(f"{name} cannot be exported: controllers and agents of whole crystals stay in Python")
    if name not in (*known, FALLBACK, *agents.shipped_names()) and Path(name).suffix != ".onnx":
        raise CzError(unknown_name_message("controller or agent", name, [*known, FALLBACK, *agents.shipped_names()]))
    pid, *margins = fallback(config)
    takes_over = (
        f"Fallback: PID searched for this puller with the drives and the camera of scenario {config.scenario.name}: "
        "gain margin {:.3g}, phase margin {:.3g} deg on Models I and II with a latency of {:g} s.".format(*margins)
    )
    # Blocks of one program need names of their own: a block for another puller or scenario is called by it.
    machine = config.puller.name if config.puller != DEFAULT else ""
    scenario = config.scenario.name if config.scenario.name != "puller" else ""
    identifier = identifier_of("-".join(filter(None, (Path(name.removesuffix(".onnx")).name, machine, scenario))))
    if name == FALLBACK:
        return Block(identifier, pid, pid, config, (takes_over, plant))
    if name in known:
        tuned = f"Settings of scenario {config.scenario.name} ({config.scenario.hash})"
        if config.puller != DEFAULT:
            tuned = "Settings scaled to the puller, or searched for it beside its file"
        controller = known[name].make(config)
        if not getattr(controller, "exportable", False):
            raise CzError(f"{name} cannot be exported: it has no feedback, several filters or an optimisation")
        facts = f"Controller {name}: {known[name].meaning}.", f"{tuned}.", plant, takes_over
        return Block(identifier, controller, pid, config, facts)
    contract = (policy := agents.load(name)).contract
    check_environment(contract, config, name)
    its, own = (
        f"puller {each.puller}, plant {each.plant}, control interval {each.control_interval:g} s"
        for each in (policy.made_for, config.made_for)
    )
    if its != own:
        raise CzError(f"{name} was trained for {its}, not for {own}")
    trained = f"trained on {contract.scenario} ({contract.scenario_hash})"
    about = f"Agent {name}: {contract.algorithm}, seed {contract.training_seed}, {trained}."
    file = f"File {contract.sha256}; observation {contract.observation} {contract.observation_hash}."
    return Block(identifier, Agent(policy, config), pid, config, (about, file, plant, takes_over))


def identifier_of(name: str) -> str:
    """A name as a part of identifiers: a letter or digit at both ends, no two underscores in a row, ASCII."""
    plain = unicodedata.normalize("NFKD", name.lower()).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "_", plain).strip("_") or "agent"
