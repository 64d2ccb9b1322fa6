"""Files as a stranger or a failing disk may leave them, and who reads them: for ``tests.stress.fuzz`` and its tests."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.agents import AgentFileError, OnnxPolicy, shipped
from cz_gym.agents.agent_file.contract import make_contract, read_agent
from cz_gym.agents.agent_file.graph import OPERATORS
from cz_gym.agents.training.checkpoint import load_checkpoint, restore, to_bytes
from cz_gym.agents.training.learners import make_learner
from cz_gym.agents.training.recipes import PPO, SAC
from cz_gym.agents.training.run_files import COLUMNS, read_rows, saved_steps
from cz_gym.baselines.registry import make_controller
from cz_gym.evaluation.cache import slow_controllers as kept
from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.rollout import Signals
from cz_gym.jit.cache import Store

SMALL = PPO(num_envs=2, hidden=(8,), steps=16, n_steps=4, batch_size=8, n_epochs=1)
SMALL_SAC = SAC(
    num_envs=2, hidden=(8,), steps=16, buffer_size=32, learning_starts=8, batch_size=4, gradient_steps=1
)  # fmt: skip
ODD = (
    b"",
    b"\0",
    b"\xff" * 8,
    b"\x80\x04.",
    b"../../../etc/passwd",
    b"NaN",
    b"1e999",
    b"-1",
    b"[" * 200,
    b'{"a":' * 50,
)
NUMBERS = (0, 1, -1, 2**31, 2**63 - 1, -(2**63), 10**400, 1.5, float("nan"), float("inf"))
WORDS = (None, True, "", "a\nb", "\x1b[31m", "x" * 200, "../x", "randomized", "history", [], {}, [[]], {"a": 1})


class Target(NamedTuple):
    """A kind of file: an honest one, and its reader, which may only return or raise AgentFileError."""

    seed: bytes
    read: Callable[[bytes], Any]


def targets(folder: Path) -> dict[str, Target]:
    """Every kind of file that the project reads back."""
    contract, network = read_agent(shipped())
    facts = {name: value for name, value in vars(contract).items() if name not in ("observation_hash", "sha256")}
    learner, off_policy = (make_learner(recipe, 0, make_controller) for recipe in (SMALL, SMALL_SAC))
    for some in (learner, off_policy):
        some.learn(lambda steps, doing: None)
    agent, checkpoint = folder / "agent.onnx", folder / "checkpoint.safetensors"
    sessions = {"steps": 100, "sessions": [{"from_step": 0}]}
    rows = ",".join(COLUMNS) + "\r\n" + ",".join(["1.5"] * len(COLUMNS)) + "\r\n"
    episode = io.BytesIO()
    signals = np.zeros((len(Signals._fields), 4))
    np.savez_compressed(episode, values=np.zeros(len(metric_names())), microseconds=1.0, signals=signals)
    store = Store(folder, "kernel")
    store.save("key", {"code": b"x" * 100})

    def read_network(content: bytes) -> None:
        OnnxPolicy.of(make_contract(content, **facts), content)

    def read_contract(content: bytes) -> None:
        agent.write_bytes(network)
        agent.with_suffix(".json").write_bytes(content)
        read_agent(agent)

    def read_checkpoint(content: bytes, into: Any = learner) -> None:
        checkpoint.write_bytes(content)
        restore(into, load_checkpoint(checkpoint)[1], checkpoint)

    def read_settings(content: bytes) -> None:
        (folder / "settings.json").write_bytes(content)
        saved_steps(folder)

    def read_progress(content: bytes) -> None:
        (folder / "progress.csv").write_bytes(content)
        read_rows(folder / "progress.csv")

    def read_episode(content: bytes) -> None:
        (folder / "0.npz").write_bytes(content)
        kept.read(folder / "0.npz", True)

    def read_code(content: bytes) -> None:
        store.path("key").write_bytes(content)
        assert store.load("key") in (None, {"code": b"x" * 100})

    return {
        "agent.onnx": Target(network, read_network),
        "agent.json": Target(shipped().with_suffix(".json").read_bytes(), read_contract),
        "checkpoint": Target(to_bytes(learner, 1.0, 0.5), read_checkpoint),
        "sac checkpoint": Target(to_bytes(off_policy, 1.0, 0.5), partial(read_checkpoint, into=off_policy)),
        "settings.json": Target(json.dumps(sessions).encode(), read_settings),
        "progress.csv": Target(rows.encode(), read_progress),
        "kept episode": Target(episode.getvalue(), read_episode),
        "compiled code": Target(store.path("key").read_bytes(), read_code),
    }


def refused(read: Callable[[bytes], Any], content: bytes) -> bool:
    """Whether a file is refused with one line; anything else that is raised passes."""
    try:
        read(content)
    except AgentFileError as error:
        message = str(error)
    else:
        return False
    if "\n" in message or len(message) > 1000:
        raise RuntimeError(f"not one line: {message!r}")
    return True


def mutant(kind: str, seed: bytes, rng: np.random.Generator) -> bytes:
    """A damaged or hostile form of an honest file."""
    if kind.endswith(".json") and rng.random() < 0.7:
        return _odd_json(json.loads(seed), rng)
    if kind == "agent.onnx" and rng.random() < 0.5:
        return _odd_graph(seed, rng)
    if kind.endswith("checkpoint") and rng.random() < 0.5:
        return _odd_header(seed, rng)
    if kind == "kept episode" and rng.random() < 0.3:
        return _odd_archive(rng)
    return _odd_bytes(seed, rng)


def _odd_bytes(seed: bytes, rng: np.random.Generator) -> bytes:
    content = bytearray(seed)
    for _ in range(int(rng.integers(1, 6))):
        # The first bytes say what the rest means: they are changed more often.
        at = int(rng.integers(0, max(len(content), 1)) * rng.random() ** 2)
        size = int(rng.integers(0, 64))
        change = int(rng.integers(0, 6))
        if change == 0:
            content[at:] = b""
        elif change == 1 and content:
            content[min(at, len(content) - 1)] ^= 1 << int(rng.integers(0, 8))
        elif change == 2:
            content[at : at + size] = rng.bytes(size)
        elif change == 3:
            content[at:at] = ODD[int(rng.integers(0, len(ODD)))]
        elif change == 4:
            content[at:at] = content[at : at + size] * int(rng.integers(1, 9))
        else:
            del content[at : at + size]
    return bytes(content)


def _pick(values: Any, rng: np.random.Generator) -> Any:
    return values[int(rng.integers(0, len(values)))]


def _odd_json(data: Any, rng: np.random.Generator) -> bytes:
    for _ in range(int(rng.integers(1, 4))):
        name = _pick([*data, "surprise"], rng)
        if rng.random() < 0.2:
            data.pop(name, None)
        else:
            data[name] = _pick(NUMBERS + WORDS, rng)
    return json.dumps(data).encode()


def _odd_header(seed: bytes, rng: np.random.Generator) -> bytes:
    """A checkpoint whose list of tensors says something else than it holds."""
    size = int.from_bytes(seed[:8], "little")
    header = json.loads(seed[8 : 8 + size])
    for _ in range(int(rng.integers(1, 4))):
        part = header[_pick([*header], rng)]
        part[_pick([*part], rng)] = _pick((*NUMBERS, *WORDS, [2**40, 2**40], [0, 4], "F64", "I64", "BOOL", "{}"), rng)
    text = json.dumps(header).encode()
    return _pick((len(text), size, 2**62), rng).to_bytes(8, "little") + text + seed[8 + size :]


def _odd_archive(rng: np.random.Generator) -> bytes:
    """A kept episode whose parts unpack to far more than the file, or claim shapes they do not have."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("values", "microseconds", "signals"):
            shape = _pick(("()", "(15,)", "(13, 4)", "(99999999999,)", "(-1,)", "(1000000, 1000000)"), rng)
            kind = _pick(("<f8", "|O", "<f4", "<U9", "<c16"), rng)
            header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
            body = b"\0" * _pick((0, 8, 120, 10_000_000), rng)
            archive.writestr(
                f"{name}.npy", b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header.encode() + body
            )
    return file.getvalue()


