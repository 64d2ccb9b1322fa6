"""The statements of a recorded program in a language: C99, or IEC 61131-3 structured text.

A :class:`Writer` orders the statements and gives their results to a small pool of work arrays, a :class:`Dialect` says
how a language writes them. An operation whose result is used once, element by element, becomes part of an expression.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .program import Program
from .trace import FUNCTIONS, Floats, Ids, Node

LONGEST = 90
"""Longest expression that becomes part of another one, in characters."""
_ARITHMETIC = {
    "add": "({0} + {1})", "subtract": "({0} - {1})", "multiply": "({0} * {1})", "divide": "({0} / {1})",
    "negative": "(-{0})", "less": "({0} < {1})", "less_equal": "({0} <= {1})",
}  # fmt: skip
C_OPERATIONS = _ARITHMETIC | {
    "absolute": "fabs({0})", "sqrt": "sqrt@({0})", "exp": "exp@({0})", "log": "log@({0})", "sin": "sin@({0})",
    "cos": "cos@({0})", "tanh": "tanh@({0})", "minimum": "fmin@({0}, {1})", "maximum": "fmax@({0}, {1})",
    "equal": "({0} == {1})", "and": "({0} && {1})", "or": "({0} || {1})", "not": "(!{0})",
    "select": "({0} ? {1} : {2})", "finite": "(fabs({0}) <= 1e38)", "real": "({0} ? 1.0 : 0.0)",
}  # fmt: skip
ST_OPERATIONS = _ARITHMETIC | {
    "absolute": "ABS({0})", "sqrt": "SQRT({0})", "exp": "EXP({0})", "log": "LN({0})", "sin": "SIN({0})",
    "cos": "COS({0})", "tanh": "(1.0 - 2.0 / (EXP(2.0 * LIMIT(-20.0, {0}, 20.0)) + 1.0))", "minimum": "MIN({0}, {1})",
    "maximum": "MAX({0}, {1})", "equal": "({0} = {1})", "and": "({0} AND {1})", "or": "({0} OR {1})",
    "not": "(NOT {0})", "select": "SEL({0}, {2}, {1})", "finite": "(ABS({0}) <= 1.0E38)", "real": "SEL({0}, 0.0, 1.0)",
}  # fmt: skip


@dataclass(frozen=True)
class Dialect:
    """How a language writes expressions and loops."""

    operations: dict[str, str]
    logical: tuple[str, str]
    """False and true."""
    assign: str
    loop: tuple[str, str]
    """Begin of a loop over ``{0}`` from 0 to ``{1}``, which is not included, or ``{2}``, which is; and its end."""
    if_: tuple[str, str]
    index: str
    """A whole number in a real one, as an index."""
    whole: str
    """A real number as the type of the alarms."""
    prefixes: tuple[str, str, str] = ("", "", "")
    """Of memory and settings, of inputs, of outputs."""
    end: str = ""
    """End of a literal, and of a function's name."""

    def number(self, value: float) -> str:
        """A literal."""
        text = repr(float(value))
        mantissa, _, exponent = text.partition("e")
        if "." not in mantissa:
            mantissa += ".0"
        text = mantissa + (f"E{int(exponent)}" if exponent else "")
        return f"({text}{self.end})" if value < 0 else text + self.end


def c_dialect(single: bool) -> Dialect:
    """C99 in double or single precision."""
    return Dialect(
        C_OPERATIONS, ("0", "1"), "{} = {};", ("for (int {0} = 0; {0} < {1}; {0}++) {{", "}"), ("if ({0}) {{", "}"),
        "(int)({0})", "(unsigned)({0})", ("block->", "measured->", "setpoints->"), "f" if single else "",
    )  # fmt: skip


def st_dialect(single: bool) -> Dialect:
    """Structured text in LREAL or REAL."""
    real = "REAL" if single else "LREAL"
    return Dialect(
        ST_OPERATIONS, ("FALSE", "TRUE"), "{} := {};", ("FOR {0} := 0 TO {2} DO", "END_FOR;"),
        ("IF {0} THEN", "END_IF;"), f"{real}_TO_DINT({{0}})", f"{real}_TO_UDINT({{0}})",
    )  # fmt: skip


