"""The statements of a recorded program in a language: C99, or IEC 61131-3 structured text.

A :class:`StatementWriter` orders the statements and gives their results to a small pool of work arrays, a
:class:`Dialect` says how a language writes them. An operation whose result is used once, element by element, becomes
part of an expression.
"""

import re
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from .trace import FUNCTIONS, Floats, Ids, Node, Program

LONGEST = 90
"""Longest expression that becomes part of another one, in characters."""
SYNTAX = {
    "add": ("({0} + {1})", "({0} + {1})"),
    "subtract": ("({0} - {1})", "({0} - {1})"),
    "multiply": ("({0} * {1})", "({0} * {1})"),
    "divide": ("({0} / {1})", "({0} / {1})"),
    "negative": ("(-{0})", "(-{0})"),
    "absolute": ("fabs{f}({0})", "ABS({0})"),
    "sqrt": ("sqrt{f}({0})", "SQRT({0})"),
    "exp": ("exp{f}({0})", "EXP({0})"),
    "log": ("log{f}({0})", "LN({0})"),
    "sin": ("sin{f}({0})", "SIN({0})"),
    "cos": ("cos{f}({0})", "COS({0})"),
    "tanh": ("tanh{f}({0})", "(1.0 - 2.0 / (EXP(2.0 * LIMIT(-20.0, {0}, 20.0)) + 1.0))"),
    "minimum": ("fmin{f}({0}, {1})", "MIN({0}, {1})"),
    "maximum": ("fmax{f}({0}, {1})", "MAX({0}, {1})"),
    "less": ("({0} < {1})", "({0} < {1})"),
    "less_equal": ("({0} <= {1})", "({0} <= {1})"),
    "equal": ("({0} == {1})", "({0} = {1})"),
    "and": ("({0} && {1})", "({0} AND {1})"),
    "or": ("({0} || {1})", "({0} OR {1})"),
    "not": ("(!{0})", "(NOT {0})"),
    "select": ("({0} ? {1} : {2})", "SEL({0}, {2}, {1})"),
    "finite": ("(fabs{f}({0}) <= 1e38{f})", "(ABS({0}) <= 1.0E38)"),
    "real": ("({0} ? 1.0{f} : 0.0{f})", "SEL({0}, 0.0, 1.0)"),
    "number": ("{0}{f}", "{0}"),
    "false": ("0", "FALSE"),
    "true": ("1", "TRUE"),
    "to d": ("(double){0}", "REAL_TO_LREAL({0})"),
    "to w": ("(float){0}", "LREAL_TO_REAL({0})"),
    "count": ("({real}){0}", "DINT_TO_{real}({0})"),
    "index": ("(int)({0})", "{real}_TO_DINT({0})"),
    "bits": ("(unsigned)({0})", "{real}_TO_UDINT({0})"),
    "memory": ("block->{0}", "{0}"),
    "reading": ("measured->{0}", "{0}"),
    "setpoint": ("setpoints->{0}", "{0}"),
    "assign": ("{0} = {1};", "{0} := {1};"),
    "loop": ("for (int {0} = 0; {0} < {1}; {0}++) {{", "FOR {0} := 0 TO {2} DO"),
    "end loop": ("}}", "END_FOR;"),
    "if": ("if ({0}) {{", "IF {0} THEN"),
    "end if": ("}}", "END_IF;"),
    "type of reading": ("double", "LREAL"),
    "type of switch": ("int", "BOOL"),
    "type of alarms": ("unsigned", "UDINT"),
    "type of b": ("unsigned char", "BOOL"),
    "type of d": ("double", "LREAL"),
    "type of w": ("{block}_real", "{real}"),
    "type of real": ("{real}", "{real}"),
    "declare input": ("{type} {name}; /* {meaning} */", "{name} : {type} := {start}; (* {meaning} *)"),
    "declare setting": (
        "{type} {name}; /* {meaning}; default {default:.10g} */",
        "{name} : {type} := {start}; (* {meaning} *)",
    ),
    "declare output": ("{type} {name}; /* {meaning} */", "{name} : {type}; (* {meaning} *)"),
    "declare number": ("{type} {name};", "{name} : {type};"),
    "declare array": ("{type} {name}[{size}];", "{name} : ARRAY [0..{last}] OF {type};"),
    "declare table": (
        "static const {type} {name}[{size}] = {{\n{rows}\n}};",
        "    {name} : ARRAY [0..{last}] OF {type} := [\n{rows}\n    ];",
    ),
    "tables": ("{0}", "VAR CONSTANT\n{0}\nEND_VAR"),
    "place": ("{1} *const {0} = block->work.{0};", ""),
    "bit": ("#define {BLOCK}_{0} {1}u /* {2} */", "{1}: {2}"),
}
"""Operations, statements and declarations in C99 and in structured text.

A loop runs over ``{0}`` from 0 to ``{1}``, which is not included, or ``{2}``, which is.
"""


