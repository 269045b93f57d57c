"""Comparison of a reconstruction with a synthetic scene, whose shape and temperature are known."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import check_positive
from thermoxels_ns.core.errors import MeshError, SceneError, ThermoxelsError
from thermoxels_ns.core.json_values import read_json
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, Views
from thermoxels_ns.evaluation.voxel_accuracy import MIN_VIEWS, TrueShape, surface_fscore
from thermoxels_ns.mesh.build import check_similarity
from thermoxels_ns.mesh.quality.checks import facet_areas
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.morphology import fill_enclosed
from thermoxels_ns.mesh.solid.voxels import SolidSelection, select_solid
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh
from thermoxels_ns.synthetic.raycast import first_surface
from thermoxels_ns.synthetic.scene_folder import load_truth, visible_surface_points
from thermoxels_ns.synthetic.scene_truth import SyntheticScene

TOLERANCE_VOXELS = 1.5  # Surfaces closer than this agree, [voxels]
DEPTH_TOLERANCE = 0.02  # Depths that differ by more, relative to the true one, are off
COMMON_RESOLUTION = 128  # Voxels along the longest side of the exact box whose size `fscore_128` is measured with

_SURFACE_POINTS = 20_000
_TRAINING_PREFIX = "frame_train_"
_JSON_NAME = "transforms.json"


@dataclass(frozen=True)
class SurfaceDistances:
    """Distances between two surfaces, [truth units]: means both ways, their mean, the largest, the closest ones."""

    mesh_to_truth: float  # Mean distance of the mesh's surface, spread evenly by area, to the true surface
    truth_to_mesh: float  # Mean distance of the given true points to the mesh's surface
    chamfer: float
    hausdorff: float
    closest_temperature_c: FloatArray
    """Temperature of the mesh at its surface point closest to each true point, shape (m,), [degrees Celsius]."""
    closest_distance: FloatArray


def sample_facets(points: FloatArray, facets: IntArray, count: int) -> FloatArray:
    """Points spread evenly by area over triangles, shape (count, 3); the same points every time.

    A low-discrepancy sequence (the golden ratio and the plastic number's R2 sequence) walks along the triangles in
    their order, so neighbouring triangles share the points in proportion to their areas.
    """
    total = np.concatenate([[0.0], np.cumsum(facet_areas(points, facets))])
    number = np.arange(count)
    which = np.searchsorted(total, (number + 0.5) / count * total[-1], side="right") - 1
    which = np.clip(which, 0, len(facets) - 1)
    u, v = np.mod(0.5 + number * 0.7548776662466927, 1.0), np.mod(0.5 + number * 0.5698402909980532, 1.0)
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = (points[facets[which, n]] for n in range(3))
    return a + u[:, None] * (b - a) + v[:, None] * (c - a)


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
    share = _barycentric(points[triangle], np.asarray(closest))
    return SurfaceDistances(
        mesh_to_truth=float(outwards.mean()),
        truth_to_mesh=float(inwards.mean()),
        chamfer=0.5 * float(outwards.mean() + inwards.mean()),
        hausdorff=float(max(outwards.max(), inwards.max())),
        closest_temperature_c=np.einsum("ij,ij->i", share, mesh.temperature_c[triangle]),
        closest_distance=inwards,
    )


def _barycentric(corners: FloatArray, points: FloatArray) -> FloatArray:
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


def load_known_truth(scene_folder: Path | str) -> KnownTruth | None:
    """Get the truth of a scene folder (or its ``transforms.json``) and its training cameras; None for real photographs.

    Raises `SceneError` for a json that is unreadable or names an unknown scene, and for cameras that cannot be used.
    """
    folder = Path(scene_folder)
    folder = folder.parent if folder.is_file() else folder
    path = folder / _JSON_NAME
    if not path.is_file():
        return None
    scene = load_truth(folder)
    if scene is None:
        return None
    content = read_json(path, error=SceneError)
    try:
        poses = [
            frame["transform_matrix"]
            for frame in content["frames"]
            if Path(frame["file_path"]).name.startswith(_TRAINING_PREFIX)
        ]
        fl_x, fl_y, cx, cy = (float(content[key]) for key in ("fl_x", "fl_y", "cx", "cy"))
        camera = Camera(int(content["w"]), int(content["h"]), fl_x, fl_y, cx, cy)
        training_poses = np.asarray(poses, dtype=np.float64)
    except (KeyError, TypeError, ValueError, AttributeError) as problem:
        if isinstance(problem, SceneError):
            raise
        raise _unusable(path, "intrinsics and frames as a synthetic scene has them", repr(problem)) from problem
    if training_poses.ndim != 3 or training_poses.shape[1:] != (4, 4) or not np.isfinite(training_poses).all():
        expected = f"finite 4x4 poses of frames named {_TRAINING_PREFIX}*"
        raise _unusable(path, expected, f"an array of shape {training_poses.shape}")
    return KnownTruth(scene, training_poses, camera)


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

    Precision is the share of the reconstructed boundary within `TOLERANCE_VOXELS` of the true surface; recall the
    share of the true surface that at least `MIN_VIEWS` training cameras see and that lies within the tolerance of
    the reconstructed boundary; the F-score is their harmonic mean. Enclosed cavities are filled first, and the
    boundary is not counted for precision where the scene box, or the region `within` that is exported, cuts it. Beside
    them stand the same figures for the part of the boundary that at least `MIN_VIEWS` training cameras see: no
    photograph shows the rest, which is a guess.

    `cells` has the shape `lattice.cell_shape`; `world_to_truth` (4, 4) is the similarity from the lattice's world to
    the input poses' coordinates, in which a synthetic scene is written in metres; without `mesh` no temperatures are
    compared; lengths of the result are those times `metres_per_unit`, the scale of the mesh's nodes.

    Returns:
        A mapping that json can write, or None if the truth is not known. Scores are 0 to 1; mean distances are of the
        boundary to the true surface, None without one; volumes and ``area_m2`` are those of the voxels (a staircase:
        its area exceeds that of the slope it follows), ``filled_volume_m3`` with cavities. With a mesh also its volume
        and the area of the true surface that its triangles stand for; ``chamfer_...`` and ``hausdorff_m`` between its
        surface and the part of the true one that is seen; ``temperature_seen_mae_c``, the mean absolute error [K] at
        the surface points closest to those true points that lie within the tolerance, and ``share_of_seen_reached``,
        the share that do; and of the boundary nodes within the tolerance: ``temperature_nodes``, the number that a
        thermal ray measured, ``temperature_mae_c``, their mean absolute error [K] (None without such a node), the same
        of the others (``..._unmeasured...``), and ``temperature_p95_all_c``, the error [K] that 95 % of all of them
        stay below.

    Raises:
        SceneError: The scene folder cannot be used, or no true point is seen by enough training cameras.
        MeshError: The voxels do not fit the lattice, the 4x4 is no similarity, or the scale is not above 0.
    """
    known = truth if isinstance(truth, KnownTruth) else load_known_truth(truth)
    if known is None:
        return None
    transform = check_similarity("world_to_truth", world_to_truth)
    check_positive("metres_per_unit", metres_per_unit, "Pass the scale the mesh was built with.", MeshError)
    voxel_m = lattice.voxel_size * float(np.cbrt(abs(np.linalg.det(transform[:3, :3]))))
    tolerance_m = TOLERANCE_VOXELS * voxel_m
    seen = points_seen(known)
    views = _training_views(known, transform)
    score = surface_fscore(
        *(cells, lattice, known.scene, seen, tolerance_m, transform, views),
        surroundings=known.surroundings,
        within=within,
    )
    assert score.seen is not None
    solid = np.asarray(cells, dtype=bool)
    result: dict[str, Any] = {
        "scene": known.scene.name,
        "voxel_size_m": voxel_m,
        "tolerance_voxels": TOLERANCE_VOXELS,
        "true_points_seen": len(seen),
        "precision": score.precision,
        "recall": score.recall,
        "fscore": score.fscore,
        "share_seen": score.seen.share,
        "precision_seen": score.seen.precision,
        "recall_seen": score.seen.recall,
        "fscore_seen": score.seen.fscore,
        "mean_distance_voxels": None if score.mean_distance is None else score.mean_distance / voxel_m,
        "mean_distance_m": score.mean_distance,
        "volume_m3": int(np.count_nonzero(solid)) * voxel_m**3,
        "filled_volume_m3": int(np.count_nonzero(fill_enclosed(solid))) * voxel_m**3,
        "true_volume_m3": float(known.scene.volume_m3),
        "area_m2": _num_faces(solid) * voxel_m**2,
        "true_area_m2": float(known.scene.area_m2),
    }
    if mesh is not None:
        result |= _mesh_errors(known, mesh, seen, voxel_m, metres_per_unit)
        result |= _temperature_errors(known.scene, mesh, tolerance_m, metres_per_unit)
    return {name: _scaled(name, value, metres_per_unit) for name, value in result.items()}


def has_truth(scene_folder: Path | str, say: Callable[[str], None] = print) -> bool:
    """Whether a scene's exact shape is known; what stands in the way of a synthetic scene's is said."""
    try:
        return load_known_truth(scene_folder) is not None
    except ThermoxelsError as problem:
        say(f"Geometry is not compared with the truth: {problem}")
        return False


def geometry_metrics(
    snapshot: GridSnapshot,
    world_to_input: FloatArray,
    truth: Path | str | KnownTruth,
    say: Callable[[str], None] = print,
) -> dict[str, float]:
    """Compare the surface that an export with default options has with the exact scene, if it is known.

    The surface is the boundary of the voxels that `SolidSelection` chooses by default; precision, recall and F-score,
    0 to 1, and the arguments are those of `compare_with_truth`. `say` gets the reason where a figure cannot be given.

    Returns:
        Nothing for real photographs. Else ``fscore``, ``precision``, ``recall`` at 1.5 voxels of the snapshot's
        lattice; ``fscore_128``, at 1.5 voxels of 128 along the exact box, to compare resolutions and boxes;
        ``fscore_seen`` and ``fscore_128_seen``, of the part of the boundary that training cameras see (the rest is a
        guess); and the mean distance to the true surface. Without any solid voxel the scores are 0 and there is no
        distance.
    """
    try:
        known = truth if isinstance(truth, KnownTruth) else load_known_truth(truth)
        if known is None:
            return {}
        seen = points_seen(known)
    except ThermoxelsError as problem:
        say(f"Geometry is not compared with the truth: {problem}")
        return {}
    try:
        solid = select_solid(snapshot, SolidSelection(), makes_up_volume=False)
    except MeshError as problem:
        say(f"The geometry scores 0: {problem}")
        return dict.fromkeys(("fscore", "precision", "recall", "fscore_128"), 0.0)

    lattice = snapshot.lattice
    transform = check_similarity("world_to_input", world_to_input)
    voxel_m = lattice.voxel_size * float(np.cbrt(abs(np.linalg.det(transform[:3, :3]))))
    common_voxel_m = float(np.subtract(known.scene.scene_box[1], known.scene.scene_box[0]).max()) / COMMON_RESOLUTION
    views = _training_views(known, transform)
    own, common = (
        surface_fscore(
            *(solid.cells, lattice, known.scene, seen, TOLERANCE_VOXELS * size_m, transform, views),
            surroundings=known.surroundings,
            within=solid.within,
        )
        for size_m in (voxel_m, common_voxel_m)
    )
    assert own.seen is not None and common.seen is not None
    result = {
        "fscore": own.fscore,
        "precision": own.precision,
        "recall": own.recall,
        f"fscore_{COMMON_RESOLUTION}": common.fscore,
        "fscore_seen": own.seen.fscore,
        f"fscore_{COMMON_RESOLUTION}_seen": common.seen.fscore,
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
    scale = float(np.cbrt(abs(np.linalg.det(transform[:3, :3]))))
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


def points_seen(known: KnownTruth) -> FloatArray:
    """Points spread evenly over the part of the true surface that enough training cameras see, shape (m, 3), [m]."""
    points, normals = known.scene.surface_points(_SURFACE_POINTS, seed=0)
    seen = visible_surface_points(known.scene, known.training_poses, known.camera, points, normals, MIN_VIEWS)
    if not seen.any():
        expected = f"a part of the surface that at least {MIN_VIEWS} of them see"
        got = f"none, with {len(known.training_poses)} training cameras"
        remedy = "Write the scene with more training views."
        raise SceneError("training cameras", expected=expected, got=got, remedy=remedy)
    return points[seen]


def _training_views(known: KnownTruth, world_to_truth: FloatArray) -> Views:
    """The training cameras in the coordinates of the lattice."""
    scale = float(np.cbrt(abs(np.linalg.det(world_to_truth[:3, :3]))))
    poses, camera, count = known.training_poses, known.camera, len(known.training_poses)
    axes = world_to_truth[:3, :3].T / scale  # the inverse of its rotation (and mirror)
    centres = (poses[:, :3, 3] - world_to_truth[:3, 3]) @ axes.T / scale
    return Views(
        camera_to_world=np.concatenate([axes @ poses[:, :3, :3], centres[:, :, None]], axis=2),
        focal=np.tile([camera.fl_x, camera.fl_y], (count, 1)),
        centre=np.tile([camera.cx, camera.cy], (count, 1)),
        size=np.tile([camera.width, camera.height], (count, 1)),
    )


def _num_faces(cells: BoolArray) -> int:
    """Number of voxel faces between solid and empty, those on the lattice's border included."""
    padded = np.pad(cells, 1)
    return sum(int(np.count_nonzero(np.diff(padded, axis=axis))) for axis in range(3))


def _mesh_errors(
    known: KnownTruth, mesh: TetMesh, seen: FloatArray, voxel_m: float, metres_per_unit: float
) -> dict[str, Any]:
    """Size of the mesh, its distance to the true surface, and temperature errors where they meet."""
    area = facet_areas(mesh.points_m, mesh.facets)
    if mesh.boundary is not None:
        area = area * mesh.boundary.area_factor
    result: dict[str, Any] = {
        "mesh_volume_m3": float(signed_volumes(mesh.points_m, mesh.tets).sum()) / metres_per_unit**3,
        "mesh_area_m2": float(area.sum()) / metres_per_unit**2,
    }
    tolerance_m = TOLERANCE_VOXELS * voxel_m
    distances = surface_distances(mesh, known.scene, seen, metres_per_unit, known.surroundings, tolerance_m)
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
    near = np.abs(scene.signed_distance(points)) <= tolerance_m
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


def _unusable(path: Path, expected: str, got: str) -> SceneError:
    return SceneError(str(path), expected=expected, got=got, remedy="Write the synthetic scene again.")
