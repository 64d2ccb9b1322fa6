"""Nested results as flat named arrays: compared, kept by all kinds of holders, overwritten."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


class Leaf(NamedTuple):
    """One array of a nested result."""

    name: str
    value: Array
    mask: Array | None = None
    """Slots where an info holds something, bool; None: all."""

    def at(self, i: int) -> Leaf:
        """Slot i alone."""
        return Leaf(self.name, np.asarray(self.value[i]))

    def copy(self) -> Leaf:
        """With arrays of its own."""
        return Leaf(self.name, self.value.copy(), None if self.mask is None else self.mask.copy())


def leaves(value: Any, name: str = "") -> list[Leaf]:
    """The arrays of a nested value of mappings, sequences and object arrays, in order; an info goes with its mask."""
    if isinstance(value, dict):
        found = []
        for key in sorted(value, key=str):
            by_slot = isinstance(value[key], dict) or np.asarray(value[key]).dtype != object
            mask = value.get(f"_{key}") if isinstance(key, str) and by_slot else None
            for leaf in leaves(value[key], f"{name}[{key!r}]" if name else str(key)):
                found.append(leaf if leaf.mask is not None or mask is None else leaf._replace(mask=mask))
        return found
    if isinstance(value, tuple | list) or (isinstance(value, np.ndarray) and value.dtype == object and value.ndim > 0):
        return [leaf for i, part in enumerate(value) for leaf in leaves(part, f"{name}[{i}]") if part is not None]
    return [Leaf(name, value if isinstance(value, np.ndarray) else np.asarray(value))]


def difference(one: list[Leaf], other: list[Leaf], rtol: float = 0.0, masked: bool = False) -> str | None:
    """What differs first, in words; None if nothing does. ``masked``: only where masks say there is something."""
    if [leaf.name for leaf in one] != [leaf.name for leaf in other]:
        odd = sorted({leaf.name for leaf in one} ^ {leaf.name for leaf in other})
        return f"{', '.join(odd[:3]) or 'the order of parts'} is in one only"
    for mine, its in zip(one, other, strict=True):
        a, b = mine.value, its.value
        if a.shape != b.shape or (a.dtype != b.dtype and not masked):
            return f"{mine.name} is {a.dtype} {a.shape} and {b.dtype} {b.shape}"
        unlike = ~_close(a, b, rtol)
        mask = its.mask
        if masked and mask is not None and a.ndim > 0 and mask.shape == a.shape[:1]:
            unlike &= mask.reshape(-1, *[1] * (a.ndim - 1))
        if unlike.any():
            at = tuple(int(i) for i in np.argwhere(unlike)[0])
            slot = f" of slot {at[0]}" if at else ""
            return f"{mine.name}{slot} is {a[at]} and {b[at]}"
    return None


def _close(a: Array, b: Array, rtol: float) -> Array:
    alike: Array = np.asarray(a == b)
    if np.issubdtype(a.dtype, np.inexact) and np.issubdtype(b.dtype, np.inexact):
        alike = alike | (np.isnan(a) & np.isnan(b))
        if rtol > 0.0:
            alike = alike | np.isclose(a, b, rtol=rtol, atol=0.0)
    return alike


def spoil(value: Any) -> None:
    """Overwrite every array of a nested value that can be written."""
    for leaf in leaves(value):
        if leaf.value.flags.writeable and leaf.value.dtype != object:
            leaf.value[...] = 1


@dataclass(frozen=True)
class Held:
    """An array as somebody keeps it, and what was in it."""

    name: str
    holder: str
    kept: Any
    read: Callable[[Any], bytes]
    content: bytes

    def unchanged(self) -> bool:
        """Whether the holder still shows what was in the array."""
        return self.read(self.kept) == self.content


def _bytes(array: Any) -> bytes:
    return np.asarray(array).tobytes()


def _ctypes(array: Array) -> Any:
    """A ctypes buffer over the array's memory: nothing but the buffer export keeps the array."""
    return (ctypes.c_char * array.nbytes).from_buffer(_view(array).cast("B"))


def _view(array: Any) -> memoryview[int]:
    return memoryview(array)


HOLDERS: tuple[tuple[str, Callable[[Array], Any], Callable[[Any], bytes]], ...] = (
    ("itself", lambda array: array, _bytes),
    ("a view", lambda array: array[...].view(), _bytes),
    ("a slice", lambda array: array[::1].T, lambda kept: _bytes(kept.T)),
    ("a memoryview", _view, lambda kept: bytes(kept.tobytes())),
    ("a ctypes buffer", _ctypes, lambda kept: bytes(kept)),
    ("an iterator", lambda array: array.flat, lambda kept: _bytes(kept.base)),
)
"""Ways to keep an array: name, maker, reader."""


def hold(leaf: Leaf, number: int) -> Held:
    """Keep an array by the holder of that number; by itself where that holder cannot."""
    array = leaf.value
    simple = array.ndim > 0 and array.size > 0 and array.flags.c_contiguous and array.flags.writeable
    name, make, read = HOLDERS[number if simple else 0]
    return Held(leaf.name, name, make(array), read, array.tobytes())
