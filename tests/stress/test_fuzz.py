"""Damaged and hostile files are read or refused in one line; ``python -m tests.stress.fuzz`` is the long form."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cz_gym.agents import AgentFileError, OnnxPolicy
from cz_gym.agents.agent_file.contract import MAX_BYTES, read_agent, read_bounded
from tests.stress.hostile_files import Target, mutant, refused, targets

KINDS = (
    "agent.onnx", "agent.json", "checkpoint", "sac checkpoint", "settings.json", "progress.csv", "cached episode",
    "compiled code",
)  # fmt: skip


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return targets(tmp_path_factory.mktemp("hostile"))


def test_every_kind_is_read_when_it_is_whole(known: dict[str, Target]) -> None:
    assert tuple(known) == KINDS
    for target in known.values():
        assert not refused(target.read, target.seed)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 2**32 - 1))
def test_damaged_files_are_read_or_refused(known: dict[str, Target], kind: str, seed: int) -> None:
    target, rng = known[kind], np.random.default_rng(seed)
    for _ in range(3):
        refused(target.read, mutant(kind, target.seed, rng))


@pytest.mark.parametrize("kind", KINDS)
@given(content=st.binary(max_size=300))
def test_garbage_is_read_or_refused(known: dict[str, Target], kind: str, content: bytes) -> None:
    refused(known[kind].read, content)


@pytest.mark.parametrize("kind", KINDS)
def test_files_cut_short_anywhere_are_read_or_refused(known: dict[str, Target], kind: str) -> None:
    target = known[kind]
    for end in np.linspace(0, len(target.seed) - 1, 60).astype(int):
        refused(target.read, target.seed[:end])


def test_pipes_devices_and_folders_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.onnx")
    began = time.monotonic()
    for path in (tmp_path / "pipe.onnx", Path("/dev/zero"), tmp_path, Path("a\0b.onnx"), Path("")):
        with pytest.raises(AgentFileError, match=r"regular file|cannot be read|null"):
            OnnxPolicy.load(path)
    assert time.monotonic() - began < 1.0


def test_a_file_larger_than_the_limit_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.onnx"
    with path.open("wb") as file:
        file.truncate(10**12)
    with pytest.raises(AgentFileError, match=f"larger than {MAX_BYTES} bytes"):
        read_agent(path)
    assert len(read_bounded(Path(__file__), 10**6)) > 0
