"""What a virtual puller leaves on the disk, whole however its process ends: the log, and the state it goes on from."""

import io
import json
import math
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Identity
from cz_gym.engine.batch import SlotState
from cz_gym.env import EnvState
from cz_gym.errors import CzError
from cz_gym.machine.identify.table import COLUMNS
from cz_gym.support.atomic_files import check_writable, naming, write_files

SYNC = 0.5
"""Time after which a log waits for the disk, which takes longer than a step [s]."""


class LogFile:
    """A CSV log, up to the last second if the power fails.

    The file is made with the first row. Once it has ``largest`` bytes, rows go on in a file of the next number:
    ``log.csv``, ``log-2.csv``.
    """

    def __init__(self, path: str | Path, largest: float = math.inf) -> None:
        self.path, self.largest = Path(path), largest
        self._part, self._size, self._synced, self._file = 1, 0, 0.0, -1

    def begin(self, resumed_at: float | None) -> None:
        """Check that rows can be written; a crystal that was resumed at a time [s] loses the rows of later times.

        CzError if the log of another crystal exists.
        """
        check_writable(self.path.absolute().parent)
        if resumed_at is None:
            for path in filter(Path.exists, map(self._name, (1, 2))):
                raise CzError(f"{path}: File exists")
            return
        while self._name(self._part + 1).exists():
            self._part += 1
        if (path := self._name(self._part)).exists():
            with naming(path):
                head, *rows = path.read_text("utf-8").splitlines(keepends=True)
            before = [row for row in rows if float(row.split(",")[0]) <= resumed_at]
            write_files({path: "".join([head, *before]).encode()})
            self._open(os.O_APPEND)

    def add(self, *rows: Mapping[str, Any]) -> None:
        """Write rows, each whole, and wait for the disk unless that was done within the last second."""
        if self._file < 0:
            self._open(os.O_APPEND | os.O_CREAT | os.O_EXCL)
            self._write(",".join(COLUMNS))
        for row in rows:
            self._write(",".join(f"{float(row[name]):.10g}" for name in COLUMNS))
        full = self._size >= self.largest
        if full or time.monotonic() >= self._synced + SYNC:
            os.fsync(self._file)
            self._synced = time.monotonic()
        if full:
            os.close(self._file)
            self._file, self._part = -1, self._part + 1

    def _name(self, part: int) -> Path:
        return self.path if part == 1 else self.path.with_stem(f"{self.path.stem}-{part}")

    def _open(self, flags: int) -> None:
        with naming(path := self._name(self._part)):
            self._file = os.open(path, os.O_WRONLY | flags, 0o644)
            self._size = os.fstat(self._file).st_size

    def _write(self, line: str) -> None:
        self._size += os.write(self._file, f"{line}\n".encode())


class State(NamedTuple):
    """A crystal and what its machine knows of it."""

    env: EnvState
    memory: npt.NDArray[np.float64]
    """Numbers of the fallback's memory, one after the other."""
    attributes: dict[str, Any]
    """Attributes of the machine."""
    tags: dict[str, Any]
    """The newest tags."""


class StateFile:
    """The file of the newest state, from which a server that was killed goes on: NumPy arrays and JSON, no code."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def load(self) -> State | None:
        """The state, or None if there is no file yet; CzError for a file of something else."""
        check_writable(self.path.absolute().parent)
        if not self.path.exists():
            return None
        with naming(self.path):
            content = self.path.read_bytes()
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as file:
                arrays = dict(file)
            facts, memory = json.loads(arrays.pop("facts").item()), arrays.pop("memory")
            identity: Any = (tuple(each) if isinstance(each, list) else each for each in facts["identity"])
            slot = SlotState(Identity(*identity), scenario=facts["scenario"], **arrays)
            return State(EnvState(slot, facts["random"]), memory, facts["attributes"], facts["tags"])
        except Exception:  # a damaged file can raise anything
            raise CzError(f"{self.path}: no state of a virtual puller, or one of another version") from None

    def save(self, state: State) -> None:
        """Replace the file at once, without waiting for the disk."""
        arrays = dict(vars(state.env.slot))
        facts = {name: arrays.pop(name) for name in ("identity", "scenario")} | {"random": state.env.random}
        facts |= {"attributes": state.attributes, "tags": state.tags}
        new = self.path.with_name(f".{self.path.name}.new")
        with open(new, "wb") as file:
            np.savez(file, facts=np.array(json.dumps(facts)), memory=state.memory, **arrays)
        os.replace(new, self.path)
