"""Connected pieces of a body, between which no heat flows, and sums over them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components

Vector = npt.NDArray[np.float64]


class Pieces:
    """Numbers of the pieces that a body's nodes belong to, and sums over them.

    >>> pieces = Pieces(sparse.csr_matrix([[2.0, -2.0, 0.0], [-2.0, 2.0, 0.0], [0.0, 0.0, 0.0]]))
    >>> pieces.count, pieces.sums(np.array([1.0, 2.0, 4.0])).tolist()
    (2, [3.0, 4.0])
    """

    def __init__(self, stiffness: sparse.csr_matrix) -> None:
        """Find the pieces of a matrix whose links go both ways."""
        # Links go both ways, so that strong connection is connection; for the undirected kind scipy would transpose.
        count, number = connected_components(stiffness, directed=True, connection="strong")
        self.count = int(count)
        """How many there are."""
        self.number: npt.NDArray[np.int32] = number
        """Number of each node's piece, shape (n,)."""

    def sums(self, nodal: Vector) -> Vector:
        """Add up over each piece, shape (p,)."""
        if self.count == 1:
            return np.array([np.sum(nodal)])
        return np.bincount(self.number, weights=nodal, minlength=self.count).astype(np.float64, copy=False)

    def at_nodes(self, values: Vector) -> Vector:
        """Values of the pieces where their nodes are; one value for all nodes if there is one piece."""
        return values[self.number] if self.count > 1 else values

    def touched(self, nodes: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Mark the pieces that have any of the nodes, shape (p,)."""
        marks = np.zeros(self.count, dtype=bool)
        marks[self.number[nodes]] = True
        return marks

    def without_sums(self, floating: npt.NDArray[np.bool_], nodal: Vector, held: Vector, sums: Vector) -> Vector:
        """Subtract multiples of `held`, whose sums over the pieces are `sums`, until floating pieces sum to 0."""
        for _ in range(2):
            nodal = nodal - self.at_nodes(np.where(floating, self.sums(nodal) / sums, 0.0)) * held
        return nodal


def is_within(values: Vector, bounds: Vector, slack: float = 0.0, sizes: Vector | None = None) -> bool:
    """Whether |values| <= bounds + slack * |sizes| everywhere.

    >>> is_within(np.array([1.0, -2.0]), np.array([1.0, 2.0])), is_within(np.array([np.nan]), np.array([1.0]))
    (True, False)
    """
    return bool(np.all(np.abs(values) <= (bounds if sizes is None else bounds + slack * np.abs(sizes))))
