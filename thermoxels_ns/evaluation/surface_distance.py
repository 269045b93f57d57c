"""Distances between a mesh's surface and a true surface, and temperatures where they meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import check_positive, check_shape
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.evaluation.voxel_accuracy import TrueShape
from thermoxels_ns.mesh.quality.checks import facet_areas
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh


@dataclass(frozen=True)
class SurfaceDistances:
    """Distances between two surfaces, [truth units], and what lies at the closest points."""

    mesh_to_truth: float
    """Mean distance of the mesh's surface, spread evenly by area, to the true surface."""
    truth_to_mesh: float
    """Mean distance of the given true points to the mesh's surface."""
    chamfer: float
    """Mean of both."""
    hausdorff: float
    """Largest of all these distances."""
    closest_temperature_c: npt.NDArray[np.float64]
    """Temperature of the mesh at its surface point closest to each true point, shape (m,), [degrees Celsius]."""
    closest_distance: npt.NDArray[np.float64]
    """Distance to that point, shape (m,)."""


def sample_facets(
    points: npt.NDArray[np.float64], facets: npt.NDArray[np.int64], count: int
) -> npt.NDArray[np.float64]:
    """Points spread evenly by area over triangles, shape (count, 3); the same points every time.

    A low-discrepancy sequence (the golden ratio and the plastic number's R2 sequence) walks along the triangles in
    their order, so neighbouring triangles share the points in proportion to their areas.

    Raises:
        MeshError: No triangle has an area above 0.
    """
    area = facet_areas(points, facets)
    total = np.concatenate([[0.0], np.cumsum(area)])
    if not total[-1] > 0.0:
        raise MeshError(
            "boundary", expected="triangles with an area above 0", got=len(facets), remedy="Build the mesh again."
        )
    number = np.arange(count)
    which = np.searchsorted(total, (number + 0.5) / count * total[-1], side="right") - 1
    which = np.clip(which, 0, len(facets) - 1)
    u, v = np.mod(0.5 + number * 0.7548776662466927, 1.0), np.mod(0.5 + number * 0.5698402909980532, 1.0)
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = (points[facets[which, n]] for n in range(3))
    return a + u[:, None] * (b - a) + v[:, None] * (c - a)


def surface_distances(
    mesh: TetMesh, truth: TrueShape, true_points: npt.NDArray[np.float64], metres_per_unit: float = 1.0
) -> SurfaceDistances | None:
    """Measure a mesh against a body whose shape is known exactly.

    Cuts by the scene box are not surface and are left out. Distances from the mesh are those of 20,000 points of it;
    those from the truth go to the nearest point of any triangle.

    Args:
        mesh: The mesh, [m].
        truth: The true body, [truth units].
        true_points: Points of the true surface that a mesh can be expected to have, shape (m, 3), m at least 1.
        metres_per_unit: Scale of the mesh, metres per truth unit, above 0.

    Returns:
        The distances; None if all of the boundary is cut by the box.

    Raises:
        MeshError: An array does not fit.
    """
    import pyvista as pv

    remedy = "Pass points of the true surface."
    seen = check_shape("true_points", np.asarray(true_points, dtype=np.float64), (None, 3), remedy, MeshError)
    check_positive("metres_per_unit", metres_per_unit, "Pass the scale of the mesh.", MeshError)
    points = mesh.points_m / metres_per_unit
    facets = mesh.facets[mesh.facet_tags != FACET_BOX]
    if len(facets) == 0 or len(seen) == 0:
        return None
    outwards = np.abs(truth.signed_distance(sample_facets(points, facets, 20_000)))
    surface = pv.PolyData.from_regular_faces(points, facets)
    cell, closest = surface.find_closest_cell(seen, return_closest_point=True)  # type: ignore[misc]
    inwards = np.linalg.norm(closest - seen, axis=1)
    triangle = facets[np.asarray(cell)]
    share = _barycentric(points[triangle], np.asarray(closest))
    return SurfaceDistances(
        mesh_to_truth=float(outwards.mean()),
        truth_to_mesh=float(inwards.mean()),
        chamfer=0.5 * float(outwards.mean() + inwards.mean()),
        hausdorff=float(max(outwards.max(), inwards.max())),
        closest_temperature_c=np.einsum("ij,ij->i", share, mesh.temperature_c[triangle]),
        closest_distance=inwards,
    )


def _barycentric(corners: npt.NDArray[np.float64], points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Weights of triangle corners (m, 3, 3) that give points (m, 3) in the triangles, in [0, 1] with sum 1."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    w = points - corners[:, 0]
    uu, uv, vv = (np.einsum("ij,ij->i", a, b) for a, b in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("ij,ij->i", w, u), np.einsum("ij,ij->i", w, v)
    divisor = uu * vv - uv * uv
    second = (vv * wu - uv * wv) / divisor
    third = (uu * wv - uv * wu) / divisor
    share = np.clip(np.stack([1.0 - second - third, second, third], axis=1), 0.0, None)
    return share / share.sum(axis=1, keepdims=True)
