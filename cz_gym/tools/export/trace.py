"""Record NumPy code as a straight line of operations, the :class:`Program` from which every language is written.

A controller's own functions are called with :class:`Traced` arrays in place of numbers. Each arithmetic operation adds
a :class:`Node` to a :class:`Graph`; slices, transposes and concatenations add none, because a traced array is an
integer array of element numbers, on which NumPy does them. The batch axis has length 1. Shortcuts that a controller
takes where no slot needs work are not taken: ``any()`` of a traced array is True and ``all()`` is False.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.support.errors import CzError, leaves, map_arrays

Floats = npt.NDArray[np.float64]
Ids = npt.NDArray[np.int64]
BAD = 3e38
"""Stands for NaN and infinity in recorded programs; float32 holds it."""
FINITE = 1e38
"""Largest magnitude of a finite number in recorded programs."""
LOGICAL = {"less", "less_equal", "equal", "and", "or", "not", "finite"}
"""Operations whose results are logical."""
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "add": np.add, "subtract": np.subtract, "multiply": np.multiply, "divide": np.divide, "negative": np.negative,
    "absolute": np.absolute, "sqrt": np.sqrt, "exp": np.exp, "log": np.log, "sin": np.sin, "cos": np.cos,
    "tanh": np.tanh, "minimum": np.minimum, "maximum": np.maximum, "less": np.less, "less_equal": np.less_equal,
    "equal": np.equal, "and": np.logical_and, "or": np.logical_or, "not": np.logical_not, "select": np.where,
    "finite": lambda x: np.abs(x) <= FINITE, "real": lambda x: x.astype(np.float64),
}  # fmt: skip
"""Operations on single numbers, which apply to each element."""
_ALIASES = {"bitwise_and": "and", "bitwise_or": "or", "invert": "not", "isfinite": "finite"}
_TINY = 1e-20


@dataclass(eq=False)
class Node:
    """One operation."""

    op: str
    """A key of :data:`FUNCTIONS`, or "input", "constant", "matmul", "argmax" or "pick"."""
    args: tuple[Ids, ...]
    """Element numbers of the arguments, each of ``size`` or one number."""
    size: int
    """Number of elements."""
    start: int
    """Number of its first element."""
    logical: bool = False
    data: Any = None
    """Values of a constant, name of an input, (m, k, n) of a matrix product."""
    wide: bool = False
    """True if it is in double precision also where the controller computes in single precision."""


@dataclass
class Graph:
    """The recorded operations, in order."""

    nodes: list[Node] = field(default_factory=list)
    starts: list[int] = field(default_factory=list)
    length: int = 0

    def add(self, op: str, args: tuple[Ids, ...], shape: tuple[int, ...], data: Any = None) -> Traced:
        """The elements, in this shape, of a new node at the end."""
        logical = op in LOGICAL or (op == "constant" and data.dtype == np.bool_)
        logical = logical or (op == "select" and self.owner(int(args[1].flat[0])).logical)
        flat, size = tuple(np.ascontiguousarray(ids).ravel() for ids in args), int(np.prod(shape))
        self.nodes.append(Node(op, flat, size, self.length, logical, data))
        self.starts.append(self.length)
        self.length += size
        return Traced(self, self.starts[-1] + np.arange(size).reshape(shape))

    def owners(self, ids: Any) -> Any:
        """The numbers of the elements' nodes."""
        return np.searchsorted(self.starts, ids, side="right") - 1

    def owner(self, element: int) -> Node:
        """The node of an element."""
        return self.nodes[int(self.owners(element))]

    def values(self, ids: Ids) -> Any:
        """The elements' values if all are constants; None otherwise."""
        nodes = [self.nodes[at] for at in self.owners(ids.ravel())]
        if any(node.op != "constant" for node in nodes):
            return None
        pairs = zip(ids.ravel(), nodes, strict=True)
        return np.array([node.data[element - node.start] for element, node in pairs]).reshape(ids.shape)

    def input(self, name: str, shape: tuple[int, ...] = (1,)) -> Traced:
        """A new input, or memory from the last sample."""
        return self.add("input", (), shape, name)

    def constant(self, value: Any) -> Traced:
        """A constant."""
        array = np.asarray(value)
        if array.dtype != np.bool_:
            array = np.nan_to_num(array.astype(np.float64), nan=BAD, posinf=BAD, neginf=-BAD)
        return self.add("constant", (), array.shape, array.ravel())

    def lift(self, value: Any) -> Traced:
        """The value itself if it is traced, else as a constant."""
        return value if isinstance(value, Traced) else self.constant(value)

    def apply(self, op: str, *values: Any) -> Traced:
        """The result of an operation on each element, with NumPy's broadcasting."""
        args = np.broadcast_arrays(*(self.lift(value).ids for value in values))
        known = [self.values(ids) for ids in args]
        if all(value is not None for value in known):
            with np.errstate(all="ignore"):
                return self.constant(FUNCTIONS[op](*known))
        if op in ("add", "subtract"):
            (a, c), (b, d) = map(self._split_constant, args)
            if np.any(c) or np.any(d):
                rest: Traced = a if b is None else self.apply(op, 0.0 if a is None else a, b)
                if not np.any(constant := FUNCTIONS[op](c, d)):
                    return rest
                op, args = "add", np.broadcast_arrays(rest.ids, self.constant(constant).ids)
        return self.add(op, tuple(args), args[0].shape)

    def _split_constant(self, ids: Ids) -> tuple[Any, Any]:
        """A value as a traced part, None if there is none, and the constant that is added to it.

        Sums keep their constants last. So the equations of a plant are recorded in deviations from its operating point,
        and single precision keeps differences of temperatures that are small beside the temperatures.
        """
        if (constant := self.values(ids)) is not None:
            return None, constant
        node = self.owner(int(ids.flat[0]))
        if node.op == "add" and (self.owners(ids) == self.owners(node.start)).all():
            left, right = (arg[ids - node.start] for arg in node.args)
            if (constant := self.values(right)) is not None:
                return Traced(self, left), constant
        return Traced(self, ids), 0.0


