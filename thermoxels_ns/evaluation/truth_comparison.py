"""Comparison of a reconstruction with a synthetic scene, whose shape and temperature are known."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import check_positive, check_shape
from thermoxels_ns.core.errors import MeshError, SceneError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, Views
from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.mesh.build import apply_transform, check_similarity
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.free_space import count_cameras
from thermoxels_ns.mesh.solid.morphology import fill_enclosed
from thermoxels_ns.mesh.solid.voxels import SolidSelection, select_solid
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh, facet_areas
from thermoxels_ns.synthetic.raycast import first_surface, visible_surface_points
from thermoxels_ns.synthetic.scene_folder import load_truth
from thermoxels_ns.synthetic.scene_truth import SyntheticScene

MIN_VIEWS = 3  # A point of a surface is seen if at least this many training cameras see it
TOLERANCE_VOXELS = 1.5  # Surfaces closer than this agree, [voxels]
DEPTH_TOLERANCE = 0.02  # Depths that differ by more, relative to the true one, are off
COMMON_RESOLUTION = 128  # Voxels along the longest side of the exact box whose size `fscore_128` is measured with

_SURFACE_POINTS = 20_000
_PER_SIDE = 2  # Points along each side of a voxel's face that stand for it
_TRAINING_PREFIX = "frame_train_"


class TrueShape(Protocol):
    """A body whose shape is known exactly, in coordinates of its own (truth units)."""

    def signed_distance(self, points: FloatArray, /) -> FloatArray:
        """Distance of points (n, 3) to the surface, shape (n,), negative inside the body."""
        ...


@dataclass(frozen=True)
class SurfaceScore:
    """Agreement of a reconstructed surface, or of a part of it, with the true one."""

    precision: float = 0.0
    """Share of the reconstructed boundary within the tolerance of the true surface, 0 to 1; 0 if there is none."""
    recall: float = 0.0
    """Share of the true surface that cameras see within the tolerance of the reconstructed boundary, 0 to 1."""
    share: float = 0.0  # Of the boundary that is scored, 0 to 1
    mean_distance: float | None = None
    """Mean distance of the reconstructed boundary to the true surface, [truth units]; None without a boundary."""

    @property
    def fscore(self) -> float:
        """Harmonic mean of precision and recall; 0 if both are."""
        return 2.0 * self.precision * self.recall / (self.precision + self.recall or 1.0)


def surface_fscore(
    cells: BoolArray,
    lattice: Lattice,
    truth: TrueShape,
    true_points_seen: FloatArray,
    tolerance: float,
    world_to_truth: FloatArray,
    views: Views,
    surroundings: TrueShape | None = None,
    within: BoolArray | None = None,
) -> tuple[SurfaceScore, SurfaceScore]:
    """Score the boundary of the solid voxels against the true surface: all of it, and the part that cameras see.

    Enclosed cavities are filled first: no camera sees what is inside. The boundary is sampled at four points per voxel
    face. Faces where the lattice or the region ends, which cut the scene, do not count for precision. A face is seen if
    `MIN_VIEWS` cameras have a free line, past the solid voxels, to the empty voxel before it.

    Args:
        cells: Solid voxels, shape `lattice.cell_shape`.
        lattice: Where they are, [world units].
        truth: The true body.
        true_points_seen: True surface that enough training cameras see, shape (m, 3), m at least 1, [truth units].
        tolerance: Distance that counts as agreement, above 0, [truth units].
        world_to_truth: Similarity, shape (4, 4), from the lattice's world to truth coordinates.
        views: The training cameras, in the coordinates of the lattice.
        surroundings: What truly stands beside the body. Boundary within the tolerance of it is neither right nor wrong:
            photographs do not say where the body ends and its surroundings begin.
        within: The region that was taken, shape `lattice.cell_shape`; None: all.
    """
    cells = check_shape("cells", cells, lattice.cell_shape, "Pass the solid voxels of this lattice.", MeshError)
    transform = check_similarity("world_to_truth", world_to_truth)
    solid = fill_enclosed(cells)
    corners, empty, on_border = _boundary_samples(solid, np.ones_like(solid) if within is None else within)
    if len(corners) == 0:
        return SurfaceScore(), SurfaceScore()
    points = apply_transform(transform, lattice.index_to_world(corners))

    def recall(some: FloatArray) -> float:
        return float(np.mean(KDTree(some).query(true_points_seen)[0] <= tolerance)) if len(some) else 0.0

    inner, recalled = points[~on_border], recall(points)
    distance = np.abs(truth.signed_distance(inner))
    scored = np.ones(len(inner), dtype=bool)
    if surroundings is not None:
        scored = (surroundings.signed_distance(inner) > tolerance) | (distance <= tolerance)
    if not scored.any():
        return SurfaceScore(recall=recalled), SurfaceScore()
    agrees = distance <= tolerance
    whole = SurfaceScore(float(agrees[scored].mean()), recalled, float(scored.mean()), float(distance[scored].mean()))
    shown = scored & (count_cameras(solid, lattice, views).free[tuple(empty[~on_border].T)] >= MIN_VIEWS)
    if not shown.any():
        return whole, SurfaceScore()
    return whole, SurfaceScore(float(agrees[shown].mean()), recall(inner[shown]), float(shown.mean()))


def _boundary_samples(cells: BoolArray, within: BoolArray) -> tuple[FloatArray, IntArray, BoolArray]:
    """Return points on the faces between solid and empty voxels, (n, 3) [corner indices], the empty voxel beside each
    (n, 3), and whether each face lies on the border of the lattice or of the region (n,)."""
    steps, within, found = (np.arange(_PER_SIDE) + 0.5) / _PER_SIDE, np.pad(within, 1), []
    for axis in range(3):
        rise = np.diff(np.pad(cells, [(int(a == axis),) * 2 for a in range(3)]).astype(np.int8), axis=axis)
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


@dataclass(frozen=True)
class SurfaceDistances:
    """Distances between two surfaces, [truth units]."""

    mesh_to_truth: float  # Mean distance of the mesh's surface, spread evenly by area, to the true surface
    truth_to_mesh: float  # Mean distance of the given true points to the mesh's surface
    hausdorff: float
    closest_temperature_c: FloatArray
    """Temperature of the mesh at its surface point closest to each true point, shape (m,), [degrees Celsius]."""
    closest_distance: FloatArray

    @property
    def chamfer(self) -> float:
        """Mean of the mean distances both ways."""
        return 0.5 * (self.mesh_to_truth + self.truth_to_mesh)


def sample_facets(points: FloatArray, facets: IntArray, count: int) -> FloatArray:
    """Return points spread by area over triangles, shape (count, 3); the same points every time."""
    from trimesh import Trimesh
    from trimesh.sample import sample_surface

    return np.asarray(sample_surface(Trimesh(points, facets, process=False), count, seed=0)[0], np.float64)


def surface_distances(
    mesh: TetMesh,
    truth: TrueShape,
    true_points: FloatArray,
    metres_per_unit: float = 1.0,
    surroundings: TrueShape | None = None,
    tolerance: float = 0.0,
) -> SurfaceDistances | None:
    """Measure a mesh against a body whose shape is known exactly; None if nothing of the boundary is left to measure.

    Cuts by the scene box, and what lies in the surroundings or within the tolerance, [truth units], of them, are left
    out. Distances from the mesh, [m], are those of 20,000 points of it; those from the truth go from the points (m, 3),
    which a mesh can be expected to have, to the nearest point of any triangle.
    """
    import pyvista as pv
    from trimesh.triangles import points_to_barycentric

    points = mesh.points_m / metres_per_unit
    facets = mesh.facets[mesh.facet_tags != FACET_BOX]
    if len(facets) == 0:
        return None
    samples = sample_facets(points, facets, 20_000)
    outwards = np.abs(truth.signed_distance(samples))
    if surroundings is not None:
        outwards = outwards[(outwards <= tolerance) | (surroundings.signed_distance(samples) > tolerance)]
        if len(outwards) == 0:
            return None
    surface = pv.PolyData.from_regular_faces(points, facets)
    cell, closest = surface.find_closest_cell(true_points, return_closest_point=True)  # type: ignore[misc]
    inwards = np.linalg.norm(closest - true_points, axis=1)
    triangle = facets[np.asarray(cell)]
    share = np.clip(points_to_barycentric(points[triangle], np.asarray(closest)), 0.0, 1.0)
    return SurfaceDistances(
        mesh_to_truth=float(outwards.mean()),
        truth_to_mesh=float(inwards.mean()),
        hausdorff=float(max(outwards.max(), inwards.max())),
        closest_temperature_c=np.einsum(
            "ij,ij->i", share / share.sum(axis=1, keepdims=True), mesh.temperature_c[triangle]
        ),
        closest_distance=inwards,
    )


@dataclass(frozen=True, eq=False)
class KnownTruth:
    """A synthetic scene and the cameras that its training photographs were taken with."""

    scene: SyntheticScene
    training_poses: FloatArray  # Training cameras, camera to world (OpenGL), shape (c, 4, 4), [m]
    camera: Camera

    @property
    def surroundings(self) -> TrueShape | None:
        """What stands around the scene and is not scored."""
        return None if self.scene.around is None else self.scene.around.solid

    @cached_property
    def points_seen(self) -> FloatArray:
        """Points spread evenly over the part of the true surface that enough training cameras see, (m, 3), [m].

        Raises `SceneError` if they see nothing of it.
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
        within: BoolArray | None,
    ) -> tuple[SurfaceScore, SurfaceScore]:
        """See `surface_fscore`, for a similarity (4, 4) from the lattice's world to the scene's, [m]."""
        scale = _scale_of(world_to_truth)
        poses, camera, count = self.training_poses, self.camera, len(self.training_poses)
        axes = world_to_truth[:3, :3].T / scale  # the inverse of its rotation (and mirror)
        centres = (poses[:, :3, 3] - world_to_truth[:3, 3]) @ axes.T / scale
        views = Views(
            camera_to_world=np.concatenate([axes @ poses[:, :3, :3], centres[:, :, None]], axis=2),
            focal=np.tile([camera.fl_x, camera.fl_y], (count, 1)),
            centre=np.tile([camera.cx, camera.cy], (count, 1)),
            size=np.tile([camera.width, camera.height], (count, 1)),
        )
        truth = self.scene.solid, self.points_seen, tolerance_m
        return surface_fscore(cells, lattice, *truth, world_to_truth, views, self.surroundings, within)


