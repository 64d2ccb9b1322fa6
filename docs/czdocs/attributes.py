"""Docstrings of fields: the text below each, its unit in the first brackets."""

import ast
import inspect
import re
import textwrap
from typing import NamedTuple

UNIT = re.compile(r"\s*\[([^\]\[]*)\]")


class Attribute(NamedTuple):
    """A field of a class."""

    name: str
    unit: str
    meaning: str


def attributes(cls: type) -> list[Attribute]:
    """The fields of a NamedTuple or dataclass that carry a text, in order."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    found = []
    for field, text in zip(node.body, node.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            whole = " ".join(str(text.value.value).split())
            unit = UNIT.search(whole)
            meaning = UNIT.sub("", whole, count=1).rstrip(".")
            found.append(Attribute(field.target.id, unit.group(1) if unit else "", meaning))
    return found