class Traced(np.lib.mixins.NDArrayOperatorsMixin):
    """An array whose elements are results of a graph's operations."""

    def __init__(self, graph: Graph, ids: Any) -> None:
        self.graph, self.ids = graph, np.asarray(ids, np.int64)

    shape = property(lambda self: self.ids.shape)
    ndim = property(lambda self: self.ids.ndim)
    size = property(lambda self: self.ids.size)
    dtype = property(lambda self: np.dtype(np.bool_ if self.logical else np.float64))
    T = property(lambda self: Traced(self.graph, self.ids.T))

    @property
    def logical(self) -> bool:
        """True if the elements are logical."""
        return bool(self.size) and self.graph.owner(int(self.ids.flat[0])).logical

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, key: Any) -> Traced:
        if isinstance(key, Traced) and key.logical:  # the slots where it holds, out of one slot
            return self
        if isinstance(key, tuple) and any(isinstance(part, Traced) for part in key):  # [slot, index]
            return _take(self.graph, self[0], key[1])
        return Traced(self.graph, self.ids[key])

    def __setitem__(self, key: Any, value: Any) -> None:
        first = key[0] if isinstance(key, tuple) else key
        new = self.graph.lift(value)
        if isinstance(first, Traced):
            key = (slice(None), *key[1:]) if isinstance(key, tuple) else slice(None)
            where = first.reshape(1, *(1,) * (self.ids[key].ndim - 1))
            new = self.graph.apply("select", where, new, Traced(self.graph, self.ids[key]))
        self.ids = self.ids.copy()
        self.ids[key] = new.ids

    def __getattr__(self, name: str) -> Any:
        if name in ("reshape", "transpose", "swapaxes", "copy", "ravel", "squeeze"):
            return lambda *given: Traced(self.graph, getattr(self.ids, name)(*given))
        raise AttributeError(name)

    def any(self, axis: Any = None) -> bool:
        """True: every masked step is recorded. Not a number of the record: CzError along an axis."""
        return self._shortcut(axis, True)

    def all(self, axis: Any = None) -> bool:
        """False: no step is left out. CzError along an axis."""
        return self._shortcut(axis, False)

    @staticmethod
    def _shortcut(axis: Any, answer: bool) -> bool:
        if axis is not None:
            raise CzError("cannot record any() or all() along an axis: write np.maximum or np.minimum")
        return answer

    def astype(self, dtype: Any) -> Traced:
        """The numbers 0 and 1 of logical elements."""
        return self.graph.apply("real", self) if self.logical else self

    def sum(self, axis: int) -> Traced:
        """Sum along an axis."""
        last = np.moveaxis(self.ids, axis, -1)
        product = self._matmul(Traced(self.graph, last.reshape(-1, last.shape[-1])), np.ones((last.shape[-1], 1)))
        return Traced(self.graph, product.ids.reshape(last.shape[:-1]))

    def mean(self, axis: int) -> Traced:
        """Mean along an axis."""
        return self.graph.apply("divide", self.sum(axis), self.shape[axis])

    def argmax(self, axis: int) -> Traced:
        """Index of the first largest element of the one row."""
        return self.graph.add("argmax", (self.ids,), (1,))

    def view(self, dtype: Any) -> Complex:
        """Pairs of numbers as complex ones."""
        return Complex(self[..., 0::2], self[..., 1::2])

    def _matmul(self, a: Any, b: Any) -> Traced:
        x, y = self.graph.lift(a).ids, self.graph.lift(b).ids
        left, right = (x[None] if x.ndim == 1 else x), (y[:, None] if y.ndim == 1 else y)
        batch = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
        (m, k), n = left.shape[-2:], right.shape[-1]
        if np.prod(batch, dtype=int) != 1 or right.shape[-2] != k:
            raise CzError(f"cannot record a matrix product of shapes {x.shape} and {y.shape}")
        shape = (*batch, *((m,) if x.ndim > 1 else ()), *((n,) if y.ndim > 1 else ()))
        return self.graph.add("matmul", (left, right), shape, (m, k, n))

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = None, **kwargs: Any) -> Any:
        name = ufunc.__name__
        if method != "__call__" or kwargs:
            raise CzError(f"cannot record np.{name}.{method} with {', '.join(kwargs)}")
        if any(isinstance(value, (complex, Complex)) or np.iscomplexobj(value) for value in inputs):
            return complex_ufunc(name, *inputs)
        if name == "matmul":
            result = self._matmul(*inputs)
        elif name in ("greater", "greater_equal"):
            result = self.graph.apply(name.replace("greater", "less"), *reversed(inputs))
        elif name == "sign":
            below = self.graph.apply("select", inputs[0] < 0.0, -1.0, 0.0)
            result = self.graph.apply("select", inputs[0] > 0.0, 1.0, below)
        elif name == "square":
            result = self.graph.apply("multiply", *inputs, *inputs)
        elif _ALIASES.get(name, name) in FUNCTIONS:
            result = self.graph.apply(_ALIASES.get(name, name), *inputs)
        else:
            raise CzError(f"cannot record np.{name}")
        if out:
            out[0].ids = result.ids
            return out[0]
        return result

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if function in _RULES:
            return _RULES[function](self.graph, *args, **kwargs)
        if function in (np.zeros_like, np.ones_like, np.full_like):
            shape = kwargs.pop("shape", None) or args[0].shape
            return self.graph.constant(function(np.zeros(shape), *args[1:], **kwargs))
        moved = {name: self._numbers(value) for name, value in kwargs.items()}
        return Traced(self.graph, function(*map(self._numbers, args), **moved))

    def _numbers(self, value: Any) -> Any:
        """An argument of a function that only moves elements, as element numbers."""
        if isinstance(value, (list, tuple)) and any(isinstance(part, Traced) for part in value):
            return [self.graph.lift(part).ids for part in value]
        return value.ids if isinstance(value, Traced) else value


