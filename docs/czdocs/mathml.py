"""Formulas as MathML, written when the site is built: browsers show them without scripts, fonts or a network."""

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert

TAG = re.compile(r"\\tag\{([^}]*)\}")
FUNCTION = re.compile(r"<mi>((?:arc)?(?:sin|cos|tan)|cot|exp|ln)</mi>")


def mathml(formula: str, display: str) -> str:
    """LaTeX as MathML, with the thin space that belongs round the name of a function."""
    return FUNCTION.sub(r'<mo lspace="0.17em" rspace="0.17em">\1</mo>', convert(formula, display=display))


def inline(writer: Any, node: nodes.Element) -> None:
    """Write a formula within a line."""
    writer.body.append(mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def block(writer: Any, node: nodes.Element) -> None:
    r"""Write a displayed formula; the number of its ``\tag`` becomes an anchor ``eq-number``."""
    text = node.astext()
    formula = mathml(TAG.sub("", text).strip(), "block")
    place, number = "", ""
    if tag := TAG.search(text):
        place = f' id="eq-{tag.group(1)}"'
        number = f'<a class="equation-number" href="#eq-{tag.group(1)}">({tag.group(1)})</a>'
    writer.body.append(f'<div class="equation"{place}>{formula}{number}</div>\n')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    """Register the renderer."""
    app.add_html_math_renderer("mathml", inline_renderers=(inline, None), block_renderers=(block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
