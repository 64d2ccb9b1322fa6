"""A recorded controller: its inputs, memory and outputs; the description from which every language is written."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from cz_gym.support.nested import leaves, map_arrays

from .trace import BAD, Floats, Graph, Ids, Node

WIDE = ("clock_s", "called_s")
"""Memory that needs double precision also where the controller computes in single precision, beside sums over time."""
PASSES = 3
"""Most samples of one call."""
CARRY = ("add", "subtract", "negative", "minimum", "maximum", "select", "multiply", "divide")
"""Operations through which a sum over time goes on, products and quotients with a constant."""


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
    again: Ids
    """Whether another sample of the same call follows, one logical element."""
    notes: tuple[str, ...] = ()
    """Facts for the header of each written file: puller, hashes, scenario."""

    @cached_property
    def nodes(self) -> tuple[Node, ...]:
        """The nodes that outputs or memory depend on, in order; without constants."""
        results = [self.due, self.again, *(ids for _, ids in self.outputs), *(cell.after for cell in self.memory)]
        wanted = set(self.graph.owners(np.concatenate(results)).tolist())
        for at in reversed(range(len(self.graph.nodes))):
            if at in wanted:
                wanted.update(*(self.graph.owners(ids).tolist() for ids in self.graph.nodes[at].args))
        return tuple(self.graph.nodes[at] for at in sorted(wanted) if self.graph.nodes[at].op != "constant")


def record(
    step: Callable[[Any, Any], tuple[Any, Any, Any, Any]],
    memory: Any,
    ports: Sequence[tuple[Port, ...]],
    name: str,
    notes: tuple[str, ...],
) -> Program:
    """Record ``step(given, memory) -> outputs, memory, due, again``; ``memory`` is that before the first sample.

    ``ports`` are settings, inputs and outputs. The first two are passed as one dictionary of traced numbers, and
    outputs are returned as one.
    """
    graph, (settings, inputs, outputs) = Graph(), ports
    before = {leaf: np.clip(np.asarray(value, np.float64), -BAD, BAD) for leaf, value in leaves(memory).items()}
    cells: list[Any] = [graph.input(leaf, value.shape) if value.size else value for leaf, value in before.items()]
    given = {port.name: graph.input(port.name) for port in (*settings, *inputs)}
    rest = iter(cells)
    results, after, due, again = step(given, map_arrays(lambda _: next(rest), memory))

    def ids_of(value: Any) -> Ids:
        return graph.lift(value).ids.ravel()

    sources, held = [_sources(graph, node) for node in graph.nodes], list[Cell]()
    for (leaf, value), cell, new in zip(before.items(), cells, leaves(after).values(), strict=True):
        if value.size:
            if leaf.endswith("covariance"):  # else rounding makes it ever less symmetric
                new = 0.5 * (new + new.swapaxes(-1, -2))
            wide = leaf in WIDE or _widen(graph, sources, cell.ids, ids_of(new))
            held.append(Cell(leaf, value.ravel(), ids_of(new), wide))
    shown = tuple((port, ids_of(results[port.name])) for port in outputs)
    return Program(name, graph, settings, inputs, shown, tuple(held), ids_of(due), ids_of(again), notes)


def _sources(graph: Graph, node: Node) -> set[int]:
    """The nodes whose values this one adds, limits, selects, or scales by a constant."""
    traced = [set(graph.owners(ids).tolist()) for ids in node.args if graph.values(ids) is None]
    linear = node.op in CARRY and (len(traced) == 1 or node.op not in ("multiply", "divide"))
    return set[int]().union(*traced) if linear else set()


def _widen(graph: Graph, sources: list[set[int]], before: Ids, after: Ids) -> bool:
    """Mark the operations that sum memory over time, as integrals and leaky means do; whether there are any.

    Rounding errors add up in such a sum: code in single precision has it in double.
    """
    reached = set(graph.owners(before.ravel()).tolist())
    for at, its in enumerate(sources):
        reached |= {at} if its & reached else set()
    loop = set(graph.owners(after).tolist()) & reached
    for at in sorted(reached, reverse=True):
        loop |= sources[at] & reached if at in loop else set()
    sums = any(graph.nodes[at].op in ("add", "subtract") for at in loop)
    for at in loop if sums else ():
        graph.nodes[at].wide = True
    return sums