class Dialect:
    """A column of :data:`SYNTAX`: how C or structured text writes a block's statements in one precision."""

    def __init__(self, language: str, block: str, single: bool) -> None:
        self._syntax = {what: texts[language == "st"] for what, texts in SYNTAX.items()}
        real = {"c": ("double", "float"), "st": ("LREAL", "REAL")}[language][single]
        self._names = {"block": block, "BLOCK": block.upper(), "real": real, "f": "f" if single else ""}

    def __call__(self, what: str, *parts: Any, **named: Any) -> str:
        """The text of an entry of :data:`SYNTAX`, filled with its parts."""
        return self._syntax[what].format(*parts, **self._names, **named)

    def number(self, value: float) -> str:
        """A literal."""
        mantissa, e, exponent = repr(float(value)).partition("e")
        return self("number", f"{mantissa}{'' if '.' in mantissa else '.0'}{e and f'E{int(exponent)}'}")

    def around(self, lines: list[str], what: str, *parts: Any) -> list[str]:
        """Lines within a loop or a condition."""
        return [self(what, *parts), *(f"    {line}" for line in lines), self(f"end {what}")]

    def declare(self, what: str, kind: str, name: str, size: int = 1, **more: Any) -> str:
        """A declaration."""
        type_ = self(f"type of {kind}")
        return self(f"declare {what}", type=type_, name=name, size=size, last=size - 1, **more)

    def variable(self, kind: str, name: str, size: int) -> str:
        """The declaration of a number, or of an array if there are several."""
        return self.declare("array" if size > 1 else "number", kind, name, size)


