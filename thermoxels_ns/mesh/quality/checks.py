"""Checks of a mesh: counts of missing, wrong or doubled faces and nodes, connected components, and figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.tet_shapes import dihedral_cosines, signed_volumes
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_areas, facet_normals

OUTWARD_FACES: IntArray = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]], dtype=np.int64)
"""Nodes (0 to 3) of a tetrahedron's faces, (4, 3): row f is opposite node f; its right-hand normal points outwards."""


@dataclass(frozen=True)
class Groups:
    """Rows of a table in groups of equal rows: group g has the row numbers `order[start[g]:start[g + 1]]`."""

    order: IntArray  # row numbers, group after group, shape (rows,)
    start: IntArray  # index in `order` of the first row of each group, shape (groups,); groups are sorted by content

    @property
    def sizes(self) -> IntArray:
        """Return the number of rows in each group, shape (groups,)."""
        return np.diff(np.append(self.start, len(self.order)))

    @property
    def first(self) -> IntArray:
        """Return the smallest row number of each group, shape (groups,)."""
        return np.minimum.reduceat(self.order, self.start) if len(self.start) else self.start

    def pairs(self) -> tuple[IntArray, IntArray]:
        """Return all pairs of rows that follow each other in a group: the first rows (p,) and the second rows (p,)."""
        follows = np.ones(len(self.order), dtype=bool)
        follows[self.start] = False
        at = np.flatnonzero(follows)
        return self.order[at - 1], self.order[at]


def group_pairs(first: IntArray, second: IntArray) -> Groups:
    """Return groups of rows that have the same pair (first[row], second[row]) of whole numbers of at least 0.

    >>> groups = group_pairs(np.array([5, 2, 5, 2]), np.array([1, 9, 1, 0]))
    >>> groups.sizes, groups.first
    (array([1, 1, 2]), array([3, 1, 0]))
    """
    order = np.lexsort((second, first))
    new = np.append(True, (np.diff(first[order]) != 0) | (np.diff(second[order]) != 0))
    return Groups(order, np.flatnonzero(new[: len(order)]))


def group_faces(tets: IntArray) -> Groups:
    """Return groups of faces with the same nodes; row 4 t + f is the face of tetrahedron t opposite its node f."""
    low, middle, high = np.sort(tets[:, OUTWARD_FACES], axis=2).reshape(-1, 3).T
    return group_pairs(low, middle * (int(high.max(initial=0)) + 1) + high)


def group_sides(facets: IntArray) -> Groups:
    """Return groups of triangle sides with equal ends; row 3 f + s is side s of triangle f, from node s to the next."""
    ends = np.roll(facets, -1, axis=1)
    return group_pairs(np.minimum(facets, ends).ravel(), np.maximum(facets, ends).ravel())


def component_of(num: int, first: IntArray, second: IntArray) -> IntArray:
    """Return the number of each node's connected component, (num,); link i joins nodes first[i] and second[i]."""
    links = sparse.coo_array((np.ones(len(first), dtype=bool), (first, second)), shape=(num, num))
    return connected_components(links, directed=False)[1].astype(np.int64) if num else np.zeros(0, dtype=np.int64)


def boundary_facets(tets: IntArray, faces: Groups | None = None) -> IntArray:
    """Return the faces of exactly one tetrahedron, (f, 3), normals outwards, in the order of their sorted nodes.

    `faces` is `group_faces(tets)`, computed if left out.

    >>> boundary_facets(np.array([[0, 1, 2, 3], [1, 3, 2, 4]])).shape
    (6, 3)
    """
    faces = group_faces(tets) if faces is None else faces
    rows = faces.first[faces.sizes == 1]
    return tets.ravel().take((rows & ~3)[:, None] + OUTWARD_FACES[rows & 3])


