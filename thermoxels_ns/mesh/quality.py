"""Is the mesh fit for a finite-element solver: volumes, areas, angles, conformity, closedness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.checks import check_finite, check_shape
from thermoxels_ns.errors import MeshError, explain
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh
from thermoxels_ns.mesh.voxel_tets import OUTWARD_FACES, boundary_facets, count_facets

_CHUNK = 1 << 18
_REMEDY = "The mesh is damaged: build it again, and report this if it persists."


@dataclass(frozen=True)
class MeshQuality:
    """Figures of a mesh that passed `check_mesh`: positive volumes, conforming, closed boundary."""

    num_nodes: int
    """Nodes."""
    num_tets: int
    """Tetrahedra."""
    num_facets: int
    """Boundary triangles."""
    num_box_facets: int
    """Boundary triangles where the scene box cuts the solid."""
    num_non_manifold_edges: int
    """Boundary edges shared by more than two boundary triangles: voxels that touch along an edge only."""
    volume_m3: float
    """Sum of the tetrahedra's volumes, [m^3]."""
    area_m2: float
    """Area of the whole boundary, cuts by the scene box included, [m^2]."""
    min_tet_volume_m3: float
    """Volume of the smallest tetrahedron, [m^3]."""
    min_dihedral_deg: float
    """Smallest angle between two faces of a tetrahedron, [degrees]."""
    max_dihedral_deg: float
    """Largest angle between two faces of a tetrahedron, [degrees]."""


