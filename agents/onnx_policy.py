"""A trained agent as data: an ONNX file run by onnxruntime, through the ``predict`` seam, without torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.observation import OBSERVATIONS

from .contract import AgentFileError, Contract, observation_hash, read_agent


@dataclass(frozen=True)
class OnnxPolicy:
    """A feed-forward agent; deterministic, stateless, batched."""

    contract: Contract
    session: Any = field(repr=False, compare=False)

    @classmethod
    def load(cls, path: str | Path, config: Config | None = None) -> OnnxPolicy:
        """Load an agent file (.onnx with its .json beside it).

        With a config, the agent must have been trained on the same nominal plant. Raises AgentFileError with one line
        that says why a file is refused. Nothing in the file is executed but its tensor operations.
        """
        path = Path(path)
        return cls.of(*read_agent(path), config, path)

    @classmethod
    def of(
        cls, contract: Contract, onnx_bytes: bytes, config: Config | None = None, path: str | Path = "agent"
    ) -> OnnxPolicy:
        """An agent of what its files say; ``path`` names it in errors."""
        if contract.observation not in OBSERVATIONS:
            raise AgentFileError(
                f"{path}: reads observation {contract.observation!r}, which this release does not have"
            )
        expected = len(OBSERVATIONS[contract.observation])
        if contract.channels != expected:
            raise AgentFileError(
                f"{path}: reads {contract.channels} channels, this release's {contract.observation!r} has {expected}"
            )
        if contract.observation_hash != observation_hash(contract.observation):
            raise AgentFileError(
                f"{path}: reads observation {contract.observation!r} with other channels or scales than this release's"
            )
        if config is not None and config.plant_hash != contract.plant_hash:
            raise AgentFileError(
                f"{path}: trained on plant {contract.plant_hash}, this environment's is {config.plant_hash}"
            )
        policy = cls(contract, _session(path, onnx_bytes, expected))
        try:
            policy._run(np.zeros((2, expected), np.float32))
        except AgentFileError as error:
            raise AgentFileError(f"{path}: {error}") from None
        return policy

    @property
    def observation(self) -> str:
        """The observation mode the agent reads."""
        return self.contract.observation

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Actions, shape (n, 2) or (2,), of observations of shape (n, channels) or (channels,)."""
        array = np.asarray(observation, np.float32)
        if array.ndim not in (1, 2) or array.shape[-1] != self.contract.channels:
            raise ValueError(
                f"expected {self.contract.channels} channels ({self.observation}), got shape {array.shape}"
            )
        action = self._run(np.atleast_2d(array))
        return (action[0] if array.ndim == 1 else action), state

    def _run(self, observation: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        try:
            (action,) = self.session.run(None, {"observation": observation})
        except Exception:  # onnxruntime raises its own exception types, one for each way a graph can fail
            raise AgentFileError(f"agent {self.contract.sha256[:12]}: its graph cannot be run") from None
        if action.shape != (len(observation), 2) or not np.isfinite(action).all():
            raise AgentFileError(f"agent {self.contract.sha256[:12]}: its action is not two finite numbers")
        found: npt.NDArray[np.float32] = action
        return found


def _session(path: str | Path, onnx_bytes: bytes, channels: int) -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise AgentFileError('running agents needs onnxruntime: pip install "cz-gym[benchmark]"') from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(onnx_bytes, options, providers=["CPUExecutionProvider"])
    except Exception:  # onnxruntime raises its own exception types, one for each way a file can be broken
        raise AgentFileError(f"{path}: not an ONNX model that onnxruntime can run") from None
    inputs = [(value.name, value.shape[1:], value.type) for value in session.get_inputs()]
    outputs = [(value.name, value.shape[1:]) for value in session.get_outputs()]
    if inputs != [("observation", [channels], "tensor(float)")] or outputs != [("action", [2])]:
        raise AgentFileError(f"{path}: must map observation (n, {channels}) to action (n, 2)")
    return session