class Writer:
    """The statements of a program in a dialect, with the work arrays and the constants that they need."""

    def __init__(self, program: Program, dialect: Dialect, wide: Dialect) -> None:
        self.program, self.dialect, self.graph = program, dialect, program.graph
        self.dialects = dialect, wide
        self.cells = {cell.name for cell in program.memory}
        self.own = self.cells | {port.name for port in program.settings}
        self.tables: dict[tuple[bytes, str, bool], tuple[str, Floats, bool]] = {}
        """Name and numbers of each table of constants, and whether they are in double precision."""
        self._statements: list[tuple[list[str], int]] = []
        """Lines in which work arrays stand as ``<number>``; the number of the array that they fill, or -1."""
        self._kinds: dict[int, tuple[int, str]] = {}
        self._inlined: dict[int, str] = {}
        self._names: dict[int, str] = {}
        self._copies: dict[bytes, int] = {}
        self._uses: Counter[int] = Counter()
        self._users: dict[int, tuple[Node, Ids]] = {}
        for node in program.nodes:
            for ids in node.args:
                self._uses.update(self._owners(ids))
                self._users.update(dict.fromkeys(self._owners(ids), (node, ids)))
        for ids in (*(ids for _, ids in program.outputs), *(cell.after for cell in program.memory), program.due):
            self._uses.update(2 * self._owners(ids))
        for node in program.nodes:
            self._node(node)
        self._finish()
        self.work, self.body = self._allocated()

    def loop(self, variable: str, count: int, lines: list[str]) -> list[str]:
        """Lines that run for a variable from 0 to count - 1."""
        head, tail = self.dialect.loop
        return [head.format(variable, count, count - 1), *(f"    {line}" for line in lines), tail]

    def assign(self, target: str, value: str) -> str:
        """A statement that gives a target its value."""
        return self.dialect.assign.format(target, value)

    def each(self, target: str, size: int, value: str) -> list[str]:
        """Statements that give each element of an array, or a number, its value, a text of ``i``."""
        return [self.assign(target, value)] if size == 1 else self.loop("i", size, [self.assign(f"{target}[i]", value)])

    def fill(self, target: str, pieces: list[tuple[int, int]], value: Callable[[int, int], str]) -> list[str]:
        """Statements that fill an array, or a number, piece by piece: from first to last + 1 with a text of ``i``."""
        lines: list[str] = []
        for first, last in pieces:
            if last - first == 1:
                lines.append(self.assign(f"{target}[{first}]" if pieces[-1][1] > 1 else target, value(first, last)))
            else:
                at = plus("i", str(first) if first else "")
                lines += self.loop("i", last - first, [self.assign(f"{target}[{at}]", value(first, last))])
        return lines

    def _owners(self, ids: Ids) -> list[int]:
        owners: list[int] = np.unique(self.graph.owners(ids)).tolist()
        return owners

    def _add(self, lines: list[str], size: int, node: Node) -> int:
        """A new work array of the node's kind, which these lines fill; its number."""
        self._kinds[len(self._kinds)] = size, "b" if node.logical else "d" if node.wide else "w"
        self._statements.append((lines, len(self._kinds) - 1))
        return len(self._kinds) - 1

    def _node(self, node: Node) -> None:
        at, self.dialect = int(self.graph.owners(node.start)), self.dialects[node.wide]
        if node.op == "input":
            self._names[at] = self.dialect.prefixes[node.data not in self.own] + node.data
            return
        if node.op in FUNCTIONS:
            args = [self._element(ids) for ids in node.args]
            text = self.dialect.operations[node.op].replace("@", self.dialect.end).format(*args)
            if self._uses[at] == 1 and len(text) <= LONGEST:
                user, used = self._users[at]
                if user.op in FUNCTIONS and np.array_equal(used, node.start + np.arange(node.size)):
                    self._inlined[at] = text
                    return
            lines = self.each("<new>", node.size, text)
        elif node.op == "matmul":
            lines = self._product(node)
        elif node.op == "argmax":
            row, best = self._array(node.args[0]), self.dialect.index.format("<new>")
            head, tail = self.dialect.if_
            body = [head.format(f"{row.format(best)} < {row.format('i')}"), f"    {self.assign('<new>', 'i')}", tail]
            lines = [self.assign("<new>", self.dialect.number(0.0)), *self.loop("i", node.args[0].size, body)]
        else:
            picked = self._array(node.args[0]).format(self.dialect.index.format(self._element(node.args[1])))
            lines = self.each("<new>", node.size, picked)
        self._names[at] = f"<{self._add(lines, node.size, node)}>"

    def _product(self, node: Node) -> list[str]:
        m, k, n = node.data
        a, b = self._array(node.args[0]), self._array(node.args[1])
        left = a.format(plus("" if m == 1 else f"{k} * i", "l"))
        right = b.format(plus("l" if n == 1 else f"{n} * l", "" if n == 1 else "j"))
        at = plus("" if m == 1 else f"{n} * i", "" if n == 1 else "j")
        lines = [
            self.assign("sum", self.dialect.number(0.0)),
            *self.loop("l", k, [self.assign("sum", f"sum + {left} * {right}")]),
            self.assign(f"<new>[{at}]" if at else "<new>", "sum"),
        ]
        lines = self.loop("j", n, lines) if n > 1 else lines
        return self.loop("i", m, lines) if m > 1 else lines

    def _array(self, ids: Ids) -> str:
        """Text of element ``{}`` of an array."""
        known = self.graph.values(ids)
        if known is not None:
            return self._table(known) + "[{}]"
        owners, steps = self._owners(ids), np.diff(ids)
        if len(owners) > 1 or not (steps == steps[:1]).all() or owners[0] in self._inlined:
            return f"<{self._copy(ids)}>" + ("[{}]" if ids.size > 1 else "")
        node, step = self.graph.nodes[owners[0]], int(steps[0]) if steps.size else 0
        if node.size == 1:
            return self._names[owners[0]]
        first = int(ids[0]) - node.start
        moved = "" if step == 0 else "{}" if step == 1 else f"{step} * ({{}})"
        return f"{self._names[owners[0]]}[{plus(moved, str(first) if first or not moved else '')}]"

    def _element(self, ids: Ids) -> str:
        """Text of element ``i`` of an argument."""
        known = self.graph.values(ids)
        if known is not None and (known.ravel() == known.flat[0]).all():
            value = known.flat[0]
            return self.dialect.logical[int(value)] if known.dtype == np.bool_ else self.dialect.number(value)
        owner = int(self.graph.owners(ids[0]))
        return self._inlined[owner] if owner in self._inlined else self._array(ids).format("i")

    def _table(self, values: Floats) -> str:
        wide = self.dialect is self.dialects[True]
        return self.tables.setdefault(
            (values.tobytes(), values.dtype.char, wide), (f"c{len(self.tables)}", values.ravel(), wide)
        )[0]

    def _copy(self, ids: Ids) -> int:
        """Work array that holds these elements next to each other."""
        key = ids.tobytes()
        if key not in self._copies:
            pieces = runs(ids, self.graph.owners(ids))
            lines = self.fill("<new>", pieces, lambda first, last: self._element(ids[first:last]))
            self._copies[key] = self._add(lines, ids.size, self.graph.owner(int(ids[0])))
        return self._copies[key]

    def _finish(self) -> None:
        """Copy results to the outputs, and to the memory where a sample was due."""
        changes: list[str] = []
        for cell in self.program.memory:
            size, nodes = cell.after.size, [self.graph.nodes[at] for at in self._owners(cell.after)]
            old = [node for node in nodes if node.op == "input" and node.data in self.cells]
            if old and old[0].data == cell.name and np.array_equal(cell.after, old[0].start + np.arange(size)):
                continue
            self.dialect = self.dialects[cell.wide]
            held = f"<{self._copy(cell.after)}>" + "[i]" * (size > 1) if old else self._element(cell.after)
            changes += self.each(self.dialect.prefixes[0] + cell.name, size, held)
        for port, ids in self.program.outputs:
            value = self._element(ids)
            value = self.dialect.whole.format(value) if port.name == "alarms" else value
            self._statements.append(([self.assign(self.dialect.prefixes[2] + port.name, value)], -1))
        head, tail = self.dialect.if_
        due = head.format(self._element(self.program.due))
        self._statements.append(([due, *(f"    {line}" for line in changes), tail], -1))

    def _allocated(self) -> tuple[dict[str, tuple[int, str]], list[str]]:
        """Work arrays by name, and the lines with their names; an array is used again after its last use.

        A kind is "b" for logical numbers, "d" for double precision, "w" for the controller's own.
        """
        token, last = re.compile(r"<(\d+)>"), dict[int, int]()
        texts = ["\n".join(lines).replace("<new>", f"<{new}>") for lines, new in self._statements]
        for at, text in enumerate(texts):
            last.update(dict.fromkeys(map(int, token.findall(text)), at))
        work: dict[str, tuple[int, str]] = {}
        free: dict[tuple[int, str], list[str]] = {}
        names: dict[int, str] = {}
        for at, ((_, new), text) in enumerate(zip(self._statements, texts, strict=True)):
            if new >= 0:
                kind = self._kinds[new]
                if not free.setdefault(kind, []):
                    free[kind].append(f"{kind[1]}{len(work)}")
                    work[free[kind][-1]] = kind
                names[new] = free[kind].pop()
            texts[at] = token.sub(lambda match: names[int(match[1])], text)
            for number in set(map(int, token.findall(text))):
                if last[number] == at:
                    free[self._kinds[number]].append(names[number])
        return work, "\n".join(texts).split("\n")


def plus(one: str, other: str) -> str:
    """The sum of two texts, of which an empty one is zero."""
    return " + ".join(part for part in (one, other) if part)


def runs(ids: Ids, owners: Ids) -> list[tuple[int, int]]:
    """First and last + 1 of the longest runs with equal steps within one node."""
    runs, first = [], 0
    for at in range(1, ids.size + 1):
        together = at < ids.size and owners[at] == owners[first]
        if together and (at - first < 2 or ids[at] - ids[at - 1] == ids[first + 1] - ids[first]):
            continue
        runs.append((first, at))
        first = at
    return runs
