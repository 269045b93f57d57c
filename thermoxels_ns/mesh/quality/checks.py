"""Areas and normals of triangles; nodes at one place, triangles that are missing, cracks."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.mesh.quality.face_count import Groups, boundary_facets, group_pairs
from thermoxels_ns.mesh.tetrahedra import TetMesh


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


def _smallest_first(facets: IntArray) -> IntArray:
    """Turn each triangle so that its smallest node comes first; its orientation stays."""
    turn = (np.argmin(facets, axis=1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(facets, turn, axis=1)
