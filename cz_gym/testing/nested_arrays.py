"""Nested results as flat lists of named arrays: compared, kept in several ways, overwritten."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


class NamedArray(NamedTuple):
    """One array of a nested result."""

    name: str
    value: Array
    mask: Array | None = None
    """Slots where an info holds something, bool; None: all."""

    def at(self, i: int) -> NamedArray:
        """A copy of slot i alone."""
        return NamedArray(self.name, np.array(self.value[i]))


def flatten(value: Any, name: str = "") -> list[NamedArray]:
    """The arrays of a nested value of mappings, sequences and object arrays, in order; an info goes with its mask."""
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


def difference(one: list[NamedArray], other: list[NamedArray], rtol: float = 0.0, masked: bool = False) -> str | None:
    """What differs first, in words; None if nothing does.

    ``masked``: only where masks say there is something; dtypes but bool may differ, as infos' do.
    """
    names = [[array.name for array in arrays] for arrays in (one, other)]
    if names[0] != names[1]:
        odd = sorted(set(names[0]) ^ set(names[1]))
        return f"{', '.join(odd[:3]) or 'the order of parts'} is in one only"
    for (name, a, _), (_, b, mask) in zip(one, other, strict=True):
        if a.shape != b.shape or (a.dtype != b.dtype and (not masked or b.dtype == np.bool_)):
            return f"{name} is {a.dtype} {a.shape} and {b.dtype} {b.shape}"
        unlike = ~_close(a, b, rtol)
        if masked and mask is not None and a.ndim > 0 and mask.shape == a.shape[:1]:
            unlike &= mask.reshape(-1, *[1] * (a.ndim - 1))
        if unlike.any():
            at = tuple(int(i) for i in np.argwhere(unlike)[0])
            slot = f" of slot {at[0]}" if at else ""
            return f"{name}{slot} is {a[at]} and {b[at]}"
    return None


def _close(a: Array, b: Array, rtol: float) -> Array:
    alike: Array = np.asarray(a == b)
    if np.issubdtype(a.dtype, np.inexact) and np.issubdtype(b.dtype, np.inexact):
        alike = alike | (np.isnan(a) & np.isnan(b))
        if rtol > 0.0:
            alike = alike | np.isclose(a, b, rtol=rtol, atol=0.0)
    return alike


def overwrite(value: Any) -> None:
    """Overwrite every array of a nested value that can be written."""
    for array in flatten(value):
        if array.value.flags.writeable and array.value.dtype != object:
            array.value[...] = 1


def _bytes(array: Any) -> bytes:
    return np.asarray(array).tobytes()


def _ctypes(array: Array) -> Any:
    """A ctypes buffer over the array's memory: nothing but the exported buffer keeps the array alive."""
    return (ctypes.c_char * array.nbytes).from_buffer(_view(array).cast("B"))


def _view(array: Any) -> memoryview[int]:
    return memoryview(array)


KEEPERS: dict[str, tuple[Callable[[Array], Any], Callable[[Any], bytes]]] = {
    "itself": (lambda array: array, _bytes),
    "a view": (lambda array: array[...].view(), _bytes),
    "a slice": (lambda array: array[::1].T, lambda kept: _bytes(kept.T)),
    "a memoryview": (_view, bytes),
    "a ctypes buffer": (_ctypes, bytes),
    "an iterator": (lambda array: array.flat, lambda kept: _bytes(kept.base)),
}
"""Ways to keep an array: how it is made from the array, and how what it shows is read."""


class Kept(NamedTuple):
    """An array as somebody keeps it, and what was in it."""

    name: str
    keeper: str
    kept: Any
    content: bytes

    @property
    def unchanged(self) -> bool:
        """Whether it still shows what was in the array."""
        return KEEPERS[self.keeper][1](self.kept) == self.content


def keep(array: NamedArray, number: int) -> Kept:
    """Keep an array in the way of that number, counted round; by itself where that way cannot."""
    value = array.value
    simple = value.ndim > 0 and value.size > 0 and value.flags.c_contiguous and value.flags.writeable
    keeper = list(KEEPERS)[number % len(KEEPERS) if simple else 0]
    return Kept(array.name, keeper, KEEPERS[keeper][0](value), value.tobytes())
