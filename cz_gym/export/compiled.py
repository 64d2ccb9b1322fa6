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
        self._init.argtypes, self._step.argtypes = [ctypes.c_void_p], [ctypes.c_void_p] * 3
        real = "f4" if single else "f8"
        cells = [(cell.name, "f8" if cell.wide else real, cell.start.shape) for cell in program.memory]
        self.block = np.dtype([*((port.name, "f8") for port in program.settings), *cells], align=True)
        self.measured = np.dtype([(port.name, "i4" if port.logical else "f8") for port in program.inputs], align=True)
        kinds = [(port.name, "u4" if port.name == "alarms" else real) for port, _ in program.outputs]
        self.setpoints = np.dtype(kinds, align=True)

    def begin(self, n: int) -> Any:
        """The memory of n blocks, a structured array of shape (n,)."""
        blocks = np.zeros(n, self.block)
        for i in range(n):
            self._init(blocks.ctypes.data + i * self.block.itemsize)
        return blocks

    def run(self, inputs: Mapping[str, Any], memory: Any) -> tuple[dict[str, Floats], Any]:
        """The outputs, each of shape (n,), and the blocks, which are changed."""
        measured, setpoints = np.zeros(len(memory), self.measured), np.zeros(len(memory), self.setpoints)
        for port in self.program.inputs:
            value = np.asarray(inputs[port.name])
            measured[port.name] = value > 0.5 if port.logical else value
        for port in self.program.settings:
            memory[port.name] = inputs.get(port.name, memory[port.name])
        places = [(array.ctypes.data, array.itemsize) for array in (memory, measured, setpoints)]
        for i in range(len(memory)):
            self._step(*(start + i * size for start, size in places))
        return {name: setpoints[name].astype(np.float64) for name in self.setpoints.names or ()}, memory
