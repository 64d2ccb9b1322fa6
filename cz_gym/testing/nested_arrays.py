"""Nested results as flat lists of named arrays, to be compared, kept in several ways or overwritten."""

from __future__ import annotations

from collections.abc import Callable
from ctypes import c_char
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


class NamedArray(NamedTuple):
    """One array of a nested result."""

    name: str
    value: Array
    mask: Array | None = None
    """Slots for which an info has a value, bool; None: all."""


def flatten(value: Any, name: str = "") -> list[NamedArray]:
    """The arrays of nested mappings, sequences and object arrays, in order; those of an info with its mask."""
    if isinstance(value, dict):
        found = []
        for key in sorted(value, key=str):
            by_slot = isinstance(value[key], dict) or np.asarray(value[key]).dtype != object
            mask = value.get(f"_{key}") if isinstance(key, str) and by_slot else None
            for array in flatten(value[key], f"{name}[{key!r}]" if name else str(key)):
                found.append(array if array.mask is not None or mask is None else array._replace(mask=mask))
        return found
    if isinstance(value, tuple | list) or (isinstance(value, np.ndarray) and value.dtype == object and value.ndim > 0):
        return [array for i, part in enumerate(value) if part is not None for array in flatten(part, f"{name}[{i}]")]
    return [NamedArray(name, value if isinstance(value, np.ndarray) else np.asarray(value))]


def difference(one: list[NamedArray], other: list[NamedArray], masked: bool = False) -> str | None:
    """The first difference, in words; None if there is none.

    ``masked`` compares only where the masks are true, and allows other dtypes except for bool, as infos have them.
    """
    names = [[array.name for array in arrays] for arrays in (one, other)]
    if names[0] != names[1]:
        odd = sorted(set(names[0]) ^ set(names[1]))
        return f"{', '.join(odd[:3]) or 'the order of parts'} is in one only"
    for (name, a, _), (_, b, mask) in zip(one, other, strict=True):
        if a.shape != b.shape or (a.dtype != b.dtype and (not masked or b.dtype == np.bool_)):
            return f"{name} is {a.dtype} {a.shape} and {b.dtype} {b.shape}"
        unlike = np.asarray((a != b) & ((a == a) | (b == b)))  # NaN is like NaN
        if masked and mask is not None and a.ndim > 0 and mask.shape == a.shape[:1]:
            unlike &= mask.reshape(-1, *[1] * (a.ndim - 1))
        if unlike.any():
            at = tuple(int(i) for i in np.argwhere(unlike)[0])
            slot = f" of slot {at[0]}" if at else ""
            return f"{name}{slot} is {a[at]} and {b[at]}"
    return None


def overwrite(value: Any) -> None:
    """Overwrite every writeable array of a nested value with ones."""
    for array in flatten(value):
        if array.value.flags.writeable and array.value.dtype != object:
            array.value[...] = 1


KEEPERS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], bytes]]] = {
    "itself": (lambda array: array, np.ndarray.tobytes),
    "a view": (lambda array: array[...].view(), np.ndarray.tobytes),
    "a slice": (lambda array: array[::1].T, lambda kept: kept.T.tobytes()),
    "a memoryview": (memoryview, bytes),
    # Only the exported buffer keeps the array alive.
    "a ctypes buffer": (lambda array: (c_char * array.nbytes).from_buffer(memoryview(array).cast("B")), bytes),
    "an iterator": (lambda array: array.flat, lambda kept: kept.base.tobytes()),
}
"""Ways to keep an array: a function that makes the keeper from the array, and one that reads the bytes from it."""


def keep(array: NamedArray, number: int) -> tuple[str, Callable[[], bool]]:
    """Keep an array in way ``number`` modulo their count, or as itself where that way is impossible.

    Returns its name with the way, and a function that says whether it shows the same bytes still.
    """
    value = array.value
    simple = value.ndim > 0 and value.size > 0 and value.flags.c_contiguous and value.flags.writeable
    way = list(KEEPERS)[number % len(KEEPERS) if simple else 0]
    make, read = KEEPERS[way]
    kept, content = make(value), value.tobytes()  # nothing else may hold the array
    return f"{array.name} (kept as {way})", lambda: read(kept) == content
