"""Messages for a name that does not exist, and for a name given where an object is needed."""

import inspect
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from typing import Any

from cz_gym.errors import CzError, UnexpectedKeyword


def needs(kind: type, value: Any, how: str) -> Any:
    """Return the value; raise CzError with a hint on how to make one unless it is of this type."""
    if not isinstance(value, kind):
        name, given = kind.__name__, " ".join(repr(value).split())
        raise CzError(f"this needs {'an' if name[0] in 'AEIO' else 'a'} {name}, not {given:.80}: {how}")
    return value


def unknown(kind: str, name: object, known: Iterable[str], also: str = "") -> str:
    """One line: the unknown name, the closest known one, all known ones, and what else (``also``) is accepted."""
    names = list(known)
    close = get_close_matches(name, names, 1, 0.65) if isinstance(name, str) else []
    meant = f": did you mean {close[0]!r}? Choose" if close else "; choose"
    return f"unknown {kind} {name!r:.80}{meant} from {', '.join(names) or 'none'}{also}"


def known_keywords(given: Iterable[str], *functions: Callable[..., Any]) -> None:
    """Raise UnexpectedKeyword for the first keyword that none of the functions has."""
    parameters = [each for function in functions for each in inspect.signature(function).parameters.values()]
    known = dict.fromkeys(each.name for each in parameters if each.name != "self" and each.kind != each.VAR_KEYWORD)
    for name in given:
        if name not in known:
            raise UnexpectedKeyword(unknown("keyword argument", name, known).replace("unknown", "unexpected", 1))
