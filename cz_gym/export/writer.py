"""The statements of a recorded program in a language: C99, or IEC 61131-3 structured text.

A :class:`Writer` orders the statements and gives their results to a small pool of work arrays, a :class:`Dialect` says
how a language writes them. An operation whose result is used once, element by element, becomes part of an expression.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from .program import Program
from .trace import FUNCTIONS, Ids, Node

LONGEST = 90
"""Longest expression that becomes part of another one, in characters."""
C_OPERATIONS = {
    "add": "({0} + {1})", "subtract": "({0} - {1})", "multiply": "({0} * {1})", "divide": "({0} / {1})",
    "negative": "(-{0})", "absolute": "fabs({0})", "sqrt": "sqrt@({0})", "exp": "exp@({0})", "log": "log@({0})",
    "sin": "sin@({0})", "cos": "cos@({0})", "tanh": "tanh@({0})", "minimum": "fmin@({0}, {1})",
    "maximum": "fmax@({0}, {1})", "less": "({0} < {1})", "less_equal": "({0} <= {1})", "equal": "({0} == {1})",
    "and": "({0} && {1})", "or": "({0} || {1})", "not": "(!{0})", "select": "({0} ? {1} : {2})",
    "finite": "(fabs({0}) <= 1e38)", "real": "({0} ? 1.0 : 0.0)",
}  # fmt: skip
ST_OPERATIONS = {
    "add": "({0} + {1})", "subtract": "({0} - {1})", "multiply": "({0} * {1})", "divide": "({0} / {1})",
    "negative": "(-{0})", "absolute": "ABS({0})", "sqrt": "SQRT({0})", "exp": "EXP({0})", "log": "LN({0})",
    "sin": "SIN({0})", "cos": "COS({0})",
    "tanh": "(1.0 - 2.0 / (EXP(2.0 * LIMIT(-20.0, {0}, 20.0)) + 1.0))", "minimum": "MIN({0}, {1})",
    "maximum": "MAX({0}, {1})", "less": "({0} < {1})", "less_equal": "({0} <= {1})", "equal": "({0} = {1})",
    "and": "({0} AND {1})", "or": "({0} OR {1})", "not": "(NOT {0})", "select": "SEL({0}, {2}, {1})",
    "finite": "(ABS({0}) <= 1.0E38)", "real": "SEL({0}, 0.0, 1.0)",
}  # fmt: skip


@dataclass(frozen=True)
class Dialect:
    """How a language writes expressions and loops."""

    operations: dict[str, str]
    true: str
    false: str
    assign: str
    end: str
    """End of a statement."""
    loop: tuple[str, str]
    """Begin of a loop over ``{0}`` from 0 to ``{1}``, which is not included, or ``{2}``, which is; and its end."""
    if_: tuple[str, str]
    remainder: str
    index: str
    """A whole number in a real one, as an index."""
    memory: str
    """Prefix of memory and settings."""
    given: str
    """Prefix of inputs."""
    result: str
    """Prefix of outputs."""
    literal: str
    """End of a literal."""
    function: str
    """End of a function's name."""
    whole: str
    """A real number as the type of the alarms."""

    def number(self, value: float) -> str:
        """A literal."""
        text = repr(float(value))
        mantissa, _, exponent = text.partition("e")
        if "." not in mantissa:
            mantissa += ".0"
        text = mantissa + (f"E{int(exponent)}" if exponent else "")
        return f"({text}{self.literal})" if value < 0 else text + self.literal


def c_dialect(single: bool) -> Dialect:
    """C99 in double or single precision."""
    end = "f" if single else ""
    return Dialect(
        C_OPERATIONS, "1", "0", " = ", ";", ("for ({0} = 0; {0} < {1}; {0}++) {{", "}"), ("if ({0}) {{", "}"), "%",
        "(int)({0})", "block->", "measured->", "setpoints->", end, end, "(unsigned)({0})",
    )  # fmt: skip


