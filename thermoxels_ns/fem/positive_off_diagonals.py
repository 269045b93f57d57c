"""Couplings between two nodes that let heat flow from the colder to the warmer one, and matrices without them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

_ROUND_OFF = 16.0 * float(np.finfo(np.float64).eps)
"""An entry above 0 by less than this share of the diagonal is what floating point left of 0."""
_ATTEMPTS = 8
"""Choices after which all wrong-signed couplings are left out."""


class WrongCouplings:
    """Entries above 0 off the diagonal of a stiffness matrix, and which of them have been left out.

    Obtuse angles between faces make them. A coupling is a heat flow between two nodes: to leave it out keeps the matrix
    symmetric, its rows sum to 0 and heat is conserved. What is taken from an entry off the diagonal is added on it, so
    that the matrix stays positive semidefinite and no piece of the body comes apart. Without all of them it is an
    M-matrix, of which no temperature leaves its range (Ciarlet and Raviart, Computer Methods in Applied Mechanics and
    Engineering 2, 1973).
    """

    def __init__(self, system: HeatSystem) -> None:
        """Find them.

        Args:
            system: The equations.
        """
        self._system = system
        upper, diagonal = sparse.triu(system.stiffness, k=1, format="coo"), system.stiffness.diagonal()
        wrong = upper.data > _ROUND_OFF * np.minimum(diagonal[upper.row], diagonal[upper.col])
        self._first, self._second, self._size = upper.row[wrong], upper.col[wrong], upper.data[wrong]

    def begin(self) -> LeftOutCouplings:
        """Begin with none left out."""
        return LeftOutCouplings(self._system, self._first, self._second, self._size)


class LeftOutCouplings:
    """Wrong-signed couplings that are left out of one equation, more with every attempt to solve it."""

    def __init__(
        self, system: HeatSystem, first: npt.NDArray[np.int32], second: npt.NDArray[np.int32], size: Vector
    ) -> None:
        """Begin with none.

        Args:
            system: The equations.
            first: Smaller node of each wrong-signed coupling, shape (c,).
            second: Its larger node, shape (c,).
            size: Its entry, shape (c,), [W / K].
        """
        self._system, self._first, self._second, self._size = system, first, second, size
        self._chosen = np.zeros(len(size), dtype=bool)
        self._attempts = 0

    @property
    def count(self) -> int:
        """How many are left out."""
        return int(np.count_nonzero(self._chosen))

    def more(self, outside: npt.NDArray[np.bool_]) -> HeatSystem | None:
        """Leave out those of more nodes, and all after some attempts.

        Args:
            outside: Marks nodes whose temperature is out of range, shape (n,).

        Returns:
            The equations without them; None if there are no more to leave out.
        """
        last = self._attempts == _ATTEMPTS
        more = ~self._chosen if last else (outside[self._first] | outside[self._second]) & ~self._chosen
        if self._attempts > _ATTEMPTS or not more.any():
            return None
        self._attempts += 1
        self._chosen |= more
        return self._system.with_stiffness(self._stiffness())

    def _stiffness(self) -> sparse.csr_matrix:
        """K without what is left out, whose heat flows are taken from the diagonal too."""
        first, second, size = (part[self._chosen] for part in (self._first, self._second, self._size))
        rows, columns = np.concatenate([first, second, first, second]), np.concatenate([second, first, first, second])
        entries = np.concatenate([-size, -size, size, size])
        change = sparse.csr_matrix((entries, (rows, columns)), shape=self._system.stiffness.shape)
        return sparse.csr_matrix(self._system.stiffness + change)
