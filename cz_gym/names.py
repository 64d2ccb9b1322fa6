"""What is said of a name that does not exist, and of one where an object belongs."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

from cz_gym.errors import CzError


def needs(kind: type, value: Any, how: str) -> Any:
    """The value itself; ValueError, which says how one is made, unless it is of that kind."""
    if not isinstance(value, kind):
        raise CzError(f"this needs a {kind.__name__}, not {value!r:.80}: {how}")
    return value


def unknown(kind: str, name: object, known: Iterable[str], also: str = "") -> str:
    """One line: what was given, what may have been meant, what there is, and what ``also`` may be given."""
    there = list(known)
    close = get_close_matches(name, there, 1, 0.65) if isinstance(name, str) else []
    meant = f": did you mean {close[0]!r}? Choose" if close else "; choose"
    return f"unknown {kind} {name!r:.80}{meant} from {', '.join(there) or 'none'}{also}"
