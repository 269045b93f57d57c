import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from tests.support.scene_folders import look_at_origin
from thermoxels_ns.core.feature_rays import RGB_STREAM, THERMAL_STREAM
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.data.datamanager import ThermalDataManager, ThermalDataManagerConfig, views_of_cameras
from thermoxels_ns.data.dataparser import ThermalDataParserConfig


def manager(path, **options) -> ThermalDataManager:
    config = ThermalDataManagerConfig(dataparser=ThermalDataParserConfig(data=path), **options)
    return config.setup(device="cpu", test_mode="test")


def cameras(kind: CameraType, width: int, height: int, fx: float, fy: float) -> Cameras:
    poses = np.stack([look_at_origin(angle)[:3] for angle in (0.3, 2.0)]).astype(np.float32)
    return Cameras(torch.from_numpy(poses), fx, fy, 0.45 * width, 0.55 * height, width, height, camera_type=kind)


def directions(views: Views, number: int) -> np.ndarray:
    """Unit directions in the world through the centres of all pixels of a view, shape (h, w, 3)."""
    width, height = views.size[number]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    across, up = (np.stack((x, y), -1) - views.centre[number]).transpose(2, 0, 1) / views.focal[number][:, None, None]
    local = np.stack((across, -up, -np.ones_like(x)), -1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    return local @ views.camera_to_world[number, :, :3].T


def inside(views: Views, number: int, rays: np.ndarray) -> np.ndarray:
    """Which directions (n, 3) a view sees."""
    local = rays @ views.camera_to_world[number, :, :3]
    ahead = local[:, 2] < -1e-9
    depth = np.where(ahead, -local[:, 2], 1.0)[:, None]
    pixel = views.centre[number] + views.focal[number] * local[:, :2] * (1, -1) / depth
    return ahead & ((pixel >= -1e-6) & (pixel <= views.size[number] + 1e-6)).all(axis=1)


@pytest.mark.parametrize("own_camera", [False, True])
def test_every_pixel_looks_along_its_training_ray(scene_folder, own_camera):
    scene = scene_folder(own_camera=own_camera, thermal_size=(12, 10) if own_camera else None)
    if own_camera:
        del scene.meta["thermal_camera"]["k1"]
        scene.rewrite()
    served = manager(scene.path)
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


def test_streams_that_do_not_train_have_no_views(scene_folder):
    scene = scene_folder(own_camera=True, thermal_size=(12, 10))
    for streams, widths in (("rgb", {24}), ("thermal", {12}), ("both", {24, 12})):
        assert set(manager(scene.path, streams=streams).training_views().size[:, 0]) == widths


def test_a_fisheye_lens_spans_its_angles():
    """120 and 60 degrees across and along: the border pixels are just within, the image of the pinhole ends there."""
    lens = cameras(CameraType.FISHEYE, 120, 60, 120 / np.deg2rad(120), 60 / np.deg2rad(60))
    views = views_of_cameras(lens)
    for number in range(2):
        middle_row = lens.generate_rays(number, keep_shape=True).directions[33].numpy()
        middle_column = lens.generate_rays(number, keep_shape=True).directions[:, 54].numpy()
        assert inside(views, number, middle_row).all() and inside(views, number, middle_column).all()
    ends = np.rad2deg(np.arctan2([views.centre[0], views.size[0] - views.centre[0]], views.focal[0]))
    np.testing.assert_allclose(ends, [[54, 33], [66, 27]], atol=0.5)


def test_a_panorama_sees_everything_once():
    lens = cameras(CameraType.EQUIRECTANGULAR, 64, 32, 32.0, 32.0)
    views = views_of_cameras(lens)
    assert views.camera_to_world.shape == (12, 3, 4) and (views.size == 16).all()
    rays = np.random.default_rng(0).normal(size=(500, 3))
    for first in (0, 6):
        seen = np.array([inside(views, number, rays) for number in range(first, first + 6)])
        assert (seen.sum(axis=0) == 1).all()
        np.testing.assert_allclose(
            views.camera_to_world[first : first + 6, :, 3], views.camera_to_world[first, :, 3][None].repeat(6, 0)
        )
    np.testing.assert_allclose(np.linalg.det(views.camera_to_world[:, :, :3]), 1.0, atol=1e-6)
