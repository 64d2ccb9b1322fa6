"""A recorded controller: its inputs, memory and outputs; and the NumPy interpreter that runs it.

This is the one description from which C, structured text and ONNX are written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .trace import BAD, FUNCTIONS, Graph, Ids, Node, Traced

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

    @cached_property
    def _plan(self) -> list[tuple[Node, list[Any]]]:
        return [(node, [self._fetch(ids) for ids in node.args]) for node in self.nodes if node.op != "input"]

    def _fetch(self, ids: Ids) -> Any:
        """Constant values, or a function that reads the elements from the table of results, shape (n, size)."""
        known = self.graph.values(ids)
        if known is not None:
            return known[None]
        first, last = int(ids[0]), int(ids[-1])
        if (ids == first).all():
            return slice(first, first + 1)
        return slice(first, last + 1) if np.array_equal(ids, np.arange(first, last + 1)) else ids

    def run(self, inputs: Mapping[str, Any], memory: Floats) -> tuple[dict[str, Floats], Floats]:
        """The outputs, each of shape (n,), and the next memory, for inputs of shape (n,) and a memory (n, width).

        ``inputs`` may also hold settings; those that are missing have their defaults.
        """
        n = len(memory)
        table = np.zeros((n, self.graph.length))
        cells = dict(zip([cell.name for cell in self.memory], np.split(memory, self._ends, axis=1), strict=True))
        given = {port.name: port.default for port in (*self.settings, *self.inputs)} | dict(inputs)
        for node in self.nodes:
            if node.op == "input":
                value = cells[node.data] if node.data in cells else np.reshape(given[node.data], (-1, 1))
                table[:, node.start : node.start + node.size] = value
        for node in self.graph.nodes:
            if node.op == "constant":
                table[:, node.start : node.start + node.size] = node.data
        with np.errstate(all="ignore"):
            for node, fetches in self._plan:
                args = [
                    table[:, at] if isinstance(at, (slice, np.ndarray)) and not _is_value(at) else at for at in fetches
                ]
                table[:, node.start : node.start + node.size] = _compute(node, args)
        after = np.concatenate([table[:, cell.after] for cell in self.memory], axis=1)
        due = table[:, self.due] > 0.5
        outputs = {port.name: table[:, ids[0]].copy() for port, ids in self.outputs}
        return outputs, np.where(due, after, memory)

    @cached_property
    def _ends(self) -> list[int]:
        return [int(end) for end in np.cumsum([cell.start.size for cell in self.memory])[:-1]]


def _is_value(at: Any) -> bool:
    return isinstance(at, np.ndarray) and at.ndim == 2


def _compute(node: Node, args: list[Any]) -> Any:
    """The results of a node, shape (n, size)."""
    if node.op == "matmul":
        m, k, n = node.data
        a, b = (np.reshape(x, (-1, *shape)) for x, shape in zip(args, ((m, k), (k, n)), strict=True))
        product = a @ b
        return product.reshape(len(product), m * n)
    if node.op == "argmax":
        return args[0].argmax(axis=1)[:, None]
    if node.op == "pick":
        at = args[1].astype(np.int64)
        return np.take_along_axis(np.broadcast_to(args[0], (len(at), args[0].shape[1])), at, axis=1)
    if node.op in ("select", "and", "or", "not", "real"):
        logical = 1 if node.op in ("select", "real") else len(args)
        args = [value > 0.5 for value in args[:logical]] + args[logical:]
    return FUNCTIONS[node.op](*args)


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


__all__ = ["Cell", "Port", "Program", "Traced", "flatten", "rebuild", "record"]
