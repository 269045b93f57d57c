from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from thermoxels_ns.core.feature_rays import RGB_STREAM, THERMAL_STREAM
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.data.datamanager import ThermalDataManager, ThermalDataManagerConfig
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.ray_sampler import CameraRays

DISTORTION = {"k1": 0.08, "k2": -0.02, "p1": 0.003, "p2": -0.002}


def manager(data: Path, mode: str = "val", parser: dict | None = None, **options) -> ThermalDataManager:
    config = ThermalDataManagerConfig(dataparser=ThermalDataParserConfig(data=data, **(parser or {})), **options)
    return config.setup(device="cpu", test_mode=mode)


def all_rays(cameras) -> dict[str, torch.Tensor]:
    """nerfstudio's rays of every pixel of every camera, flat."""
    bundles = [cameras[n : n + 1].generate_rays(0, keep_shape=True).flatten() for n in range(len(cameras))]
    return {name: torch.cat([getattr(b, name) for b in bundles]) for name in ("origins", "directions")} | {
        "camera_indices": torch.cat([torch.full((len(b), 1), i) for i, b in enumerate(bundles)])
    }


def nearest_pixel(bundle, reference) -> torch.Tensor:
    """Which of the reference rays each ray is."""
    keys = torch.cat([reference["origins"], reference["directions"]], dim=1)
    distances = torch.cdist(torch.cat([bundle.origins, bundle.directions], dim=1).double(), keys.double())
    assert float(distances.amin(1).max()) < 1e-5
    return distances.argmin(1)


def check_rays(bundle, reference) -> torch.Tensor:
    pixels = nearest_pixel(bundle, reference)
    for name in ("origins", "directions"):
        torch.testing.assert_close(getattr(bundle, name), reference[name][pixels], atol=2e-6, rtol=2e-3)
    assert torch.equal(bundle.camera_indices, reference["camera_indices"][pixels])
    assert bundle.camera_indices.dtype == torch.int64
    torch.testing.assert_close(bundle.directions.norm(dim=1), torch.ones(len(bundle)))
    return pixels


def test_shared_camera_one_ray_carries_both_targets(scene_folder):
    scene = scene_folder(distortion=DISTORTION)
    served = manager(scene.path, train_num_rays_per_batch=700)
    bundle, batch = served.next_train(3)
    assert bundle.shape == (700,) and served.get_train_rays_per_batch() == 700
    assert (bundle.metadata["stream"] == RGB_STREAM | THERMAL_STREAM).all()
    assert bundle.metadata["stream"].dtype == torch.uint8 and bundle.metadata["stream"].shape == (700, 1)
    pixels = check_rays(bundle, all_rays(served.train_dataset.cameras)).numpy()
    names = [path.name for path in served.train_dataset.image_filenames]
    colours = np.concatenate([np.asarray(Image.open(scene.path / "images" / n)).reshape(-1, 3) for n in names])
    np.testing.assert_allclose(batch["image"].numpy(), colours[pixels] / 255.0, atol=1e-6)
    counts = np.concatenate([c.ravel() for c, n in zip(scene.counts, scene.names) if f"{n}.png" in names])
    # 16 bits: every count is told from its neighbours.
    assert np.abs(batch["thermal"][:, 0].numpy() - counts[pixels] / 65535.0).max() < 0.25 / 65535.0
    assert len(np.unique(pixels)) > 500 and len(torch.unique(bundle.camera_indices)) == len(names)


def test_own_thermal_camera_gives_a_second_stream(scene_folder):
    scene = scene_folder(own_camera=True, thermal_size=(12, 10), distortion=DISTORTION)
    served = manager(scene.path, train_num_rays_per_batch=300, thermal_num_rays_per_batch=200)
    bundle, batch = served.next_train(0)
    stream = bundle.metadata["stream"][:, 0]
    assert (stream[:300] == RGB_STREAM).all() and (stream[300:] == THERMAL_STREAM).all() and len(stream) == 500
    assert served.get_train_rays_per_batch() == 500
    check_rays(bundle[:300], all_rays(served.train_dataset.cameras))
    pixels = check_rays(bundle[300:], all_rays(served.train_dataset.metadata["thermal_cameras"])).numpy()
    counts = np.concatenate([c.ravel() for c, n in zip(scene.counts, scene.names) if "train" in n])
    np.testing.assert_allclose(batch["thermal"][300:, 0].numpy(), counts[pixels] / 65535.0, atol=4e-6)
    assert not batch["thermal"][:300].any() and not batch["image"][300:].any() and batch["image"][:300].any()


