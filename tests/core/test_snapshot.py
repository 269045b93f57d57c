import re
from dataclasses import replace

import numpy as np
import pytest

from tests.support.boxed_scene import write_boxed_scene
from tests.support.short_training import train
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.ray_streams import RGB_STREAM, THERMAL_STREAM
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence, Views
from thermoxels_ns.synthetic.scene_folder import make_scene


def full() -> GridSnapshot:
    """A snapshot of 2 x 3 x 4 corners with everything known."""
    ones = np.ones((2, 3, 4), np.float32)
    return GridSnapshot(
        Lattice((0.0, 0.0, 0.0), 1.0, (2, 3, 4)),
        ones,
        ones,
        ones,
        np.ones((1, 2, 3), np.float32),
        np.ones((2, 3, 4, 3), np.float32),
        RayEvidence(np.ones((1, 2, 3), np.float32), np.ones(7, np.float32), np.ones((1, 2, 3), np.float32)),
        Views(np.zeros((5, 3, 4)), np.ones((5, 2)), np.zeros((5, 2)), np.ones((5, 2), np.int64)),
    )


def spoilt(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array.reshape(-1)[-1] = value
    return array


def test_a_sound_snapshot_is_taken_as_it_is():
    snapshot = full()
    assert snapshot.evidence is not None
    nothing_ended = replace(snapshot, evidence=replace(snapshot.evidence, half_depth_density=np.zeros(0, np.float32)))
    assert nothing_ended.centre_density().sum() == 6.0


@pytest.mark.parametrize("part", ["evidence", "views"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused_by_name(part, value):
    snapshot = full()
    whole = getattr(snapshot, part)
    for name, array in vars(whole).items():
        if array.dtype.kind == "f":
            broken = replace(whole, **{name: spoilt(array, value)})
            with pytest.raises(MeshError, match=f"{name}: expected finite numbers only, got 1 of {array.size}"):
                replace(snapshot, **{part: broken})


@pytest.mark.parametrize("part", ["evidence", "views"])
def test_shapes_that_do_not_fit_are_refused_by_name(part):
    snapshot = full()
    whole = getattr(snapshot, part)
    for name, array in vars(whole).items():
        with pytest.raises(MeshError, match=r"grid snapshot .*: expected shape"):
            replace(snapshot, **{part: replace(whole, **{name: array[..., None]})})
    with pytest.raises(MeshError, match="voxel_density: expected shape"):
        replace(snapshot, voxel_density=np.ones((2, 3, 4), np.float32))
    with pytest.raises(MeshError, match="colour: expected shape"):
        replace(snapshot, colour=np.ones((2, 3, 4), np.float32))


@pytest.mark.parametrize(
    "part, name, value, message",
    [
        ("evidence", "voxel_weight", -1e-3, "voxel_weight: expected 0 or more, got -0.001 to 1. The checkpoint"),
        ("evidence", "half_depth_density", -1.0, "half_depth_density: expected 0 or more, got -1 to 1. The checkpoint"),
        ("evidence", "voxel_ends", -1.0, "voxel_ends: expected 0 or more, got -1 to 1. The checkpoint"),
        ("views", "focal", 0.0, "focal: expected 1e-06 or more, got 0 to 1. Correct the camera"),
        ("views", "size", 0, "size: expected 1 or more, got 0 to 1. Correct the camera"),
    ],
)
def test_numbers_that_cannot_be_are_refused(part, name, value, message):
    snapshot = full()
    whole = getattr(snapshot, part)
    with pytest.raises(MeshError, match=re.escape(message)):
        replace(snapshot, **{part: replace(whole, **{name: spoilt(getattr(whole, name), value)})})


def test_a_pipeline_fills_evidence_and_views_from_both_streams(tmp_path):
    scene = tmp_path / "scene"
    write_boxed_scene(make_scene("sphere"), scene, 6, 2, width=24, height=18, thermal_width=8)
    pipeline = train(scene, 20)
    snapshot = pipeline.grid_snapshot()
    evidence, views = snapshot.evidence, snapshot.views
    assert evidence is not None and views is not None and snapshot.colour is not None
    assert views.size[:, 0].tolist() == [24] * 6 + [8] * 6
    model, opacity = pipeline.model, {}
    for stream in (RGB_STREAM, THERMAL_STREAM):
        bundles = pipeline.datamanager.training_rays(stream)  # type: ignore[attr-defined]
        opacity[stream] = sum(
            float(1 - t) for b in bundles for t in model.sample_rays(b.origins, b.directions).transmittance
        )
    assert min(opacity.values()) > 1.0
    assert evidence.voxel_weight.sum() == pytest.approx(sum(opacity.values()), rel=1e-4)
    assert snapshot.observed_weight.sum() <= opacity[THERMAL_STREAM] * (1 + 1e-5)
    lo, hi = np.array(snapshot.lattice.lo), np.array(snapshot.lattice.hi)
    towards = 0.5 * (lo + hi) - views.camera_to_world[:, :, 3]
    assert (np.einsum("ni,ni->n", towards, -views.camera_to_world[:, :, 2]) > 0).all()  # they look at the box
