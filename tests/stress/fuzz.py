"""Every kind of file that is read back, damaged at random: ``python -m tests.stress.fuzz --files 100000``.

Whatever a stranger or a failing disk leaves is read, or refused in one line. The command runs in bounded memory, and
leaves a file that breaks its reader in ``hostile.bin``.
"""

import argparse
import io
import json
import resource
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cz_gym.agents import AgentFileError, OnnxPolicy, shipped
from cz_gym.agents.agent_file.contract import make_contract, read_agent
from cz_gym.agents.agent_file.graph import OPERATORS
from cz_gym.agents.training.checkpoint import load_checkpoint, restore, to_bytes
from cz_gym.agents.training.learners import make_learner
from cz_gym.agents.training.recipes import PPO, SAC
from cz_gym.agents.training.run_files import COLUMNS, read_rows, read_settings
from cz_gym.baselines.registry import make_controller
from cz_gym.evaluation.cache import read_episode
from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.rollout import Signals
from cz_gym.jit.cache import Store

SPARE = 1_000_000_000
"""Memory beyond what importing takes [bytes]."""
SMALL = PPO(num_envs=2, hidden=(8,), steps=16, n_steps=4, batch_size=8, n_epochs=1)
SMALL_SAC = SAC(
    num_envs=2, hidden=(8,), steps=16, buffer_size=32, learning_starts=8, batch_size=4, gradient_steps=1
)  # fmt: skip
ODD = (
    b"", b"\0", b"\xff" * 8, b"\x80\x04.", b"../../../etc/passwd", b"NaN", b"1e999", b"-1", b"[" * 200, b'{"a":' * 50,
)  # fmt: skip
VALUES = (
    0, 1, -1, 2**31, 2**63 - 1, -(2**63), 10**400, 1.5, float("nan"), float("inf"), None, True, "", "a\nb", "\x1b[31m",
    "x" * 200, "../x", "randomized", "history", [], {}, [[]], {"a": 1}, [2**40, 2**40], [0, 4], "F64", "I64", "{}",
)  # fmt: skip


class Target(NamedTuple):
    """A kind of file: an honest one, and its reader, which may only return or raise AgentFileError."""

    seed: bytes
    read: Callable[[bytes], Any]


def targets(folder: Path) -> dict[str, Target]:
    """Every kind of file that the project reads back."""
    contract, network = read_agent(shipped())
    facts = {name: value for name, value in vars(contract).items() if name not in ("observation_hash", "sha256")}
    agent, checkpoint = folder / "agent.onnx", folder / "checkpoint.safetensors"
    agent.write_bytes(network)
    facts_file = shipped().with_suffix(".json")
    ppo, sac = (make_learner(recipe, 0, make_controller) for recipe in (SMALL, SMALL_SAC))
    for learner in (ppo, sac):
        learner.learn(lambda steps, doing: None)
    store = Store(folder, "kernel")
    store.save("key", {"code": b"x" * 100})

    def reader(path: Path, read: Callable[[Path], Any]) -> Callable[[bytes], Any]:
        return lambda content: (path.write_bytes(content), read(path))

    def read_code(path: Path) -> None:
        assert store.load("key") in (None, {"code": b"x" * 100})

    def restored(learner: Any) -> Callable[[Path], None]:
        return lambda path: restore(learner, load_checkpoint(path)[1], path)

    return {
        "agent.onnx": Target(network, lambda content: OnnxPolicy.of(make_contract(content, **facts), content)),
        "agent.json": Target(facts_file.read_bytes(), reader(folder / "agent.json", lambda _: read_agent(agent))),
        "checkpoint": Target(to_bytes(ppo, 1.0, 0.5), reader(checkpoint, restored(ppo))),
        "sac checkpoint": Target(to_bytes(sac, 1.0, 0.5), reader(checkpoint, restored(sac))),
        "settings.json": Target(
            json.dumps({"steps": 100, "sessions": [{"from_step": 0}]}).encode(),
            reader(folder / "settings.json", read_settings),
        ),
        "progress.csv": Target(_csv().encode(), reader(folder / "progress.csv", read_rows)),
        "cached episode": Target(_episode(), reader(folder / "0.npz", lambda path: read_episode(path, True))),
        "compiled code": Target(store.path("key").read_bytes(), reader(store.path("key"), read_code)),
    }


def _csv() -> str:
    return ",".join(COLUMNS) + "\r\n" + ",".join(["1.5"] * len(COLUMNS)) + "\r\n"