def facet_owners(tets: IntArray, facets: IntArray) -> tuple[IntArray, IntArray]:
    """Return for each boundary triangle its tetrahedron (f,), and the node (0 to 3) opposite the triangle there (f,).

    Only faces whose nodes all lie on the boundary are sorted, so the time grows with the surface, not with the volume.

    Raises:
        MeshError: A triangle is listed twice, is no face of a tetrahedron, or lies between two tetrahedra.

    >>> facet_owners(np.array([[0, 1, 2, 3]]), np.array([[0, 2, 1], [1, 2, 3]]))
    (array([0, 0]), array([3, 0]))
    """
    if not len(facets):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    size, count = max(int(tets.max()), int(facets.max())) + 1, len(facets)
    on_boundary = np.zeros(size, dtype=bool)
    on_boundary[facets.ravel()] = True
    flags = on_boundary[tets]
    # Face f is of interest if the three nodes other than node f all lie on the boundary.
    tet, face = np.nonzero((flags.sum(axis=1)[:, None] - flags) == 3)
    faces = np.concatenate([facets, tets[tet[:, None], OUTWARD_FACES[face]]]).astype(np.int64)
    low, middle, high = np.sort(faces, axis=1).T
    groups = group_pairs(low, middle * size + high)
    first, last = groups.first, np.maximum.reduceat(groups.order, groups.start)
    good = (groups.sizes == 2) & (first < count) & (last >= count)
    if np.count_nonzero(good) != count:
        expected = "different triangles, each a face of exactly one tetrahedron"
        remedy, got = "Build the mesh with thermoxels_ns.mesh.build.", f"{count - np.count_nonzero(good)} others"
        raise MeshError("facets", expected=expected, got=got, remedy=remedy)
    of_facet = np.empty(count, dtype=np.int64)
    of_facet[first[good]] = last[good] - count
    return tet[of_facet], face[of_facet]


def count_twin_nodes(points: FloatArray) -> int:
    """Return the number of nodes at exactly the same place as another node that was counted before."""
    ordered = points[np.lexsort(points.T)]
    return int(np.count_nonzero(np.all(ordered[1:] == ordered[:-1], axis=1)))


def count_wrong_facets(mesh: TetMesh, faces: Groups) -> int:
    """Return the number of wrong triangles in `mesh.facets` plus the number of triangles that are missing there.

    `mesh.facets` must list every face of exactly one tetrahedron, with its normal outwards, and no other triangle. A
    triangle that is turned over counts twice, as wrong and as missing. `faces` is `group_faces(mesh.tets)`.
    """
    wanted = boundary_facets(mesh.tets, faces)
    both = np.concatenate([wanted, mesh.facets]).astype(np.int64)
    turn = (np.argmin(both, axis=1)[:, None] + np.arange(3)) % 3  # the smallest node first, so orientation stays
    both = np.take_along_axis(both, turn, axis=1)
    same = group_pairs(both[:, 0], both[:, 1] * len(mesh.points_m) + both[:, 2])
    side = np.repeat([1, -1], [len(wanted), len(mesh.facets)])[same.order]
    return int(np.abs(np.add.reduceat(side, same.start)).sum()) if len(same.start) else 0


def count_overlaps(points: FloatArray, facets: IntArray, sides: Groups) -> int:
    """Return the number of pairs of triangles that share an edge and lie in one plane on the same side of the edge.

    These pairs show cracks: faces of neighbours lie upon each other, unconnected. `sides` is `group_sides(facets)`.
    """
    normals = facet_normals(points, facets)
    facet, side = np.divmod(sides.order, 3)
    direction = np.where(facets[facet, side] < facets[facet, (side + 1) % 3], 1.0, -1.0)
    edge = np.repeat(np.arange(len(sides.start)), sides.sizes)
    # The direction from an edge into a triangle is the triangle's normal turned by 90 degrees about the edge. The sense
    # of this turn depends on the direction in which the triangle passes along the edge.
    overlaps = 0
    for gap in range(1, int(sides.sizes.max(initial=1))):
        pairs = np.flatnonzero(edge[gap:] == edge[:-gap])
        cosine = np.einsum("ij,ij->i", normals[facet[pairs + gap]], normals[facet[pairs]])
        cosine *= direction[pairs + gap] * direction[pairs]
        overlaps += int(np.count_nonzero(cosine > 1.0 - 1e-10))
    return overlaps