class StatementWriter:
    """The statements of a program in a dialect, with the work arrays and the constants that they need."""

    def __init__(self, program: Program, language: str, single: bool) -> None:
        """The language is "c" or "st"; in single precision, readings, settings and sums over time stay in double."""
        self.program, self.graph, block = program, program.graph, f"cz_{program.name}"
        self.dialects = Dialect(language, block, single), Dialect(language, block, False)
        self.dialect, self.single = self.dialects[False], single
        self.cells = {cell.name: "d" if cell.wide else "w" for cell in program.memory}
        self.own = self.cells.keys() | {port.name for port in program.settings}
        self.switches = {port.name for port in program.inputs if port.logical}
        self.tables: dict[tuple[bytes, str, bool], tuple[str, Floats, bool]] = {}
        """Name and numbers of each table of constants, and whether they are in double precision."""
        self._statements: list[tuple[list[str], int]] = []
        """Lines in which work arrays stand as ``<number>``; the number of the array that they fill, or -1."""
        self._kinds: dict[int, tuple[int, str]] = {}
        self._inlined: dict[int, tuple[str, str]] = {}
        """Expressions that stand in others, and their kinds."""
        self._names: dict[int, str] = {}
        self._copies: dict[bytes, int] = {}
        self._uses: Counter[int] = Counter()
        self._users: dict[int, tuple[Node, Ids]] = {}
        for node in program.nodes:
            for ids in node.args:
                self._uses.update(self._owners(ids))
                self._users.update(dict.fromkeys(self._owners(ids), (node, ids)))
        results = (*(ids for _, ids in program.outputs), *(cell.after for cell in program.memory))
        for ids in (*results, program.due, program.again):
            self._uses.update(2 * self._owners(ids))
        for node in program.nodes:
            self._node(node)
        self._finish()
        self.work, self.body = self._allocated()
        if any(node.op == "matmul" for node in program.nodes):
            self.work["sum"] = 1, "w"

    def loop(self, variable: str, count: int, lines: list[str]) -> list[str]:
        """Lines that run for a variable from 0 to count - 1."""
        return self.dialect.around(lines, "loop", variable, count, count - 1)

    def assign(self, target: str, value: str) -> str:
        """A statement that gives a target its value."""
        return self.dialect("assign", target, value)

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

    def _kind(self, ids: Ids) -> str:
        """Kind of some elements: "b" for logical ones, "d" for double precision, "w" for the controller's own, "" for
        constants."""
        owners = [at for at in self._owners(ids) if self.graph.nodes[at].op != "constant"]
        kinds = {self._inlined[at][1] if at in self._inlined else self._stored(self.graph.nodes[at]) for at in owners}
        return max(kinds - {"w"}, default="w" if kinds else "")

    def _stored(self, node: Node) -> str:
        if node.op == "input":
            return "w" if node.data in self.switches else self.cells.get(node.data, "d")
        return "b" if node.logical else "d" if node.wide else "w"

    def _as(self, kind: str, text: str, of: str) -> str:
        """An expression of one kind as one of another."""
        return self.dialect(f"to {kind}", text) if self.single and {kind, of} == {"d", "w"} else text

    def _add(self, lines: list[str], size: int, kind: str) -> int:
        """A new work array of a kind, which these lines fill; its number."""
        self._kinds[len(self._kinds)] = size, kind
        self._statements.append((lines, len(self._kinds) - 1))
        return len(self._kinds) - 1

    def _node(self, node: Node) -> None:
        at, self.dialect = int(self.graph.owners(node.start)), self.dialects[node.wide]
        if node.op == "input":
            name = self.dialect("memory" if node.data in self.own else "reading", node.data)
            self._names[at] = self.dialect("real", name) if node.data in self.switches else name
            return
        kind = self._stored(node)
        if node.op in FUNCTIONS:
            result, text = self._expression(node)
            if self._uses[at] == 1 and len(text) <= LONGEST:
                user, used = self._users[at]
                if user.op in FUNCTIONS and np.array_equal(used, node.start + np.arange(node.size)):
                    self._inlined[at] = text, result
                    return
            lines = self.each("<new>", node.size, self._as(kind, text, result))
        elif node.op == "matmul":
            lines = self._product(node)
        elif node.op == "argmax":
            row, best = self._array(node.args[0]), self.dialect("index", "<new>")
            larger = f"{row.format(best)} < {row.format('i')}"
            body = self.dialect.around([self.assign("<new>", self.dialect("count", "i"))], "if", larger)
            lines = [self.assign("<new>", self.dialect.number(0.0)), *self.loop("i", node.args[0].size, body)]
        else:
            picked = self._array(node.args[0]).format(self.dialect("index", self._element(node.args[1], "")))
            lines = self.each("<new>", node.size, self._as(kind, picked, self._kind(node.args[0])))
        self._names[at] = f"<{self._add(lines, node.size, kind)}>"

    def _expression(self, node: Node) -> tuple[str, str]:
        """The kind and the text of an operation on single numbers: in double precision if an argument is."""
        kind = max("d" if node.wide else "w", *({self._kind(ids) for ids in node.args} - {"b"}), key="w d".find)
        kind = "d" if kind == "d" else "w"
        self.dialect = self.dialects[kind == "d"]
        text = self.dialect(node.op, *(self._element(ids, kind) for ids in node.args))
        self.dialect = self.dialects[node.wide]
        return ("b" if node.logical else kind), text

    def _product(self, node: Node) -> list[str]:
        m, k, n = node.data
        self.dialect = self.dialects[False]
        a, b = self._array(node.args[0]), self._array(node.args[1])
        left = self._as("w", a.format(plus("" if m == 1 else f"{k} * i", "l")), self._kind(node.args[0]))
        right = b.format(plus("l" if n == 1 else f"{n} * l", "" if n == 1 else "j"))
        right = self._as("w", right, self._kind(node.args[1]))
        at = plus("" if m == 1 else f"{n} * i", "" if n == 1 else "j")
        lines = [
            self.assign("sum", self.dialect.number(0.0)),
            *self.loop("l", k, [self.assign("sum", f"sum + {left} * {right}")]),
            self.assign(f"<new>[{at}]" if at else "<new>", self._as(self._stored(node), "sum", "w")),
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

    def _element(self, ids: Ids, kind: str) -> str:
        """Text of element ``i`` of an argument, as one of a kind if there is one."""
        known = self.graph.values(ids)
        if known is not None and (known.ravel() == known.flat[0]).all():
            value = known.flat[0]
            if known.dtype == np.bool_:
                return self.dialect("true" if value else "false")
            return f"({self.dialect.number(value)})" if value < 0 else self.dialect.number(value)
        owner = int(self.graph.owners(ids[0]))
        text = self._inlined[owner][0] if owner in self._inlined else self._array(ids).format("i")
        return self._as(kind, text, self._kind(ids))

    def _table(self, values: Floats) -> str:
        wide = self.dialect is self.dialects[True]
        return self.tables.setdefault(
            (values.tobytes(), values.dtype.char, wide), (f"c{len(self.tables)}", values.ravel(), wide)
        )[0]

    def _copy(self, ids: Ids) -> int:
        """Work array that holds these elements next to each other."""
        key = ids.tobytes()
        if key not in self._copies:
            pieces, kind = runs(ids, self.graph.owners(ids)), self._kind(ids)
            lines = self.fill("<new>", pieces, lambda first, last: self._element(ids[first:last], kind))
            self._copies[key] = self._add(lines, ids.size, kind)
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
            kind = self.cells[cell.name]
            held = f"<{self._copy(cell.after)}>" + "[i]" * (size > 1) if old else self._element(cell.after, kind)
            held = self._as(kind, held, self._kind(cell.after)) if old else held
            changes += self.each(self.dialect("memory", cell.name), size, held)
        for port, ids in self.program.outputs:
            value = self._element(ids, "w")
            value = self.dialect("bits", value) if port.name == "alarms" else value
            self._statements.append(([self.assign(self.dialect("setpoint", port.name), value)], -1))
        self.dialect = self.dialects[False]
        self._statements.append(([self.assign("again", self._element(self.program.again, ""))], -1))
        self._statements.append((self.dialect.around(changes, "if", self._element(self.program.due, "")), -1))

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
