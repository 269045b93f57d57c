"""Comparison of a reconstruction with a synthetic scene, whose shape and temperature are known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import check_array
from thermoxels_ns.core.errors import MeshError, SceneError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, Views
from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.mesh.build import apply_transform
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.free_space import count_cameras
from thermoxels_ns.mesh.solid.interior import camera_voxels, cavities
from thermoxels_ns.mesh.solid.voxels import SolidSelection, select_solid
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh, facet_areas
from thermoxels_ns.synthetic.raycast import first_surface, visible_surface_points
from thermoxels_ns.synthetic.scene_folder import load_truth
from thermoxels_ns.synthetic.scene_truth import SyntheticScene

MIN_VIEWS = 3  # A point of a surface counts as seen if at least this many training cameras see it
TOLERANCE_VOXELS = 1.5  # A point agrees with the other surface if it is at most this far from that surface, [voxels]
DEPTH_TOLERANCE = 0.02  # A depth is off if it differs from the true depth by more than this share of the true depth
COMMON_RESOLUTION = 128  # Voxels along the exact box's longest side; their size sets the tolerance of `fscore_128`

_SURFACE_POINTS = 20_000
_PER_SIDE = 2  # Sample points along each side of a voxel's face
_TRAINING_PREFIX = "frame_train_"


@dataclass(frozen=True)
class SurfaceScore:
    """Agreement of a reconstructed surface, or of a part of it, with the true one."""

    precision: float = 0.0
    """Share of the reconstructed boundary within the tolerance of the true surface, 0 to 1; 0 if there is none."""
    recall: float = 0.0
    """Share of the true surface seen by cameras that is within the tolerance of the reconstructed boundary, 0 to 1."""
    share: float = 0.0  # Share of the reconstructed boundary that is scored, 0 to 1
    mean_distance: float | None = None
    """Mean distance of the scored boundary to the true surface, [m]; None if it was not measured."""

    @property
    def fscore(self) -> float:
        """Harmonic mean of precision and recall, 0 to 1; 0 if both are 0."""
        return 2.0 * self.precision * self.recall / (self.precision + self.recall or 1.0)


def _boundary_samples(cells: BoolArray, within: BoolArray) -> tuple[FloatArray, IntArray, BoolArray]:
    """Return sample points on the faces between solid `cells` and empty cells, `_PER_SIDE` squared on each face.
    Returns the points (n, 3) [corner indices], the index of the empty cell in front of each point (n, 3), and a mask
    (n,), True if that empty cell is outside the lattice or outside the region `within` (a mask like `cells`)."""
    steps, within, found = (np.arange(_PER_SIDE) + 0.5) / _PER_SIDE, np.pad(within, 1), []
    for axis in range(3):
        rise = np.diff(cells.astype(np.int8), axis=axis, prepend=np.int8(0), append=np.int8(0))
        corner = np.argwhere(rise != 0)
        empty = corner.copy()
        empty[:, axis] -= rise[tuple(corner.T)] > 0
        u, v = (a for a in range(3) if a != axis)
        offsets = np.zeros((_PER_SIDE, _PER_SIDE, 3))
        offsets[..., u], offsets[..., v] = steps[:, None], steps[None, :]
        points = (corner[:, None, :] + offsets.reshape(1, -1, 3)).reshape(-1, 3)
        found.append((points, *(np.repeat(x, _PER_SIDE**2, axis=0) for x in (empty, ~within[tuple((empty + 1).T)]))))
    points, empty, on_border = (np.concatenate(each) for each in zip(*found))
    return points, empty, on_border


@dataclass(frozen=True, eq=False)
class KnownTruth:
    """A synthetic scene, whose coordinates are metres, and the cameras of its training photographs."""

    scene: SyntheticScene
    training_poses: FloatArray  # Training cameras, camera to world (OpenGL), shape (c, 4, 4), [m]
    camera: Camera  # Intrinsics of all training cameras

    @cached_property
    def points_seen(self) -> FloatArray:
        """Random points (m, 3) [m], uniform by area, of the true surface that `MIN_VIEWS` or more training cameras see.

        Raises `SceneError` if none of the points is seen by so many cameras.
        """
        points, normals = self.scene.solid.surface_points(_SURFACE_POINTS, seed=0)
        seen = visible_surface_points(self.scene, self.training_poses, self.camera, points, normals, MIN_VIEWS)
        if not seen.any():
            expected = f"a part of the surface that at least {MIN_VIEWS} of them see"
            got = f"none, with {len(self.training_poses)} training cameras"
            remedy = "Write the scene with more training views."
            raise SceneError("training cameras", expected=expected, got=got, remedy=remedy)
        return points[seen]

    def score(
        self,
        cells: BoolArray,
        lattice: Lattice,
        world_to_truth: FloatArray,
        tolerance_m: float,
        within: BoolArray | None = None,
    ) -> tuple[SurfaceScore, SurfaceScore]:
        """Return the score of the boundary of solid voxels against the true surface, and the score of its seen faces.

        Enclosed cavities are filled first, because no camera sees into them, except rooms in which a camera stands. The
        boundary is sampled at four points per voxel face. Two kinds of faces do not count for precision: those at the
        end of the lattice or of the region `within`, which cut the scene; and those near the surroundings and not near
        the body (see `counts`). A face is seen if at least `MIN_VIEWS` cameras have a line of sight, free of solid
        voxels, to the empty voxel in front of the face.

        Args:
            cells: Mask of the solid voxels, shape `lattice.cell_shape`.
            lattice: Lattice of the voxels, [world units].
            world_to_truth: Similarity, shape (4, 4), from the lattice's world to the scene's coordinates.
            tolerance_m: Largest distance at which a point agrees with the other surface, above 0, [m].
            within: Mask of the region that was reconstructed, shape `lattice.cell_shape`; None: all voxels.
        """
        cells = check_array("cells", cells, lattice.cell_shape, "Pass the solid voxels of this lattice.", MeshError)
        views = self.views(world_to_truth)
        solid = cells | cavities(cells, camera_voxels(cells, lattice, views))[0]
        corners, empty, on_border = _boundary_samples(solid, np.ones_like(solid) if within is None else within)
        points = apply_transform(world_to_truth, lattice.index_to_world(corners))

        def recall(some: FloatArray) -> float:
            return float(np.mean(KDTree(some).query(self.points_seen)[0] <= tolerance_m)) if len(some) else 0.0

        inner, recalled = points[~on_border], recall(points)
        distance = np.abs(self.scene.solid.signed_distance(inner))
        agrees = distance <= tolerance_m
        scored = self.counts(inner, agrees, tolerance_m)
        if not scored.any():
            return SurfaceScore(recall=recalled), SurfaceScore()
        precision, share = float(agrees[scored].mean()), float(scored.mean())
        whole = SurfaceScore(precision, recalled, share, float(distance[scored].mean()))
        free = count_cameras(solid, lattice, views).free[tuple(empty[~on_border].T)]
        shown = scored & (free >= MIN_VIEWS)
        if not shown.any():
            return whole, SurfaceScore()
        return whole, SurfaceScore(float(agrees[shown].mean()), recall(inner[shown]), float(shown.mean()))

    def counts(self, points: FloatArray, agrees: BoolArray, tolerance_m: float) -> BoolArray:
        """Return a mask (n,) of the boundary points (n, 3) [m] that count for precision.

        These are all points that agree with the body (mask `agrees`), and all points farther than `tolerance_m` from
        the surroundings: photographs do not say where the body ends and its surroundings begin.
        """
        if self.scene.around is None:
            return np.ones(len(points), dtype=bool)
        return agrees | (self.scene.around.solid.signed_distance(points) > tolerance_m)

    def views(self, world_to_truth: FloatArray) -> Views:
        """Return the training cameras in the coordinates from which the similarity `world_to_truth` (4, 4) maps."""
        poses = np.linalg.inv(world_to_truth) @ self.training_poses
        poses[:, :3, :3] *= _scale_of(world_to_truth)  # axes stay 1 long
        return Views.of([self.camera] * len(poses), list(poses))


def _scale_of(similarity: FloatArray) -> float:
    return float(np.cbrt(abs(np.linalg.det(similarity[:3, :3]))))


def load_known_truth(scene_folder: Path | str) -> KnownTruth | None:
    """Return the synthetic scene and training cameras of a scene folder (or its json); None if it is not synthetic.

    Raises `SceneError` if a json is unreadable or names an unknown scene, or if frames are missing or cannot be used.
    """
    folder = Path(scene_folder)
    folder = folder.parent if folder.is_file() else folder
    scene = load_truth(folder)
    if scene is None:
        return None
    frames = [f for f in read_scene_file(folder, "skip").frames if f.image.name.startswith(_TRAINING_PREFIX)]
    if not frames:
        expected, remedy = f"frames named {_TRAINING_PREFIX}*", "Write the synthetic scene again."
        raise SceneError(str(folder / "transforms.json"), expected=expected, got="none", remedy=remedy)
    return KnownTruth(scene, np.array([frame.pose for frame in frames]), frames[0].intrinsics)


def compare_with_truth(
    cells: BoolArray,
    lattice: Lattice,
    world_to_truth: FloatArray,
    truth: Path | str | KnownTruth,
    mesh: TetMesh | None = None,
    metres_per_unit: float = 1.0,
    within: BoolArray | None = None,
) -> dict[str, Any] | None:
    """Compare solid voxels, and optionally a mesh made from them, with the exact scene; return figures by name.

    `cells` and `within` are masks as in `KnownTruth.score`, whose two scores are computed with a tolerance of
    `TOLERANCE_VOXELS`. Figures named ``..._seen`` are of the part of the boundary that cameras see, and 0 if they see
    none. `world_to_truth` (4, 4) is the similarity from the lattice's world to the coordinates of the input poses,
    which are metres in a synthetic scene. `truth` is a scene folder or what `load_known_truth` returned for it. The
    mesh's nodes are divided by `metres_per_unit`, its scale.

    Returns:
        Figures that json can hold, in metres of the scene; None if the truth is not known. Scores are 0 to 1. Mean
        distances are from the boundary to the true surface (None without a boundary). With a mesh, the figures of
        `mesh_errors` and ``chamfer_voxels`` are added.

    Raises:
        SceneError: The scene folder cannot be used, or no true point is seen by enough training cameras.
        MeshError: `cells` does not fit the lattice.
    """
    known = truth if isinstance(truth, KnownTruth) else load_known_truth(truth)
    if known is None:
        return None
    transform = np.asarray(world_to_truth, dtype=np.float64)
    voxel_m = lattice.voxel_size * _scale_of(transform)
    tolerance_m = TOLERANCE_VOXELS * voxel_m
    score, of_seen = known.score(cells, lattice, transform, tolerance_m, within)
    result: dict[str, Any] = {
        "scene": known.scene.name,
        "voxel_size_m": voxel_m,
        "tolerance_voxels": TOLERANCE_VOXELS,
        "true_points_seen": len(known.points_seen),
        "precision": score.precision,
        "recall": score.recall,
        "fscore": score.fscore,
        "share_seen": of_seen.share,
        "precision_seen": of_seen.precision,
        "recall_seen": of_seen.recall,
        "fscore_seen": of_seen.fscore,
        "mean_distance_voxels": None if score.mean_distance is None else score.mean_distance / voxel_m,
        "mean_distance_m": score.mean_distance,
        "true_volume_m3": float(known.scene.solid.volume),
        "true_area_m2": float(known.scene.solid.area),
    }
    if mesh is not None:
        result |= mesh_errors(known, mesh, tolerance_m, metres_per_unit)
        if "chamfer_m" in result:
            result["chamfer_voxels"] = result["chamfer_m"] / voxel_m
    return result


def geometry_metrics(snapshot: GridSnapshot, world_to_input: FloatArray, known: KnownTruth) -> dict[str, float]:
    """Return scores, by name, of the surface that an export with default options would have, against the exact scene.

    The surface is the boundary of the voxels that `SolidSelection` chooses by default. `world_to_input` (4, 4) is the
    similarity from the lattice's world to input coordinates. If no voxel is solid, the reason is printed.

    Returns:
        ``fscore``, ``fscore_seen``, ``precision`` and ``recall`` of `compare_with_truth`; ``fscore_128`` and
        ``fscore_128_seen``, whose tolerance does not depend on the lattice (`COMMON_RESOLUTION`); and the mean distance
        ``surface_distance_...`` from the surface to the true surface, in voxels and in m. If no voxel is solid:
        ``fscore``, ``precision``, ``recall`` and ``fscore_128``, all 0.

    Raises:
        SceneError: No true point is seen by enough training cameras.
    """
    known.points_seen  # noqa: B018 - raises before anything slow
    try:
        solid = select_solid(snapshot, SolidSelection())
    except MeshError as problem:
        print(f"The geometry scores 0: {problem}")
        return dict.fromkeys(("fscore", "precision", "recall", "fscore_128"), 0.0)
    own = compare_with_truth(solid.cells, snapshot.lattice, world_to_input, known, within=solid.within)
    assert own is not None  # the truth is known
    tolerance_m = TOLERANCE_VOXELS * known.scene.size / COMMON_RESOLUTION
    common, of_seen = known.score(solid.cells, snapshot.lattice, world_to_input, tolerance_m, solid.within)
    result = {name: own[name] for name in ("fscore", "precision", "recall", "fscore_seen")}
    result |= {f"fscore_{COMMON_RESOLUTION}": common.fscore, f"fscore_{COMMON_RESOLUTION}_seen": of_seen.fscore}
    if own["mean_distance_m"] is not None:
        result |= {f"surface_distance_{unit}": own[f"mean_distance_{unit}"] for unit in ("voxels", "m")}
    return result


@dataclass(frozen=True, eq=False)
class RenderedRays:
    """Rays of one held-out frame, and the depth at which a model ends each ray. Lengths are in world units."""

    origins: FloatArray  # Shape (n, 3)
    directions: FloatArray  # Unit vectors, shape (n, 3)
    depth: FloatArray  # Distance along each ray at which the ray ends, shape (n,)
    ends: BoolArray  # True for a ray that loses more than half of its light in the lattice's box, shape (n,)
    in_box: BoolArray  # True for a ray that meets the lattice's box, shape (n,)


def depth_metrics(
    frames: Iterable[RenderedRays], lattice: Lattice, world_to_input: FloatArray, scene: SyntheticScene
) -> dict[str, float]:
    """Return errors, by name, of the depths at which a model ends rays, against the exact scene, ray by ray.

    `world_to_input` (4, 4) is the similarity from the lattice's world to input coordinates.

    Returns:
        ``depth_error`` and ``depth_off_share``: of all rays that meet the lattice's box and hit the true solid, the
        median relative error of depth, and the share with an error above `DEPTH_TOLERANCE`. ``sky_filled``: of all rays
        that miss the true solid and meet nothing else in the lattice's box, the share that the model ends in the box. A
        figure without rays is left out.
    """
    transform = np.asarray(world_to_input, dtype=np.float64)
    scale = _scale_of(transform)
    errors, filled = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for rays in frames:
        origins = rays.origins @ transform[:3, :3].T + transform[:3, 3]
        distance, own = first_surface(scene, origins, rays.directions @ transform[:3, :3].T / scale)
        distance /= scale
        met = own & rays.in_box
        errors.append(np.abs(rays.depth[met] / distance[met] - 1.0))
        with np.errstate(invalid="ignore"):  # an infinite distance times a direction of 0
            index = lattice.world_to_index(rays.origins + distance[:, None] * rays.directions)
            outside = ~((index >= 0) & (index <= lattice.cell_shape)).all(axis=1)
        filled.append(rays.ends[~own & outside])
    error, sky = np.concatenate(errors), np.concatenate(filled)
    result = {}
    if len(error):
        result = {"depth_error": float(np.median(error)), "depth_off_share": float((error > DEPTH_TOLERANCE).mean())}
    return result | ({"sky_filled": float(sky.mean())} if len(sky) else {})


def mesh_errors(known: KnownTruth, mesh: TetMesh, tolerance_m: float, metres_per_unit: float = 1.0) -> dict[str, Any]:
    """Return volume and area of a mesh, and the errors of its surface and temperatures against the truth, by name.

    The surface consists of all facets that are not on the scene box, which cuts the scene. ``chamfer_m`` is half the
    sum of two mean distances: from 20,000 random points of the surface that count (`KnownTruth.counts`) to the true
    surface, and from `KnownTruth.points_seen` to their nearest points on the mesh's surface.
    ``share_of_seen_reached`` is the share of the seen points that are within `tolerance_m` of the mesh's surface.
    ``temperature_seen_mae_c`` is the mean absolute error [K] at the nearest points of the seen points so reached; None
    if there are none, or no temperatures. Nodes are divided by `metres_per_unit`. If no point of the surface counts,
    only ``mesh_volume_m3`` and ``mesh_area_m2`` are returned.
    """
    import pyvista as pv
    from trimesh import Trimesh
    from trimesh.sample import sample_surface
    from trimesh.triangles import points_to_barycentric

    result: dict[str, Any] = {
        "mesh_volume_m3": float(signed_volumes(mesh.points_m, mesh.tets).sum()) / metres_per_unit**3,
        "mesh_area_m2": float(facet_areas(mesh.points_m, mesh.facets).sum()) / metres_per_unit**2,
    }
    points, scene, seen = mesh.points_m / metres_per_unit, known.scene, known.points_seen
    facets = mesh.facets[mesh.facet_tags != FACET_BOX]
    if len(facets) == 0:
        return result
    drawn = sample_surface(Trimesh(points, facets, process=False), _SURFACE_POINTS, seed=0)[0]
    samples = np.asarray(drawn, dtype=np.float64)
    outwards = np.abs(scene.solid.signed_distance(samples))
    outwards = outwards[known.counts(samples, outwards <= tolerance_m, tolerance_m)]
    if len(outwards) == 0:
        return result
    surface = pv.PolyData.from_regular_faces(points, facets)
    cell, closest = surface.find_closest_cell(seen, return_closest_point=True)  # type: ignore[misc]
    inwards = np.linalg.norm(closest - seen, axis=1)
    triangle, reached = facets[np.asarray(cell)], inwards <= tolerance_m
    share = np.clip(points_to_barycentric(points[triangle], np.asarray(closest)), 0.0, 1.0)
    temperature_c = np.einsum("ij,ij->i", share / share.sum(axis=1, keepdims=True), mesh.temperature_c[triangle])
    error_k = np.abs(temperature_c - scene.surface_temperature_c(seen))[reached]
    return result | {
        "chamfer_m": 0.5 * float(outwards.mean() + inwards.mean()),
        "temperature_seen_mae_c": float(error_k.mean()) if len(error_k) and mesh.has_temperatures else None,
        "share_of_seen_reached": float(reached.mean()),
    }
