"""Errors raised on purpose and their messages; functions on nested tuples of arrays; versions of packages."""

import inspect
import platform
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from difflib import get_close_matches
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np


class CzError(ValueError):
    """An error whose message tells the user what to change.

    Commands print it as one line; every other exception is a bug, the user's or ours, and keeps its traceback.
    """


class UnexpectedKeyword(CzError, TypeError):
    """A keyword that a function does not have: a TypeError with Python's words, for libraries that look for those."""


def require_type(kind: type, value: Any, how: str) -> Any:
    """Return the value; raise CzError, with a hint on how to make one, unless it is of this type."""
    if not isinstance(value, kind):
        name, given = kind.__name__, " ".join(repr(value).split())
        raise CzError(f"this needs {'an' if name[0] in 'AEIO' else 'a'} {name}, not {given:.80}: {how}")
    return value


def unknown_name_message(kind: str, name: object, known: Iterable[str], also: str = "") -> str:
    """Line on an unknown name: the closest known one, all known ones, and what else (``also``) is accepted."""
    names = list(known)
    close = get_close_matches(name, names, 1, 0.65) if isinstance(name, str) else []
    meant = f": did you mean {close[0]!r}? Choose" if close else "; choose"
    return f"unknown {kind} {name!r:.80}{meant} from {', '.join(names) or 'none'}{also}"


def check_keywords(given: Iterable[str], *functions: Callable[..., Any]) -> None:
    """Raise UnexpectedKeyword for the first keyword that none of the functions has."""
    parameters = [each for function in functions for each in inspect.signature(function).parameters.values()]
    several = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    known = dict.fromkeys(each.name for each in parameters if each.name != "self" and each.kind not in several)
    for name in given:
        if name not in known:
            raise UnexpectedKeyword(
                unknown_name_message("keyword argument", name, known).replace("unknown", "unexpected", 1)
            )


def map_arrays(function: Callable[..., Any], *values: Any) -> Any:
    """Apply a function to the arrays of ``values``, which are nested alike; return its results nested as these."""
    if not isinstance(values[0], tuple):
        return function(*values)
    parts = [map_arrays(function, *some) for some in zip(*values, strict=True)]
    return type(values[0])(*parts) if hasattr(values[0], "_fields") else tuple(parts)


def leaves(value: Any, between: str = "_", name: str = "") -> dict[str, Any]:
    """Return the arrays of nested tuples by the names of their fields, or places, with ``between`` them, in order."""
    if not isinstance(value, tuple):
        return {name: value}
    parts: dict[str, Any] = {}
    for field, part in zip(getattr(value, "_fields", range(len(value))), value, strict=True):
        parts |= leaves(part, between, f"{name}{between}{field}" if name else str(field))
    return parts


def select(where: Any, one: Any, other: Any) -> Any:
    """Take ``one`` in the slots where ``where``, shape (n,), is true, ``other`` elsewhere; nested tuples of arrays."""
    return map_arrays(lambda a, b: np.where(np.reshape(where, (-1, *(1,) * (np.ndim(b) - 1))), a, b), one, other)


def stack(values: Sequence[Any]) -> Any:
    """Stack NamedTuples of one kind into one NamedTuple of arrays, with a new leading axis."""
    return map_arrays(lambda *parts: np.stack(parts), *values)


def software(packages: Sequence[str]) -> dict[str, Any]:
    """Return the versions of Python and of the packages, None for one that is not installed."""
    versions: dict[str, str | None] = dict.fromkeys(packages)
    for name in packages:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return {"python": platform.python_version(), "packages": versions}
