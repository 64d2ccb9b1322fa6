"""A recorded controller: its inputs, memory and outputs; and the NumPy interpreter that runs it.

This is the one description from which C and structured text are written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .trace import BAD, FINITE, FUNCTIONS, Graph, Ids, Node

Floats = npt.NDArray[np.float64]


WIDE = ("last_time_s",)
"""Memory that needs double precision also where the controller computes in single precision."""


class Port(NamedTuple):
    """One input, setting or output of the block."""

    name: str
    """The quantity and its unit."""
    meaning: str
    default: float = 0.0
    """Value of a setting; for an input, a sensible constant."""
    logical: bool = False


class Cell(NamedTuple):
    """One array that a program remembers from sample to sample."""

    name: str
    start: Floats
    """Values before the first sample, flat."""
    after: Ids
    """Elements that it holds after a sample."""
    wide: bool = False
    """Whether it needs double precision."""


@dataclass(frozen=True)
class Program:
    """What a controller computes at a sample."""

    name: str
    graph: Graph
    settings: tuple[Port, ...]
    inputs: tuple[Port, ...]
    outputs: tuple[tuple[Port, Ids], ...]
    memory: tuple[Cell, ...]
    due: Ids
    """Whether the memory changes at this call, one logical element."""
    needs_double: bool = False
    """Whether single precision loses too much."""
    notes: tuple[str, ...] = ()
    """Facts for the header of each written file: puller, hashes, scenario."""

    @property
    def width(self) -> int:
        """Length of the memory."""
        return sum(cell.start.size for cell in self.memory)

    @property
    def start(self) -> Floats:
        """The memory before the first sample."""
        return np.concatenate([cell.start for cell in self.memory])

    @cached_property
    def nodes(self) -> tuple[Node, ...]:
        """The nodes that outputs or memory depend on, in order; without constants."""
        wanted: set[int] = set()
        reached = [self.due, *(ids for _, ids in self.outputs), *(cell.after for cell in self.memory)]
        while reached:
            ids = reached.pop()
            for at in set((np.searchsorted(self.graph.starts, ids, side="right") - 1).tolist()) - wanted:
                wanted.add(at)
                reached.extend(self.graph.nodes[at].args)
        return tuple(node for at, node in enumerate(self.graph.nodes) if at in wanted and node.op != "constant")

    def run(self, inputs: Mapping[str, Any], memory: Floats) -> tuple[dict[str, Floats], Floats]:
        """The outputs, each of shape (n,), and the next memory, for inputs of shape (n,) and a memory (n, width).

        ``inputs`` may also hold settings; those that are missing have their defaults.
        """
        n = len(memory)
        if n not in self._machines:
            self._machines[n] = Machine(self, n)
        return self._machines[n].run(inputs, memory)

    @cached_property
    def _machines(self) -> dict[int, Machine]:
        return {}


class Machine:
    """NumPy calls that run a program for n blocks, on one table of results of shape (elements, n)."""

    def __init__(self, program: Program, n: int) -> None:
        self.program, self.n, graph = program, n, program.graph
        self.table = np.zeros((graph.length, n))
        for node in graph.nodes:
            if node.op == "constant":
                self.rows(node)[:] = node.data[:, None]
        self.calls: list[Callable[[], Any]] = []
        for node in program.nodes:
            if node.op != "input":
                self.calls.append(self._call(node, [self._read(ids) for ids in node.args]))
        self.inputs = {node.data: self.rows(node) for node in program.nodes if node.op == "input"}
        self.ports = [
            (port.name, port.default) for port in (*program.settings, *program.inputs) if port.name in self.inputs
        ]
        sizes = np.cumsum([0, *(cell.start.size for cell in program.memory)])
        self.cells = [
            (cell.name, slice(first, last), cell.after)
            for cell, first, last in zip(program.memory, sizes[:-1], sizes[1:], strict=True)
        ]

    def rows(self, node: Node) -> Any:
        """The results of a node."""
        return self.table[node.start : node.start + node.size]

    def run(self, inputs: Mapping[str, Any], memory: Floats) -> tuple[dict[str, Floats], Floats]:
        """As :meth:`Program.run`."""
        for name, where, _ in self.cells:
            if name in self.inputs:
                self.inputs[name][:] = memory[:, where].T
        for name, default in self.ports:
            self.inputs[name][:] = inputs.get(name, default)
        with np.errstate(all="ignore"):
            for call in self.calls:
                call()
        after = np.concatenate([self.table[ids] for _, _, ids in self.cells]).T
        due = self.table[self.program.due[0]] > 0.5
        outputs = {port.name: self.table[ids[0]].copy() for port, ids in self.program.outputs}
        return outputs, np.where(due[:, None], after, memory)

    def _read(self, ids: Ids) -> Any:
        """A view of the elements, or a buffer that a call of its own fills."""
        first, last = int(ids[0]), int(ids[-1])
        if (ids == first).all():
            return self.table[first : first + 1]
        if np.array_equal(ids, np.arange(first, last + 1)):
            return self.table[first : last + 1]
        buffer = np.zeros((len(ids), self.n))
        self.calls.append(partial(np.take, self.table, ids, 0, buffer, "clip"))
        return buffer

    def _call(self, node: Node, args: list[Any]) -> Callable[[], Any]:
        out = self.rows(node)
        if node.op == "matmul":
            m, k, n = node.data
            a, b, c = (
                np.moveaxis(x.reshape(*shape, -1), -1, 0)
                for x, shape in zip((*args, out), ((m, k), (k, n), (m, n)), strict=True)
            )
            return partial(np.matmul, a, b, c)
        if node.op == "select":
            return partial(_select, args[0], args[1], args[2], out)
        if node.op == "argmax":
            return lambda: out.__setitem__(0, args[0].argmax(axis=0))
        if node.op == "pick":
            return lambda: out.__setitem__(slice(None), np.take_along_axis(args[0], args[1].astype(np.int64), axis=0))
        if node.op in ("finite", "real"):
            return partial(np.copyto, out, args[0]) if node.op == "real" else partial(_finite, args[0], out)
        function: Any = FUNCTIONS[node.op]
        return partial(function, *args, out=out)


def _select(condition: Any, one: Any, other: Any, out: Any) -> None:
    np.copyto(out, other)
    np.copyto(out, one, where=condition > 0.5)


def _finite(value: Any, out: Any) -> None:
    np.less_equal(np.abs(value), FINITE, out)


def flatten(value: Any, name: str = "") -> list[tuple[str, Any]]:
    """Names and arrays of nested tuples, in order; names are joined by underscores."""
    if not isinstance(value, tuple):
        return [(name, value)]
    names = getattr(value, "_fields", range(len(value)))
    return [
        leaf for part, each in zip(names, value, strict=True) for leaf in flatten(each, f"{name}_{part}".strip("_"))
    ]


def rebuild(like: Any, leaves: Any) -> Any:
    """Nested tuples like ``like`` with the arrays that an iterator gives, in order."""
    if not isinstance(like, tuple):
        return next(leaves)
    parts = [rebuild(each, leaves) for each in like]
    kind: Any = type(like)
    return kind(*parts) if hasattr(like, "_fields") else tuple(parts)


def record(
    name: str,
    settings: tuple[Port, ...],
    inputs: tuple[Port, ...],
    outputs: tuple[Port, ...],
    memory: Any,
    step: Callable[[Any, Any, Any], tuple[Any, Any, Any]],
    needs_double: bool = False,
    notes: tuple[str, ...] = (),
) -> Program:
    """Record ``step(settings, inputs, memory) -> outputs, memory, due``; ``memory`` is that before the first sample.

    Settings and inputs are passed as dictionaries of traced numbers, outputs are returned as one.
    """
    graph = Graph()
    leaves = [(leaf, np.clip(np.asarray(value, np.float64), -BAD, BAD)) for leaf, value in flatten(memory)]
    cells = [graph.input(leaf, value.shape) if value.size else value for leaf, value in leaves]
    given = [{port.name: graph.input(port.name) for port in ports} for ports in (settings, inputs)]
    results, after, due = step(given[0], given[1], rebuild(memory, iter(cells)))

    def ids_of(value: Any) -> Ids:
        return np.ascontiguousarray(graph.lift(value).ids).ravel()

    held = [
        Cell(leaf, value.ravel(), ids_of(new), leaf in WIDE)
        for (leaf, value), (_, new) in zip(leaves, flatten(after), strict=True)
        if value.size
    ]
    for cell in held:
        if cell.after.size != cell.start.size:
            raise ValueError(f"{cell.name}: {cell.start.size} numbers became {cell.after.size}")
    shown = tuple((port, ids_of(results[port.name])) for port in outputs)
    return Program(name, graph, settings, inputs, shown, tuple(held), ids_of(due), needs_double, notes)
