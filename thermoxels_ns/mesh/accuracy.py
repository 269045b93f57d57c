"""How well the solid voxels agree with a scene whose true shape is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from thermoxels_ns.checks import check_finite, check_positive, check_shape
from thermoxels_ns.errors import MeshError, explain
from thermoxels_ns.lattice import Lattice
from thermoxels_ns.mesh.build import apply_transform, check_similarity
from thermoxels_ns.mesh.solid import fill_enclosed


class TrueShape(Protocol):
    """A body whose shape is known exactly, in coordinates of its own (truth units)."""

    def signed_distance(self, points: npt.NDArray[np.float64], /) -> npt.NDArray[np.float64]:
        """Distance of points (n, 3) to the surface, shape (n,), negative inside the body."""
        ...

    def surface_points(self, n: int, seed: int, /) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """`n` points spread evenly by area over the surface, and their outward unit normals, each (n, 3)."""
        ...


@dataclass(frozen=True)
class SurfaceScore:
    """Agreement of a reconstructed surface with the true one."""

    precision: float
    """Share of the reconstructed boundary within the tolerance of the true surface, 0 to 1; 0 if there is none."""
    recall: float
    """Share of the true surface that cameras see within the tolerance of the reconstructed boundary, 0 to 1."""
    fscore: float
    """Harmonic mean of precision and recall; 0 if both are."""
    mean_distance: float | None
    """Mean distance of the reconstructed boundary to the true surface, [truth units]; None without a boundary."""


def surface_fscore(
    cells: npt.NDArray[np.bool_],
    lattice: Lattice,
    truth: TrueShape,
    true_points_seen: npt.NDArray[np.float64],
    tolerance: float,
    world_to_truth: npt.NDArray[np.float64] | None = None,
) -> SurfaceScore:
    """Compare the boundary of the solid voxels with the true surface.

    Enclosed cavities are filled first: no camera sees what is inside. The boundary is sampled at four points per voxel
    face. Faces on the border of the lattice, where the box cuts the scene, do not count for precision. Distances for
    recall go to the nearest sample, at most 0.36 voxels beyond the face itself.

    Args:
        cells: Solid voxels, shape `lattice.cell_shape`.
        lattice: Where they are, [world units].
        truth: The true body; only its `signed_distance` is asked.
        true_points_seen: Points of the true surface that enough training cameras see (three, by custom), shape (m, 3),
            m at least 1, [truth units].
        tolerance: Distance that counts as agreement, above 0, [truth units]; 1.5 voxels by custom.
        world_to_truth: Similarity, shape (4, 4), from the lattice's world to truth coordinates (homogeneous column
            vectors); the identity if left out.

    Returns:
        Precision, recall, F-score and mean distance.

    Raises:
        MeshError: Shapes do not fit, or no true point is given.
    """
    remedy = "Pass the solid voxels of this lattice."
    cells = check_shape("cells", np.asarray(cells, dtype=bool), lattice.cell_shape, remedy, MeshError)
    remedy = "Pass points of the true surface that the training cameras see."
    seen = check_shape("true_points_seen", np.asarray(true_points_seen, np.float64), (None, 3), remedy, MeshError)
    check_finite("true_points_seen", seen, remedy, MeshError)
    if len(seen) == 0:
        raise MeshError(explain("true_points_seen", expected="at least one point", got="none", remedy=remedy))
    check_positive("tolerance", tolerance, "Pass 1.5 voxels in truth units.", MeshError)
    transform = check_similarity("world_to_truth", np.eye(4) if world_to_truth is None else world_to_truth)

    samples, on_border = boundary_samples(fill_enclosed(cells))
    if len(samples) == 0:
        return SurfaceScore(precision=0.0, recall=0.0, fscore=0.0, mean_distance=None)
    samples = apply_transform(transform, lattice.index_to_world(samples))
    recall = float(np.mean(KDTree(samples).query(seen)[0] <= tolerance))
    inner = samples[~on_border]
    if len(inner) == 0:
        return SurfaceScore(precision=0.0, recall=recall, fscore=0.0, mean_distance=None)
    distance = np.abs(truth.signed_distance(inner))
    precision = float(np.mean(distance <= tolerance))
    total = precision + recall
    return SurfaceScore(
        precision=precision,
        recall=recall,
        fscore=2.0 * precision * recall / total if total > 0.0 else 0.0,
        mean_distance=float(distance.mean()),
    )


def boundary_samples(
    cells: npt.NDArray[np.bool_], per_side: int = 2
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Sample the voxel faces between solid and empty on a regular grid of `per_side`^2 points each.

    Args:
        cells: Solid voxels, shape (nx-1, ny-1, nz-1).
        per_side: Points along each side of a face, at least 1.

    Returns:
        points: Fractional corner indices, shape (n, 3).
        on_border: True where the face lies on the border of the lattice, shape (n,).
    """
    cells = np.asarray(cells, dtype=bool)
    steps = (np.arange(per_side) + 0.5) / per_side
    points, borders = [np.zeros((0, 3))], [np.zeros(0, dtype=bool)]
    for axis in range(3):
        width = [(0, 0)] * 3
        width[axis] = (1, 1)
        padded = np.pad(cells, width).astype(np.int8)
        face = np.argwhere(np.diff(padded, axis=axis) != 0)
        u, v = (a for a in range(3) if a != axis)
        offsets = np.zeros((per_side, per_side, 3))
        offsets[..., u], offsets[..., v] = steps[:, None], steps[None, :]
        points.append((face[:, None, :] + offsets.reshape(1, -1, 3)).reshape(-1, 3))
        on_border = (face[:, axis] == 0) | (face[:, axis] == cells.shape[axis])
        borders.append(np.repeat(on_border, per_side**2))
    return np.concatenate(points), np.concatenate(borders)
