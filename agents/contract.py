"""Agent files: the ONNX graph, the contract beside it as JSON, and the policy that runs both."""

import hashlib
import json
import math
import os
import stat
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config, check_config
from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.evaluation.protocol import GROUPS
from cz_gym.puller.file import DEFAULT
from cz_gym.spaces import ACTIONS, CLIP, TargetEnv, observations, tag
from cz_gym.support.command_line import missing
from cz_gym.support.errors import CzError
from cz_gym.support.files import write_files

from .exported import to_plain
from .graph import GraphError, check_graph
from .residual import ALONE, Base, Residual

FORMAT = "cz-gym-agent"
FORMAT_VERSION = 6
MAX_BYTES = 4_000_000
"""Largest agent file that is read."""
MAX_JSON_BYTES = 1_000_000
"""Largest JSON file that is read."""
MAX_TEXT = 160
"""Longest text in a contract."""
MAX_WHOLE = 2**63 - 1
"""Largest whole number in a contract."""


class AgentFileError(CzError):
    """An agent file is missing, broken, or made for something else; the message is one line."""


@dataclass(frozen=True)
class Contract:
    """An agent's observation, the meaning of its actions, and its training."""

    observation: str
    """Name of the observation that the agent reads."""
    channels: int
    """Length of the observation."""
    observation_hash: str
    """Hash of the observation's channels: their names, units and scales, in order."""
    action: str
    """Meaning of the actions: "direct", "smooth" or "rate" (:func:`cz_gym.spaces.drives_of`)."""
    control_interval: float
    """Time between actions [s]."""
    plant_hash: str
    """Hash of the nominal plant of the training."""
    reward_hash: str
    """Hash of the reward of training and validation (:attr:`cz_gym.config.Config.reward_hash`)."""
    scenario: str
    """Scenario of the training, or shares of scenarios."""
    scenario_hash: str
    """Hash of the training's scenario."""
    algorithm: str
    """Name of the training recipe."""
    learned_from: str
    """Source of the learning, in words of :mod:`cz_gym.evaluation.protocol`: REWARD, STATE or PLANT."""
    training_seed: int
    """Seed of the training run."""
    training_steps: int
    """Environment steps of learning, those after the agent was chosen too."""
    validation_cost: float
    """Mean cost of a step [-] on the validation episodes that choose no agent."""
    validation_rmse_mm: float
    """Mean RMSE on the validation episodes that choose no agent [mm]."""
    sha256: str
    """Hash of the ONNX file."""
    puller: str = DEFAULT.label
    """Name and hash of the training's puller file (:attr:`cz_gym.puller.file.PullerFile.label`)."""
    environment: str = "Cz-v0"
    """Name of the training's environment."""
    controller: str = ALONE
    """Name and hash of the controller that the actions are added to."""
    pull_limit: float = 0.0
    """Largest addition to that controller's pull speed, as a share of v_0 [-]."""
    heater_limit: float = 0.0
    """Largest addition to that controller's heater power [kW]."""

    @property
    def facts(self) -> dict[str, Any]:
        """Every field of the file; an agent that acts alone has none about a controller."""
        return {k: v for k, v in asdict(self).items() if self.controller != ALONE or k not in OF_CONTROLLER}

    @property
    def hash(self) -> str:
        """SHA-256 of the network and of every other field: what the file does, and what it declares (64 hex digits)."""
        return hashlib.sha256(json.dumps(self.facts, sort_keys=True).encode()).hexdigest()


OF_CONTROLLER: dict[str, Any] = {"controller": ALONE, "pull_limit": 0.0, "heater_limit": 0.0}
"""Fields about the controller that an agent adds to, of one that acts alone."""
ADDED_FIELDS = {"puller": DEFAULT.label, "environment": "Cz-v0", **OF_CONTROLLER}
"""Fields that older files do not have, with the values that hold for those."""


