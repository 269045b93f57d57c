"""Photographs are read as small pinhole pictures: lenses, masks and sizes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from thermoxels_ns.multiview.photographs import read_photographs


class Frames:
    """A dataset of pictures whose red and green say where a pixel's ray goes: x and y on the plane at depth 1."""

    def __init__(self, width: int, height: int, distortion: list[float] | None, masked: bool = False):
        focal, kinds = 0.8 * width, CameraType.PERSPECTIVE
        poses = torch.eye(4)[None, :3].repeat(40, 1, 1)
        poses[:, 0, 3] = torch.arange(40.0)
        lens = None if distortion is None else torch.tensor([distortion])
        self.cameras = Cameras(
            poses, focal, focal, width / 2, height / 2, width, height, distortion_params=lens, camera_type=kinds
        )
        directions = self.cameras.generate_rays(camera_indices=0).directions
        x, y = directions[..., 0] / -directions[..., 2], directions[..., 1] / -directions[..., 2]
        picture = torch.stack((0.5 + 0.4 * x, 0.5 + 0.4 * y, torch.zeros_like(x)), -1)
        self.picture, self.masked = (255 * picture).round().to(torch.uint8), masked

    def get_image_uint8(self, index: int) -> torch.Tensor:
        return self.picture

    def get_mask(self, index: int) -> torch.Tensor | None:
        mask = torch.ones(*self.picture.shape[:2], 1, dtype=torch.bool)
        mask[: len(mask) // 4] = False
        return mask if self.masked else None


@pytest.mark.parametrize("distortion", [None, [-0.12, 0.03, 0.0, 0.0, 0.004, -0.006]])
@pytest.mark.parametrize(("width", "height"), [(120, 90), (1000, 750)])
def test_read_photographs_are_pinholes(distortion, width, height):
    read = read_photographs(Frames(width, height, distortion), most=32, longest_side=400)
    assert read is not None and len(read) == 32
    assert read.centres[0, 0] == 0.0 and read.centres[-1, 0] == 39.0 and len(set(read.centres[:, 0])) == 32
    assert tuple(read.sizes[3]) == ((120, 90) if width == 120 else (400, 300))
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.35, 0.35, 7))
    for k in (0, 17):
        points = np.stack((read.centres[k, 0] + 2 * x, 2 * y, np.full_like(x, -2.0), np.ones_like(x)), -1)
        u, v, depth = np.moveaxis(points @ read.matrices[k].T, -1, 0)
        assert depth == pytest.approx(2.0)
        picture = read.colours[read.firsts[k] :][: np.prod(read.sizes[k])].reshape(*read.sizes[k][::-1], 3)
        shown = picture[np.floor(v / depth).astype(int), np.floor(u / depth).astype(int)]
        pixel = 0.4 * 1.25 / read.sizes[k, 0]
        assert shown[..., 0] == pytest.approx(0.5 + 0.4 * x, abs=0.6 * pixel + 0.004)
        assert shown[..., 1] == pytest.approx(0.5 + 0.4 * y, abs=0.6 * pixel + 0.004)


def test_masks_of_read_photographs():
    read = read_photographs(Frames(600, 450, None, masked=True), most=32, longest_side=400)
    assert read is not None
    rows = np.isnan(read.colours[: np.prod(read.sizes[0])].reshape(*read.sizes[0][::-1], 3)).all((1, 2))
    assert rows[:75].all() and not rows[76:].any()


def test_other_lenses_are_left_out():
    frames = Frames(60, 40, None)
    kinds = torch.full((40, 1), CameraType.FISHEYE.value)
    frames.cameras.camera_type = kinds
    assert read_photographs(frames) is None
    kinds[3:9] = CameraType.PERSPECTIVE.value
    read = read_photographs(frames)
    assert read is not None and read.centres[:, 0].tolist() == [3.0, 4.0, 5.0, 6.0, 7.0, 8.0]
