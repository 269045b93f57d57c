"""Short names of the array types that most signatures have, and large arrays whose memory is used again."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

SMALLEST = 1 << 15  # Bytes below which an array is made as usual
PATIENCE = 2048  # Loans after which memory that nobody asked for is given back to the system


class BufferPool:
    """Lends arrays; the memory of one comes back when nothing refers to it or to a view of it any more.

    A page of memory that a program touches for the first time costs several times what filling it costs.
    """

    def __init__(self) -> None:
        self._free: dict[int, list[tuple[npt.NDArray[np.uint8], int]]] = {}
        self._loans = 0
        self._lock = threading.RLock()  # a loan may end inside of any other call, when garbage is collected

    def empty(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """An array with whatever stands in the memory it gets."""
        shape = (shape,) if isinstance(shape, int) else shape
        wanted = np.dtype(dtype)
        count = math.prod(shape)
        size = count * wanted.itemsize
        if size < SMALLEST:
            return np.empty(shape, wanted)
        length = rounded_size(size)
        with self._lock:
            self._loans += 1
            if self._loans % PATIENCE == 0:
                self._forget()
            waiting = self._free.setdefault(length, [])
            block = waiting.pop()[0] if waiting else np.empty(length, np.uint8)
        return np.asarray(_Loan(self, block))[:size].view(wanted).reshape(shape)

    def release(self) -> None:
        """Give back to the system what is not lent."""
        with self._lock:
            self._free.clear()

    def _take_back(self, block: npt.NDArray[np.uint8]) -> None:
        with self._lock:
            self._free.setdefault(len(block), []).append((block, self._loans))

    def _forget(self) -> None:
        for blocks in self._free.values():
            blocks[:] = [kept for kept in blocks if self._loans - kept[1] < PATIENCE]


class _Loan:
    """Owner of a block while arrays look at it."""

    def __init__(self, pool: BufferPool, block: npt.NDArray[np.uint8]):
        self._pool, self._block = pool, block
        self.__array_interface__ = block.__array_interface__

    def __del__(self) -> None:
        self._pool._take_back(self._block)


def rounded_size(size: int) -> int:
    """`size` rounded up to one of four sizes per doubling, so that steps that need a little more fit too.

    >>> [rounded_size(n) for n in (1024, 1025, 1400, 1800)]
    [1024, 1280, 1536, 2048]
    """
    quarter = max(1, 1 << max(0, (size - 1).bit_length() - 3))
    return -(-size // quarter) * quarter


BUFFERS = BufferPool()  # What the compiled renderer lends from
