"""Tables in Markdown, as the studies' reports have them."""

from __future__ import annotations

from collections.abc import Iterable


def table(heads: Iterable[str], rows: Iterable[Iterable[str]], rule: str = "--:") -> str:
    """A table; ``rule`` is the line under the heads of all columns but the first."""
    heads = list(heads)
    lines = [f"| {' | '.join(heads)} |", "|---|" + f"{rule}|" * (len(heads) - 1)]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])