def _scale_of(similarity: FloatArray) -> float:
    return float(np.cbrt(abs(np.linalg.det(similarity[:3, :3]))))


def load_known_truth(scene_folder: Path | str) -> KnownTruth | None:
    """Return the truth of a scene folder (or its ``transforms.json``) with its training cameras; None: not synthetic.

    Raises `SceneError` for a json that is unreadable or names an unknown scene, and for cameras that cannot be used.
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
    """Compare solid voxels, and the temperatures of a mesh made from them, with the exact scene.

    Precision is the share of the reconstructed boundary within `TOLERANCE_VOXELS` of the true surface. Recall is the
    share of the true surface seen by `MIN_VIEWS` training cameras that lies within that tolerance of the boundary. The
    F-score is their harmonic mean. `surface_fscore` says what is left out. Figures named ``..._seen`` are of the part
    of the boundary that cameras see; the rest is a guess.

    `cells` has the shape `lattice.cell_shape`; `world_to_truth` (4, 4) is the similarity from the lattice's world to
    the input poses' coordinates, in which a synthetic scene is written in metres; without `mesh` no temperatures are
    compared; lengths of the result are those times `metres_per_unit`, the scale of the mesh's nodes.

    Returns:
        A mapping that json can write, or None if the truth is not known. Scores are 0 to 1; mean distances are of the
        boundary to the true surface (None without a boundary); volumes and ``area_m2`` are those of the voxels, a
        staircase, ``filled_volume_m3`` with cavities. With a mesh also: its volume and area; ``chamfer_...`` and
        ``hausdorff_m`` between its surface and the seen true one; ``share_of_seen_reached``, the share of seen true
        points within the tolerance of its surface, and ``temperature_seen_mae_c``, the mean absolute error [K] at the
        surface points closest to those; of the boundary nodes within the tolerance ``temperature_nodes``, the number
        that a thermal ray measured, ``temperature_mae_c``, their mean absolute error [K], the same of the others
        (``..._unmeasured...``), and ``temperature_p95_all_c``, the error [K] that 95 % of all stay below.

    Raises:
        SceneError: The scene folder cannot be used, or no true point is seen by enough training cameras.
        MeshError: The voxels do not fit the lattice, the 4x4 is no similarity, or the scale is not above 0.
    """
    known = truth if isinstance(truth, KnownTruth) else load_known_truth(truth)
    if known is None:
        return None
    transform = check_similarity("world_to_truth", world_to_truth)
    check_positive("metres_per_unit", metres_per_unit, "Pass the scale the mesh was built with.", MeshError)
    voxel_m = lattice.voxel_size * _scale_of(transform)
    tolerance_m = TOLERANCE_VOXELS * voxel_m
    score, of_seen = known.score(cells, lattice, transform, tolerance_m, within)
    solid = np.asarray(cells, dtype=bool)
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
        "volume_m3": int(np.count_nonzero(solid)) * voxel_m**3,
        "filled_volume_m3": int(np.count_nonzero(fill_enclosed(solid))) * voxel_m**3,
        "true_volume_m3": float(known.scene.solid.volume),
        "area_m2": _num_faces(solid) * voxel_m**2,
        "true_area_m2": float(known.scene.solid.area),
    }
    if mesh is not None:
        result |= _mesh_errors(known, mesh, voxel_m, metres_per_unit)
        result |= _temperature_errors(known.scene, mesh, tolerance_m, metres_per_unit)
    return {name: _scaled(name, value, metres_per_unit) for name, value in result.items()}


def geometry_metrics(
    snapshot: GridSnapshot, world_to_input: FloatArray, known: KnownTruth, say: Callable[[str], None] = print
) -> dict[str, float]:
    """Compare the surface that an export with default options has with the exact scene.

    The surface is the boundary of the voxels that `SolidSelection` chooses by default; scores and arguments are those
    of `compare_with_truth`. `say` gets the reason where there is no surface.

    Returns:
        ``fscore``, ``precision``, ``recall`` at 1.5 voxels of the snapshot's lattice; ``fscore_128``, at 1.5 voxels of
        128 along the exact box, to compare resolutions and boxes; ``fscore_seen`` and ``fscore_128_seen``; and the mean
        distance to the true surface. Without any solid voxel the scores are 0 and there is no distance.

    Raises:
        SceneError: No true point is seen by enough training cameras.
    """
    known.points_seen  # noqa: B018 - before anything slow
    try:
        solid = select_solid(snapshot, SolidSelection(), makes_up_volume=False)
    except MeshError as problem:
        say(f"The geometry scores 0: {problem}")
        return dict.fromkeys(("fscore", "precision", "recall", "fscore_128"), 0.0)
    lattice, transform = snapshot.lattice, check_similarity("world_to_input", world_to_input)
    voxel_m = lattice.voxel_size * _scale_of(transform)
    (own, own_seen), (common, common_seen) = (
        known.score(solid.cells, lattice, transform, TOLERANCE_VOXELS * size_m, solid.within)
        for size_m in (voxel_m, known.scene.size / COMMON_RESOLUTION)
    )
    result = {
        "fscore": own.fscore,
        "precision": own.precision,
        "recall": own.recall,
        f"fscore_{COMMON_RESOLUTION}": common.fscore,
        "fscore_seen": own_seen.fscore,
        f"fscore_{COMMON_RESOLUTION}_seen": common_seen.fscore,
    }
    if own.mean_distance is not None:
        result["surface_distance_voxels"] = own.mean_distance / voxel_m
        result["surface_distance_m"] = own.mean_distance
    return result


@dataclass(frozen=True, eq=False)
class RenderedRays:
    """Rays of a held-out frame, and where a model has them end, [world units]."""

    origins: FloatArray  # Shape (n, 3)
    directions: FloatArray  # Unit vectors, shape (n, 3)
    depth: FloatArray  # Distance along each ray at which it ends, shape (n,)
    ends: BoolArray  # Whether it loses more than half of its light in the lattice's box, shape (n,)
    in_box: BoolArray  # Whether it meets that box, shape (n,)


def depth_metrics(
    frames: Iterable[RenderedRays], lattice: Lattice, world_to_input: FloatArray, scene: SyntheticScene
) -> dict[str, float]:
    """Compare where rays end with where they meet the exact scene, pixel by pixel.

    `world_to_input` is that of `geometry_metrics`.

    Returns:
        Of the rays that truly end on the scene's solid and meet the lattice's box: ``depth_error``, the median relative
        error of their depth, and ``depth_off_share``, the share that is off by more than `DEPTH_TOLERANCE`. Of those
        that truly end outside the box, on what stands around the scene or nowhere: ``sky_filled``, the share that ends
        in the box. Figures without a ray are left out.
    """
    transform = check_similarity("world_to_input", world_to_input)
    scale = _scale_of(transform)
    errors, filled = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for rays in frames:
        origins = rays.origins @ transform[:3, :3].T + transform[:3, 3]
        distance, own = first_surface(scene, origins, rays.directions @ transform[:3, :3].T / scale)
        distance /= scale
        met = own & rays.in_box
        errors.append(np.abs(rays.depth[met] / distance[met] - 1.0))
        with np.errstate(invalid="ignore"):  # at infinity along an axis
            index = lattice.world_to_index(rays.origins + distance[:, None] * rays.directions)
            outside = ~((index >= 0) & (index <= lattice.cell_shape)).all(axis=1)
        filled.append(rays.ends[~own & outside])
    error, sky = np.concatenate(errors), np.concatenate(filled)
    result = {}
    if len(error):
        result = {"depth_error": float(np.median(error)), "depth_off_share": float((error > DEPTH_TOLERANCE).mean())}
    return result | ({"sky_filled": float(sky.mean())} if len(sky) else {})


def _scaled(name: str, value: Any, metres_per_unit: float) -> Any:
    """A figure in the units of the mesh: the ending of its name says how it grows with the scale."""
    power = next((power for ending, power in (("_m", 1), ("_m2", 2), ("_m3", 3)) if name.endswith(ending)), 0)
    return value if value is None or power == 0 else value * metres_per_unit**power


def _num_faces(cells: BoolArray) -> int:
    """Number of voxel faces between solid and empty, those on the lattice's border included."""
    padded = np.pad(cells, 1)
    return sum(int(np.count_nonzero(np.diff(padded, axis=axis))) for axis in range(3))


