"""Is the mesh fit for a finite-element solver: volumes, areas, angles, conformity, closedness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import check_finite, check_shape
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.face_count import Groups, boundary_facets, group_faces, group_pairs
from thermoxels_ns.mesh.quality.tet_shapes import shapes_in_chunks
from thermoxels_ns.mesh.quality.topology import group_sides
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh

_REMEDY = "The mesh is damaged: build it again, and report this if it persists."


@dataclass(frozen=True)
class MeshQuality:
    """Figures of a mesh that passed `check_mesh`: positive volumes, conforming, closed boundary."""

    num_nodes: int
    num_tets: int
    num_facets: int
    num_box_facets: int  # boundary triangles where the scene box cuts the solid
    num_non_manifold_edges: int
    """Boundary edges shared by more than two boundary triangles: voxels that touch along an edge only."""
    volume_m3: float  # sum of the tetrahedra's volumes, [m^3]
    area_m2: float  # area of the whole boundary, cuts by the scene box included, [m^2]
    min_tet_volume_m3: float  # volume of the smallest tetrahedron, [m^3]
    min_dihedral_deg: float  # smallest angle between two faces of a tetrahedron, [degrees]
    max_dihedral_deg: float  # largest angle between two faces of a tetrahedron, [degrees]


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


def check_mesh(mesh: TetMesh) -> MeshQuality:
    """Check that a mesh is what a finite-element solver needs, and measure it.

    Checked: shapes and finite numbers; every node is used and no two coincide; volumes above 0; interior faces belong
    to exactly two tetrahedra; `mesh.facets` are exactly the other faces, normals outwards, which makes the boundary
    closed (every edge of it belongs to an even number of triangles); no two boundary triangles lie on each other,
    which is how a crack between neighbours that do not match looks.

    Raises:
        MeshError: A check failed; the message says which, where and how often.
    """
    check_arrays(mesh)
    unused = len(mesh.points_m) - np.count_nonzero(np.bincount(mesh.tets.ravel(), minlength=len(mesh.points_m)))
    if unused:
        _fail("points_m", "nodes that belong to a tetrahedron", f"{unused} that belong to none")
    twins = count_twin_nodes(mesh.points_m)
    if twins:
        _fail("points_m", "different positions", f"{twins} nodes at the place of another")
    volumes, smallest, largest = volumes_and_angles(mesh.points_m, mesh.tets)
    bad = np.flatnonzero(~(volumes > 0.0))
    if len(bad):
        _fail("tetrahedra", "volumes above 0", f"{len(bad)} of {len(volumes)} at or below 0, the first is {bad[0]}")

    faces = group_faces(mesh.tets)
    shared_by_more = np.count_nonzero(faces.sizes > 2)
    if shared_by_more:
        _fail("tetrahedra", "faces shared by at most 2", f"{shared_by_more} faces shared by more")
    wrong = count_wrong_facets(mesh, faces)
    if wrong:
        expected = "the faces owned by one tetrahedron, normals outwards"
        _fail("facets", expected, f"{wrong} missing, extra or turned over")
    sides = group_sides(mesh.facets)
    # Closed: each tetrahedron's faces meet every edge an even number of times, and faces with two owners cancel.
    assert not np.any(sides.sizes % 2)
    folded = count_overlaps(mesh.points_m, mesh.facets, sides)
    if folded:
        _fail("tetrahedra", "neighbours whose faces match", f"a crack: {folded} pairs of boundary triangles overlap")

    return MeshQuality(
        num_nodes=len(mesh.points_m),
        num_tets=len(mesh.tets),
        num_facets=len(mesh.facets),
        num_box_facets=int(np.count_nonzero(mesh.facet_tags == FACET_BOX)),
        num_non_manifold_edges=int(np.count_nonzero(sides.sizes > 2)),
        volume_m3=float(volumes.sum()),
        area_m2=float(facet_areas(mesh.points_m, mesh.facets).sum()),
        min_tet_volume_m3=float(volumes.min()),
        min_dihedral_deg=smallest,
        max_dihedral_deg=largest,
    )


def check_arrays(mesh: TetMesh) -> None:
    """Raise `MeshError` if shapes do not fit, numbers are not finite, or node numbers are out of range."""
    nodes, tets, facets = len(mesh.points_m), len(mesh.tets), len(mesh.facets)
    shapes: dict[str, tuple[int | None, ...]] = {
        "points_m": (None, 3),
        "tets": (None, 4),
        "temperature_c": (nodes,),
        "observed": (nodes,),
        "facets": (None, 3),
        "facet_tags": (facets,),
        "region": (tets,),
    }
    for name, shape in shapes.items():
        check_shape(f"mesh {name}", getattr(mesh, name), shape, _REMEDY, MeshError)
        check_finite(f"mesh {name}", getattr(mesh, name), _REMEDY, MeshError)
    if tets == 0:
        _fail("tets", "at least one tetrahedron", "none")
    for name, numbers in (("tets", mesh.tets), ("facets", mesh.facets)):
        if len(numbers) and not (numbers.min() >= 0 and numbers.max() < nodes):
            _fail(name, f"node numbers from 0 to {nodes - 1}", f"{numbers.min()} to {numbers.max()}")


def count_twin_nodes(points: FloatArray) -> int:
    """Number of nodes at the place of an earlier one."""
    # Equal points have equal sums of scrambled bits (and -0.0 + 0.0 is 0.0); only points with equal sums are compared.
    bits = (np.asarray(points, dtype=np.float64) + 0.0).view(np.uint64)
    sums = (bits ^ (bits >> np.uint64(29))) @ np.array(
        [0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64
    )
    ordered = np.sort(sums)
    doubled = ordered[1:][ordered[1:] == ordered[:-1]]
    if len(doubled) == 0:
        return 0
    candidates = points[np.isin(sums, doubled)]
    candidates = candidates[np.lexsort(candidates.T)]
    return int(np.count_nonzero(np.all(candidates[1:] == candidates[:-1], axis=1)))


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


def volumes_and_angles(points: FloatArray, tets: IntArray) -> tuple[FloatArray, float, float]:
    """Signed volumes (t,), [m^3], smallest and largest dihedral angle, [degrees]; 0 at a face without area."""
    volumes = np.empty(len(tets))
    low, high = 1.0, -1.0
    for which, shapes in shapes_in_chunks(points, tets):
        volumes[which] = shapes.volumes
        cosines = shapes.dihedral_cosines()
        low, high = min(low, float(cosines.min())), max(high, float(cosines.max()))
    return volumes, float(np.degrees(np.arccos(high))), float(np.degrees(np.arccos(low)))


def _fail(name: str, expected: str, got: str) -> None:
    raise MeshError(f"mesh {name}", expected=expected, got=got, remedy=_REMEDY)


def _smallest_first(facets: IntArray) -> IntArray:
    """Turn each triangle so that its smallest node comes first; its orientation stays."""
    turn = (np.argmin(facets, axis=1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(facets, turn, axis=1)