def _clip(graph: Graph, value: Any, low: Any, high: Any) -> Any:
    value = value if low is None else graph.apply("maximum", value, low)
    return value if high is None else graph.apply("minimum", value, high)


def _take(graph: Graph, array: Any, index: Any, axis: Any = None) -> Traced:
    at = graph.lift(index).ids
    return graph.add("pick", (graph.lift(array).ids, at), at.shape)


def _einsum(graph: Graph, rule: str, a: Any, b: Any) -> Any:
    if rule != "ni,ni->n":
        raise CzError(f"cannot record np.einsum({rule!r})")
    product = graph.lift(a)[:, None, :] @ graph.lift(b)[:, :, None]
    return product[:, 0, 0]


_RULES: dict[Any, Callable[..., Any]] = {
    np.ndim: lambda graph, array: array.ndim,
    np.iscomplexobj: lambda graph, array: False,
    np.where: lambda graph, *values: graph.apply("select", *values),
    np.clip: _clip,
    np.take_along_axis: _take,
    np.einsum: _einsum,
    np.split: lambda graph, array, *given: [Traced(graph, ids) for ids in np.split(array.ids, *given)],
    np.diff: lambda graph, array, axis: array[..., 1:] - array[..., :-1],
}


class Complex(np.lib.mixins.NDArrayOperatorsMixin):
    """Traced complex numbers ``re + j unit im``; with a tiny unit, that of complex steps, its square is zero."""

    def __init__(self, re: Any, im: Any, unit: float = 1.0) -> None:
        self.re, self.im, self.unit = re, im, unit

    @property
    def real(self) -> Any:
        """Real part."""
        return self.re

    @property
    def imag(self) -> Any:
        """Imaginary part."""
        return self.im * self.unit

    def __len__(self) -> int:
        return len(self.re)

    def __getitem__(self, key: Any) -> Complex:
        return Complex(self.re[key], self.im[key], self.unit)

    def view(self, dtype: Any) -> Any:
        """Complex numbers as pairs."""
        return np.stack([self.re, self.imag], axis=-1).reshape(*self.re.shape[:-1], 2 * self.re.shape[-1])

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = None, **kwargs: Any) -> Any:
        return complex_ufunc(ufunc.__name__, *inputs)


