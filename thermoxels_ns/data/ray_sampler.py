"""Rays of a split with what their pixels saw, drawn at random or on a grid."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Int
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.ray_streams import RGB_STREAM, THERMAL_STREAM
from thermoxels_ns.data.camera_rays import CameraRays
from thermoxels_ns.data.dataset import ThermalDataset

Streams = Literal["both", "rgb", "thermal"]
_BITS = {"both": RGB_STREAM | THERMAL_STREAM, "rgb": RGB_STREAM, "thermal": THERMAL_STREAM}


class RaySampler:
    """Pixels of a `ThermalDataset` in memory, drawn at random or on a regular grid.

    Where a pair shares its camera, a ray through a photograph's pixel carries both targets, and the thermal target
    only where the thermal pixel is valid. Else the thermal cameras have rays of their own, drawn among valid pixels.
    Photographs are decoded at the first draw, so that the grids (which need no colour) are cheap. Tables live in
    `storage`, batches go to `device`.
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
        self._colour_rays: CameraRays | None = None
        self._thermal_rays: CameraRays | None = None
        self._colours: Tensor | None = None

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
        self._thermal_pixels = _numbers(self._valid, "thermal pixels", "Check the masks and the thermal files.")
        self._valid = self._valid.to(self.storage)

    @property
    def colour_rays(self) -> CameraRays:
        """Rays of the photographs."""
        if self._colour_rays is None:
            self._colour_rays = CameraRays(self.dataset.cameras, self.storage)
        return self._colour_rays

    @property
    def thermal_rays(self) -> CameraRays:
        """Rays of the thermal images; the photographs' where the camera is shared."""
        if self.dataset.thermal_cameras is None:
            return self.colour_rays
        if self._thermal_rays is None:
            self._thermal_rays = CameraRays(self.dataset.thermal_cameras, self.storage)
        return self._thermal_rays

    def load(self) -> None:
        """Decode all photographs that the streams need and fill the tables of rays."""
        if self.streams != "thermal":
            self._load_colours()
            _ = self.colour_rays
        if self.streams != "rgb":
            _ = self.thermal_rays

    def draw(self, generator: torch.Generator, rgb_rays: int, thermal_rays: int) -> tuple[RayBundle, dict[str, Tensor]]:
        """Draw rays with equal chance for every pixel, with replacement; numbers from the CPU, so that devices agree.

        With the streams "thermal" and a shared camera `rgb_rays` go through thermal pixels; `thermal_rays` count where
        thermal cameras are not the photographs'.

        Returns:
            Rays (colour first, then thermal only) and the targets ``image`` (n, 3) and ``thermal`` (n, 1), float32 and
            0 where the ray has no such target.
        """
        columns: list[dict[str, Tensor]] = []
        bits, images, temperatures = [], [], []
        if self.streams != "thermal":
            pixels = self._pick(self._rgb_pixels, len(self.colour_rays), rgb_rays, generator)
            columns.append(self.colour_rays.columns(pixels))
            images.append(self._load_colours().index_select(0, pixels).to(self.device).to(torch.float32) / 255.0)
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

    def grid(self, stream: int, stride: int, max_rays_per_image: int | None, chunk: int) -> Iterator[RayBundle]:
        """Give the usable pixels of a stream on a regular grid, see `ThermalDataManager.training_rays`."""
        if not 0 < stream <= RGB_STREAM | THERMAL_STREAM or min(stride, chunk, max_rays_per_image or 1) < 1:
            raise ValueError(f"no such grid: {stream=}, {stride=}, {max_rays_per_image=}, {chunk=}")
        wanted = stream & _BITS[self.streams]
        if wanted & RGB_STREAM:
            pixels = _regular(self.colour_rays, stride, max_rays_per_image)
            if self._allowed is not None:
                pixels = pixels[self._allowed.to(pixels.device)[pixels]]
            both = self.shared and bool(wanted & THERMAL_STREAM)
            for part in pixels.split(chunk):
                bits = torch.full((len(part), 1), RGB_STREAM, dtype=torch.uint8, device=part.device)
                if both:
                    bits += THERMAL_STREAM * self._valid[part][:, None]
                yield self._bundle(self.colour_rays.columns(part), bits)
        if wanted & THERMAL_STREAM and not (self.shared and wanted & RGB_STREAM):
            pixels = _regular(self.thermal_rays, stride, max_rays_per_image)
            for part in pixels[self._valid[pixels]].split(chunk):
                bits = torch.full((len(part), 1), THERMAL_STREAM, dtype=torch.uint8, device=part.device)
                yield self._bundle(self.thermal_rays.columns(part), bits)

    def _bundle(self, columns: dict[str, Tensor], bits: Int[Tensor, "n 1"]) -> RayBundle:
        moved = {name: column.to(self.device, non_blocking=True) for name, column in columns.items()}
        return RayBundle(**moved, metadata={"stream": bits.to(self.device, non_blocking=True)})

    def _load_colours(self) -> Tensor:
        """All photographs one after the other, shape (pixels, 3), uint8."""
        if self._colours is None:
            first = self.colour_rays.first_pixel.tolist()
            colours = torch.empty(first[-1], 3, dtype=torch.uint8)
            for index in range(len(self.dataset)):
                colours[first[index] : first[index + 1]] = self.dataset.get_image_uint8(index).reshape(-1, 3)
            self._colours = colours.to(self.storage)
        return self._colours

    def _pick(
        self, numbers: Tensor | None, total: int, count: int, generator: torch.Generator
    ) -> Int[Tensor, " count"]:
        size = total if numbers is None else len(numbers)
        drawn = torch.randint(size, (count,), generator=generator)
        if numbers is not None:
            drawn = numbers.index_select(0, drawn).to(torch.int64)
        return drawn.to(self.storage)


def _regular(rays: CameraRays, stride: int, max_rays_per_image: int | None) -> Int[Tensor, " n"]:
    """Pixels of a regular grid in every photograph, at most `max_rays_per_image` of each."""
    strides = torch.full_like(rays.widths, stride)
    if max_rays_per_image is not None:
        # Rows and columns are rounded up, so the square root alone may give a few pixels too many.
        enough = (rays.widths * rays.heights / max_rays_per_image).sqrt().to(torch.int64).clamp(min=1)
        while bool((too_many := rays.grid_sizes(enough) > max_rays_per_image).any()):
            enough = enough + too_many.to(torch.int64)
        strides = torch.maximum(strides, enough)
    return rays.grid(strides)


def draw_generator(*key: int) -> torch.Generator:
    """Make a generator on the CPU whose numbers depend on `key` alone (non-negative integers).

    torch seeds its CPU generator with 32 bits, so the key is hashed first instead of added up.
    """
    return torch.Generator().manual_seed(int(np.random.SeedSequence(key).generate_state(1)[0]))


def _numbers(usable: Bool[Tensor, " pixels"] | None, name: str, remedy: str) -> Int[Tensor, " usable"] | None:
    """Numbers of the usable pixels, or None if all are."""
    if usable is None or bool(usable.all()):
        return None
    numbers = usable.nonzero()[:, 0]
    if len(numbers) == 0:
        raise SceneError(name, expected="at least one that is not masked", got="none", remedy=remedy)
    return numbers.to(torch.int32) if len(usable) < 2**31 else numbers