@pytest.mark.parametrize("own_camera", [False, True])
def test_streams_alone(scene_folder, own_camera):
    scene = scene_folder(own_camera=own_camera, thermal_size=(12, 10) if own_camera else None)
    rays = {"train_num_rays_per_batch": 64, "thermal_num_rays_per_batch": 32}
    bundle, batch = manager(scene.path, streams="rgb", **rays).next_train(0)
    assert (bundle.metadata["stream"] == RGB_STREAM).all() and len(bundle) == 64 and not batch["thermal"].any()
    served = manager(scene.path, streams="thermal", **rays)
    bundle, batch = served.next_train(0)
    count = 32 if own_camera else 64
    assert (bundle.metadata["stream"] == THERMAL_STREAM).all() and len(bundle) == count
    assert served.get_train_rays_per_batch() == count and not batch["image"].any() and batch["thermal"].any()
    assert set(served.training_views().size[:, 0]) == {12 if own_camera else 24}


def test_batches_depend_on_seed_and_step_alone(scene_folder):
    scene = scene_folder()
    first, second = manager(scene.path), manager(scene.path)
    for step in range(5):
        first.next_train(step)
    torch.manual_seed(123)
    for step in (5, 4, 5):
        (ours, batch), (again, copy) = first.next_train(step), second.next_train(step)
        assert torch.equal(ours.origins, again.origins) and torch.equal(ours.directions, again.directions)
        assert torch.equal(batch["image"], copy["image"]) and torch.equal(batch["thermal"], copy["thermal"])
    assert not torch.equal(first.next_train(4)[1]["image"], first.next_train(5)[1]["image"])
    other = manager(scene.path, seed=1).next_train(4)[1]["image"]
    assert not torch.equal(first.next_train(4)[1]["image"], other)
    # Steps and seeds that add up to the same number are different draws.
    assert not torch.equal(manager(scene.path, seed=0).next_train(1)[1]["image"], other)


def test_evaluation_frames_never_train(scene_folder):
    """Every frame's pixels have a colour of their own; a training batch shows the training frames' only."""
    scene = scene_folder()
    for number, name in enumerate(scene.names):
        Image.fromarray(np.full((18, 24, 3), number, np.uint8)).save(scene.path / "images" / f"{name}.png")
    served = manager(scene.path)
    seen = lambda batch: set((batch["image"] * 255).round().int().flatten().tolist())  # noqa: E731
    assert set().union(*(seen(served.next_train(step)[1]) for step in range(5))) == {0, 1, 3, 4, 5, 6, 8, 9}
    assert seen(served.next_eval(0)[1]) == {2, 7}
    assert {served.next_eval_image(step)[1]["image_idx"] for step in range(20)} == {0, 1}


def test_masked_pixels_are_never_drawn(scene_folder):
    scene = scene_folder()
    mask = scene.add_masks()
    served = manager(scene.path)
    bundle, _ = served.next_train(0)
    pixels = nearest_pixel(bundle, all_rays(served.train_dataset.cameras)) % (18 * 24)
    assert set(pixels.tolist()) == set(np.flatnonzero(mask).tolist())
    gridded = torch.cat([part.directions for part in served.training_rays(THERMAL_STREAM)])
    assert len(gridded) == 8 * 25


def test_frames_of_different_resolutions_and_lenses(scene_folder):
    scene = scene_folder(frames=5, distortion=DISTORTION)
    name = scene.names[0]
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (9, 12, 3), dtype=np.uint8)).save(scene.path / "images" / f"{name}.png")
    Image.fromarray(rng.integers(0, 65536, (9, 12)).astype(np.uint16)).save(scene.path / "thermal" / f"{name}.png")
    scene.meta["frames"][0].update(w=12, h=9, fl_x=13.0, fl_y=13.5, cx=6.0, cy=4.5)
    scene.rewrite()
    served = manager(scene.path)
    cameras = served.train_dataset.cameras
    bundle, batch = served.next_train(0)
    pixels = check_rays(bundle, all_rays(cameras))
    colours = torch.cat([served.train_dataset[i]["image"].reshape(-1, 3) for i in range(4)])
    torch.testing.assert_close(batch["image"], colours[pixels])
    rays = CameraRays(cameras)
    columns = rays.columns(torch.arange(len(rays)))
    for key, expected in all_rays(cameras).items():
        torch.testing.assert_close(columns[key], expected, atol=1e-6, rtol=2e-3)


