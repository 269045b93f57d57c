"""How well the solid voxels agree with a scene whose true shape is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.checks import check_shape
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.build import apply_transform, check_similarity
from thermoxels_ns.mesh.solid.free_space import count_cameras
from thermoxels_ns.mesh.solid.morphology import fill_enclosed

MIN_VIEWS = 3  # A point of a surface is seen if at least this many training cameras see it

_PER_SIDE = 2


class TrueShape(Protocol):
    """A body whose shape is known exactly, in coordinates of its own (truth units)."""

    def signed_distance(self, points: FloatArray, /) -> FloatArray:
        """Distance of points (n, 3) to the surface, shape (n,), negative inside the body."""
        ...


@dataclass(frozen=True)
class _Score:
    precision: float
    """Share of the reconstructed boundary within the tolerance of the true surface, 0 to 1; 0 if there is none."""
    recall: float
    """Share of the true surface that cameras see within the tolerance of the reconstructed boundary, 0 to 1."""
    fscore: float  # Harmonic mean of precision and recall; 0 if both are


@dataclass(frozen=True)
class SeenScore(_Score):
    """Agreement of the part of a reconstructed surface that cameras see, and its share of the whole, 0 to 1.

    Against the whole surface's score it tells what photographs could have shown from what was guessed behind it.
    """

    share: float


@dataclass(frozen=True)
class SurfaceScore(_Score):
    """Agreement of a reconstructed surface with the true one."""

    mean_distance: float | None
    """Mean distance of the reconstructed boundary to the true surface, [truth units]; None without a boundary."""
    seen: SeenScore | None = None
    """The same for the part of the boundary that cameras see; None if the cameras are not given."""


def surface_fscore(
    cells: BoolArray,
    lattice: Lattice,
    truth: TrueShape,
    true_points_seen: FloatArray,
    tolerance: float,
    world_to_truth: FloatArray | None = None,
    views: Views | None = None,
    surroundings: TrueShape | None = None,
    within: BoolArray | None = None,
) -> SurfaceScore:
    """Compare the boundary of the solid voxels with the true surface.

    Enclosed cavities are filled first: no camera sees what is inside. The boundary is sampled at four points per voxel
    face. Faces where the lattice or the region ends, which cut the scene, do not count for precision. Distances for
    recall go to the nearest sample, at most 0.36 voxels beyond the face itself.

    A voxel face is seen if `MIN_VIEWS` cameras have a free line, past the solid voxels, to the empty voxel before it.

    Args:
        cells: Solid voxels, shape `lattice.cell_shape`.
        lattice: Where they are, [world units].
        truth: The true body.
        true_points_seen: True surface that enough training cameras see, shape (m, 3), m at least 1, [truth units].
        tolerance: Distance that counts as agreement, above 0, [truth units]; 1.5 voxels by custom.
        world_to_truth: Similarity, shape (4, 4), from the lattice's world to truth coordinates; None: the identity.
        views: The training cameras, in the coordinates of the lattice: the part of the boundary that they see is scored
            too, which takes a few passes over the lattice per camera.
        surroundings: What truly stands beside the body. Boundary in it, or within the tolerance of it, is neither right
            nor wrong: photographs do not say where the body ends and its surroundings begin.
        within: The region that was taken, shape `lattice.cell_shape`; None: all.
    """
    cells = check_shape("cells", cells, lattice.cell_shape, "Pass the solid voxels of this lattice.", MeshError)
    seen = np.asarray(true_points_seen, dtype=np.float64)
    assert len(seen) and tolerance > 0.0
    transform = check_similarity("world_to_truth", np.eye(4) if world_to_truth is None else world_to_truth)

    solid = fill_enclosed(cells)
    faces = _boundary_faces(solid, np.ones_like(solid) if within is None else within)
    samples, on_border = _samples(faces)
    of_seen = None if views is None else SeenScore(share=0.0, precision=0.0, recall=0.0, fscore=0.0)
    if len(samples) == 0:
        return SurfaceScore(precision=0.0, recall=0.0, fscore=0.0, mean_distance=None, seen=of_seen)
    samples = apply_transform(transform, lattice.index_to_world(samples))
    recall = float(np.mean(KDTree(samples).query(seen)[0] <= tolerance))
    inner = samples[~on_border]
    scored = np.ones(len(inner), dtype=bool)
    if surroundings is not None:
        scored = (surroundings.signed_distance(inner) > tolerance) | (np.abs(truth.signed_distance(inner)) <= tolerance)
    if not scored.any():
        return SurfaceScore(precision=0.0, recall=recall, fscore=0.0, mean_distance=None, seen=of_seen)
    distance = np.abs(truth.signed_distance(inner))
    precision = float(np.mean(distance[scored] <= tolerance))
    if views is not None and len(views.focal):
        free = count_cameras(solid, lattice, views).free >= MIN_VIEWS
        shown = np.concatenate([free[tuple(f.empty[~f.on_border].T)] for f in faces]).repeat(_PER_SIDE**2)
        shown &= scored
        of_seen = _seen_score(inner[shown], distance[shown] <= tolerance, float(shown.mean()), seen, tolerance)
    return SurfaceScore(
        precision=precision,
        recall=recall,
        fscore=_harmonic_mean(precision, recall),
        mean_distance=float(distance[scored].mean()),
        seen=of_seen,
    )


def _seen_score(
    samples: FloatArray, agrees: BoolArray, share: float, true_points: FloatArray, tolerance: float
) -> SeenScore:
    if len(samples) == 0:
        return SeenScore(share=0.0, precision=0.0, recall=0.0, fscore=0.0)
    precision = float(agrees.mean())
    recall = float(np.mean(KDTree(samples).query(true_points)[0] <= tolerance))
    return SeenScore(precision, recall, _harmonic_mean(precision, recall), share)


def _harmonic_mean(precision: float, recall: float) -> float:
    total = precision + recall
    return 2.0 * precision * recall / total if total > 0.0 else 0.0


@dataclass(frozen=True)
class _Faces:
    """Voxel faces across one axis, between solid and empty."""

    axis: int
    corner: IntArray  # Corner index of each face's first corner, shape (n, 3)
    empty: IntArray  # The empty voxel beside each face, shape (n, 3); outside the lattice for some faces on its border
    on_border: BoolArray  # Faces on the border of the lattice or of the region, shape (n,)


def _boundary_faces(cells: BoolArray, within: BoolArray) -> tuple[_Faces, ...]:
    faces, within = [], np.pad(within, 1)
    for axis in range(3):
        width = [(0, 0)] * 3
        width[axis] = (1, 1)
        rise = np.diff(np.pad(cells, width).astype(np.int8), axis=axis)
        corner = np.argwhere(rise != 0)
        empty = corner.copy()
        empty[:, axis] -= rise[tuple(corner.T)] > 0
        faces.append(_Faces(axis, corner, empty, on_border=~within[tuple((empty + 1).T)]))
    return tuple(faces)


def _samples(faces: tuple[_Faces, ...]) -> tuple[FloatArray, BoolArray]:
    """Corner indices of `_PER_SIDE`^2 points on a regular grid of each face, and which lie on a border."""
    steps = (np.arange(_PER_SIDE) + 0.5) / _PER_SIDE
    points, borders = [], []
    for face in faces:
        u, v = (a for a in range(3) if a != face.axis)
        offsets = np.zeros((_PER_SIDE, _PER_SIDE, 3))
        offsets[..., u], offsets[..., v] = steps[:, None], steps[None, :]
        points.append((face.corner[:, None, :] + offsets.reshape(1, -1, 3)).reshape(-1, 3))
        borders.append(np.repeat(face.on_border, _PER_SIDE**2))
    return np.concatenate(points), np.concatenate(borders)
