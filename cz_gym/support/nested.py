"""Functions on nested tuples of arrays: the memories of controllers, and records of one kind."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np


def map_arrays(function: Callable[..., Any], *values: Any) -> Any:
    """The nested tuple of the function's results for the arrays of ``values``, which are nested alike."""
    if not isinstance(values[0], tuple):
        return function(*values)
    parts = [map_arrays(function, *some) for some in zip(*values, strict=True)]
    return type(values[0])(*parts) if hasattr(values[0], "_fields") else tuple(parts)


def leaves(value: Any, between: str = "_", name: str = "") -> dict[str, Any]:
    """The arrays of nested tuples, in order, by the names of their fields, or places, with ``between`` them."""
    if not isinstance(value, tuple):
        return {name: value}
    parts: dict[str, Any] = {}
    for field, part in zip(getattr(value, "_fields", range(len(value))), value, strict=True):
        parts |= leaves(part, between, f"{name}{between}{field}" if name else str(field))
    return parts


def select(where: Any, one: Any, other: Any) -> Any:
    """``one`` in the slots where ``where``, of shape (n,), is true, ``other`` elsewhere; nested tuples of arrays."""
    return map_arrays(lambda a, b: np.where(np.reshape(where, (-1, *(1,) * (np.ndim(b) - 1))), a, b), one, other)


def stack(values: Sequence[Any]) -> Any:
    """NamedTuples of one kind as one NamedTuple of arrays, with a new leading axis."""
    return map_arrays(lambda *parts: np.stack(parts), *values)
