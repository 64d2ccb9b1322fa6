"""API pages: docstrings as this project writes them; the parameters' fields stand in the nomenclature."""

from __future__ import annotations

import re
from typing import Any

from cz_gym import Parameters

PLACE = "Alias for field number"
HEADING = re.compile(r"^## (.*)$")
CODE = re.compile(r"(``.*?``)")


def say(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Turn a docstring into reStructuredText: Gymnasium's headings, absolute values, and fields of tuples."""
    if lines and lines[0].startswith(PLACE):
        lines[:] = [""]
    lines[:] = [_plain(line) for line in lines]


def _plain(line: str) -> str:
    heading = HEADING.match(line)
    if heading:
        return f"**{heading.group(1)}**"
    return "".join(part if part.startswith("``") else part.replace("|", r"\|") for part in CODE.split(line))


def sign(app: Any, what: str, name: str, thing: Any, options: Any, signature: str | None, returns: str | None) -> Any:
    """The parameters' signature without their descriptions, which stand below it."""
    if thing is not Parameters:
        return None
    defaults = (f"{field}={value:.6g}" for field, value in Parameters()._asdict().items())
    return f"({', '.join(defaults)})", None


def skip(app: Any, what: str, name: str, thing: Any, skipped: bool, options: Any) -> bool | None:
    """Leave the parameters' fields to the nomenclature."""
    return True if name in Parameters._fields and thing is vars(Parameters).get(name) else None


def setup(app: Any) -> dict[str, bool]:
    """Listen to autodoc."""
    app.connect("autodoc-process-docstring", say)
    app.connect("autodoc-process-signature", sign)
    app.connect("autodoc-skip-member", skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