def st_dialect(single: bool) -> Dialect:
    """Structured text in LREAL or REAL."""
    real = "REAL" if single else "LREAL"
    return Dialect(
        ST_OPERATIONS, "TRUE", "FALSE", " := ", ";", ("FOR {0} := 0 TO {2} DO", "END_FOR;"),
        ("IF {0} THEN", "END_IF;"), " MOD ", f"{real}_TO_DINT({{0}})", "", "", "", "", "", f"{real}_TO_UDINT({{0}})",
    )  # fmt: skip


@dataclass
class Statement:
    """Lines of text in which work arrays stand as ``<number>``."""

    lines: list[str]
    defines: int = -1


class Writer:
    """The statements of a program in a dialect, with the work arrays and the constants that they need."""

    def __init__(self, program: Program, dialect: Dialect) -> None:
        self.program, self.dialect, self.graph = program, dialect, program.graph
        self.cells = {cell.name: cell for cell in program.memory}
        self.settings = {port.name for port in program.settings}
        self.tables: dict[bytes, tuple[str, Any]] = {}
        self.statements: list[Statement] = []
        self.sizes: dict[int, tuple[int, bool]] = {}
        self.inlined: dict[int, str] = {}
        self.copies: dict[bytes, int] = {}
        self.uses: Counter[int] = Counter()
        self.users: dict[int, tuple[Node, Ids]] = {}
        for node in program.nodes:
            for ids in node.args:
                self.uses.update(self._owners(ids))
                self.users.update(dict.fromkeys(self._owners(ids), (node, ids)))
        once = [*(ids for _, ids in program.outputs), *(cell.after for cell in program.memory), program.due]
        self.uses.update(owner for ids in once for owner in 2 * self._owners(ids))
        for node in program.nodes:
            self._node(node)
        self._finish()
        self.work, self.body = self._allocated()

    def _owners(self, ids: Ids) -> list[int]:
        return sorted(set((np.searchsorted(self.graph.starts, ids, side="right") - 1).tolist()))

    def _add(self, lines: list[str], size: int = 0, logical: bool = False) -> int:
        number = len(self.sizes)
        if size:
            self.sizes[number] = size, logical
        self.statements.append(Statement(lines, number if size else -1))
        return number

    def loop(self, variable: str, count: int, lines: list[str]) -> list[str]:
        """Lines that run for a variable from 0 to count - 1."""
        head, tail = self.dialect.loop
        return [head.format(variable, count, count - 1), *(f"    {line}" for line in lines), tail]

    def assign(self, target: str, value: str) -> str:
        """A statement that gives a target its value."""
        return f"{target}{self.dialect.assign}{value}{self.dialect.end}"

    def _node(self, node: Node) -> None:
        if node.op == "input":
            return
        size, new = node.size, "<new>" + ("[{}]" if node.size > 1 else "")
        if node.op in FUNCTIONS:
            args = [self._element(ids, "i") for ids in node.args]
            text = self.dialect.operations[node.op].replace("@", self.dialect.function).format(*args)
            if self.uses[self._at(node)] == 1 and len(text) <= LONGEST and self._joins(node):
                self.inlined[self._at(node)] = text
                return
            line = [self.assign(new.format("i"), _bare(text))]
            lines = self.loop("i", size, line) if size > 1 else line
        elif node.op == "matmul":
            lines = self._product(node)
        elif node.op == "argmax":
            row, best = self._array(node.args[0]), self.dialect.index.format("<new>")
            head, tail = self.dialect.if_
            body = [head.format(row.format(best) + " < " + row.format("i")), "    " + self.assign("<new>", "i"), tail]
            lines = [self.assign("<new>", self.dialect.number(0.0)), *self.loop("i", node.args[0].size, body)]
        else:
            row = self._array(node.args[0])
            line = [
                self.assign(new.format("i"), row.format(self.dialect.index.format(self._element(node.args[1], "i"))))
            ]
            lines = self.loop("i", size, line) if size > 1 else line
        self.copies[f"node {self._at(node)}".encode()] = self._add(lines, size, node.logical)

    def _at(self, node: Node) -> int:
        return int(np.searchsorted(self.graph.starts, node.start, side="right")) - 1

    def _joins(self, node: Node) -> bool:
        """Whether the one use of a node is the same element of an operation on each element."""
        user, ids = self.users[self._at(node)]
        return user.op in FUNCTIONS and np.array_equal(ids, node.start + np.arange(node.size))

    def _product(self, node: Node) -> list[str]:
        m, k, n = node.data
        a, b = self._array(node.args[0]), self._array(node.args[1])
        row = "" if m == 1 else (f"{k} * i" if k > 1 else "i")
        left = a.format(plus(row, "l"))
        right = b.format(plus("l" if n == 1 else f"{n} * l", "" if n == 1 else "j"))
        at = plus("" if m == 1 else ("i" if n == 1 else f"{n} * i"), "" if n == 1 else "j")
        target = f"<new>[{at}]" if m * n > 1 else "<new>"
        lines = [
            self.assign("sum", self.dialect.number(0.0)),
            *self.loop("l", k, [self.assign("sum", f"sum + {left} * {right}")]),
            self.assign(target, "sum"),
        ]
        lines = self.loop("j", n, lines) if n > 1 else lines
        return self.loop("i", m, lines) if m > 1 else lines

    def _array(self, ids: Ids) -> str:
        """Text of an array's element ``{}``."""
        known = self.graph.values(ids)
        if known is not None:
            return self._table(known) + "[{}]"
        owners = self._owners(ids)
        node = self.graph.nodes[owners[0]]
        whole = len(owners) == 1 and np.array_equal(ids, node.start + np.arange(node.size))
        if whole and node.size > 1 and owners[0] not in self.inlined:
            return self._name(owners[0]) + "[{}]"
        return f"<{self._copy(ids)}>" + ("[{}]" if ids.size > 1 else "")

    def _element(self, ids: Ids, i: str) -> str:
        """Text of element i of an argument."""
        known = self.graph.values(ids)
        if known is not None:
            flat = known.ravel()
            if (flat == flat[0]).all():
                if known.dtype == np.bool_:
                    return self.dialect.true if flat[0] else self.dialect.false
                return self.dialect.number(flat[0])
            return f"{self._table(known)}[{i}]"
        owners = self._owners(ids)
        pattern = _pattern(ids - self.graph.nodes[owners[0]].start, i, self.dialect) if len(owners) == 1 else None
        if pattern is None:
            return f"<{self._copy(ids)}>[{i}]"
        if owners[0] in self.inlined:
            return self.inlined[owners[0]]
        node = self.graph.nodes[owners[0]]
        return self._name(owners[0]) + (f"[{pattern}]" if node.size > 1 else "")

    def _name(self, owner: int) -> str:
        """Name of a node's array or number."""
        node = self.graph.nodes[owner]
        if node.op != "input":
            return f"<{self.copies[f'node {owner}'.encode()]}>"
        own = node.data in self.cells or node.data in self.settings
        return f"{self.dialect.memory if own else self.dialect.given}{node.data}"

    def _table(self, values: Any) -> str:
        key = values.tobytes() + values.dtype.char.encode()
        self.tables.setdefault(key, (f"c{len(self.tables)}", values.ravel()))
        name: str = self.tables[key][0]
        return name

    def _copy(self, ids: Ids) -> int:
        """Work array that holds these elements next to each other."""
        key = ids.tobytes()
        if key not in self.copies:
            lines: list[str] = []
            for first, last in runs(ids, self._starts(ids)):
                part = ids[first:last]
                source = self._element(part, "i")
                at = f"[{plus('i' if last - first > 1 else '', str(first) if first else '')}]" if ids.size > 1 else ""
                at = at.replace("[]", "[0]")
                line = [self.assign(f"<new>{at}", source)]
                lines += self.loop("i", last - first, line) if last - first > 1 else line
            logical = self.graph.owner(int(ids[0])).logical
            self.copies[key] = self._add(lines, ids.size, logical)
        return self.copies[key]

    def _starts(self, ids: Ids) -> Any:
        return np.searchsorted(self.graph.starts, ids, side="right") - 1

    def _finish(self) -> None:
        """Copy results to the outputs, and to the memory where a sample was due."""
        changes: list[str] = []
        for cell in self.program.memory:
            owners = self._owners(cell.after)
            nodes = [self.graph.nodes[at] for at in owners]
            if [node.data for node in nodes if node.op == "input"] == [cell.name] and np.array_equal(
                cell.after, nodes[0].start + np.arange(cell.after.size)
            ):
                continue
            name = self.dialect.memory + cell.name
            if any(node.op == "input" and node.data in self.cells for node in nodes) and cell.after.size > 1:
                source = f"<{self._copy(cell.after)}>[i]"
            elif any(node.op == "input" and node.data in self.cells for node in nodes):
                source = f"<{self._copy(cell.after)}>"
            else:
                source = self._element(cell.after, "i")
            if cell.after.size > 1:
                changes += self.loop("i", cell.after.size, [self.assign(f"{name}[i]", source)])
            else:
                changes.append(self.assign(name, source))
        for port, ids in self.program.outputs:
            value = self._element(ids, "0")
            value = self.dialect.whole.format(value) if port.name == "alarms" else value
            self._add([self.assign(self.dialect.result + port.name, value)])
        head, tail = self.dialect.if_
        self._add([head.format(self._element(self.program.due, "0")), *(f"    {line}" for line in changes), tail])

    def _allocated(self) -> tuple[dict[str, tuple[int, bool]], list[str]]:
        """Work arrays by name, and the lines with their names; an array is used again after its last use."""
        token = re.compile(r"<(\d+|new)>")
        last: dict[int, int] = {}
        for at, statement in enumerate(self.statements):
            for word in token.findall("\n".join(statement.lines)):
                last[statement.defines if word == "new" else int(word)] = at
        work: dict[str, tuple[int, bool]] = {}
        free: dict[tuple[int, bool], list[str]] = {}
        names: dict[int, str] = {}
        lines: list[str] = []
        for at, statement in enumerate(self.statements):
            if statement.defines >= 0:
                kind = self.sizes[statement.defines]
                if not free.get(kind):
                    free.setdefault(kind, []).append(f"{'b' if kind[1] else 'w'}{len(work)}")
                    work[free[kind][-1]] = kind
                names[statement.defines] = free[kind].pop()
            mine = statement.defines

            def named(match: re.Match[str], mine: int = mine) -> str:
                return names[mine if match[1] == "new" else int(match[1])]

            lines += [token.sub(named, line) for line in statement.lines]
            for number in [number for number, use in last.items() if use == at]:
                free[self.sizes[number]].append(names[number])
        return work, lines


