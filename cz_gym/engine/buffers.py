"""A pool of memory for the arrays that a step returns; a block is reused once nothing refers to it.

Large new arrays come as untouched pages, and writing those for the first time costs a good part of a step.
"""

import ctypes
import math
import weakref
from typing import Any, cast

import numpy as np
import numpy.typing as npt

SPARES = 3
"""Most free blocks that a pool holds."""
_ALIGNED = 64
_LARGE = 1 << 14
"""Arrays below this size [B] are made anew: the allocator keeps such memory itself."""
Block = npt.NDArray[np.uint8]


class _Use(weakref.ref[Any]):
    """A weak reference to the buffer around a block; its callback returns the block to the pool."""

    __slots__ = ("block",)
    block: Block


class BufferPool:
    """Arrays of one shape and type, on blocks of memory that are reused when no reference to them is left.

    An array's base is a buffer made for it alone. The array, its views, memory views, tensors and pointers made from
    them, in any thread, all hold a reference to that buffer, as they would to an array's own memory. When the last
    one is gone, the block returns to the pool.
    """

    def __init__(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._shape, self._dtype = shape, np.dtype(dtype)
        size = math.prod(shape) * self._dtype.itemsize
        self._type = ctypes.c_byte * size if size >= _LARGE else None
        self._free: list[Block] = []
        self._in_use: dict[int, _Use] = {}

    def new(self) -> npt.NDArray[Any]:
        """An array with arbitrary content."""
        if self._type is None:
            return np.empty(self._shape, self._dtype)
        try:
            block = self._free.pop()
        except IndexError:
            block = _block(ctypes.sizeof(self._type))
        view: Any = self._type.from_buffer(cast(Any, block))
        use = _Use(view, self._return)
        use.block = block
        self._in_use[id(use)] = use
        return np.ndarray(self._shape, self._dtype, view)

    def _return(self, use: _Use) -> None:
        del self._in_use[id(use)]
        if len(self._free) < SPARES:
            self._free.append(use.block)


def _block(size: int) -> Block:
    """Memory that begins at a cache line."""
    memory = np.empty(size + _ALIGNED, np.uint8)
    start = -memory.ctypes.data % _ALIGNED
    return memory[start : start + size]