def complex_ufunc(name: str, *inputs: Any) -> Complex:
    """The ufunc of complex numbers, traced in real ones; CzError for one that has no rule.

    Of quotients, roots and logarithms only those of complex steps have one, whose unit is tiny.
    """
    parts = [_parts(value) for value in inputs]
    unit = min(part.unit for part in parts if part.im is not None)
    a, b = parts[0], parts[-1]
    if name in ("add", "subtract"):
        return _sum(getattr(np, name), a, b, unit)
    if name == "multiply":
        return _product(a, b, unit)
    if name == "divide" and (unit < _TINY or b.im is None):
        re = a.re / b.re
        top = 0.0 if a.im is None else a.im
        return Complex(re, (top if b.im is None else top - re * b.im) / b.re, unit)
    if name == "sqrt" and unit < _TINY:
        root = np.sqrt(a.re)
        return Complex(root, a.im / (2.0 * root), unit)
    if name == "log" and unit < _TINY:
        return Complex(np.log(a.re), a.im / a.re, unit)
    raise CzError(f"cannot record np.{name} of complex numbers")


def _sum(plus: Any, a: Complex, b: Complex, unit: float) -> Complex:
    """The sum or difference; the imaginary part of a real term is None."""
    im = a.im if b.im is None else (plus(0.0, b.im) if a.im is None else plus(a.im, b.im))
    return Complex(plus(a.re, b.re), im, unit)


def _product(a: Complex, b: Complex, unit: float) -> Complex:
    """The product; terms of a real factor's imaginary part, None, are left out."""
    re = a.re * b.re
    if a.im is not None and b.im is not None and unit == 1.0:
        re = re - a.im * b.im
    im = sum(x * y for x, y in ((a.re, b.im), (a.im, b.re)) if x is not None and y is not None)
    return Complex(re, im, unit)


def _parts(value: Any) -> Complex:
    if isinstance(value, Complex):
        return value
    if not np.iscomplexobj(value):
        return Complex(value, None)
    array = np.asarray(value)
    unit = float(np.max(np.abs(array.imag)))
    unit = unit if 0.0 < unit < _TINY else 1.0
    return Complex(array.real, array.imag / unit, unit)


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
    """One array of a program's memory."""

    name: str
    start: Floats
    """Values before the first sample, flat."""
    after: Ids
    """Elements that the array holds after a sample."""
    wide: bool = False
    """True if the array needs double precision."""


@dataclass(frozen=True)
class Program:
    """The recorded operations of a controller's sample, with its ports and memory."""

    name: str
    graph: Graph
    settings: tuple[Port, ...]
    inputs: tuple[Port, ...]
    outputs: tuple[tuple[Port, Ids], ...]
    memory: tuple[Cell, ...]
    due: Ids
    """True if the memory changes at this call, one logical element."""
    again: Ids
    """True if another sample of the same call follows, one logical element."""
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
    """Numbers of the nodes whose values this node adds, limits, selects, or scales by a constant."""
    traced = [set(graph.owners(ids).tolist()) for ids in node.args if graph.values(ids) is None]
    linear = node.op in CARRY and (len(traced) == 1 or node.op not in ("multiply", "divide"))
    return set[int]().union(*traced) if linear else set()


def _widen(graph: Graph, sources: list[set[int]], before: Ids, after: Ids) -> bool:
    """Mark the operations that sum memory over time, as integrals and leaky means do; True if there are any.

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
