"""A block's C as a library of this machine: compiled with the system's compiler, called through ctypes."""

import ctypes
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from cz_gym.errors import CzError

from .ports import INPUTS
from .program import Program
from .shell import Block
from .text import write_c
from .trace import Floats
from .writer import StatementWriter

FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
"""Options of the compiler."""


def memory_of(program: Program, single: bool = False) -> tuple[np.dtype[Any], int]:
    """The structure of a block in C, and the most stack [byte] that a call needs."""
    real = "f4" if single else "f8"
    work, kinds = StatementWriter(program, "c", single).work, {"b": "u1", "d": "f8", "w": real}
    arrays = [(name, kinds[kind], size) for name, (size, kind) in work.items() if size > 1]
    room: Any = ("work", np.dtype([("unused", "u1"), *arrays], align=True))
    cells: Any = [(cell.name, "f8" if cell.wide else real, cell.start.shape) for cell in program.memory]
    settings = [(port.name, "f8") for port in program.settings]
    return np.dtype([*settings, *cells, room], align=True), 2048 + 16 * len(work)


class CompiledBlock:
    """Runs n blocks of compiled C, as :class:`.shell.Block` does; CzError if there is no compiler."""

    def __init__(self, block: Block, single: bool = False) -> None:
        program, name = block.program, f"cz_{block.name}"
        if shutil.which("cc") is None:
            raise CzError("no C compiler: 'cc' is not installed")
        with TemporaryDirectory() as folder:
            for file, text in write_c(program, single).items():
                (Path(folder) / file).write_text(text)
            command = ["cc", *FLAGS, f"{name}.c", "-o", f"{name}.so", "-lm"]
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            if done.returncode:
                raise CzError(f"{name}.c: cc says {done.stderr.strip()[:300]}")
            library = ctypes.CDLL(f"{folder}/{name}.so")
        self._init, self._step = getattr(library, f"{name}_init"), getattr(library, f"{name}_step")
        self._init.argtypes, self._step.argtypes = [ctypes.c_void_p], [ctypes.c_void_p] * 3
        self.settings, real = {port.name for port in program.settings}, "f4" if single else "f8"
        self.memory, _ = memory_of(program, single)
        self.measured = np.dtype([(port.name, "i4" if port.logical else "f8") for port in INPUTS], align=True)
        shown = [(port.name, "u4" if port.name == "alarms" else real) for port, _ in program.outputs]
        self.setpoints = np.dtype(shown, align=True)

    def start(self, n: int) -> Any:
        """The memory of n blocks before their first sample, a structured array of shape (n,)."""
        memory = np.zeros(1, self.memory)
        self._init(memory.ctypes.data)
        return memory.repeat(n)

    def run(self, inputs: Mapping[str, Any], memory: Any) -> tuple[dict[str, Floats], Any]:
        """The outputs, each of shape (n,), and the next memory; settings that are given stay."""
        memory, measured = memory.copy(), np.zeros(len(memory), self.measured)
        setpoints = np.zeros(len(memory), self.setpoints)
        for port in INPUTS:
            value = np.asarray(inputs.get(port.name, port.default))
            measured[port.name] = value > 0.5 if port.logical else value
        for name in self.settings & inputs.keys():
            memory[name] = inputs[name]
        places = [(array.ctypes.data, array.itemsize) for array in (memory, measured, setpoints)]
        for i in range(len(memory)):
            self._step(*(start + i * size for start, size in places))
        return {name: setpoints[name].astype(np.float64) for name in setpoints.dtype.names or ()}, memory