def signed_volumes(points: npt.NDArray[np.float64], tets: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Volumes det(p1 - p0, p2 - p0, p3 - p0) / 6, shape (t,), [m^3]; negative if a tetrahedron is turned over."""
    origin = points[tets[:, 0]]
    a, b, c = (points[tets[:, n]] - origin for n in (1, 2, 3))
    return np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0


def facet_area_vectors(points: npt.NDArray[np.float64], facets: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Area times unit normal of triangles (right-hand rule), shape (f, 3), [m^2]."""
    origin = points[facets[:, 0]]
    return 0.5 * np.cross(points[facets[:, 1]] - origin, points[facets[:, 2]] - origin)


def facet_areas(points: npt.NDArray[np.float64], facets: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Areas of triangles, shape (f,), [m^2]."""
    return np.linalg.norm(facet_area_vectors(points, facets), axis=1)


def facet_normals(points: npt.NDArray[np.float64], facets: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Unit normals of triangles (right-hand rule), shape (f, 3)."""
    vectors = facet_area_vectors(points, facets)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def dihedral_range_deg(points: npt.NDArray[np.float64], tets: npt.NDArray[np.int64]) -> tuple[float, float]:
    """Smallest and largest angle between two faces of a tetrahedron, [degrees]."""
    smallest, largest = 180.0, 0.0
    first, second = np.triu_indices(4, k=1)
    for start in range(0, len(tets), _CHUNK):
        chunk = tets[start : start + _CHUNK]
        normals = facet_normals(points, chunk[:, OUTWARD_FACES].reshape(-1, 3)).reshape(-1, 4, 3)
        cosine = -np.einsum("tij,tij->ti", normals[:, first], normals[:, second])
        angles = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        smallest, largest = min(smallest, float(angles.min())), max(largest, float(angles.max()))
    return smallest, largest


def check_mesh(mesh: TetMesh) -> MeshQuality:
    """Check that a mesh is what a finite-element solver needs, and measure it.

    Checked: shapes and finite numbers; every node is used and no two coincide; volumes above 0; interior faces belong
    to exactly two tetrahedra; `mesh.facets` are exactly the other faces, normals outwards, which makes the boundary
    closed (every edge of it belongs to an even number of triangles); no two boundary triangles lie on each other,
    which is how a crack between neighbours that do not match looks.

    Args:
        mesh: The mesh to check.

    Returns:
        Counts, volume, area and angles.

    Raises:
        MeshError: A check failed; the message says which, where and how often.
    """
    _check_arrays(mesh)
    volumes = signed_volumes(mesh.points_m, mesh.tets)
    bad = np.flatnonzero(~(volumes > 0.0))
    if len(bad):
        _fail("tetrahedra", "volumes above 0", f"{len(bad)} of {len(volumes)} at or below 0, the first is {bad[0]}")

    _, uses = count_facets(mesh.tets)
    if uses.max() > 2:
        _fail("tetrahedra", "faces shared by at most 2", f"{np.count_nonzero(uses > 2)} faces shared by more")
    if not np.array_equal(_canonical(mesh.facets), _canonical(boundary_facets(mesh.tets))):
        _fail("facets", "the faces owned by one tetrahedron, normals outwards", "different triangles or orientations")
    num_non_manifold = _check_boundary(mesh)

    low, high = dihedral_range_deg(mesh.points_m, mesh.tets)
    return MeshQuality(
        num_nodes=len(mesh.points_m),
        num_tets=len(mesh.tets),
        num_facets=len(mesh.facets),
        num_box_facets=int(np.count_nonzero(mesh.facet_tags == FACET_BOX)),
        num_non_manifold_edges=num_non_manifold,
        volume_m3=float(volumes.sum()),
        area_m2=float(facet_areas(mesh.points_m, mesh.facets).sum()),
        min_tet_volume_m3=float(volumes.min()),
        min_dihedral_deg=low,
        max_dihedral_deg=high,
    )


def _fail(name: str, expected: str, got: str) -> None:
    raise MeshError(explain(f"mesh {name}", expected=expected, got=got, remedy=_REMEDY))


def _check_arrays(mesh: TetMesh) -> None:
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
    if mesh.tets.min() < 0 or mesh.tets.max() >= nodes:
        _fail("tets", f"node numbers from 0 to {nodes - 1}", f"{mesh.tets.min()} to {mesh.tets.max()}")
    unused = nodes - np.count_nonzero(np.bincount(mesh.tets.ravel(), minlength=nodes))
    if unused:
        _fail("points_m", "nodes that belong to a tetrahedron", f"{unused} that belong to none")
    ordered = mesh.points_m[np.lexsort(mesh.points_m.T)]
    twins = np.count_nonzero(np.all(ordered[1:] == ordered[:-1], axis=1))
    if twins:
        _fail("points_m", "different positions", f"{twins} nodes at the place of another")


def _canonical(facets: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Turn each triangle so that its smallest node comes first, keep its orientation, and sort the rows."""
    turn = (np.argmin(facets, axis=1)[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(facets, turn, axis=1)
    return turned[np.lexsort((turned[:, 2], turned[:, 1], turned[:, 0]))]


def _check_boundary(mesh: TetMesh) -> int:
    """Raise if the boundary lies on itself; return the number of non-manifold edges."""
    facets = mesh.facets
    edges = np.concatenate([facets[:, [0, 1]], facets[:, [1, 2]], facets[:, [2, 0]]])
    apexes = np.concatenate([facets[:, 2], facets[:, 0], facets[:, 1]])
    low, high = edges.min(axis=1), edges.max(axis=1)
    order = np.lexsort((high, low))
    low, high, apexes = low[order], high[order], apexes[order]
    first = np.concatenate([[True], (low[1:] != low[:-1]) | (high[1:] != high[:-1])])
    edge = np.cumsum(first) - 1
    uses = np.bincount(edge)
    # Closed: each tetrahedron's faces meet every edge an even number of times, and faces with two owners cancel.
    assert not np.any(uses % 2)

    # Unit vectors from an edge into its triangles. Two that agree: two triangles lie on each other.
    along = mesh.points_m[high] - mesh.points_m[low]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    inward = mesh.points_m[apexes] - mesh.points_m[low]
    inward -= np.einsum("ij,ij->i", inward, along)[:, None] * along
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    folded = 0
    for gap in range(1, int(uses.max())):
        same_edge = edge[gap:] == edge[:-gap]
        cosine = np.einsum("ij,ij->i", inward[gap:], inward[:-gap])
        folded += int(np.count_nonzero(same_edge & (cosine > 1.0 - 1e-10)))
    if folded:
        _fail("tetrahedra", "neighbours whose faces match", f"a crack: {folded} pairs of boundary triangles overlap")
    return int(np.count_nonzero(uses > 2))
