"""Loops over nodes that keep what each connected piece stores and exchanges exact.

Plain sums over many nodes lose digits; these are sums of sums over blocks.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.fem.pieces import Pieces

Vector = npt.NDArray[np.float64]

_BLOCK = 512


def is_within(values: Vector, bounds: Vector, slack: float = 0.0, sizes: Vector | None = None) -> bool:
    """Whether |values| <= bounds + slack * |sizes| everywhere; the first that is not ends the search.

    >>> is_within(np.array([1.0, -2.0]), np.array([1.0, 2.0])), is_within(np.array([np.nan]), np.array([1.0]))
    (True, False)
    """
    return bool(_is_within(values, bounds, slack, values if sizes is None else sizes))


def without_sums(pieces: Pieces, floating: npt.NDArray[np.bool_], nodal: Vector, held: Vector, sums: Vector) -> Vector:
    """Subtract multiples of a vector so that what is left sums to 0 over each floating piece, twice for round-off.

    Args:
        pieces: The pieces.
        floating: Which of them to treat, shape (p,).
        nodal: Values of the nodes, shape (n,).
        held: The vector, shape (n,).
        sums: Its sums over the pieces, shape (p,); those of pieces that do not float count for nothing.
    """
    rest = nodal.copy()
    for _ in range(2):
        if pieces.count == 1:
            _subtract(rest, held, _sum(rest) / sums[0])
        else:
            surplus = np.where(floating, pieces.sums(rest) / sums, 0.0)
            _subtract_by_piece(rest, held, pieces.number, surplus)
    return rest


def weighted_sums(pieces: Pieces, weights: Vector, nodal: Vector) -> Vector:
    """Add up weights times values over each piece, shape (p,)."""
    if pieces.count == 1:
        return np.array([_sum_of_products(weights, nodal)])
    return pieces.sums(weights * nodal)


@kernel
def _is_within(values, bounds, slack, sizes):
    i, count = 0, len(values)
    while i < count and abs(values[i]) <= bounds[i] + slack * abs(sizes[i]):
        i += 1
    return i == count


@kernel(fastmath={"reassoc", "contract"})
def _sum(values):
    total = 0.0
    for begin in range(0, len(values), _BLOCK):
        part = 0.0
        for i in range(begin, min(begin + _BLOCK, len(values))):
            part += values[i]
        total += part
    return total


@kernel(fastmath={"reassoc", "contract"})
def _sum_of_products(first, second):
    total = 0.0
    for begin in range(0, len(first), _BLOCK):
        part = 0.0
        for i in range(begin, min(begin + _BLOCK, len(first))):
            part += first[i] * second[i]
        total += part
    return total


@kernel
def _subtract(values, held, share):
    for i in range(len(values)):
        values[i] -= share * held[i]


@kernel
def _subtract_by_piece(values, held, number, shares):
    for i in range(len(values)):
        values[i] -= shares[number[i]] * held[i]