def _bare(text: str) -> str:
    """An expression without parentheses around all of it."""
    depth = 0
    for at, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0:
            return text[1:-1] if at == len(text) - 1 and text[0] == "(" else text
    return text


def plus(one: str, other: str) -> str:
    """The sum of two texts, of which an empty one is zero."""
    return " + ".join(part for part in (one, other) if part)


def _pattern(at: Ids, i: str, dialect: Dialect) -> str | None:
    """Text of the i-th of these indices; None if there is no short one."""
    first = int(at[0])
    if (at == first).all():
        return str(first)

    def term(stride: int, text: str) -> str:
        return "" if stride == 0 else text if stride == 1 else f"{stride} * {text}"

    steps = np.diff(at)
    if (steps == steps[0]).all():
        if steps[0] < 0:
            return f"{first} - {term(-int(steps[0]), i)}"
        return plus(term(int(steps[0]), i), str(first) if first else "")
    for m in (m for m in range(2, at.size) if at.size % m == 0):
        table = at.reshape(-1, m)
        inner, outer = np.diff(table, axis=1), np.diff(table[:, 0])
        if (inner == inner[0, 0]).all() and (outer == outer[0]).all() and inner[0, 0] >= 0 and outer[0] >= 0:
            parts = term(int(outer[0]), f"({i} / {m})"), term(int(inner[0, 0]), f"({i}{dialect.remainder}{m})")
            return plus(plus(*parts), str(first) if first else "")
    return None


def runs(ids: Ids, owners: Any) -> list[tuple[int, int]]:
    """First and last + 1 of the longest runs with equal steps within one node."""
    runs, first = [], 0
    for at in range(1, ids.size + 1):
        together = at < ids.size and owners[at] == owners[first]
        if together and (at - first < 2 or ids[at] - ids[at - 1] == ids[first + 1] - ids[first]):
            continue
        runs.append((first, at))
        first = at
    return runs
