"""A recorded controller: its inputs, memory and outputs; the description from which every language is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .trace import BAD, Graph, Ids, Node

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
    step: Callable[[Any, Any], tuple[Any, Any, Any]],
    needs_double: bool = False,
    notes: tuple[str, ...] = (),
) -> Program:
    """Record ``step(given, memory) -> outputs, memory, due``; ``memory`` is that before the first sample.

    Settings and inputs are passed as a dictionary of traced numbers, outputs are returned as one.
    """
    graph = Graph()
    leaves = [(leaf, np.clip(np.asarray(value, np.float64), -BAD, BAD)) for leaf, value in flatten(memory)]
    cells = [graph.input(leaf, value.shape) if value.size else value for leaf, value in leaves]
    given = {port.name: graph.input(port.name) for port in (*settings, *inputs)}
    results, after, due = step(given, rebuild(memory, iter(cells)))

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
