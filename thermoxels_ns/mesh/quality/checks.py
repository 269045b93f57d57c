"""Areas and normals of triangles; nodes at one place, triangles that are missing, cracks."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.mesh.quality.face_count import Groups, boundary_facets, group_pairs
from thermoxels_ns.mesh.tetrahedra import TetMesh

_MOST_TRIED, _NEAREST = 2_000, 16
"""Tetrahedra of a body that are looked for in another one, and those of the other, by their centres, that may hold
each."""
_WITHIN = 1e-6  # How far inside a tetrahedron, as a share of its heights, a point lies in it beyond doubt


def facet_area_vectors(points: FloatArray, facets: IntArray) -> FloatArray:
    """Area times unit normal of triangles (right-hand rule), shape (f, 3), [m^2]."""
    origin = points[facets[:, 0]]
    return 0.5 * np.cross(points[facets[:, 1]] - origin, points[facets[:, 2]] - origin)


def facet_areas(points: FloatArray, facets: IntArray) -> FloatArray:
    """Areas of triangles, shape (f,), [m^2]."""
    return np.linalg.norm(facet_area_vectors(points, facets), axis=1)


def facet_normals(points: FloatArray, facets: IntArray) -> FloatArray:
    """Unit normals of triangles (right-hand rule), 0 for one without area, shape (f, 3)."""
    vectors = facet_area_vectors(points, facets)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def count_twin_nodes(points: FloatArray) -> int:
    """Number of nodes at the place of an earlier one."""
    ordered = points[np.lexsort(points.T)]
    return int(np.count_nonzero(np.all(ordered[1:] == ordered[:-1], axis=1)))


def count_wrong_facets(mesh: TetMesh, faces: Groups) -> int:
    """Number of triangles to take from and add to `mesh.facets` (one turned over counts twice) to get the faces of one
    owner, normals outwards. `faces` is `face_count.group_faces(mesh.tets)`."""
    wanted = boundary_facets(mesh.tets, faces)
    both = np.concatenate([_smallest_first(wanted), _smallest_first(mesh.facets)])
    same = group_pairs(both[:, 0], both[:, 1] * len(mesh.points_m) + both[:, 2])
    return int(np.abs(same.sums(np.repeat([1, -1], [len(wanted), len(mesh.facets)]))).sum())


def count_overlaps(points: FloatArray, facets: IntArray, sides: Groups) -> int:
    """Number of pairs of triangles that share an edge and lie on the same side of it in the same plane.

    This is how a crack looks: the faces of neighbours that do not match are boundary triangles, one upon the other.
    `sides` is `topology.group_sides(facets)`.
    """
    normals = facet_normals(points, facets)
    facet, side = np.divmod(sides.order, 3)
    direction = np.where(facets[facet, side] < facets[facet, (side + 1) % 3], 1.0, -1.0)
    edge = np.repeat(np.arange(len(sides.start)), sides.sizes)
    # The direction from an edge into a triangle is the triangle's normal turned by 90 degrees about the edge, one way
    # or the other as the triangle passes along the edge.
    overlaps = 0
    for gap in range(1, int(sides.sizes.max(initial=1))):
        pairs = np.flatnonzero(edge[gap:] == edge[:-gap])
        cosine = np.einsum("ij,ij->i", normals[facet[pairs + gap]], normals[facet[pairs]])
        cosine *= direction[pairs + gap] * direction[pairs]
        overlaps += int(np.count_nonzero(cosine > 1.0 - 1e-10))
    return overlaps


def count_tets_in_other_bodies(mesh: TetMesh) -> int:
    """Number of tetrahedra whose centre lies in a body that they share no node with; of many, some are tried."""
    points, tets = mesh.points_m, mesh.tets
    pairs = sparse.coo_matrix(
        (np.ones(3 * len(tets), bool), (np.repeat(tets[:, 0], 3), tets[:, 1:].ravel())), shape=(len(points),) * 2
    )
    of_node = connected_components(pairs, directed=False)[1]
    body, sizes = np.unique(of_node[tets[:, 0]], return_inverse=True, return_counts=True)[1:]
    if len(sizes) == 1:
        return 0
    centres, found = points[tets].mean(axis=1), 0
    by_body = np.split(np.argsort(body, kind="stable"), np.cumsum(sizes)[:-1])
    low, high = (np.array([end(points[tets[own]], axis=(0, 1)) for own in by_body]) for end in (np.min, np.max))
    for number, own in enumerate(by_body[:-1]):
        close = np.all((low <= high[number]) & (high >= low[number]), axis=1)
        close[: number + 1] = False
        if not close.any():
            continue
        others = np.concatenate([by_body[other] for other in np.flatnonzero(close)])
        for around, inside in ((own, others), (others, own)):
            tried = inside[:: len(inside) // _MOST_TRIED + 1]
            tree: Any = KDTree(centres[around])
            near = tree.query(centres[tried], k=list(range(1, min(len(around), _NEAREST) + 1)))[1]
            corner = points[tets[around[near]]]
            sides = np.swapaxes(corner[:, :, 1:] - corner[:, :, :1], 2, 3)
            shares = np.linalg.solve(sides, (centres[tried][:, None] - corner[:, :, 0])[..., None])[..., 0]
            holds = (shares.min(axis=2) > _WITHIN) & (shares.sum(axis=2) < 1.0 - _WITHIN)
            found += int(np.count_nonzero(holds.any(axis=1)))
    return found


def _smallest_first(facets: IntArray) -> IntArray:
    """Turn each triangle so that its smallest node comes first; its orientation stays."""
    turn = (np.argmin(facets, axis=1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(facets, turn, axis=1)
