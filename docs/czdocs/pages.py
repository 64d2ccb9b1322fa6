"""The index lists what there is: pages and reports that it does not name itself are put where it says."""

from __future__ import annotations

import re
from typing import Any

INDEX = "docs/index"
NAMED = re.compile(r"^(?:.*<)?([\w./-]+)>?$", re.MULTILINE)


def unnamed(found: set[str], text: str, under: str) -> list[str]:
    """Pages of a folder, without the index' own, whose path the index does not hold on a line of its own."""
    named = {match.group(1) for match in NAMED.finditer(text)}
    pages = (page.removeprefix(under) for page in found if page.startswith(under) and page != INDEX)
    return sorted(page for page in pages if page not in named)


def fill(app: Any, docname: str, source: list[str]) -> None:
    """Replace the index' two places for lists."""
    if docname != INDEX:
        return
    found = app.env.found_docs
    others = unnamed(found, source[0], "docs/")
    reports = [f"{page.partition('/')[0].capitalize()} <../results/{page}>" for page in unnamed(found, "", "results/")]
    source[0] = source[0].replace("{other pages}", "\n".join(others)).replace("{reports}", "\n".join(reports))


def setup(app: Any) -> dict[str, bool]:
    """Listen to reading."""
    app.connect("source-read", fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