def observation_hash(name: str, environment: str = "Cz-v0") -> str:
    """Hash of an observation's channels (16 hex digits): names, units and scales, not their explanations."""
    listed = observations(ENVIRONMENTS[environment])[name]
    channels = [(channel.name, channel.unit, channel.scale) for channel in listed]
    return hashlib.sha256(json.dumps([channels, CLIP]).encode()).hexdigest()[:16]


def facts_of(config: Config) -> dict[str, Any]:
    """Fields of a contract that follow from the environment's settings."""
    return {
        "observation": config.observation,
        "channels": len(observations(config.process)[config.observation]),
        "action": config.action,
        "control_interval": config.control_interval,
        "plant_hash": config.plant_hash,
        "reward_hash": config.reward_hash,
        "scenario": config.scenario.name,
        "scenario_hash": config.scenario.hash,
        "puller": config.puller.label,
        "environment": config.process.name,
    }


def check_environment(contract: Contract, config: Config, name: str | Path) -> None:
    """Raise AgentFileError, with ``name`` at its front, for an agent of another environment than the config's."""
    environment, own = contract.environment, config.process.name or "an environment of your own"
    if environment != own:
        raise AgentFileError(
            f'{name}: trained for {environment}, not for {own}: gym.make("{environment}", **agent.settings) is its '
            f"environment, --env {environment} the option of cz-gym benchmark"
        )


def make_contract(onnx_bytes: bytes, **facts: Any) -> Contract:
    """Make the contract of an ONNX file; ``facts`` are its fields without the hashes of observation and file.

    AgentFileError for a value that no contract may hold.
    """
    digest = hashlib.sha256(onnx_bytes).hexdigest()
    known = {**plain_facts(facts), "sha256": digest}
    known["observation_hash"] = observation_hash(known["observation"], known["environment"])
    _check(known, "contract")
    return Contract(**known)


def plain_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    """All facts of a contract, Python's numbers in place of NumPy's; AgentFileError for missing or unknown ones."""
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in facts.items()}
    given = {**ADDED_FIELDS, **plain}
    odd = sorted(set(given) ^ {each.name for each in fields(Contract)} - {"sha256", "observation_hash"})
    if odd:
        lacking = [name for name in odd if name not in given]
        what = f"missing {', '.join(lacking)}" if lacking else f"unknown {', '.join(odd)}"
        raise AgentFileError(f"an agent's facts: {what:.160} (cz_gym.agents.contract.facts_of(config) gives some)")
    return given


def agent_files(path: Path, onnx_bytes: bytes, contract: Contract) -> dict[Path, bytes]:
    """Contents of the files ``path`` (.onnx) and its contract (.json)."""
    content = {"format": FORMAT, "format_version": FORMAT_VERSION, **contract.facts, "hash": contract.hash}
    text = json.dumps(content, indent=2) + "\n"
    return {path: onnx_bytes, path.with_suffix(".json"): text.encode()}


def write_agent(path: str | Path, onnx_bytes: bytes | str | Path, **facts: Any) -> Contract:
    """Write an agent file with its contract; ``facts`` as for :func:`make_contract`.

    The ONNX model, or its file, may be any exporter's (:mod:`cz_gym.agents.exported`); AgentFileError for a graph that
    agents may not have.
    """
    path, facts = Path(path), plain_facts(facts)
    content = plain_graph(onnx_bytes, facts["channels"], path)
    contract = make_contract(content, **facts)
    write_files(agent_files(path, content, contract))
    return contract


def plain_graph(source: bytes | str | Path, channels: int, path: str | Path) -> bytes:
    """An ONNX model, or its file, as the graph of the agent ``path``; AgentFileError where it cannot become one."""
    source = Path(source) if isinstance(source, str) else source
    if isinstance(source, Path):
        try:
            content = source.read_bytes()
        except OSError as error:
            raise AgentFileError(f"{source}: cannot be read ({error.strerror})") from None
    else:
        content = source
    try:
        check_graph(content, channels)
        return content
    except GraphError:
        pass
    try:
        return to_plain(source, channels)
    except GraphError as error:
        raise AgentFileError(f"{path}: {error}") from None


