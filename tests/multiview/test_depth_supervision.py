from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from tests.support.plane_photographs import EYES, SIZE, photographs
from tests.support.short_training import train, write_boxed_scene
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.core.lattice import input_from_world
from thermoxels_ns.multiview.evidence import evidence_of_photographs
from thermoxels_ns.multiview.stereo import ERROR_PLANES, Depths, feature_rays_to_depths
from thermoxels_ns.synthetic.scene_folder import make_scene
from thermoxels_ns.training.callbacks import SHORTEST_RUN_WITH_DEPTHS, follow_depths
from thermoxels_ns.training.losses import COARSE_LIGHT, FeatureRaySampler, feature_ray_loss
from thermoxels_ns.training.model import ThermoxelsModel


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "pipes"
    write_boxed_scene(make_scene("pipes"), folder, 18, 2, width=160, height=120)
    return folder


def test_lines_run_from_each_camera_to_what_its_sure_pixels_show():
    seen = photographs()
    depth = np.full(len(seen.colours), np.nan, np.float32)
    sure = np.array([5, SIZE * SIZE - 1, 3 * SIZE * SIZE, len(depth) - 1])
    depth[sure] = [1.5, 1.6, 1.7, 1.8]
    lines = feature_rays_to_depths(Depths(seen, depth, np.full(len(depth), 0.02, np.float32)))
    number = [0, 0, 3, len(EYES) - 1]
    assert np.array_equal(lines.origins, seen.centres[number]) and np.array_equal(lines.point, np.arange(4))
    for pixel, camera, point, error in zip(sure, number, lines.points, lines.uncertainty):
        across = seen.matrices[camera] @ np.append(point, 1.0)
        place = pixel - camera * SIZE * SIZE
        assert across[2] == pytest.approx(depth[pixel], abs=1e-6)
        assert across[:2] / across[2] == pytest.approx([place % SIZE + 0.5, place // SIZE + 0.5], abs=1e-3)
        slope = np.linalg.norm(point - seen.centres[camera]) / depth[pixel]
        assert error == pytest.approx(ERROR_PLANES * 0.02 * slope, rel=1e-5)


def test_most_lines_of_a_scene_end_at_its_surface(scene):
    untrained = train(scene, 0, {})
    lattice = untrained.model.grid.lattice
    found = evidence_of_photographs(untrained.datamanager.train_dataset, 0.0, lattice.lo, lattice.hi, print)
    assert found is not None and len(found.feature_rays.points) > 200
    outputs: Any = untrained.datamanager.train_dataparser_outputs
    to_input = input_from_world(outputs.dataparser_transform.numpy(), float(outputs.dataparser_scale))
    points = found.feature_rays.points @ to_input[:3, :3].T + to_input[:3, 3]
    off = np.abs(make_scene("pipes").solid.signed_distance(points))
    assert np.median(off) < 0.02 and np.quantile(off, 0.9) < 0.06, np.quantile(off, [0.5, 0.9])


def test_thermal_cameras_of_their_own_measure_the_sky(tmp_path):
    """A pixel of unknown depth is looked up as if it showed something far away."""
    write_boxed_scene(
        make_scene("house-corner+sky=0.55,0.57,0.60"), tmp_path, 12, 1, width=128, height=96, own_thermal_camera=True
    )
    dataset: Any = train(tmp_path, 0, {}).datamanager.train_dataset
    assert dataset.thermal_cameras is not None
    found = evidence_of_photographs(dataset, 0.0, (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), print, False, False)
    assert found is not None and found.backdrop.mean() > 0.1
    warm = found.photographs.thermal
    sky, body = (warm[chosen & np.isfinite(warm)] for chosen in (found.backdrop, np.isfinite(found.depth)))
    assert len(sky) > 0.3 * found.backdrop.sum() and np.median(sky) < np.median(body)


def attributes_of(datamanager: Any, steps: int = SHORTEST_RUN_WITH_DEPTHS) -> Any:
    first = steps // 2  # of a resumed training the steps before count too
    trainer = SimpleNamespace(_start_step=first, config=SimpleNamespace(max_num_iterations=steps - first))
    return SimpleNamespace(pipeline=SimpleNamespace(datamanager=datamanager), trainer=trainer)


@pytest.mark.parametrize(
    ("wanted", "steps", "tracks", "weight", "asked"),
    [
        ("auto", SHORTEST_RUN_WITH_DEPTHS, False, 0.05, True),
        ("auto", SHORTEST_RUN_WITH_DEPTHS - 1, False, 0.05, False),
        ("auto", SHORTEST_RUN_WITH_DEPTHS, True, 0.05, True),
        ("auto", SHORTEST_RUN_WITH_DEPTHS, False, 0.0, False),
        ("on", 1, True, 0.05, True),
        ("off", SHORTEST_RUN_WITH_DEPTHS, False, 0.05, False),
    ],
)
def test_when_photographs_are_asked(scene, monkeypatch, wanted, steps, tracks, weight, asked):
    boxes: list[Any] = []
    asks = "thermoxels_ns.training.callbacks.evidence_of_photographs"

    def ask(dataset, near, lo, hi, *more):
        boxes.append((lo, hi))
        raise InterruptedError

    monkeypatch.setattr(asks, ask)
    pipeline = train(scene, 0, {"photo_depth": "off", "loss_overrides": {"tracks": weight}})
    pipeline.model.config.photo_depth = wanted
    pipeline.model.feature_ray_sampler = object() if tracks else None  # type: ignore[assignment]
    with suppress(InterruptedError):
        follow_depths(pipeline.model, attributes_of(pipeline.datamanager, steps))
    assert len(boxes) == asked
    boxes.clear()  # where no photographs train
    data = SimpleNamespace(config=SimpleNamespace(streams="thermal"), train_dataset=pipeline.datamanager.train_dataset)
    follow_depths(pipeline.model, attributes_of(data, steps))
    assert boxes == []


def test_a_training_follows_depths(scene, capsys):
    course = {"resolutions": [8, 16], "voxel_pixels": 0.0, "refine_at": [3], "photo_depth": "on"}
    followed = train(scene, 6, course).model
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("photographs agree about") == 1
    alone = train(scene, 6, {**course, "photo_depth": "off"}).model
    assert "depths:" not in capsys.readouterr().out
    assert followed.feature_ray_sampler is not None and alone.feature_ray_sampler is None
    assert not torch.equal(followed.grid.density, alone.grid.density)


@pytest.mark.parametrize(("depths", "light"), [("on", COARSE_LIGHT), ("off", 0.0)])
def test_light_may_pass_depths_but_not_tracks_while_the_lattice_is_coarse(scene, monkeypatch, depths, light):
    populate, asked = ThermoxelsModel.populate_modules, []

    def with_tracks(model):
        populate(model)
        model.feature_ray_sampler = FeatureRaySampler(
            FeatureRays(np.zeros((1, 3)), np.zeros(1, int), np.ones((1, 3)), np.zeros(1)), model.scene_box.aabb
        )

    def recorded(accumulation, transmittance, tolerated):
        asked.append(tolerated)
        return feature_ray_loss(accumulation, transmittance, tolerated)

    monkeypatch.setattr(ThermoxelsModel, "populate_modules", with_tracks)
    monkeypatch.setattr("thermoxels_ns.training.losses.feature_ray_loss", recorded)
    course = {"resolutions": [8, 16], "voxel_pixels": 0.0, "refine_at": [4], "loss_overrides": {"backdrop": 0.0}}
    train(scene, 6, {**course, "photo_depth": depths})
    assert asked == [light] * 4 + [0.0] * 2
