"""Connected parts of a tetrahedral mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components


def node_parts(tets: npt.NDArray[np.int64], num_nodes: int) -> npt.NDArray[np.int64]:
    """Number of the connected part of each node, shape (n,), from 0; parts share no node.

    >>> node_parts(np.array([[0, 1, 2, 3], [3, 4, 5, 6], [7, 8, 9, 10]]), 11).tolist()
    [0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1]
    """
    start, end = tets[:, :3].ravel(), tets[:, 1:].ravel()
    links = sparse.coo_array((np.ones(len(start), np.int8), (start, end)), shape=(num_nodes, num_nodes))
    return connected_components(links, directed=False)[1].astype(np.int64)


def renumbered(
    keep: npt.NDArray[np.bool_],
) -> npt.NDArray[np.int64]:
    """New number of each node when only some stay, -1 for the others, shape (n,).

    >>> renumbered(np.array([True, False, True])).tolist()
    [0, -1, 1]
    """
    number = np.cumsum(keep, dtype=np.int64) - 1
    number[~keep] = -1
    return number
