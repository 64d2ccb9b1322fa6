"""An interpreter of the structured text that is exported: declarations and statements, one line after the other."""

import math
import re
from typing import Any

FUNCTIONS: dict[str, Any] = {
    "ABS": abs, "SQRT": math.sqrt, "EXP": math.exp, "LN": math.log, "SIN": math.sin, "COS": math.cos,
    "MIN": lambda a, b: b if b < a else a, "MAX": lambda a, b: b if b > a else a,
    "LIMIT": lambda low, x, high: min(max(low, x), high), "SEL": lambda which, no, yes: yes if which else no,
    "LREAL_TO_DINT": round, "LREAL_TO_UDINT": round, "DINT_TO_LREAL": float, "TRUE": True, "FALSE": False,
}  # fmt: skip
WORDS = {"AND": "and", "OR": "or", "NOT": "not", "MOD": "%", "=": "=="}


def expression(text: str) -> str:
    """A Python expression for one of structured text."""
    words = re.split(r"(\s+|[()\[\],])", text)
    python = "".join(WORDS.get(word, word) for word in words)
    return re.sub(r"\[[^\[\]]*\]", lambda index: index[0].replace(" / ", " // "), python)


class FunctionBlock:
    """One function block: calls set inputs, run the statements, and return the outputs."""

    def __init__(self, text: str) -> None:
        text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.DOTALL)
        self.name = text.split()[1]
        *declared, body = text.split("END_VAR")
        self.values: dict[str, Any] = {}
        self.kinds: dict[str, str] = {}
        self.outputs: list[str] = []
        for section in declared:
            kind, _, rest = section.partition("VAR")[2].partition("\n")
            for name, type_, start in re.findall(r"(\w+) : ([^:;]+?)(?: := ([^;]*))?;", rest):
                self.values[name] = self._start(type_.strip(), start)
                self.kinds[name] = type_.strip()
                if kind.strip() == "_OUTPUT":
                    self.outputs.append(name)
        source, depth = ["def body():"], 1
        for line in filter(None, map(str.strip, body.partition("END_FUNCTION_BLOCK")[0].splitlines())):
            depth -= line in ("END_FOR;", "END_IF;")
            source.append("    " * depth + self._statement(line))
            depth += line.endswith((" DO", " THEN"))
        source.insert(1, f"    global {', '.join(self.values)}")
        self.space = FUNCTIONS | self.values
        exec(compile("\n".join(source), self.name, "exec"), self.space)

    def _start(self, kind: str, start: str) -> Any:
        if kind.startswith("ARRAY"):
            length = int(re.findall(r"\.\.(\d+)\]", kind)[0]) + 1
            given = [float(word) for word in start.strip("[] \n").split(",")] if start else [0.0] * length
            assert len(given) == length
            return given
        return start == "TRUE" if kind == "BOOL" else float(start or 0.0) if "REAL" in kind else int(start or 0)

    def _statement(self, line: str) -> str:
        if line in ("END_FOR;", "END_IF;"):
            return "pass"
        if loop := re.fullmatch(r"FOR (\w) := 0 TO (\d+) DO", line):
            return f"for {loop[1]} in range({int(loop[2]) + 1}):"
        if branch := re.fullmatch(r"IF (.*) THEN", line):
            return f"if {expression(branch[1])}:"
        target, sign, value = line.removesuffix(";").partition(" := ")
        assert sign, line
        assert line.endswith(";"), line
        assert target.partition("[")[0] in self.values, line
        return f"{expression(target)} = {expression(value)}"

    def __call__(self, **inputs: Any) -> dict[str, Any]:
        for name, value in inputs.items():
            self.space[name] = bool(value > 0.5) if self.kinds[name] == "BOOL" else float(value)
        self.space["body"]()
        return {name: self.space[name] for name in self.outputs}
