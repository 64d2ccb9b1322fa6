"""API pages: docstrings as this project writes them, and links to names that stand on no page; the link to the game."""

import dataclasses
import pkgutil
import re
from typing import Any

from sphinx.addnodes import desc_annotation

from cz_gym import Parameters
from cz_gym.body.signals import Measured
from cz_gym.camera.view import Camera

DESCRIBED: tuple[Any, ...] = (Parameters, Camera, Measured)
"""Records whose fields are in a table of a page."""
LONGEST = 25
"""Longest default in a signature, and longest value of a constant [characters]."""
PLACE = "Alias for field number"
HEADING = re.compile(r"^## (.*)$")
GAME = re.compile(r"\[([^]]+)\]\([\w./]*_root/play\.html\)")
"""Link to the page on which a visitor pulls a crystal."""
CODE = re.compile(r"(``.*?``)")


def say(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Turn a docstring into reStructuredText: Gymnasium's headings, absolute values, and fields of tuples."""
    if lines and lines[0].startswith(PLACE):
        lines[:] = [""]
    lines[:] = [_plain(line) for line in lines]


def _plain(line: str) -> str:
    line = HEADING.sub(r"**\1**", line)
    return "".join(part if part.startswith("``") else part.replace("|", r"\|") for part in CODE.split(line))


def sign(app: Any, what: str, name: str, thing: Any, options: Any, signature: str | None, returns: str | None) -> Any:
    """The signature of a record: names, and defaults that are short enough to read."""
    if thing in DESCRIBED:
        defaults = thing._field_defaults
    elif dataclasses.is_dataclass(thing) and isinstance(thing, type):
        defaults = {field.name: field.default for field in dataclasses.fields(thing)}
    else:
        return None
    shown = {name: f"{value:.6g}" if isinstance(value, float) else repr(value) for name, value in defaults.items()}
    ends = {name: "" if defaults[name] is dataclasses.MISSING else f"={text}" for name, text in shown.items()}
    return f"({', '.join(name + (end if len(end) <= LONGEST else '=...') for name, end in ends.items())})", returns


def skip(app: Any, what: str, name: str, thing: Any, skipped: bool, options: Any) -> bool | None:
    """Leave the fields of what a table describes to the table."""
    return True if any(thing is vars(described).get(name) for described in DESCRIBED) else None


def open_game(app: Any, docname: str, source: list[str]) -> None:
    """Link to the game's page at the site's root: Sphinx would offer it for download."""
    place = "../" * docname.count("/") + "play.html"
    source[0] = GAME.sub(rf'<a href="{place}">\1</a>', source[0])


def exists(app: Any, domain: Any, node: Any) -> bool | None:
    """Nobody is warned of a name that is there but that no page describes; a name that is not there is a warning."""
    target, within = node.get("reftarget", ""), node.get("py:module")
    for name in (target, f"{within}.{target}"):
        try:
            pkgutil.resolve_name(name)
        except (ImportError, AttributeError, ValueError):
            continue
        return True
    return None


def shorten(app: Any, domain: str, kind: str, content: Any) -> None:
    """Leave out the value of a constant that is too long to read: autodoc shows those of a module's members."""
    for node in list(content.parent.findall(desc_annotation)):
        if node.astext().lstrip().startswith("=") and len(node.astext()) > LONGEST:
            node.parent.remove(node)


def setup(app: Any) -> dict[str, bool]:
    """Listen to autodoc."""
    app.connect("object-description-transform", shorten)
    app.connect("autodoc-process-docstring", say)
    app.connect("autodoc-process-signature", sign)
    app.connect("autodoc-skip-member", skip)
    app.connect("source-read", open_game)
    app.connect("warn-missing-reference", exists)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
