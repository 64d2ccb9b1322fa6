"""Files that a user may get from elsewhere are read or refused in one line, in bounded memory, however damaged.

``pytest tests/stress/test_fuzz.py --hypothesis-profile long`` is the long form.
"""

import io
import json
import os
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cz_gym.agents import AgentFileError, OnnxPolicy, shipped
from cz_gym.agents.contract import make_contract, read_agent
from cz_gym.agents.recipes import COLUMNS
from cz_gym.agents.train import load_checkpoint, read_rows, read_settings, restore, to_bytes

SPARE = 1_000_000_000
"""Memory beyond what is used already [bytes]."""
ODD = st.sampled_from(
    (b"", b"\0", b"\xff" * 8, b"\x80\x04.", b"../../../etc/passwd", b"NaN", b"1e999", b"-1", b"[" * 200, b'{"a":' * 50)
)
VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.lists(st.integers(), max_size=2),
    st.sampled_from((2**63 - 1, 10**400, "a\nb", "\x1b[31m", "x" * 200, "../x", "history", {}, [[]], "F64")),
)  # fmt: skip
EDITS = st.lists(
    st.tuples(st.floats(0.0, 1.0), st.none() | st.integers(0, 63), ODD | st.binary(max_size=64), st.integers(0, 8)),
    min_size=1,
    max_size=5,
)


class Target(NamedTuple):
    """A kind of file: an honest one, and its reader, which may only return or raise AgentFileError."""

    seed: bytes
    read: Callable[[bytes], Any]


@pytest.fixture(scope="module")
def known(ppo, tmp_path_factory):
    """Every kind of file that the project reads back; memory is bounded while they are read."""
    folder, contract, network = tmp_path_factory.mktemp("hostile"), *read_agent(shipped())
    facts = {name: value for name, value in vars(contract).items() if name not in ("observation_hash", "sha256")}
    (folder / "agent.onnx").write_bytes(network)
    progress = ",".join(COLUMNS) + "\r\n" + ",".join(["1.5"] * len(COLUMNS)) + "\r\n"
    run = {"algorithm": "ppo", "seed": 0, "settings": {}, "steps": 100, "sessions": [{"from_step": 0}]}
    settings = json.dumps(run)

    def kept(seed, name, read):
        return Target(seed, lambda content: ((folder / name).write_bytes(content), read(folder / name)))

    def restored(path):
        restore(ppo, load_checkpoint(path), path)

    targets = {
        "agent.onnx": Target(network, lambda content: OnnxPolicy.of(make_contract(content, **facts), content)),
        "agent.json": kept(
            shipped().with_suffix(".json").read_bytes(), "agent.json", lambda _: read_agent(folder / "agent.onnx")
        ),
        "checkpoint": kept(to_bytes(ppo, 1.0, 0.5), "ppo.zip", restored),
        "settings.json": kept(settings.encode(), "settings.json", read_settings),
        "progress.csv": kept(progress.encode(), "progress.csv", read_rows),
    }
    assert targets.keys() == MUTANTS.keys()
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + SPARE, limits[1]))
    yield targets
    resource.setrlimit(resource.RLIMIT_AS, limits)


def refused(read, content):
    """Whether a file is refused with one line; anything else that is raised passes."""
    try:
        read(content)
    except AgentFileError as error:
        said = str(error)
    else:
        return False
    assert "\n" not in said
    return len(said) < 1000 or pytest.fail(said)


@st.composite
def odd_bytes(draw, seed):
    """Parts removed, overwritten, repeated and cut; most often at the start, which says what the rest means."""
    content = bytearray(seed)
    for where, size, new, times in draw(EDITS):
        at = int(len(content) * where**2)
        if size is None:
            content[at : at + len(new)] = new
        else:
            content[at : at + size] = new + content[at : at + size] * times
    return bytes(content[: draw(st.none() | st.integers(0, len(content)))])


@st.composite
def odd_json(draw, seed):
    """Members removed, added and replaced, at the top or one level below."""
    data = json.loads(seed)
    for _ in range(draw(st.integers(1, 3))):
        part = draw(st.sampled_from([data, *(each for each in data.values() if isinstance(each, dict) and each)]))
        name = draw(st.sampled_from([*part, "surprise"]))
        part[name] = draw(VALUES)
        if draw(st.integers(0, 4)) == 0:
            del part[name]
    return json.dumps(data).encode()


@st.composite
def odd_checkpoint(draw, seed):
    """A checkpoint with odd members, or of which one part is damaged, with the right check sum."""
    content = torch.load(io.BytesIO(seed), weights_only=True)
    if draw(st.booleans()):
        for _ in range(draw(st.integers(1, 3))):
            part = draw(
                st.sampled_from([content, *(each for each in content.values() if isinstance(each, dict) and each)])
            )
            part[draw(st.sampled_from([*part, "surprise"]))] = draw(VALUES)
        torch.save(content, file := io.BytesIO())
        return file.getvalue()
    with zipfile.ZipFile(io.BytesIO(seed)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = draw(st.sampled_from(sorted(members)))
    members[name] = draw(odd_bytes(members[name]))
    with zipfile.ZipFile(file := io.BytesIO(), "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return file.getvalue()


MUTANTS = {
    "agent.onnx": odd_bytes, "agent.json": odd_json, "checkpoint": odd_checkpoint, "settings.json": odd_json,
    "progress.csv": odd_bytes,
}  # fmt: skip


@pytest.mark.parametrize("kind", MUTANTS)
@given(data=st.data())
def test_damaged_files_are_read_or_refused(known, kind, data):
    seed, read = known[kind]
    assert not refused(read, seed)
    for content in data.draw(st.tuples(MUTANTS[kind](seed), odd_bytes(seed), st.binary(max_size=300))):
        refused(read, content)


def test_pipes_devices_and_folders_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.onnx")
    for path in (tmp_path / "pipe.onnx", Path("/dev/zero"), tmp_path, Path("a\0b.onnx"), Path("")):
        with pytest.raises(AgentFileError, match=r"regular file|cannot be read|null|not an .onnx agent file"):
            OnnxPolicy.load(path)