def _mesh_errors(known: KnownTruth, mesh: TetMesh, voxel_m: float, metres_per_unit: float) -> dict[str, Any]:
    """Size of the mesh, its distance to the true surface, and temperature errors where they meet."""
    area = facet_areas(mesh.points_m, mesh.facets)
    result: dict[str, Any] = {
        "mesh_volume_m3": float(signed_volumes(mesh.points_m, mesh.tets).sum()) / metres_per_unit**3,
        "mesh_area_m2": float(area.sum()) / metres_per_unit**2,
    }
    tolerance_m, seen = TOLERANCE_VOXELS * voxel_m, known.points_seen
    distances = surface_distances(mesh, known.scene.solid, seen, metres_per_unit, known.surroundings, tolerance_m)
    if distances is None:
        return result
    reached = distances.closest_distance <= tolerance_m
    error_k = np.abs(distances.closest_temperature_c - known.scene.surface_temperature_c(seen))[reached]
    return result | {
        "chamfer_voxels": distances.chamfer / voxel_m,
        "chamfer_m": distances.chamfer,
        "hausdorff_m": distances.hausdorff,
        "temperature_seen_mae_c": float(error_k.mean()) if len(error_k) else None,
        "share_of_seen_reached": float(reached.mean()),
    }


def _temperature_errors(
    scene: SyntheticScene, mesh: TetMesh, tolerance_m: float, metres_per_unit: float
) -> dict[str, Any]:
    """Temperature errors on the part of the boundary that lies where it should: measured nodes, and all of them."""
    nodes = np.unique(mesh.facets)
    points = mesh.points_m[nodes] / metres_per_unit
    near = np.abs(scene.solid.signed_distance(points)) <= tolerance_m
    nodes, points = nodes[near], points[near]
    error_k = np.abs(mesh.temperature_c[nodes] - scene.surface_temperature_c(points))
    measured = mesh.observed[nodes]

    def mean(errors: FloatArray) -> float | None:
        return float(errors.mean()) if len(errors) else None

    return {
        "temperature_nodes": int(measured.sum()),
        "temperature_mae_c": mean(error_k[measured]),
        "temperature_nodes_unmeasured": int((~measured).sum()),
        "temperature_mae_unmeasured_c": mean(error_k[~measured]),
        "temperature_p95_all_c": float(np.quantile(error_k, 0.95)) if len(error_k) else None,
    }
