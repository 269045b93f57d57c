"""Tetrahedra that cannot carry a gradient."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.kernel_cache import kernel


def count_flat_tets(points_m: npt.NDArray[np.float64], tets: npt.NDArray[np.int64], share: float = 1e-12) -> int:
    """Count tetrahedra that are inverted, or flat to round-off of their own size.

    Args:
        points_m: Nodes, shape (n, 3), [m].
        tets: Node numbers, all in range, shape (t, 4).
        share: Least volume as a share of the cube of the longest coordinate difference from the first node.

    >>> count_flat_tets(np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 1, 2, 3], [1, 0, 2, 3]]))
    1
    """
    return int(_count(np.ascontiguousarray(points_m, np.float64), np.ascontiguousarray(tets, np.int64), share))


@kernel
def _count(points, tets, share):
    flat = 0
    for t in range(len(tets)):
        o, p, q, r = points[tets[t, 0]], points[tets[t, 1]], points[tets[t, 2]], points[tets[t, 3]]
        a0, a1, a2 = p[0] - o[0], p[1] - o[1], p[2] - o[2]
        b0, b1, b2 = q[0] - o[0], q[1] - o[1], q[2] - o[2]
        c0, c1, c2 = r[0] - o[0], r[1] - o[1], r[2] - o[2]
        size = max(abs(a0), abs(a1), abs(a2), abs(b0), abs(b1), abs(b2), abs(c0), abs(c1), abs(c2))
        if not size > 0.0:
            flat += 1
            continue
        # In units of the size, so that no product overflows or vanishes.
        a0, a1, a2, b0, b1, b2 = a0 / size, a1 / size, a2 / size, b0 / size, b1 / size, b2 / size
        c0, c1, c2 = c0 / size, c1 / size, c2 / size
        six_volumes = a0 * (b1 * c2 - b2 * c1) + a1 * (b2 * c0 - b0 * c2) + a2 * (b0 * c1 - b1 * c0)
        if not six_volumes > 6.0 * share:
            flat += 1
    return flat