def count_tets_in_other_bodies(mesh: TetMesh) -> int:
    """Return the number of tetrahedra whose centroid lies inside another body; bodies are parts that share no node."""
    import pyvista as pv

    points, tets = mesh.points_m, mesh.tets
    body = component_of(len(points), tets[:, :3].ravel(), tets[:, 1:].ravel())[tets[:, 0]]
    centres, found = points[tets].mean(axis=1), 0
    for number in np.unique(body) if body.any() else ():
        corners = points[tets[body == number]]
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        near = (body != number) & np.all((centres > low) & (centres < high), axis=1)
        if near.any():
            own = pv.UnstructuredGrid({pv.CellType.TETRA: tets[body == number]}, points)
            found += int(np.count_nonzero(np.atleast_1d(own.find_containing_cell(centres[near])) >= 0))
    return found


def dihedral_range_deg(points: FloatArray, tets: IntArray) -> tuple[float, float]:
    """Return the smallest and the largest angle between two faces of a tetrahedron, [degrees]."""
    cosines = dihedral_cosines(points, tets)
    low, high = np.degrees(np.arccos([cosines.max(initial=-1.0), cosines.min(initial=1.0)])).tolist()
    return low, high


@dataclass(frozen=True)
class MeshFigures:
    """Figures of a mesh that passed `check_mesh`; lengths are in the unit of its nodes, here [m]."""

    volume_m3: float  # sum of the volumes, [m^3]
    area_m2: float  # sum of the boundary triangles' areas, [m^2]
    dihedral_range_deg: tuple[float, float]
    """Smallest and largest angle between two faces of a tetrahedron, [degrees]. The six tetrahedra of a voxel have
    angles of 45, 60 and 90 degrees, conforming meshes 10.9 to 163.8."""
    num_non_manifold_edges: int
    """Number of boundary edges with more than two boundary triangles; they are allowed where bodies touch."""


def check_mesh(mesh: TetMesh) -> MeshFigures:
    """Check that a solver can use a mesh, and return its figures.

    Raises:
        MeshError: A volume is not above 0, neighbours do not share whole faces, a node belongs to no tetrahedron, two
            nodes are at one place, `facets` is not the boundary of the body, or `TetMesh.check` fails.
    """
    mesh.check()
    points, tets = mesh.points_m, mesh.tets
    volumes, faces, sides = signed_volumes(points, tets), group_faces(tets), group_sides(mesh.facets)
    cracks = int(np.count_nonzero(faces.sizes > 2)) + count_overlaps(points, mesh.facets, sides)
    cracks += count_twin_nodes(points) + len(points) - np.count_nonzero(np.bincount(tets.ravel()))
    for name, expected, wrong in (
        ("volumes", "every tetrahedron with a volume above 0", np.count_nonzero(~(volumes > 0.0))),
        ("conformity", "no crack, no face with three owners, no twin or unused node", cracks),
        ("boundary", "just the faces with one owner, normals outwards", count_wrong_facets(mesh, faces)),
    ):
        if wrong:
            remedy = "The mesh is damaged: build it again, and report this if it persists."
            raise MeshError(f"mesh {name}", expected=expected, got=f"{wrong:,} that are wrong", remedy=remedy)
    return MeshFigures(
        volume_m3=float(volumes.sum()),
        area_m2=float(facet_areas(points, mesh.facets).sum()),
        dihedral_range_deg=dihedral_range_deg(points, tets),
        num_non_manifold_edges=int(np.count_nonzero(sides.sizes > 2)),
    )
