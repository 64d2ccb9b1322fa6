"""Damaged and hostile files are read or refused in one line; ``python -m tests.stress.fuzz`` is the long form."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cz_gym.agents import AgentFileError, OnnxPolicy
from tests.stress.fuzz import Target, mutant, refused, targets

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
@given(seed=st.integers(0, 2**32 - 1), garbage=st.binary(max_size=300))
def test_damaged_files_are_read_or_refused(known: dict[str, Target], kind: str, seed: int, garbage: bytes) -> None:
    target, rng = known[kind], np.random.default_rng(seed)
    for content in (*(mutant(kind, target.seed, rng) for _ in range(3)), garbage):
        refused(target.read, content)


@pytest.mark.parametrize("kind", KINDS)
def test_files_cut_short_anywhere_are_read_or_refused(known: dict[str, Target], kind: str) -> None:
    target = known[kind]
    for end in np.linspace(0, len(target.seed) - 1, 60).astype(int):
        refused(target.read, target.seed[:end])


def test_pipes_devices_and_folders_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.onnx")
    for path in (tmp_path / "pipe.onnx", Path("/dev/zero"), tmp_path, Path("a\0b.onnx"), Path("")):
        with pytest.raises(AgentFileError, match=r"regular file|cannot be read|null"):
            OnnxPolicy.load(path)