def test_training_rays_are_a_regular_subset(scene_folder):
    scene = scene_folder(own_camera=True, thermal_size=(12, 10))
    served = manager(scene.path, mode="inference")
    data = served.train_dataset
    for stream, cameras, most in ((RGB_STREAM, data.cameras, 24), (2, data.thermal_cameras, 6)):
        parts = list(served.training_rays(stream, most))
        assert all((p.metadata["stream"] == stream).all() for p in parts)
        pixels = torch.cat([nearest_pixel(part, all_rays(cameras)) for part in parts])
        width, height = int(cameras.width[0]), int(cameras.height[0])
        inside = [r * width + c for r in range(2, height, 4) for c in range(2, width, 4)]
        assert pixels.tolist() == [i * width * height + p for i in range(8) for p in inside]
    both = torch.cat([part.metadata["stream"] for part in served.training_rays(RGB_STREAM | THERMAL_STREAM)])
    assert both.flatten().tolist() == [RGB_STREAM] * 8 * 24 * 18 + [THERMAL_STREAM] * 8 * 12 * 10
    alone = manager(scene.path, streams="thermal")
    assert list(alone.training_rays(RGB_STREAM)) == [] and sum(map(len, alone.training_rays(3))) == 8 * 12 * 10


@pytest.mark.parametrize("most", [1, 7, 30, 100, 1000])
def test_training_rays_per_image_are_limited(scene_folder, most):
    served = manager(scene_folder().path, mode="inference")
    images = torch.cat([part.camera_indices for part in served.training_rays(RGB_STREAM, most)])
    counts = torch.bincount(images.flatten(), minlength=8)
    assert int(counts.max()) <= most and int(counts.min()) >= min(most / 4, 432)


def test_photographs_scaled_by_the_datamanager_keep_their_thermal_images(scene_folder):
    served = manager(scene_folder().path, camera_res_scale_factor=0.5)
    item = served.eval_dataset[0]
    assert item["image"].shape == (9, 12, 3) and item["thermal"].shape == (18, 24, 1)
    assert int(item["thermal_camera"].width) == 24


