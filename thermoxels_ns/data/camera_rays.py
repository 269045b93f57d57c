"""Rays of all pixels of many photographs, addressed by one number, computed before training."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from thermoxels_ns.core.errors import SceneError

TABLE_LIMIT_BYTES = 2 * 1024**3
"""Above this the directions are computed per batch: scenes where every photograph has intrinsics of its own."""
_CHUNK = 1 << 17
_BYTES_PER_PIXEL = 16
_FISHEYE = CameraType.FISHEYE.value


class CameraRays:
    """Every pixel of every camera has one number: cameras in order, rows from the top, columns from the left.

    Directions in camera axes depend on the intrinsics only, so one table serves all photographs of a camera; a ray
    is then one look-up and one rotation. The table is filled by nerfstudio's `Cameras.generate_rays`, so lens
    distortion is the same as in evaluation.

    Attributes:
        first_pixel: Number of the first pixel of each camera and, last, the number of pixels, shape (n + 1,).
    """

    def __init__(
        self, cameras: Cameras, device: torch.device | str = "cpu", table_limit_bytes: int = TABLE_LIMIT_BYTES
    ) -> None:
        self.device = torch.device(device)
        self.cameras = cameras.to("cpu")
        self.widths = self.cameras.width.view(-1).to(torch.int64)
        self.heights = self.cameras.height.view(-1).to(torch.int64)
        sizes = self.widths * self.heights
        self.first_pixel = torch.cat([torch.zeros(1, dtype=torch.int64), sizes.cumsum(0)])
        self._first_pixel = self.first_pixel.to(self.device)
        poses = self.cameras.camera_to_worlds
        self._rotations = poses[:, :, :3].contiguous().to(self.device)
        self._origins = poses[:, :, 3].contiguous().to(self.device)

        models = self._models()
        _, first, self_model = np.unique(models, axis=0, return_index=True, return_inverse=True)
        model_sizes = sizes[torch.from_numpy(first)]
        self.has_table = int(model_sizes.sum()) * _BYTES_PER_PIXEL <= table_limit_bytes
        if self.has_table:
            starts = torch.cat([torch.zeros(1, dtype=torch.int64), model_sizes.cumsum(0)])[:-1]
            shift = starts[torch.from_numpy(self_model.reshape(-1))] - self.first_pixel[:-1]
            self._table_shift = shift.to(self.device)
            tables = [self._camera_axes(int(index)) for index in first]
            self._directions = torch.cat([directions for directions, _ in tables]).to(self.device)
            self._pixel_area = torch.cat([area for _, area in tables]).to(self.device)

    def __len__(self) -> int:
        return int(self.first_pixel[-1])

    def image_of(self, pixels: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
        """Return which camera each pixel number belongs to."""
        return torch.searchsorted(self._first_pixel, pixels, right=True) - 1

    def columns(self, pixels: Int[Tensor, " n"]) -> dict[str, Tensor]:
        """Return the rays through the centres of pixels, int64 numbers on the device of this object.

        Fields of a `RayBundle`: origins (n, 3), unit directions (n, 3), pixel_area (n, 1) and camera_indices (n, 1).
        """
        image = self.image_of(pixels)
        if self.has_table:
            place = pixels + self._table_shift.index_select(0, image)
            camera_axes = self._directions.index_select(0, place)[..., None]
            directions = torch.bmm(self._rotations.index_select(0, image), camera_axes)[..., 0]
            origins, area = self._origins.index_select(0, image), self._pixel_area.index_select(0, place)
        else:
            rays = self._generate(image.cpu(), (pixels - self._first_pixel[image]).cpu(), self.cameras)
            parts = (rays.directions, rays.origins, rays.pixel_area)
            directions, origins, area = (part.to(self.device) for part in parts)
        return {"origins": origins, "directions": directions, "pixel_area": area, "camera_indices": image[:, None]}

    def grid(self, stride: Int[Tensor, " images"]) -> Int[Tensor, " n"]:
        """Return the numbers of every `stride`-th pixel in both directions of every photograph, in order.

        The grid starts in the middle of its first cell, so that it prefers no border; a photograph smaller than its
        stride gives its middle pixel.
        """
        numbers = []
        for index, step in enumerate(stride.tolist()):
            width, height = int(self.widths[index]), int(self.heights[index])
            columns = torch.arange(min(step, width) // 2, width, step)
            rows = torch.arange(min(step, height) // 2, height, step)
            numbers.append((self.first_pixel[index] + rows[:, None] * width + columns[None, :]).reshape(-1))
        return torch.cat(numbers).to(self.device)

    def grid_sizes(self, stride: Int[Tensor, " images"]) -> Int[Tensor, " images"]:
        """Return how many pixels `grid` gives of every photograph."""

        def along(length: Tensor) -> Tensor:
            start = torch.minimum(stride, length) // 2
            return (length - start + stride - 1) // stride

        return along(self.widths) * along(self.heights)

    def _models(self) -> np.ndarray:
        """One row of numbers per camera; equal rows have equal directions in camera axes."""
        cameras = self.cameras
        parts = [cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.width, cameras.height, cameras.camera_type]
        if cameras.distortion_params is not None:
            parts.append(cameras.distortion_params)
        return torch.cat([part.to(torch.float64) for part in parts], dim=-1).numpy()

    def _camera_axes(self, index: int) -> tuple[Float[Tensor, "pixels 3"], Float[Tensor, "pixels 1"]]:
        """Directions and areas of all pixels of one camera, seen from the camera."""
        still = self.cameras[index : index + 1]
        still.camera_to_worlds = torch.eye(4)[None, :3]
        size = int(self.widths[index] * self.heights[index])
        directions, areas = torch.empty(size, 3), torch.empty(size, 1)
        for start in range(0, size, _CHUNK):
            local = torch.arange(start, min(start + _CHUNK, size))
            rays = self._generate(torch.zeros_like(local), local, still)
            directions[local], areas[local] = rays.directions, rays.pixel_area
        return directions, areas

    def _generate(self, image: Int[Tensor, " n"], local: Int[Tensor, " n"], cameras: Cameras) -> RayBundle:
        width = cameras.width.view(-1)[image]
        coords = torch.stack([local // width, local % width], dim=-1) + 0.5
        rays = cameras.generate_rays(image[:, None], coords=coords)
        finite = torch.isfinite(rays.directions).all(dim=1)
        if not bool((finite & torch.isfinite(rays.pixel_area[:, 0])).all()):
            _mend_optical_axis(rays, cameras, image, coords, ~finite)
        return rays


def _mend_optical_axis(
    rays: RayBundle, cameras: Cameras, image: Int[Tensor, " n"], coords: Float[Tensor, "n 2"], lost: Bool[Tensor, " n"]
) -> None:
    """Give the ray on the optical axis of a fisheye lens its limit, where nerfstudio divides 0 by 0.

    A `SceneError` is raised where a ray is lost elsewhere: the distortion cannot be undone there.
    """
    axis = torch.cat([cameras.cy, cameras.cx], dim=-1)[image]
    on_axis = ((coords - axis).abs().amax(dim=1) < 1e-3) & (cameras.camera_type.view(-1)[image] == _FISHEYE)
    if bool((lost & ~on_axis).any()):
        what = f"camera of photograph {int(image[lost & ~on_axis][0])}"
        remedy = "Check k1 to p2, or undistort the photographs."
        expected = "a lens distortion that can be undone in every pixel"
        got = f"{int((lost & ~on_axis).sum())} pixels without a finite ray"
        raise SceneError(what, expected=expected, got=got, remedy=remedy)
    rays.directions[lost] = -cameras.camera_to_worlds[image[lost], :, 2]
    area = 1.0 / (cameras.fx * cameras.fy)[image]
    rays.pixel_area = torch.where(torch.isfinite(rays.pixel_area), rays.pixel_area, area)
