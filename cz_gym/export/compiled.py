"""A written C block as a library of this machine: compiled with the system's compiler, called through ctypes."""

from __future__ import annotations

import ctypes
import hashlib
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.errors import CzError

from .program import Floats, Program

FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
"""Options of the compiler."""


class CompiledBlock:
    """Runs n blocks of a compiled source, as :meth:`cz_gym.export.program.Program.run` does."""

    def __init__(self, program: Program, source: Path, single: bool = False, compiler: str = "cc") -> None:
        self.program, name = program, f"cz_{program.name}"
        if shutil.which(compiler) is None:
            raise CzError(f"no C compiler: {compiler!r} is not installed")
        digest = hashlib.sha256(source.read_bytes()).hexdigest()[:16]  # a library is loaded once for each name
        library = source.with_name(f"{source.stem}-{digest}.so")
        command = [compiler, *FLAGS, str(source), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise CzError(f"{source}: {compiler} says {done.stderr.strip()[:300]}")
        self.library = ctypes.CDLL(str(library))
        self._init, self._step = getattr(self.library, f"{name}_init"), getattr(self.library, f"{name}_step")
        real: Any = ctypes.c_float if single else ctypes.c_double
        kinds = [(cell, ctypes.c_double if cell.wide else real) for cell in program.memory]
        arrays = [(cell.name, kind * cell.start.size if cell.start.size > 1 else kind) for cell, kind in kinds]
        self.block = _structure([*((port.name, ctypes.c_double) for port in program.settings), *arrays])
        self.measured = _structure([(p.name, ctypes.c_int if p.logical else ctypes.c_double) for p in program.inputs])
        self.setpoints = _structure(
            [(port.name, ctypes.c_uint if port.name == "alarms" else real) for port, _ in program.outputs]
        )

    def begin(self, n: int) -> Any:
        """The memory of n blocks."""
        blocks = np.empty(n, object)
        for i in range(n):
            blocks[i] = self.block()
            self._init(ctypes.byref(blocks[i]))
        return blocks

    def run(self, inputs: Mapping[str, Any], memory: Any) -> tuple[dict[str, Floats], Any]:
        """The outputs, each of shape (n,), and the blocks, which are changed."""
        names = [port.name for port in self.program.inputs]
        columns = [np.broadcast_to(inputs[name], (len(memory),)).tolist() for name in names]
        changed = {name: value for name, value in inputs.items() if name not in names}
        outputs = np.zeros((len(memory), len(self.program.outputs)))
        for i, (block, row) in enumerate(zip(memory, zip(*columns, strict=True), strict=True)):
            for name, value in changed.items():
                setattr(block, name, value)
            measured, setpoints = self.measured(*map(_whole, self.program.inputs, row)), self.setpoints()
            self._step(ctypes.byref(block), ctypes.byref(measured), ctypes.byref(setpoints))
            outputs[i] = [getattr(setpoints, port.name) for port, _ in self.program.outputs]
        return {port.name: outputs[:, at] for at, (port, _) in enumerate(self.program.outputs)}, memory


def _structure(fields: list[tuple[str, Any]]) -> Any:
    return type("Fields", (ctypes.Structure,), {"_fields_": fields})


def _whole(port: Any, value: float) -> Any:
    return int(value > 0.5) if port.logical else value
