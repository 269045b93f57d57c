"""Rays of a split and the colours and temperatures of their pixels, drawn at random or on a grid of pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from itertools import count
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.feature_rays import RGB_STREAM, THERMAL_STREAM
from thermoxels_ns.data.dataset import ThermalDataset

Streams = Literal["both", "rgb", "thermal"]
_BITS = {"both": RGB_STREAM | THERMAL_STREAM, "rgb": RGB_STREAM, "thermal": THERMAL_STREAM}
_CHUNK = 1 << 17
_GRID_RAYS = 1 << 14  # most rays of a bundle of `grid`


class RaySampler:
    """All pixels of a `ThermalDataset` in memory. Rays through them are drawn at random or on a regular grid.

    If photographs and thermal images share cameras, a ray carries a colour and, if its thermal pixel is valid, also a
    temperature. Otherwise the thermal cameras have rays of their own, through valid pixels. Photographs are decoded at
    the first draw: a grid needs no colours and is cheap. Tables are kept on the device `storage`; batches are moved to
    `device`. `streams` names the images that train.
    """

    def __init__(
        self,
        dataset: ThermalDataset,
        streams: Streams = "both",
        storage: torch.device | str = "cpu",
        device: torch.device | str = "cpu",
    ) -> None:
        self.dataset = dataset
        self.streams: Streams = streams
        self.storage, self.device = torch.device(storage), torch.device(device)
        self.shared = dataset.thermal_cameras is None

        thermal, valid = zip(*(dataset.get_thermal(index) for index in range(len(dataset))))
        self._temperatures = torch.cat([image.reshape(-1) for image in thermal]).to(self.storage)
        self._valid = torch.cat([image.reshape(-1) for image in valid])
        self._allowed: Tensor | None = None
        masks = [dataset.get_mask(index) for index in range(len(dataset))]
        if masks[0] is not None:
            self._allowed = torch.cat([mask.reshape(-1) for mask in masks if mask is not None])
            if self.shared:
                self._valid &= self._allowed
        self._rgb_pixels = _numbers(self._allowed, "colour pixels", "Check the masks.")
        self._thermal_pixels = None
        if dataset.temperature_range is not None:
            self._thermal_pixels = _numbers(self._valid, "thermal pixels", "Check the masks and the thermal files.")
        self._valid = self._valid.to(self.storage)

    @cached_property
    def colour_rays(self) -> CameraRays:
        """Rays of all pixels of the photographs."""
        return CameraRays(self.dataset.cameras, self.storage)

    @cached_property
    def thermal_rays(self) -> CameraRays:
        """Rays of all pixels of the thermal images; `colour_rays` if cameras are shared."""
        cameras = self.dataset.thermal_cameras
        return self.colour_rays if cameras is None else CameraRays(cameras, self.storage)

    @cached_property
    def _colours(self) -> Tensor:
        """All photographs one after the other, shape (pixels, 3), uint8."""
        first = self.colour_rays.first_pixel.tolist()
        colours = torch.empty(first[-1], 3, dtype=torch.uint8)
        for index in range(len(self.dataset)):
            colours[first[index] : first[index + 1]] = self.dataset.get_image_uint8(index).reshape(-1, 3)
        return colours.to(self.storage)

    def load(self) -> None:
        """Decode all photographs and make the tables of rays, if the streams that train need them."""
        if self.streams != "thermal":
            _ = self._colours
        if self.streams != "rgb":
            _ = self.thermal_rays

    def draw(self, generator: torch.Generator, rgb_rays: int, thermal_rays: int) -> tuple[RayBundle, dict[str, Tensor]]:
        """Return random rays and their targets. Pixels are drawn with replacement, all usable ones with equal chance.

        `rgb_rays` and `thermal_rays` are the numbers of rays through photographs and thermal images. With shared
        cameras, `thermal_rays` is ignored; if `streams` is then "thermal", `rgb_rays` rays go through valid thermal
        pixels. Rays through photographs come first. The targets are ``image`` (n, 3) in [0, 1] and ``thermal`` (n, 1),
        normalised, both float32, and 0 for a ray without this target.
        """
        columns: list[dict[str, Tensor]] = []
        bits, images, temperatures = [], [], []
        if self.streams != "thermal":
            pixels = self._pick(self._rgb_pixels, len(self.colour_rays), rgb_rays, generator)
            columns.append(self.colour_rays.columns(pixels))
            images.append(self._colours.index_select(0, pixels).to(self.device).to(torch.float32) / 255.0)
            stream = torch.full((rgb_rays, 1), RGB_STREAM, dtype=torch.uint8, device=self.storage)
            temperature = torch.zeros(rgb_rays, 1, device=self.storage)
            if self.shared and self.streams == "both":
                valid = self._valid.index_select(0, pixels)[:, None]
                stream += THERMAL_STREAM * valid
                temperature = self._temperatures.index_select(0, pixels)[:, None]  # is 0 where invalid
                temperature = temperature * valid if self._allowed is not None else temperature
            bits.append(stream)
            temperatures.append(temperature)
        if self.streams == "thermal" or (self.streams == "both" and not self.shared):
            count = rgb_rays if self.shared else thermal_rays
            pixels = self._pick(self._thermal_pixels, len(self.thermal_rays), count, generator)
            columns.append(self.thermal_rays.columns(pixels))
            images.append(torch.zeros(count, 3, device=self.device))
            bits.append(torch.full((count, 1), THERMAL_STREAM, dtype=torch.uint8, device=self.storage))
            temperatures.append(self._temperatures.index_select(0, pixels)[:, None])
        rays = {name: torch.cat([part[name] for part in columns]) for name in columns[0]}
        batch = {"image": torch.cat(images), "thermal": torch.cat(temperatures).to(self.device)}
        return self._bundle(rays, torch.cat(bits)), batch

    def grid(self, stream: int, max_rays_per_image: int | None) -> Iterator[RayBundle]:
        """Yield bundles of rays through the usable pixels of a grid, see `ThermalDataManager.training_rays`."""
        wanted = stream & _BITS[self.streams]
        if wanted & RGB_STREAM:
            pixels = self.colour_rays.grid(max_rays_per_image)
            if self._allowed is not None:
                pixels = pixels[self._allowed.to(pixels.device)[pixels]]
            both = self.shared and bool(wanted & THERMAL_STREAM)
            for part in pixels.split(_GRID_RAYS):
                bits = torch.full((len(part), 1), RGB_STREAM, dtype=torch.uint8, device=part.device)
                if both:
                    bits += THERMAL_STREAM * self._valid[part][:, None]
                yield self._bundle(self.colour_rays.columns(part), bits)
        if wanted & THERMAL_STREAM and not (self.shared and wanted & RGB_STREAM):
            pixels = self.thermal_rays.grid(max_rays_per_image)
            for part in pixels[self._valid[pixels]].split(_GRID_RAYS):
                bits = torch.full((len(part), 1), THERMAL_STREAM, dtype=torch.uint8, device=part.device)
                yield self._bundle(self.thermal_rays.columns(part), bits)

    def _bundle(self, columns: dict[str, Tensor], bits: Int[Tensor, "n 1"]) -> RayBundle:
        moved = {name: column.to(self.device, non_blocking=True) for name, column in columns.items()}
        return RayBundle(**moved, metadata={"stream": bits.to(self.device, non_blocking=True)})

    def _pick(
        self, numbers: Tensor | None, total: int, count: int, generator: torch.Generator
    ) -> Int[Tensor, " count"]:
        size = total if numbers is None else len(numbers)
        drawn = torch.randint(size, (count,), generator=generator)
        if numbers is not None:
            drawn = numbers.index_select(0, drawn).to(torch.int64)
        return drawn.to(self.storage)


def draw_generator(*key: int) -> torch.Generator:
    """Return a random generator on the CPU, seeded with a hash of `key` (non-negative integers).

    The hash has 32 bits, because torch seeds its CPU generator with no more.
    """
    return torch.Generator().manual_seed(int(np.random.SeedSequence(key).generate_state(1)[0]))


def _numbers(usable: Bool[Tensor, " pixels"] | None, name: str, remedy: str) -> Int[Tensor, " usable"] | None:
    """Return the indices of the usable pixels; None if all are usable or the mask is None. Raises `SceneError` if none
    is usable; `name` and `remedy` are for its message."""
    if usable is None or bool(usable.all()):
        return None
    numbers = usable.nonzero()[:, 0]
    if len(numbers) == 0:
        raise SceneError(name, expected="at least one that is not masked", got="none", remedy=remedy)
    return numbers.to(torch.int32) if len(usable) < 2**31 else numbers


class CameraRays:
    """Rays of all pixels of n `cameras`, numbered camera by camera, rows from the top, columns from the left.

    Directions in camera axes depend on the intrinsics alone. Cameras with equal intrinsics therefore share one table of
    directions, and a ray costs one look-up and one rotation. nerfstudio's `Cameras.generate_rays` fills the table, so
    that lens distortion is the same as in evaluation. `first_pixel` (n + 1,) is the number of each camera's first pixel
    and, as last entry, the number of all pixels.
    """

    def __init__(self, cameras: Cameras, device: torch.device | str = "cpu") -> None:
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
        self._areas = (1.0 / (self.cameras.fx * self.cameras.fy)).to(self.device)

        # Cameras with equal rows in `models` have equal directions in camera axes.
        names = ["fx", "fy", "cx", "cy", "width", "height", "distortion_params"]
        parts = [part.double() for name in names if (part := getattr(self.cameras, name)) is not None]
        models = torch.cat(parts, dim=-1).numpy()
        _, first, self_model = np.unique(models, axis=0, return_index=True, return_inverse=True)
        model_sizes = sizes[torch.from_numpy(first)]
        starts = torch.cat([torch.zeros(1, dtype=torch.int64), model_sizes.cumsum(0)])[:-1]
        shift = starts[torch.from_numpy(self_model.reshape(-1))] - self.first_pixel[:-1]
        self._table_shift = shift.to(self.device)
        self._directions = torch.cat([self._camera_axes(int(index)) for index in first]).to(self.device)

    def __len__(self) -> int:
        return int(self.first_pixel[-1])

    def columns(self, pixels: Int[Tensor, " n"]) -> dict[str, Tensor]:
        """Return fields of `RayBundle` by name for the rays through the centres of the pixels numbered `pixels` (n,).
        They are origins (n, 3), unit directions (n, 3), camera_indices (n, 1), and pixel_area (n, 1), the area at
        distance 1 that a pixel in the middle of the image covers. `pixels` must be on `self.device`."""
        image = torch.searchsorted(self._first_pixel, pixels, right=True) - 1
        place = pixels + self._table_shift.index_select(0, image)
        camera_axes = self._directions.index_select(0, place)[..., None]
        return {
            "origins": self._origins.index_select(0, image),
            "directions": torch.bmm(self._rotations.index_select(0, image), camera_axes)[..., 0],
            "pixel_area": self._areas.index_select(0, image),
            "camera_indices": image[:, None],
        }

    def grid(self, most: int | None) -> Int[Tensor, " n"]:
        """Return the numbers of every k-th pixel in both directions of each image, in ascending order.

        In each image, k is the smallest step that gives at most `most` pixels (None: k = 1). The grid starts in the
        middle of its first cell, so that no border is preferred. Along a side shorter than k, only the middle is used.
        """
        numbers = []
        for first, width, height in zip(self.first_pixel, self.widths.tolist(), self.heights.tolist()):
            # Rows and columns are rounded up, so the square root alone may give a few pixels too many.
            for step in count(max(math.isqrt(width * height // (most or width * height)), 1)):
                columns, rows = (torch.arange(min(step, side) // 2, side, step) for side in (width, height))
                if most is None or len(columns) * len(rows) <= most:
                    break
            numbers.append((first + rows[:, None] * width + columns[None, :]).reshape(-1))
        return torch.cat(numbers).to(self.device)

    def _camera_axes(self, index: int) -> Float[Tensor, "pixels 3"]:
        """Return unit ray directions in camera axes for all pixels of camera `index`, (pixels, 3). Raises `SceneError`
        if the lens distortion cannot be undone in a pixel."""
        still = self.cameras[index : index + 1]
        still.camera_to_worlds = torch.eye(4)[None, :3]
        width = int(self.widths[index])
        pixels = torch.arange(width * int(self.heights[index]))
        coords = torch.stack([pixels // width, pixels % width], dim=-1) + 0.5
        directions = torch.empty(len(pixels), 3)
        for part in pixels.split(_CHUNK):
            directions[part] = still.generate_rays(torch.zeros_like(part)[:, None], coords=coords[part]).directions
        lost = ~torch.isfinite(directions).all(dim=1)
        if bool(lost.any()):
            expected = "a lens distortion that can be undone in every pixel"
            got = f"{int(lost.sum())} pixels without a finite ray"
            remedy = "Check k1 to p2, or undistort the photographs."
            raise SceneError(f"camera of photograph {index}", expected=expected, got=got, remedy=remedy)
        return directions