def read_agent(path: Path) -> tuple[Contract, bytes]:
    """Read an agent file: its contract and ONNX bytes. AgentFileError says what is wrong."""
    onnx_bytes = read_bounded(path, MAX_BYTES)
    contract = _parse(path.with_suffix(".json"))
    if hashlib.sha256(onnx_bytes).hexdigest() != contract.sha256:
        raise AgentFileError(f"{path}: not the file its contract was written for (SHA-256 differs)")
    return contract, onnx_bytes


def read_bounded(path: Path, limit: int) -> bytes:
    """Read a regular file of at most ``limit`` bytes; AgentFileError for others, also pipes and devices."""
    try:
        # O_NONBLOCK: opening a pipe would wait for a writer. O_BINARY: Windows would end the file at a Ctrl-Z.
        flags = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        with open(os.open(path, os.O_RDONLY | flags), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise AgentFileError(f"{path}: not a regular file")
            content = file.read(limit + 1)
    except FileNotFoundError:
        raise AgentFileError(f"{path}: no such file") from None
    except OSError as error:
        raise AgentFileError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        # AgentFileError is a ValueError; the other one is of a name that no file can have.
        raise error if isinstance(error, AgentFileError) else AgentFileError(f"{path!r}: {error}") from None
    if len(content) > limit:
        raise AgentFileError(f"{path}: larger than {limit} bytes")
    return content


def read_json(path: Path) -> Any:
    """Read a JSON file of bounded size; AgentFileError if it is none."""
    content = read_bounded(path, MAX_JSON_BYTES)
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        raise AgentFileError(f"{path}: not JSON") from None


def _parse(path: Path) -> Contract:
    data = read_json(path)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise AgentFileError(f"{path}: not a {FORMAT} contract")
    if data.get("format_version") != FORMAT_VERSION:
        version = data.get("format_version")
        raise AgentFileError(f"{path}: format version {version!r:.80}, this release reads {FORMAT_VERSION}")
    wanted = {field.name for field in fields(Contract)}
    given = {**ADDED_FIELDS, **data}
    del given["format"], given["format_version"]
    given.pop("hash", None)
    if set(given) != wanted:
        odd = sorted(set(given) ^ wanted)[0]
        raise AgentFileError(f"{path}: field {odd!r:.80} is {'missing' if odd in wanted else 'unknown'}")
    _check(given, path)
    return Contract(**given)


def _check(given: Mapping[str, Any], where: Path | str) -> None:
    """AgentFileError unless every value is one that the contract's field may hold."""
    for each in fields(Contract):
        if wrong := _wrong(each.type, given[each.name]):
            raise AgentFileError(f"{where}: field {each.name!r} must be {wrong}, not {given[each.name]!r:.80}")
    if given["learned_from"] not in GROUPS:
        raise AgentFileError(f"{where}: learned_from must be in {', '.join(GROUPS)}, not {given['learned_from']!r:.80}")


def _wrong(kind: Any, value: Any) -> str | None:
    """Describe the right values of this type, the text after "must be"; None if the value is one of them."""
    if kind is str:
        plain = isinstance(value, str) and 0 < len(value) <= MAX_TEXT and value.isprintable() and "|" not in value
        return None if plain else f"printable text of 1 to {MAX_TEXT} characters without |"  # it stands in tables
    if isinstance(value, bool) or not isinstance(value, int if kind is int else (int, float)):
        return str(kind.__name__)
    if isinstance(value, int):
        return None if 0 <= value <= MAX_WHOLE else f"between 0 and {MAX_WHOLE}"
    return None if 0.0 <= value < math.inf else "finite and at least 0"


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
    residual: Residual | None = None
    """The controller that the agent adds to, and the limits; None if it acts alone."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).of, (self.contract, self.content, None, "agent", self.residual and self.residual.base)

    @classmethod
    def load(cls, path: str | Path, config: Config | None = None, base: Base | None = None) -> Self:
        """Load an agent file (.onnx, with its .json beside it); nothing in it is executed but its tensor operations.

        With a config, it must have been trained on the same nominal plant. An agent that adds to a controller needs
        this one as its ``base`` (:func:`cz_gym.tools.registry.load_agent` gives it). AgentFileError says why it is
        refused.
        """
        path = Path(path)
        if path.suffix != ".onnx":
            said = f"{path}: not an .onnx agent file; cz_gym.agents.load({str(path)!r}) loads a shipped agent"
            raise AgentFileError(said)
        policy = cls.of(*read_agent(path), config, path, base)
        written = read_json(path.with_suffix(".json")).get("hash", policy.contract.hash)
        if written != policy.contract.hash:
            raise AgentFileError(f"{path.with_suffix('.json')}: changed after it was written (its hash differs)")
        return policy

    @classmethod
    def of(
        cls, contract: Contract, onnx_bytes: bytes, config: Config | None = None, path: str | Path = "agent",
        base: Base | None = None,
    ) -> Self:  # fmt: skip
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
            check_environment(contract, check_config(config), path)
            for what, own, other in (
                ("puller", contract.puller, config.puller.label),
                ("plant", contract.plant_hash, config.plant_hash),
            ):
                if own != other:
                    raise AgentFileError(f"{path}: trained for {what} {own}, this environment's is {other}")
        residual = _residual(path, contract, base)
        width = expected + (residual.width if residual else 0)
        policy = cls(contract, *_session(path, onnx_bytes, width), onnx_bytes, residual)
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
        if self.residual:
            added, state = self.residual.read(rows, state, episode_start)
            wanted, own = self._act(np.concatenate([added, rows], axis=1), state.network, episode_start)
            action, state = self.residual.act(wanted, state._replace(network=own))
            return tag(action[0] if array.ndim == 1 else action, self.made_for), state
        action, after = self._act(rows, state, episode_start)
        if array.ndim == 1:
            return action[0], after[0] if self.memory_length else after
        return action, after

    def _act(self, rows: Floats, state: Any, episode_start: Any) -> tuple[Floats, Any]:
        """The network's output and its next memory."""
        if not self.memory_length:
            return self._run({"observation": rows})[0], state
        before = np.zeros((len(rows), self.memory_length), np.float32)
        if state is not None:
            if np.size(state) != before.size:
                raise CzError(f"expected the state that predict returned, shape {before.shape}, not {np.shape(state)}")
            before += np.reshape(state, before.shape)
        if episode_start is not None:
            before[np.broadcast_to(np.asarray(episode_start, np.bool_), len(rows))] = 0.0
        action, after = self._run({"observation": rows, "state": before})
        return action, after

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


def _residual(path: str | Path, contract: Contract, base: Base | None) -> Residual | None:
    """The controller that the agent adds to; AgentFileError unless it is the one it was trained on."""
    if contract.controller == ALONE:
        return None
    if base is None:
        raise AgentFileError(
            f"{path}: adds to the controller {contract.controller}: cz-gym benchmark --agent runs both, "
            "cz_gym.tools.registry.load_agent loads both"
        )
    if base.label != contract.controller:
        raise AgentFileError(f"{path}: trained on the controller {contract.controller}, not on {base.label}")
    return Residual(base, contract.pull_limit, contract.heater_limit)


def _session(path: str | Path, onnx_bytes: bytes, channels: int) -> tuple[Any, int]:
    """Make the session that runs the graph; returns it and the length of the graph's state."""
    try:
        import onnxruntime

        clean, state = check_graph(onnx_bytes, channels)
    except ImportError:
        raise AgentFileError(f"running agents: {missing('onnx or onnxruntime', 'benchmark')}") from None
    except GraphError as error:
        raise AgentFileError(f"{path}: {error}") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(clean, options, providers=["CPUExecutionProvider"]), state
    except Exception:  # onnxruntime raises its own exception types, one for each way a file can be broken
        raise AgentFileError(f"{path}: not an ONNX model that onnxruntime can run") from None
