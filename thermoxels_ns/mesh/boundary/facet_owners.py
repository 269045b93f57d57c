"""Which tetrahedron each boundary triangle belongs to."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.voxel_tets import OUTWARD_FACES


def facet_owners(
    tets: npt.NDArray[np.int64], facets: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Find the tetrahedron of every boundary triangle, and which of its faces the triangle is.

    Only faces whose nodes all lie on the boundary are looked at, so the sort follows the surface, not the volume.

    Args:
        tets: Node indices, shape (t, 4).
        facets: Boundary triangles, shape (f, 3).

    Returns:
        owner: Index of the tetrahedron, shape (f,).
        opposite: Which of the tetrahedron's four nodes the triangle lies opposite to, 0 to 3, shape (f,).

    Raises:
        MeshError: A triangle is listed twice, is no face of a tetrahedron, or lies between two.

    >>> facet_owners(np.array([[0, 1, 2, 3]]), np.array([[0, 2, 1], [1, 2, 3]]))
    (array([0, 0]), array([3, 0]))
    """
    if not len(facets):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    on_boundary = np.zeros(max(int(tets.max()), int(facets.max())) + 1, dtype=bool)
    on_boundary[facets.ravel()] = True
    flags = on_boundary[tets]
    num_flagged = flags.sum(axis=1)
    # A face is flagged if the only node that is not is the one opposite, or none is not.
    flagged_face = (num_flagged[:, None] - flags) == 3
    candidate_tet, candidate_face = np.nonzero(flagged_face)
    faces = tets[candidate_tet[:, None], OUTWARD_FACES[candidate_face]]

    low, middle, high = np.sort(np.concatenate([facets, faces]).astype(np.int64), axis=1).T
    # Two keys sort faster than three; node numbers are far below 2^31. The sort is stable: triangles come first.
    key = low * len(on_boundary) + middle
    order = np.lexsort((high, key))
    key, high = key[order], high[order]
    first = np.flatnonzero(np.concatenate([[True], (key[1:] != key[:-1]) | (high[1:] != high[:-1])]))
    uses = np.diff(np.append(first, len(order)))
    asked = order[first] < len(facets)
    first, uses = first[asked], uses[asked]
    second = order[np.minimum(first + 1, len(order) - 1)]
    if len(first) != len(facets) or np.any(uses != 2) or np.any(second < len(facets)):
        raise MeshError(
            "facets",
            expected="different triangles, each a face of exactly one tetrahedron",
            got=f"{len(facets) - np.count_nonzero((uses == 2) & (second >= len(facets)))} others",
            remedy="Build the mesh with thermoxels_ns.mesh.build.",
        )
    face = np.empty(len(facets), dtype=np.int64)
    face[order[first]] = second - len(facets)
    return candidate_tet[face], candidate_face[face]
