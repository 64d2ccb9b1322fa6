"""What is said of a name that does not exist."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def unknown(kind: str, name: object, known: Iterable[str], also: str = "") -> str:
    """One line: what was given, what may have been meant, what there is, and what ``also`` may be given."""
    there = list(known)
    close = get_close_matches(name, there, 1, 0.7) if isinstance(name, str) else []
    meant = f": did you mean {close[0]!r}? Choose" if close else "; choose"
    return f"unknown {kind} {name!r:.80}{meant} from {', '.join(there) or 'none'}{also}"
