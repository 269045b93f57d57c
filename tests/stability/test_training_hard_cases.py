import json

import numpy as np
import pytest
import torch
from PIL import Image

from tests.support.short_training import COURSE, STEPS, train, write_boxed_scene
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.synthetic.imperfections import Imperfections
from thermoxels_ns.synthetic.scene_folder import make_scene


def sphere(folder, views=12, **options):
    return write_boxed_scene(make_scene("sphere"), folder, views, 2, width=40, height=30, **options)


def all_finite(pipeline) -> bool:
    return all(bool(torch.isfinite(p).all()) for p in pipeline.parameters())


def test_constant_thermal_images_of_a_textured_body_stay_constant(tmp_path):
    """Texture must not print into temperature: std below 0.1 K; and max = min must not divide by zero."""
    scene = sphere(tmp_path / "scene")
    for path in (scene / "thermal").iterdir():
        Image.fromarray(np.full((30, 40), 20_000, dtype=np.uint16)).save(path)
    (scene / "temperature_bounds.json").write_text(
        json.dumps({"absolute_min_temperature": 20.0, "absolute_max_temperature": 20.0})
    )
    pipeline = train(scene, 60)
    metrics = pipeline.get_average_eval_image_metrics()
    assert all_finite(pipeline) and np.isfinite(metrics["thermal_psnr"])
    pipeline.eval()
    camera = pipeline.datamanager.eval_dataset.cameras[0:1]
    temperature_c = pipeline.model.get_outputs_for_camera(camera)["temperature_c"]
    assert float(temperature_c.std()) < 0.1 and metrics["thermal_mae_c"] < 0.2


def test_drift_is_found_by_the_offsets(tmp_path):
    scene = sphere(tmp_path / "scene", views=16, imperfections=Imperfections(drift_k=4.0))
    drift = np.array(json.loads((scene / "truth.json").read_text())["drift_k"])
    pipeline = train(scene, 250, {"per_image_offset": "on"}, rate=2.0)
    offset = pipeline.model.thermal_offset.detach()
    found = ((offset - offset.mean()) * pipeline.model.temperature_range.span_k).numpy()
    names = [p.stem for p in pipeline.datamanager.train_dataset.image_filenames]
    frames = [f["file_path"] for f in json.loads((scene / "transforms.json").read_text())["frames"]]
    true = np.array([drift[i] for i, path in enumerate(frames) if any(name in path for name in names)])
    true -= true.mean()
    assert np.corrcoef(found, true)[0, 1] > 0.95
    assert np.abs(found - true).mean() < 0.35 * np.abs(true).mean()


def test_image_without_a_valid_thermal_pixel_in_evaluation_does_not_spoil_the_average(tmp_path, monkeypatch):
    pipeline = train(sphere(tmp_path / "scene"), 5)
    dataset = pipeline.datamanager.eval_dataset
    original = dataset.get_data

    def blind(index, *args, **kwargs):
        item = original(index, *args, **kwargs)
        return {**item, "thermal_valid": torch.zeros_like(item["thermal_valid"])} if index == 0 else item

    monkeypatch.setattr(dataset, "get_data", blind)
    metrics = pipeline.get_average_eval_image_metrics()
    assert np.isfinite(metrics["thermal_mae_c"]) and np.isfinite(metrics["thermal_psnr"])


@pytest.mark.parametrize(("recipe", "rate"), [("default", 1e6), ("paper", 100.0)])
def test_learning_rates_far_too_large_end_in_a_finite_model_or_a_clear_error(tmp_path, recipe, rate):
    scene = sphere(tmp_path / "scene")
    activation = "exp" if recipe == "default" else "relu"
    try:
        pipeline = train(scene, STEPS, COURSE | {"recipe": recipe, "density_activation": activation}, rate=rate)
    except ThermoxelsError as error:
        assert "--pipeline.model" in str(error) or "learning rate" in str(error)
        return
    assert all_finite(pipeline)
    assert all(np.isfinite(value) for value in pipeline.get_average_eval_image_metrics().values())
    snapshot = pipeline.grid_snapshot()
    assert np.isfinite(snapshot.density).all() and np.isfinite(snapshot.temperature_c).all()


def mask_one(scene, frames: list[dict]) -> None:
    """Give every frame a mask; that of one lets nothing through."""
    for number, frame in enumerate(frames):
        frame["mask_path"] = f"mask_{number}.png"
        Image.fromarray(np.full((30, 40), 0 if number == 3 else 255, np.uint8)).save(scene / frame["mask_path"])


def look_the_same_way(scene, frames: list[dict]) -> None:
    """Parallel axes: the cameras stand side by side and see one side of the body."""
    first = np.array(frames[0]["transform_matrix"])
    for number, frame in enumerate(frames):
        pose = first.copy()
        pose[:3, 3] += 0.1 * (number - 6) * first[:3, 0]
        frame["transform_matrix"] = pose.tolist()


@pytest.mark.parametrize(
    ("change", "views"), [(mask_one, 12), (look_the_same_way, 12), (lambda *_: None, 1)], ids=["mask", "side", "one"]
)
def test_scenes_that_show_little(tmp_path, change, views):
    scene = sphere(tmp_path / "scene", views=views)
    transforms = json.loads((scene / "transforms.json").read_text())
    change(scene, transforms["frames"])
    (scene / "transforms.json").write_text(json.dumps(transforms))
    pipeline = train(scene, STEPS, COURSE)
    assert pipeline.model.grid.lattice.cell_shape[0] == 16 and all_finite(pipeline)
    metrics = pipeline.get_average_eval_image_metrics()
    assert np.isfinite(metrics["thermal_mae_c"]) and np.isfinite(metrics["psnr"])
