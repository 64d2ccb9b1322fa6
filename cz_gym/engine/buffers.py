"""Memory for the arrays that a step gives out, used again once nobody can look at it any more.

Large new arrays come as untouched pages, and writing those for the first time costs a good part of a step.
"""

from __future__ import annotations

import ctypes
import math
import weakref
from typing import Any, cast

import numpy as np
import numpy.typing as npt

SPARES = 3
"""Most blocks of memory kept for further use."""
_ALIGNED = 64
_LARGE = 1 << 14
"""Arrays below this size [B] are made anew: the allocator keeps such memory itself."""
Block = npt.NDArray[np.uint8]


class _Loan(weakref.ref[Any]):
    """Tells when nobody looks at a block any more; keeps the block until then."""

    __slots__ = ("block",)
    block: Block


class Lender:
    """Gives out arrays of one shape and type, each an object of its own, never written again by a later one while used.

    An array stands on a block lent for it alone. Everything that looks at the block (the array, its views, memory
    views, tensors and pointers made from them, in any thread) keeps that loan alive, as it would keep an array's own
    memory. Only the end of the loan, when nothing is left that could look, gives the block back.
    """

    def __init__(self, shape: tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._shape, self._dtype = shape, np.dtype(dtype)
        size = math.prod(shape) * self._dtype.itemsize
        self._type = ctypes.c_byte * size if size >= _LARGE else None
        self._free: list[Block] = []
        self._loans: dict[int, _Loan] = {}

    def new(self) -> npt.NDArray[Any]:
        """An array of any content."""
        if self._type is None:
            return np.empty(self._shape, self._dtype)
        try:
            block = self._free.pop()
        except IndexError:
            block = _block(ctypes.sizeof(self._type))
        lent: Any = self._type.from_buffer(cast(Any, block))
        loan = _Loan(lent, self._give_back)
        loan.block = block
        self._loans[id(loan)] = loan
        return np.ndarray(self._shape, self._dtype, lent)

    def _give_back(self, loan: _Loan) -> None:
        del self._loans[id(loan)]
        if len(self._free) < SPARES:
            self._free.append(loan.block)


def _block(size: int) -> Block:
    """Memory that begins at a line of the cache."""
    memory = np.empty(size + _ALIGNED, np.uint8)
    start = -memory.ctypes.data % _ALIGNED
    return memory[start : start + size]