def _odd_graph(seed: bytes, rng: np.random.Generator) -> bytes:
    """A sound file of an unsound graph: nodes, attributes, shapes and types changed at random."""
    import onnx

    model = onnx.load_from_string(seed)
    graph = model.graph
    for _ in range(int(rng.integers(1, 5))):
        node, tensor = _pick(graph.node, rng), _pick(graph.initializer, rng)
        names = [name for other in graph.node for name in (*other.input, *other.output)]
        change = int(rng.integers(0, 9))
        if change == 0:
            node.op_type = _pick((*OPERATORS, "Loop", "If", "Scan", "Expand", "Tile", "ConstantOfShape", "Einsum"), rng)
        elif change == 1 and len(node.input):
            node.input[int(rng.integers(0, len(node.input)))] = _pick(names, rng)
        elif change == 2:
            node.attribute.append(onnx.helper.make_attribute(_pick(("axis", "transA", "alpha", "to"), rng), 1))
        elif change == 3:
            tensor.dims[:] = [int(_pick((0, 1, 2, 72, 2**20, 2**40, -1), rng)) for _ in range(int(rng.integers(0, 5)))]
        elif change == 4:
            tensor.data_type = int(rng.integers(0, 24))
        elif change == 5:
            tensor.raw_data = rng.bytes(int(rng.integers(0, 600)))
        elif change == 6:
            tensor.data_location = 1
            entry = tensor.external_data.add()
            entry.key, entry.value = "location", "../../etc/passwd"
        elif change == 7:
            graph.node.append(node)
        else:
            model.opset_import[0].version = int(_pick((0, 1, 9, 13, 18, 21, 99, -1), rng))
    content: bytes = model.SerializeToString()
    return content
