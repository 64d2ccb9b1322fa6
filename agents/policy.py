"""A trained agent as data: an ONNX file run by onnxruntime, through the method ``predict``, without torch."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config, check_config
from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.spaces import ACTIONS, TargetEnv, observations, tag
from cz_gym.support.errors import CzError

from .contract import AgentFileError, Contract, observation_hash, read_agent
from .graph import GraphError, check_graph

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class OnnxPolicy:
    """A deterministic, batched agent; its memory, if it has one, travels in ``state``."""

    contract: Contract
    session: Any = field(repr=False, compare=False)
    memory_length: int = 0
    """Length of the agent's state; 0 if it has none."""
    content: bytes = field(default=b"", repr=False, compare=False)
    """The ONNX file, so that a policy pickles."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).of, (self.contract, self.content)

    @classmethod
    def load(cls, path: str | Path, config: Config | None = None) -> Self:
        """Load an agent file (.onnx, with its .json beside it); nothing in it is executed but its tensor operations.

        With a config, it must have been trained on the same nominal plant. AgentFileError says why it is refused.
        """
        path = Path(path)
        if path.suffix != ".onnx":
            said = f"{path}: not an .onnx agent file; cz_gym.agents.load({str(path)!r}) loads a shipped agent"
            raise AgentFileError(said)
        return cls.of(*read_agent(path), config, path)

    @classmethod
    def of(
        cls, contract: Contract, onnx_bytes: bytes, config: Config | None = None, path: str | Path = "agent"
    ) -> Self:
        """Make an agent of its contract and ONNX file; ``path`` names it in errors."""
        environment, known = contract.environment, dict[str, Any]()
        if environment in ENVIRONMENTS:
            known = observations(ENVIRONMENTS[environment])
        for name, names in ((environment, ENVIRONMENTS), (contract.observation, known), (contract.action, ACTIONS)):
            if name not in names:
                raise AgentFileError(f"{path}: made for {name!r}, which this release does not have")
        expected = len(known[contract.observation])
        digest = observation_hash(contract.observation, environment)
        if (contract.channels, contract.observation_hash) != (expected, digest):
            raise AgentFileError(
                f"{path}: reads {contract.channels} channels of {contract.observation!r}; this release's has "
                f"{expected}, or others, or other scales"
            )
        if config is not None:
            if environment != (own := check_config(config).process.name):
                raise AgentFileError(
                    f"{path}: trained for {environment}, not for {own or 'an environment of your own'}"
                )
            for what, own, other in (
                ("puller", contract.puller, config.puller.label),
                ("plant", contract.plant_hash, config.plant_hash),
            ):
                if own != other:
                    raise AgentFileError(f"{path}: trained for {what} {own}, this environment's is {other}")
        policy = cls(contract, *_session(path, onnx_bytes, expected), onnx_bytes)
        try:
            policy.predict(np.zeros((2, expected), np.float32))
        except AgentFileError as error:
            raise AgentFileError(f"{path}: {error}") from None
        return policy

    @property
    def observation(self) -> str:
        """Name of the observation that the agent reads."""
        return self.contract.observation

    @property
    def action(self) -> str:
        """Meaning of the agent's actions, the environment's argument ``action``."""
        return self.contract.action

    @property
    def made_for(self) -> TargetEnv:
        """Environment that the agent was trained in: meaning of actions, control interval, plant and puller."""
        contract = self.contract
        return TargetEnv(self.action, contract.control_interval, contract.plant_hash, contract.puller)

    @property
    def settings(self) -> dict[str, Any]:
        """Arguments of ``gym.make(contract.environment, ...)``: observation, action and control interval [s]."""
        return {name: getattr(self.contract, name) for name in ("observation", "action", "control_interval")}

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Actions, shape (n, 2) or (2,), for observations of shape (n, channels) or (channels,).

        Environments that the agent was not made for refuse them. An agent with a memory takes and returns ``state``,
        shape (n, k) or (k,); it starts at zero where ``state`` is None or ``episode_start`` is true. An agent without
        one returns ``state`` unchanged.
        """
        array = np.asarray(observation, np.float32)
        if array.ndim not in (1, 2) or array.shape[-1] != self.contract.channels:
            raise CzError(
                f"expected {self.contract.channels} channels ({self.observation}), got shape {array.shape}: "
                f'gym.make("{self.contract.environment}", **agent.settings) gives them'
            )
        rows = np.atleast_2d(array)
        if not self.memory_length:
            (action,) = self._run({"observation": rows})
            return (action[0] if array.ndim == 1 else action), state
        before = np.zeros((len(rows), self.memory_length), np.float32)
        if state is not None:
            before += np.reshape(state, before.shape)
        if episode_start is not None:
            before[np.broadcast_to(np.asarray(episode_start, np.bool_), len(rows))] = 0.0
        action, after = self._run({"observation": rows, "state": before})
        return (action[0], after[0]) if array.ndim == 1 else (action, after)

    def _run(self, inputs: dict[str, Floats]) -> list[Floats]:
        try:
            outputs: list[Floats] = self.session.run(None, inputs)
        except Exception:  # onnxruntime raises its own exception types, one for each way a graph can fail
            raise AgentFileError(f"agent {self.contract.sha256[:12]}: its graph cannot be run") from None
        shapes = [(len(inputs["observation"]), width) for width in (2, self.memory_length) if width]
        if [output.shape for output in outputs] != shapes or not all(np.isfinite(output).all() for output in outputs):
            raise AgentFileError(f"agent {self.contract.sha256[:12]}: its action is not two finite numbers")
        outputs[0] = tag(outputs[0], self.made_for)
        return outputs


def _session(path: str | Path, onnx_bytes: bytes, channels: int) -> tuple[Any, int]:
    """Make the session that runs the graph; returns it and the length of the graph's state."""
    try:
        import onnxruntime

        clean, state = check_graph(onnx_bytes, channels)
    except ImportError:
        raise AgentFileError('running agents needs onnx and onnxruntime: pip install ".[benchmark]"') from None
    except GraphError as error:
        raise AgentFileError(f"{path}: {error}") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(clean, options, providers=["CPUExecutionProvider"]), state
    except Exception:  # onnxruntime raises its own exception types, one for each way a file can be broken
        raise AgentFileError(f"{path}: not an ONNX model that onnxruntime can run") from None