def _episode() -> bytes:
    file = io.BytesIO()
    signals = np.zeros((len(Signals._fields), 4))
    np.savez_compressed(file, values=np.zeros(len(metric_names())), microseconds=1.0, signals=signals)
    return file.getvalue()


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
    """A damaged or hostile form of an honest file: half of the time of what it holds, else of its bytes."""
    change = {
        "agent.onnx": _odd_graph,
        "agent.json": _odd_json,
        "settings.json": _odd_json,
        "checkpoint": _odd_header,
        "sac checkpoint": _odd_header,
        "cached episode": _odd_archive,
    }.get(kind, _odd_bytes)
    return (change if rng.random() < 0.5 else _odd_bytes)(seed, rng)


def _pick(values: Any, rng: np.random.Generator) -> Any:
    return values[int(rng.integers(0, len(values)))]


def _odd_bytes(seed: bytes, rng: np.random.Generator) -> bytes:
    """Cut, flipped, overwritten, repeated; most often at the start, which says what the rest means."""
    content = bytearray(seed)
    for _ in range(int(rng.integers(1, 6))):
        at, size = int(rng.integers(0, max(len(content), 1)) * rng.random() ** 2), int(rng.integers(0, 64))
        old = bytes(content[at : at + size])
        flipped = bytes([old[0] ^ 1 << int(rng.integers(0, 8))]) + old[1:] if old else b""
        repeated, mixed = old * int(rng.integers(1, 9)), _pick(ODD, rng) + old
        content[at : at + size] = _pick((b"", flipped, rng.bytes(size), mixed, repeated), rng)
        if rng.random() < 0.15:
            del content[at:]
    return bytes(content)


def _odd_json(seed: bytes, rng: np.random.Generator) -> bytes:
    """Members removed, added and replaced, at the top or one level below."""
    data = json.loads(seed)
    for _ in range(int(rng.integers(1, 4))):
        below = [part for part in data.values() if isinstance(part, dict) and part]
        part = _pick(below, rng) if below and rng.random() < 0.8 else data
        name = _pick([*part, "surprise"], rng)
        if rng.random() < 0.2:
            part.pop(name, None)
        else:
            part[name] = _pick(VALUES, rng)
    return json.dumps(data).encode()


def _odd_header(seed: bytes, rng: np.random.Generator) -> bytes:
    """A checkpoint whose list of tensors says something else than it holds."""
    size = int.from_bytes(seed[:8], "little")
    text = _odd_json(seed[8 : 8 + size], rng)
    return _pick((len(text), size, 2**62), rng).to_bytes(8, "little") + text + seed[8 + size :]


def _odd_archive(seed: bytes, rng: np.random.Generator) -> bytes:
    """A cached episode whose parts unpack to far more than the file, or claim shapes they do not have."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("values", "microseconds", "signals"):
            shape = _pick(("()", "(15,)", "(13, 4)", "(99999999999,)", "(-1,)", "(1000000, 1000000)"), rng)
            kind = _pick(("<f8", "|O", "<f4", "<U9", "<c16"), rng)
            header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
            magic = b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little")
            archive.writestr(f"{name}.npy", magic + header.encode() + b"\0" * _pick((0, 8, 120, 10_000_000), rng))
    return file.getvalue()


def _odd_graph(seed: bytes, rng: np.random.Generator) -> bytes:
    """A sound file of an unsound graph: nodes, attributes, shapes and types changed at random."""
    import onnx

    model = onnx.load_from_string(seed)
    nodes, tensors = model.graph.node, model.graph.initializer
    for _ in range(int(rng.integers(1, 5))):
        node, tensor = _pick(nodes, rng), _pick(tensors, rng)
        change = int(rng.integers(0, 9))
        if change == 0:
            node.op_type = _pick((*OPERATORS, "Loop", "If", "Scan", "Expand", "Tile", "ConstantOfShape", "Einsum"), rng)
        elif change == 1 and len(node.input):
            names = [name for other in nodes for name in (*other.input, *other.output)]
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
            tensor.data_location = onnx.TensorProto.EXTERNAL
            tensor.external_data.add(key="location", value="../../etc/passwd")
        elif change == 7:
            nodes.append(node)
        else:
            model.opset_import[0].version = int(_pick((0, 1, 9, 13, 18, 21, 99, -1), rng))
    content: bytes = model.SerializeToString()
    return content


def main() -> int:
    """Fuzz; raises at the first file that is neither read nor refused in one line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=20_000, help="of each kind (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        known = targets(Path(folder))
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + SPARE, used + SPARE))
        for kind, target in known.items():
            rng, count = np.random.default_rng([arguments.seed, len(kind), target.seed[0]]), 0
            for _ in range(arguments.files):
                content = mutant(kind, target.seed, rng)
                try:
                    count += refused(target.read, content)
                except BaseException:
                    Path("hostile.bin").write_bytes(content)
                    print(f"{kind}: a file that breaks its reader is in hostile.bin", file=sys.stderr)
                    raise
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
            print(f"{kind}: {arguments.files} files, {count} refused, memory {memory} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
