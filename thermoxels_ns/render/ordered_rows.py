"""Lists of rows that are known to ascend, so that nobody looks through them again.

Gradients of rows come out of their kernel in order. Torch forgets that when it puts them into ``grad``, but not where
in memory they lie.
"""

from __future__ import annotations

import weakref

import numpy.typing as npt
from torch import Tensor

_known: weakref.WeakValueDictionary[int, npt.NDArray] = weakref.WeakValueDictionary()
"""Lists by their address. A tensor made of one keeps it alive, and its memory is nobody else's until then."""


def remember_order(rows: npt.NDArray) -> None:
    """Say that a list ascends; it must not be changed afterwards.

    Args:
        rows: Row numbers, int64, each larger than the one before; the tensor to recognise is made of this very array.
    """
    _known[rows.ctypes.data] = rows


def in_order(rows: Tensor) -> bool:
    """Whether every row number is larger than the one before.

    Args:
        rows: Row numbers, (n,); what `remember_order` knows is not read.
    """
    known = _known.get(rows.data_ptr()) if rows.device.type == "cpu" and len(rows) else None
    if known is not None and len(known) == len(rows) and rows.is_contiguous():
        return True
    return bool((rows[1:] > rows[:-1]).all())
