from dataclasses import replace

import numpy as np
import pytest

from tests.support.boxed_scene import write_boxed_scene
from tests.support.short_training import train
from thermoxels_ns.core.lattice import Lattice, input_from_world
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.evaluation.truth_comparison import (
    KnownTruth,
    RenderedRays,
    compare_with_truth,
    depth_metrics,
    geometry_metrics,
    load_known_truth,
)
from thermoxels_ns.synthetic.raycast import render_view
from thermoxels_ns.synthetic.scene_folder import make_scene

IDENTITY = np.eye(4)
SCORES = ("fscore", "precision", "recall")


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


@pytest.fixture(scope="module")
def sphere() -> KnownTruth:
    scene = make_scene("sphere")
    return KnownTruth(scene, scene.poses(12, 0)[0], scene.camera(64, 48))


def test_the_figures_are_those_of_the_export(sphere):
    snapshot = exact_snapshot(sphere, 24)
    result = geometry_metrics(snapshot, IDENTITY, sphere)
    assert snapshot.voxel_density is not None
    exported = compare_with_truth(snapshot.voxel_density > 0, snapshot.lattice, IDENTITY, sphere)
    assert exported is not None
    assert {name: result[name] for name in SCORES} == {name: exported[name] for name in SCORES}
    assert result["surface_distance_voxels"] == pytest.approx(exported["mean_distance_voxels"])
    assert result["surface_distance_m"] == pytest.approx(exported["mean_distance_m"])


def test_only_what_the_default_selection_takes_counts(sphere):
    """Fog and a floater change nothing: the largest body of voxels with an optical depth of one half is the surface."""
    snapshot = exact_snapshot(sphere, 32)
    assert snapshot.voxel_density is not None
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


def test_nothing_solid_scores_nothing_and_says_why(sphere):
    snapshot = exact_snapshot(sphere, 16)
    assert snapshot.voxel_density is not None
    said: list[str] = []
    result = geometry_metrics(
        replace(snapshot, voxel_density=snapshot.voxel_density * 0), IDENTITY, sphere, said.append
    )
    assert result == dict.fromkeys((*SCORES, "fscore_128"), 0.0)
    assert said[0].startswith("The geometry scores 0: solid voxels: expected at least one voxel")


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
    depth, hit = view.depth_m.ravel() / scale, view.hit.ravel()
    ends = np.linspace(0.0, 2.0 * np.nanmax(depth[hit]), 2000)[:, None, None] * directions + origins
    index = lattice.world_to_index(ends)
    in_box = ((index >= 0) & (index <= lattice.cell_shape)).all(-1).any(0)
    return RenderedRays(origins, directions, np.where(hit, depth, 99.0), hit, in_box)


TURNED = np.array([[0.0, -0.5, 0.0, 0.3], [0.5, 0.0, 0.0, -0.1], [0.0, 0.0, 0.5, 0.2], [0.0, 0.0, 0.0, 1.0]])


@pytest.mark.parametrize("world_to_input", [IDENTITY, TURNED])
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


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "hot"
    write_boxed_scene(make_scene("hot-object"), folder, 8, 2, width=24, height=18)
    return train(folder, steps=0)


def test_ns_eval_compares_the_trained_density_with_the_scene(pipeline, monkeypatch):
    """A field that holds the exact scene, in the trained world's own coordinates, scores full."""
    averages = pipeline.get_average_eval_image_metrics()  # as in a training: without the geometry
    assert 0.0 < averages["half_transparent"] <= 1.0 and "fscore" not in averages
    outputs = pipeline.datamanager.train_dataparser_outputs
    world_to_input = input_from_world(outputs.dataparser_transform.numpy(), float(outputs.dataparser_scale))
    assert not np.allclose(world_to_input, IDENTITY)
    known = load_known_truth(pipeline.datamanager.get_datapath())
    assert known is not None
    exact = exact_snapshot(known, 48, world_to_input)
    asked = []
    monkeypatch.setattr(
        pipeline.model, "grid_snapshot", lambda rays, views: asked.append((len(list(rays)), len(views.size))) or exact
    )
    monkeypatch.setattr(pipeline, "test_mode", "test")
    averages = pipeline.get_average_eval_image_metrics(get_std=True)
    assert averages["precision"] > 0.99 and averages["recall"] > 0.95
    assert averages["surface_distance_voxels"] < 0.6
    assert averages["depth_error"] > 0.0 and 0.0 < averages["depth_off_share"] <= 1.0 and averages["sky_filled"] == 0.0
    assert "fscore_std" not in averages and "half_transparent_std" in averages
    ((rays, views),) = asked
    assert rays > 0 and views == len(pipeline.datamanager.train_dataset)  # what is solid is decided as in an export
