"""Whether a mesh keeps temperatures between those they come from."""

from __future__ import annotations

import numpy as np
from scipy import sparse

_POSITIVE = 1e-9
"""Share of the diagonal above which an entry off it counts as above 0."""


def holds_maximum_principle(stiffness: sparse.csr_matrix) -> bool:
    """Whether a stiffness matrix has no entry above 0 off its diagonal, so that it is an M-matrix.

    So it is on meshes without obtuse angles between faces; then no temperature leaves the range of its neighbours.

    >>> holds_maximum_principle(sparse.csr_matrix([[1.0, -1.0], [-1.0, 1.0]]))
    True
    """
    entries = stiffness.tocoo()
    off = entries.row != entries.col
    return not np.any(entries.data[off] > _POSITIVE * stiffness.diagonal()[entries.row[off]])