def directions(views: Views, number: int) -> np.ndarray:
    """Unit directions in the world through the centres of all pixels of a view, shape (h, w, 3)."""
    width, height = views.size[number]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    across, up = (np.stack((x, y), -1) - views.centre[number]).transpose(2, 0, 1) / views.focal[number][:, None, None]
    local = np.stack((across, -up, -np.ones_like(x)), -1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    return local @ views.camera_to_world[number, :, :3].T


@pytest.mark.parametrize("own_camera", [False, True])
def test_every_pixel_looks_along_its_training_ray(scene_folder, own_camera):
    scene = scene_folder(own_camera=own_camera, thermal_size=(12, 10) if own_camera else None)
    if own_camera:
        del scene.meta["thermal_camera"]["k1"]
        scene.rewrite()
    served = manager(scene.path, "test")
    views = served.training_views()
    ours = [directions(views, number) for number in range(len(views.size))]
    assert views.camera_to_world.shape == ((16 if own_camera else 8), 3, 4)
    bundles = list(served.training_rays(RGB_STREAM | THERMAL_STREAM))
    rays = {
        name: torch.cat([getattr(bundle, name) for bundle in bundles]).numpy() for name in ("origins", "directions")
    }
    np.testing.assert_allclose(np.concatenate([d.reshape(-1, 3) for d in ours]), rays["directions"], atol=2e-6)
    centres = np.concatenate(
        [np.broadcast_to(p[:, 3], (d[..., 0].size, 3)) for p, d in zip(views.camera_to_world, ours)]
    )
    np.testing.assert_allclose(centres, rays["origins"], atol=1e-6)
    assert views.size.tolist() == [[24, 18]] * 8 + [[12, 10]] * (8 if own_camera else 0)
    assert views.camera_to_world.dtype == views.focal.dtype == views.centre.dtype == np.float64


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("images_on_gpu", [False, True])
def test_cuda_gives_the_batch_of_the_cpu(scene_folder, images_on_gpu):
    scene = scene_folder(own_camera=True, thermal_size=(12, 10))
    options = ThermalDataManagerConfig(dataparser=ThermalDataParserConfig(data=scene.path), images_on_gpu=images_on_gpu)
    bundle, batch = options.setup(device="cuda", test_mode="val").next_train(2)
    expected, targets = manager(scene.path).next_train(2)
    assert bundle.origins.is_cuda and bundle.metadata["stream"].is_cuda
    torch.testing.assert_close(bundle.directions.cpu(), expected.directions)
    for name in targets:
        assert batch[name].is_cuda
        torch.testing.assert_close(batch[name].cpu(), targets[name])


def celsius(number: int, shape: tuple[int, int]) -> np.ndarray:
    return np.random.default_rng(number).uniform(12.0, 28.0, shape).astype(np.float32)


def test_bad_pixels_are_masked_and_the_rest_is_unchanged(scene_folder, capsys):
    """The same images with 1 % NaN, one infinite and one impossible pixel."""
    size = (40, 30)
    clean = manager(scene_folder(suffix=".npy", size=size, counts=celsius).path)
    clean.train_dataset.get_thermal(0)
    expected = {index: clean.train_dataset.get_thermal(index)[0] for index in range(8)}
    batch_clean = clean.next_train(7)
    for number, path in enumerate(sorted((clean.config.data / "thermal").glob("*.npy"), key=lambda p: p.stem[-3:])):
        values = celsius(number, (30, 40))
        values[np.random.default_rng(100 + number).random((30, 40)) < 0.01] = np.nan
        values[0, 0], values[0, 1] = np.inf, -300.0
        np.save(path, values)
    served = manager(clean.config.data)
    for index in range(8):
        got, valid = served.train_dataset.get_thermal(index)
        assert not valid[0, :2].any()
        assert 0.98 < float(valid.float().mean()) < 1.0
        torch.testing.assert_close(got[valid], expected[index][valid], atol=0, rtol=0)
        assert not got[~valid].any()
    bundle, batch = served.next_train(7)
    thermal = (bundle.metadata["stream"] & THERMAL_STREAM > 0)[:, 0]
    # The same rays and colours; temperatures only where they are measurements.
    assert torch.equal(bundle.directions, batch_clean[0].directions)
    assert torch.equal(batch["image"], batch_clean[1]["image"])
    assert (bundle.metadata["stream"] & RGB_STREAM > 0).all() and 0.98 < float(thermal.float().mean()) < 1.0
    assert torch.equal(batch["thermal"][thermal], batch_clean[1]["thermal"][thermal])
    assert torch.isfinite(batch["thermal"]).all() and not batch["thermal"][~thermal].any()
    alone = manager(clean.config.data, streams="thermal")
    measured = sum(int(alone.train_dataset.get_thermal(index)[1].sum()) for index in range(8))
    assert sum(len(part) for part in alone.training_rays(THERMAL_STREAM)) == measured
    assert (alone.next_train(0)[1]["thermal"] > 0).all()
    masked = sum(int((~served.train_dataset.get_thermal(index)[1]).sum()) for index in range(8))
    assert 16 <= masked < 0.02 * 8 * 1200
    assert f"{masked} of {8 * 1200} pixels masked" in " ".join(capsys.readouterr().out.split())


def test_no_valid_pixel_becomes_nan_in_a_narrow_range(scene_folder):
    """0.05 K of contrast at 1500 C: the steps that float32 degrees can hold survive the normalisation."""
    values = lambda i, s: np.float32(1500.0) + np.float32(2**-13) * np.arange(s[0] * s[1]).reshape(s)  # noqa: E731
    served = manager(scene_folder(suffix=".npy", bounds=False, counts=values).path)
    thermal, valid = served.train_dataset.get_thermal(0)
    assert valid.all() and len(torch.unique(thermal)) == thermal.numel()
    assert float(thermal.min()) == 0.0 and float(thermal.max()) == 1.0
