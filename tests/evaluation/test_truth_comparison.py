import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.demo_mesh import demo_mesh
from tests.support.short_training import train, write_boxed_scene
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.feature_rays import RGB_STREAM, THERMAL_STREAM
from thermoxels_ns.core.lattice import Lattice, input_from_world
from thermoxels_ns.core.snapshot import GridSnapshot, Views
from thermoxels_ns.evaluation.truth_comparison import (
    KnownTruth,
    RenderedRays,
    compare_with_truth,
    depth_metrics,
    geometry_metrics,
    load_known_truth,
)
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.interior import cavities
from thermoxels_ns.mesh.solid.voxels import SolidSelection, select_solid
from thermoxels_ns.synthetic.raycast import render_view, visible_surface_points
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

IDENTITY = np.eye(4)
MIRRORED = np.array([[0.0, -0.5, 0.0, 0.3], [0.5, 0.0, 0.0, -0.1], [0.0, 0.0, -0.5, 0.2], [0.0, 0.0, 0.0, 1.0]])
"""To the input coordinates of a world that is a mirror image, turned about z and twice as large."""


def known(name: str, cameras: int = 12, width: int = 64) -> KnownTruth:
    scene = make_scene(name)
    return KnownTruth(scene, scene.poses(cameras, 0)[0], scene.camera(width, 3 * width // 4))


@pytest.fixture(scope="module")
def hot_object() -> KnownTruth:
    return known("hot-object")


@pytest.fixture(scope="module")
def sphere() -> KnownTruth:
    return known("sphere")


def exact_snapshot(truth: KnownTruth, resolution: int, world_to_input: np.ndarray = IDENTITY) -> GridSnapshot:
    """The exact scene on a lattice in the trained world: opaque where it is solid."""
    input_to_world = np.linalg.inv(world_to_input)
    lo, hi = (np.asarray(end) for end in truth.scene.scene_box)
    ends = np.array([[(lo, hi)[bit][axis] for axis, bit in enumerate(bits)] for bits in np.ndindex(2, 2, 2)])
    ends = ends @ input_to_world[:3, :3].T + input_to_world[:3, 3]
    lattice = Lattice.covering(ends.min(axis=0), ends.max(axis=0), resolution)
    centres = lattice.cell_centres().reshape(-1, 3) @ world_to_input[:3, :3].T + world_to_input[:3, 3]
    solid = truth.scene.solid.contains(centres).reshape(lattice.cell_shape)
    corner = np.zeros(lattice.shape, dtype=np.float32)
    return GridSnapshot(lattice, corner, corner, corner, (solid * 2.0 / lattice.voxel_size).astype(np.float32))


def compared(
    truth: KnownTruth | Path, snapshot: GridSnapshot, world_to_input: np.ndarray = IDENTITY, *mesh: Any
) -> dict:
    """Figures of all solid voxels, and of a mesh of them with its metres per unit."""
    return compare_with_truth(snapshot.voxel_density > 0, snapshot.lattice, world_to_input, truth, *mesh)


def test_cameras_are_found_in_a_mirrored_turned_and_scaled_world(hot_object):
    plain = compared(hot_object, exact_snapshot(hot_object, 24))
    assert compared(hot_object, exact_snapshot(hot_object, 24, MIRRORED), MIRRORED) == pytest.approx(plain, abs=2e-3)


def test_a_mesh_in_metres_is_compared_in_those_of_the_scene(hot_object):
    snapshot, mesh = exact_snapshot(hot_object, 24), demo_mesh("hot-object", 24, "voxel")
    scaled = replace(mesh, points_m=3.0 * mesh.points_m)
    plain = compared(hot_object, snapshot, IDENTITY, mesh)
    assert compared(hot_object, snapshot, IDENTITY, scaled, 3.0) == pytest.approx(plain)
    volume = float(signed_volumes(mesh.points_m, mesh.tets).sum())
    assert plain["mesh_volume_m3"] == pytest.approx(volume)
    warmer = replace(mesh, temperature_c=mesh.temperature_c + 50.0)
    off_k = compared(hot_object, snapshot, IDENTITY, warmer)["temperature_seen_mae_c"]
    assert off_k == pytest.approx(50.0, abs=plain["temperature_seen_mae_c"] + 1e-6)


def test_surfaces_that_few_training_cameras_see_are_not_asked_for(hot_object):
    # Nobody sees the table's underside, three tenths of the scene's surface.
    seen = compared(hot_object, snapshot := exact_snapshot(hot_object, 40))["true_points_seen"]
    assert seen < 0.8 * len(hot_object.scene.solid.surface_points(20_000, 0)[0])
    with pytest.raises(SceneError):
        compared(replace(hot_object, training_poses=hot_object.training_poses[:2]), snapshot)


def test_truth_comes_from_the_folder_with_training_cameras_only(tmp_path):
    scene = make_scene("sphere")
    write_scene(scene, tmp_path, num_train=5, num_eval=2, width=16, height=12, progress=False)
    known = load_known_truth(tmp_path)
    assert known.scene.name == "sphere"
    np.testing.assert_allclose(known.training_poses, scene.poses(5, 2)[0])
    assert known.camera == scene.camera(16, 12)
    from_json = load_known_truth(tmp_path / "transforms.json")
    np.testing.assert_array_equal(from_json.training_poses, known.training_poses)
    by_folder = compared(tmp_path, snapshot := exact_snapshot(known, 16))
    assert by_folder == compared(known, snapshot)
    assert json.loads(json.dumps(by_folder)) == by_folder
    content = json.loads((tmp_path / "transforms.json").read_text())
    content["frames"] = content["frames"][5:]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(SceneError, match="frame_train_"):
        load_known_truth(tmp_path)


def test_mesh_of_the_exact_voxels_is_near_the_truth_in_shape_and_temperature(sphere) -> None:
    snapshot = exact_snapshot(sphere, 24)
    lattice, result = snapshot.lattice, compared(sphere, snapshot, IDENTITY, demo_mesh("sphere", 24, "voxel"))
    assert result["precision"] == 1.0 and result["recall"] > 0.99
    assert result["mean_distance_m"] == pytest.approx(result["mean_distance_voxels"] * lattice.voxel_size)
    assert result["mean_distance_voxels"] < 0.5 and result["voxel_size_m"] == lattice.voxel_size
    assert 0.1 < result["chamfer_voxels"] < 0.5
    assert result["chamfer_m"] == pytest.approx(result["chamfer_voxels"] * lattice.voxel_size)
    assert result["share_of_seen_reached"] == 1.0 and result["temperature_seen_mae_c"] < 0.5
    assert result["mesh_volume_m3"] == pytest.approx(result["true_volume_m3"], rel=0.02)
    # The faces of a digitised convex body cover each of its three shadows twice: 6 pi r^2 for a ball of area 4 pi r^2.
    assert result["mesh_area_m2"] == pytest.approx(1.5 * result["true_area_m2"], rel=0.05)


def shell_that_cameras_see(truth: KnownTruth, resolution: int) -> GridSnapshot:
    """What a perfect training would leave: dense voxels just below the surface that three cameras see."""
    lattice = Lattice.covering(*truth.scene.scene_box, resolution)
    points, normals = truth.scene.solid.surface_points(12 * resolution**2, 1)
    seen = visible_surface_points(truth.scene, truth.training_poses, truth.camera, points, normals, 3)
    below = lattice.world_to_index(points[seen] - 0.5 * lattice.voxel_size * normals[seen])
    density = np.zeros(lattice.cell_shape, dtype=np.float32)
    density[tuple(np.clip(np.floor(below).astype(int), 0, np.array(lattice.cell_shape) - 1).T)] = 1.0
    corners = np.zeros(lattice.shape, dtype=np.float32)
    return GridSnapshot(lattice, corners, corners, corners, voxel_density=density, views=truth.views(IDENTITY))


@pytest.mark.parametrize(
    ("name", "resolution", "least_fscore"), [("pipes", 128, 0.99), ("hot-object", 64, 0.97), ("house-corner", 64, 0.97)]
)
def test_the_solid_of_a_perfectly_trained_scene_is_the_scene(name, resolution, least_fscore):
    """Filling adds the inside of every body, and nothing between pipes and the wall that they stand before."""
    truth = known(name, 24, 160)
    snapshot = shell_that_cameras_see(truth, resolution)
    shell = select_solid(snapshot, SolidSelection(density_threshold=0.5, interior="hollow")).cells
    cells = select_solid(snapshot, SolidSelection(density_threshold=0.5)).cells
    result = compare_with_truth(cells, snapshot.lattice, IDENTITY, truth)
    assert result["fscore"] > least_fscore and result["fscore_seen"] > least_fscore
    # The wall is 7 voxels thick, the table 5: half a voxel to either side.
    volume_m3 = np.count_nonzero(cells) * snapshot.lattice.voxel_size**3
    assert volume_m3 == pytest.approx(result["true_volume_m3"], rel=0.13)
    assert np.count_nonzero(cells) > 3 * np.count_nonzero(shell)


def test_a_room_in_which_cameras_stand_is_scored_from_inside():
    """Its walls are seen from the room alone, whose air must not be filled as that of a cavity is."""
    truth = known("living-room", 24, 160)
    snapshot = exact_snapshot(truth, 96)
    cells = snapshot.voxel_density > 0
    assert cavities(cells, np.zeros_like(cells))[0].mean() > 0.4  # closed on all sides
    result = compared(truth, snapshot)
    assert result["fscore_seen"] > 0.97 and result["recall_seen"] > 0.97


SCORES = ("fscore", "precision", "recall")


def test_the_figures_are_those_of_the_export(sphere):
    snapshot = exact_snapshot(sphere, 24)
    result = geometry_metrics(snapshot, IDENTITY, sphere)
    exported = compared(sphere, snapshot)
    assert {name: result[name] for name in SCORES} == {name: exported[name] for name in SCORES}
    assert result["surface_distance_voxels"] == pytest.approx(exported["mean_distance_voxels"])
    assert result["surface_distance_m"] == pytest.approx(exported["mean_distance_m"])


def test_only_what_the_default_selection_takes_counts(sphere):
    """Fog and a floater change nothing: the largest body of voxels with an optical depth of one half is the surface."""
    snapshot = exact_snapshot(sphere, 32)
    plain = geometry_metrics(snapshot, IDENTITY, sphere)
    density = snapshot.voxel_density.copy()
    density[density == 0] = 0.49 / snapshot.lattice.voxel_size
    density[:2, :2, :2] = 5.0 / snapshot.lattice.voxel_size
    assert geometry_metrics(replace(snapshot, voxel_density=density), IDENTITY, sphere) == plain
    density[density < 0.5 / snapshot.lattice.voxel_size] = 0.51 / snapshot.lattice.voxel_size
    assert geometry_metrics(replace(snapshot, voxel_density=density), IDENTITY, sphere)["fscore"] < 0.5


def test_coarse_lattices_are_judged_by_the_common_voxel(sphere):
    """At 128 voxels both scores are one; a coarse lattice that agrees within its own voxels does not in finer ones."""
    shift = IDENTITY.copy()
    fine = exact_snapshot(sphere, 128)
    at_128 = geometry_metrics(fine, shift, sphere)
    assert at_128["fscore_128"] == at_128["fscore"]
    shift[0, 3] = 1.0 * exact_snapshot(sphere, 16).lattice.voxel_size
    coarse = geometry_metrics(exact_snapshot(sphere, 16), shift, sphere)
    assert coarse["fscore"] > 0.95
    assert coarse["fscore_128"] < 0.5


def test_nothing_solid_scores_nothing_and_says_why(sphere, capsys):
    snapshot = exact_snapshot(sphere, 16)
    result = geometry_metrics(replace(snapshot, voxel_density=snapshot.voxel_density * 0), IDENTITY, sphere)
    assert result == dict.fromkeys((*SCORES, "fscore_128"), 0.0)
    assert capsys.readouterr().out.startswith("The geometry scores 0: solid voxels: expected at least one voxel")


def exact_rays(
    truth: KnownTruth, pose: np.ndarray, lattice: Lattice, world_to_input: np.ndarray = IDENTITY
) -> RenderedRays:
    """What a perfect model renders of one view, in the trained world."""
    scale = np.cbrt(abs(np.linalg.det(world_to_input)))
    input_to_world = np.linalg.inv(world_to_input)
    view = render_view(truth.scene, pose, truth.camera, 1)
    origin = input_to_world[:3, :3] @ pose[:3, 3] + input_to_world[:3, 3]
    directions = truth.camera.directions(pose).reshape(-1, 3) @ input_to_world[:3, :3].T * scale
    origins = np.tile(origin, (len(directions), 1))
    depth, hit = view.depth_m.ravel() / scale, np.isfinite(view.depth_m.ravel())
    ends = np.linspace(0.0, 2.0 * np.nanmax(depth[hit]), 300)[:, None, None] * directions + origins
    index = lattice.world_to_index(ends)
    in_box = ((index >= 0) & (index <= lattice.cell_shape)).all(-1).any(0)
    return RenderedRays(origins, directions, np.where(hit, depth, 99.0), hit, in_box)


@pytest.mark.parametrize("world_to_input", [IDENTITY, MIRRORED])
def test_exact_depths_have_no_error_in_any_world(sphere, world_to_input):
    lattice = exact_snapshot(sphere, 16, world_to_input).lattice
    frames = [exact_rays(sphere, pose, lattice, world_to_input) for pose in sphere.scene.poses(12, 2)[1]]
    result = depth_metrics(frames, lattice, world_to_input, sphere.scene)
    assert result == {"depth_error": pytest.approx(0.0, abs=1e-12), "depth_off_share": 0.0, "sky_filled": 0.0}
    off = [replace(rays, depth=1.03 * rays.depth) for rays in frames]
    result = depth_metrics(off, lattice, world_to_input, sphere.scene)
    assert result["depth_error"] == pytest.approx(0.03) and result["depth_off_share"] == 1.0


def test_shares_are_of_the_rays_that_could_be_right(sphere):
    """Rays past the box have no depth to be right about; all that show the sky could leave a lump there."""
    lattice = exact_snapshot(sphere, 16).lattice
    rays = exact_rays(sphere, sphere.training_poses[0], lattice)
    shown = np.flatnonzero(rays.ends)
    depth, in_box, ends = rays.depth.copy(), rays.in_box.copy(), rays.ends.copy()
    depth[shown[:10]] *= 0.9
    in_box[shown[10:20]], depth[shown[10:20]] = False, 99.0
    sky = np.flatnonzero(~rays.ends)
    ends[sky[:7]] = True
    result = depth_metrics([replace(rays, depth=depth, in_box=in_box, ends=ends)], lattice, IDENTITY, sphere.scene)
    assert result["depth_off_share"] == pytest.approx(10 / (len(shown) - 10))
    assert result["sky_filled"] == pytest.approx(7 / len(sky))


def test_surroundings_within_the_lattice_are_no_sky():
    """A room's walls may be there; where the lattice ends before them, what stands in it before them is wrong."""
    scene = make_scene("sphere+room")
    truth = KnownTruth(scene, scene.poses(12, 0)[0], scene.camera(32, 24))
    narrow, wide = exact_snapshot(truth, 16).lattice, Lattice((-50.0, -50.0, -50.0), 1.0, (101, 101, 101))
    rays = exact_rays(truth, truth.training_poses[0], narrow)
    everywhere = replace(rays, ends=np.ones_like(rays.ends))
    assert depth_metrics([everywhere], narrow, IDENTITY, scene)["sky_filled"] == 1.0
    assert "sky_filled" not in depth_metrics([everywhere], wide, IDENTITY, scene)
    assert depth_metrics([], narrow, IDENTITY, scene) == {}


def test_ns_eval_compares_the_trained_density_with_the_scene(tmp_path, monkeypatch):
    """A field that holds the exact scene, in the trained world's own coordinates, scores full."""
    write_boxed_scene(make_scene("hot-object"), tmp_path, 8, 2, width=24, height=18, own_thermal_camera=True)
    pipeline = train(tmp_path, steps=0)
    averages = pipeline.get_average_eval_image_metrics()  # as in a training: without the geometry
    assert 0.0 < averages["half_transparent"] <= 1.0 and "fscore" not in averages
    outputs = pipeline.datamanager.train_dataparser_outputs
    world_to_input = input_from_world(outputs.dataparser_transform.numpy(), float(outputs.dataparser_scale))
    assert not np.allclose(world_to_input, IDENTITY)
    known = load_known_truth(pipeline.datamanager.get_datapath())
    exact = exact_snapshot(known, 48, world_to_input)
    asked = []

    def snapshot(rays, views: Views) -> GridSnapshot:
        asked.append(({int(bundle.metadata["stream"][0]) for bundle in rays}, views.size[:, 0].tolist()))
        return exact

    monkeypatch.setattr(pipeline.model, "grid_snapshot", snapshot)
    monkeypatch.setattr(pipeline, "test_mode", "test")
    averages = pipeline.get_average_eval_image_metrics(get_std=True)
    assert averages["precision"] > 0.99 and averages["recall"] > 0.95
    assert averages["surface_distance_voxels"] < 0.6
    assert averages["depth_error"] > 0.0 and 0.0 < averages["depth_off_share"] <= 1.0 and averages["sky_filled"] == 0.0
    assert "fscore_std" not in averages and "half_transparent_std" in averages
    # What is solid is decided as in an export, by the rays and cameras of both streams.
    assert asked == [({RGB_STREAM, THERMAL_STREAM}, [24] * 8 + [12] * 8)]
