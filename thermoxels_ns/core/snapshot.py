"""The trained field as plain arrays, which training hands to the mesher."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import check_array
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import CORNER_OFFSETS, Lattice

SHOWN_WELL = 0.15
"""Least visibility of a place that is shown well, relative to what cameras were pointed at. In nine synthetic scenes
with a street or room around, this keeps all of the scene and removes half of what is around; in synthetic rooms seen
from inside it keeps 99.7 % of what two photographs see."""
_FEWEST_CAMERAS = 0.1  # Quantile of the visibility of what cameras are pointed at; `SHOWN_WELL` refers to it


@dataclass(frozen=True)
class Views:
    """The training cameras (pinholes without distortion), in the coordinates of the lattice."""

    camera_to_world: FloatArray  # Poses [R | centre], x right, y up, z back (OpenGL), shape (c, 3, 4)
    focal: FloatArray  # Focal lengths along x and y, shape (c, 2), [pixels]
    centre: FloatArray  # Principal points x, y from the image's upper left corner, shape (c, 2), [pixels]
    size: IntArray  # Image widths and heights, shape (c, 2), [pixels]

    @classmethod
    def of(cls, cameras: Sequence[Camera], poses: Sequence[FloatArray]) -> Views:
        """Return the views of `cameras` at `poses`, (3, 4) or (4, 4) each, camera to world (OpenGL). Distortion is left
        out, so that a view may end a little inside or outside the border of the photograph."""
        pairs = (("fl_x", "fl_y"), ("cx", "cy"), ("width", "height"))
        parts = (np.array([[getattr(camera, name) for name in pair] for camera in cameras]) for pair in pairs)
        return cls(np.stack([pose[:3] for pose in poses]), *parts)

    def matrices(self) -> FloatArray:
        """Return the projection matrices (c, 3, 4) from (x, y, z, 1) to depth * (column, row, 1); depth > 0 ahead."""
        turned = self.camera_to_world[:, :, :3].transpose(0, 2, 1) * [[1.0], [-1.0], [-1.0]]
        local = np.concatenate((turned, -turned @ self.camera_to_world[:, :, 3:]), axis=2)
        local[:, :2] = self.focal[..., None] * local[:, :2] + self.centre[..., None] * local[:, 2:]
        return local

    def shows(self, camera: int, directions: FloatArray) -> BoolArray:
        """Return for each direction (..., 3) from the centre of `camera` whether its image shows it, shape (...)."""
        column, row, depth = np.moveaxis(directions @ self.matrices()[camera, :, :3].T, -1, 0)
        width, height = self.size[camera]
        inside = (column >= 0) & (column <= width * depth) & (row >= 0) & (row <= height * depth)
        return inside & (depth > 1e-9)

    def shown_well(self, places: FloatArray, reach: FloatArray) -> BoolArray:
        """Return for each place (n, 3) whether photographs show it about as well as the cameras' targets, (n,).

        `reach` (cameras,) is the distance of each camera's target, the point that it was pointed at; a camera with NaN
        does not count. A camera adds 1 to the visibility of each place in its image up to the distance `reach`, and
        (reach / distance)^2 beyond, in proportion to the pixels per area. Occlusion is ignored. A place is shown well
        if its visibility is at least `SHOWN_WELL` times the quantile `_FEWEST_CAMERAS` of the targets' visibilities.
        Open ground then ends about where the cameras stood. If no camera counts, all places are shown well.
        """
        (known,) = np.nonzero(np.isfinite(reach))
        eyes, axes = self.camera_to_world[:, :, 3], self.camera_to_world[:, :, 2]
        aims = (eyes - (1.0 - 1e-6) * reach[:, None] * axes)[known]

        def visibility(at: FloatArray) -> FloatArray:
            total = np.zeros(len(at))
            for camera in known.tolist():
                away = at - eyes[camera]
                nearness = reach[camera] ** 2 / np.maximum((away**2).sum(axis=1), 1e-12)
                total += self.shows(camera, away) * np.minimum(1.0, nearness)
            return total

        least = float(np.quantile(visibility(aims), _FEWEST_CAMERAS)) if len(known) else 0.0
        return visibility(places) >= SHOWN_WELL * least


@dataclass(frozen=True)
class RayEvidence:
    """Evidence from training rays of both streams about where solid matter is."""

    half_depth_density: Float32Array
    """For each ray whose opacity exceeds 1/2, the highest density at the centres of the voxels that the ray crosses
    within half a voxel of the point at which half of its weight is spent, shape (rays,), [1 / world unit]."""
    ends: Float32Array
    """Points at which half of the weight of these rays is spent, in corner indices of the lattice, shape (rays, 3)."""
    directions: Float32Array  # Unit vectors along these rays, shape (rays, 3)


@dataclass(frozen=True)
class GridSnapshot:
    """The trained field as arrays on the corners of a lattice. Raises `MeshError` for wrong shapes and bad values."""

    lattice: Lattice
    density: Float32Array  # Density after activation at the corners, [1 / world unit], >= 0
    temperature_c: Float32Array | None
    """Temperature at the corners, [degrees Celsius]: the mean over samples of thermal training rays at their first hit,
    weighted by their share of the pixel. Where `observed_weight` is 0, the value is not a measurement. None: only
    photographs trained."""
    observed_weight: Float32Array
    """Sum of the weights that thermal training rays gave each corner; 0: no thermal ray saw the corner."""
    voxel_density: Float32Array | None = None
    """Density of the field at the voxel centres, shape `lattice.cell_shape`, [1 / world unit]. None: the field is
    trilinear, so the density at a centre is the mean of the voxel's corners."""
    colour: Float32Array | None = None
    """Red, green, blue in [0, 1] at the corners, the mean over all directions, shape (*lattice.shape, 3). None: the
    model has no colour."""
    evidence: RayEvidence | None = None  # Where training rays end. None: not known
    views: Views | None = None  # The training cameras of both streams. None: not known

    def __post_init__(self) -> None:
        corners, cells, seen, views = self.lattice.shape, self.lattice.cell_shape, self.evidence, self.views
        count = 0 if views is None else len(views.camera_to_world)
        rays = 0 if seen is None else len(seen.half_depth_density)
        for part, name, shape, least, most in (
            (self, "density", corners, -np.inf, np.inf),
            (self, "temperature_c", corners, -np.inf, np.inf),
            (self, "observed_weight", corners, -np.inf, np.inf),
            (self, "voxel_density", cells, -np.inf, np.inf),
            (self, "colour", (*corners, 3), 0.0, 1.0),
            (seen, "half_depth_density", (None,), 0.0, np.inf),
            (seen, "ends", (rays, 3), -np.inf, np.inf),
            (seen, "directions", (rays, 3), -1.01, 1.01),
            (views, "camera_to_world", (count, 3, 4), -np.inf, np.inf),
            (views, "focal", (count, 2), _SMALLEST_FOCAL, np.inf),
            (views, "centre", (count, 2), -np.inf, np.inf),
            (views, "size", (count, 2), 1.0, np.inf),
        ):
            array = None if part is None else getattr(part, name)
            if array is None:
                continue
            named, remedy = f"grid snapshot {name}", _CAMERAS if part is views else _FIELD
            check_array(named, array, shape, remedy, MeshError)
            if array.size and not least <= array.min() <= array.max() <= most:
                expected, got = f"values from {least:g} to {most:g}", f"{array.min():g} to {array.max():g}"
                raise MeshError(named, expected=expected, got=got, remedy=remedy)

    def centre_density(self) -> FloatArray:
        """Return the density at the voxel centres, shape `lattice.cell_shape`, [1 / world unit]."""
        if self.voxel_density is not None:
            return self.voxel_density.astype(np.float64)
        x, y, z = self.lattice.cell_shape
        corners = self.density.astype(np.float64)
        total = np.asarray(sum(corners[i : i + x, j : j + y, k : k + z] for i, j, k in CORNER_OFFSETS))
        return total / 8.0


_SMALLEST_FOCAL = 1e-6  # least focal length of a lens, [pixels]
_FIELD = "The checkpoint is damaged; resume from an earlier one."
_CAMERAS = "Correct the camera poses and intrinsics of the scene."
