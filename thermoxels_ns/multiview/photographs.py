"""Reading of photographs as small pinhole pictures that are compared with each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from thermoxels_ns.core.camera import Camera

MOST_PHOTOGRAPHS = 64  # Most photographs that are compared; from a longer list, evenly spaced ones are taken
SATURATED = 0.98  # Channel value, of 1, at or above which the scene may have been brighter than the pixel shows
LONGEST_SIDE = 160  # Pixels along the longer side of photographs that are compared; larger ones are averaged down


@dataclass(frozen=True, eq=False)
class Photographs:
    """Pinhole photographs, with the pixels of all of them in one array."""

    matrices: FloatArray  # World to homogeneous pixels, depth positive in front, shape (photographs, 3, 4)
    centres: FloatArray  # Camera centres, [world units], shape (photographs, 3)
    sizes: IntArray  # Width and height, [pixels], shape (photographs, 2)
    firsts: IntArray  # Index in `colours` of each photograph's upper left pixel, shape (photographs,)
    colours: Float32Array
    """Red, green, blue in [0, 1], photograph after photograph, row after row, shape (pixels, 3); NaN where masked."""
    thermal: Float32Array
    """Normalised temperature, shape (pixels,); NaN where unknown or where thermal images have a camera of their own."""
    near: float = 0.0  # Depth before which nothing stands, [world units]
    index: IntArray | None = None  # Index of each photograph in its dataset; None: not from a dataset
    measured: Float32Array | None = None
    """`colours` before gains were corrected, shape (pixels, 3); None: gains were not corrected."""

    @property
    def numbers(self) -> IntArray:
        """Index of the photograph to which each pixel belongs, shape (pixels,)."""
        return np.repeat(np.arange(len(self)), np.prod(self.sizes, axis=1))

    def __len__(self) -> int:
        return len(self.matrices)

    def moved(self, shift: FloatArray) -> Photographs:
        """Return the same photographs in a world in which all places lie farther on by `shift` (3,), [world units]."""
        matrices = self.matrices.copy()
        matrices[:, :, 3] -= self.matrices[:, :, :3] @ shift
        return replace(self, matrices=matrices, centres=self.centres + shift)

    def of_pixels(self, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return camera centres, and directions of depth 1, of the pixels `chosen` (n,), both (n, 3), world axes."""
        number = np.searchsorted(self.firsts, chosen, side="right") - 1
        place, width = chosen - self.firsts[number], self.sizes[number, 0]
        pixel = np.column_stack((place % width + 0.5, place // width + 0.5, np.ones(len(chosen))))
        return self.centres[number], np.einsum("nij,nj->ni", np.linalg.inv(self.matrices[:, :, :3])[number], pixel)

    def shown(self, number: int, points: FloatArray) -> tuple[IntArray, FloatArray, BoolArray]:
        """Return pixel index in `colours`, depth, and whether in view, of points (n, 3) in photograph `number`. Each
        has shape (n,). A point out of view has the index of the photograph's first pixel. Occlusion is ignored."""
        seen = points @ self.matrices[number, :, :3].T + self.matrices[number, :, 3]
        depth = seen[:, 2]
        place = np.floor(seen[:, :2] / np.where(depth > 0.0, depth, np.inf)[:, None]).astype(np.int64)
        inside = (depth > 0.0) & ((place >= 0) & (place < self.sizes[number])).all(1)
        place[~inside] = 0
        return self.firsts[number] + place[:, 1] * self.sizes[number, 0] + place[:, 0], depth, inside


def read_photographs(dataset: Any, near: float = 0.0, most: int = MOST_PHOTOGRAPHS) -> Photographs:
    """Return at most `most` evenly spaced photographs of a `ThermalDataset` as small pinhole pictures. Photographs with
    a side longer than `LONGEST_SIDE` are averaged down to this side. See `Photographs` for `near`."""
    chosen = np.linspace(0, len(dataset) - 1, min(most, len(dataset))).round().astype(int)
    pinholes = [_photograph(dataset, int(index)) for index in chosen]
    return replace(gathered(pinholes, [dataset.pose(index)[:, 3] for index in chosen], near), index=chosen)


Pinhole = tuple[Float32Array, Float32Array, FloatArray]
"""Three arrays: a photograph without distortion, (h, w, 3), NaN where masked; its normalised temperature, (h, w), NaN
where unknown; the matrix from the world to homogeneous pixels, (3, 4)."""


def gathered(pinholes: Sequence[Pinhole], centres: npt.ArrayLike, near: float = 0.0) -> Photographs:
    """Return pinhole photographs and their camera centres (photographs, 3), [world units], as one `Photographs`."""
    sizes = np.array([picture.shape[1::-1] for picture, _, _ in pinholes], dtype=np.int64)
    return Photographs(
        np.stack([matrix for _, _, matrix in pinholes]),
        np.asarray(centres, dtype=np.float64),
        sizes,
        np.concatenate(([0], np.cumsum(np.prod(sizes, axis=1))[:-1])),
        np.concatenate([picture.reshape(-1, 3) for picture, _, _ in pinholes]),
        np.concatenate([thermal.ravel() for _, thermal, _ in pinholes]),
        near,
    )


def _photograph(dataset: Any, index: int) -> Pinhole:
    picture, mask = dataset.get_image_uint8(index).numpy(), dataset.get_mask(index)
    camera, pose, thermal = dataset.camera(index), dataset.pose(index), None
    if dataset.thermal_cameras is None:
        warm, valid = (values.numpy()[..., 0] for values in dataset.get_thermal(index))
        thermal = np.where(valid, warm, np.nan).astype(np.float32)
    return pinhole(picture, None if mask is None else mask.numpy()[..., 0], camera, pose, thermal=thermal)


def thermal_at(dataset: Any, photographs: Photographs, depth: Float32Array) -> Float32Array:
    """Return the normalised temperature at the pixels of photographs, shape (pixels,); NaN where unknown.

    If the dataset has separate thermal cameras, the temperature is that of the thermal pixel which shows the point at
    `depth` (pixels,), and NaN if the depth is NaN. Occlusion is ignored, because both cameras stand side by side.
    """
    if dataset.thermal_cameras is None:
        return photographs.thermal
    found = np.full(len(depth), np.nan, np.float32)
    (sure,) = np.nonzero(np.isfinite(depth))
    assert photographs.index is not None
    origins, along = photographs.of_pixels(sure)
    points, number = origins + depth[sure, None] * along, photographs.numbers[sure]
    for place, index in enumerate(photographs.index.tolist()):
        camera, own = dataset.camera(index, thermal=True), number == place
        pixels = camera.project_world(dataset.pose(index, thermal=True), points[own])
        warm, valid = (values.numpy()[..., 0] for values in dataset.get_thermal(index))
        shown = camera.contains(pixels)
        column, row = (
            np.minimum(np.where(shown, pixels[:, axis], 0.0).astype(np.int64), warm.shape[1 - axis] - 1)
            for axis in (0, 1)
        )
        found[sure[own]] = np.where(shown & valid[row, column], warm[row, column], np.nan)
    return found


def pinhole(
    photograph: npt.NDArray[np.uint8],
    mask: BoolArray | None,
    camera: Camera,
    pose: FloatArray,
    longest_side: int = LONGEST_SIDE,
    thermal: Float32Array | None = None,
) -> Pinhole:
    """Return a photograph (h, w, 3) as a `Pinhole`, averaged down to `longest_side` pixels and without distortion.

    Pixels that are False in `mask` (h, w) become NaN; None: no mask. `thermal` is the normalised temperature by the
    same camera, at any resolution; None: unknown. `pose` is camera to world, (3, 4) or (4, 4), OpenGL axes.
    """
    picture = photograph.astype(np.float32)
    picture /= np.float32(255.0)
    shown = np.ones(picture.shape[:2], np.float32) if mask is None else mask.astype(np.float32)
    height, width = picture.shape[:2]
    shrink = max(1.0, max(height, width) / longest_side)
    size = (max(2, round(width / shrink)), max(2, round(height / shrink)))
    if shrink > 1.0:
        picture, shown = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (picture, shown))
    warm = np.full(size[::-1], np.nan, np.float32)
    if thermal is not None:
        warm = np.asarray(cv2.resize(thermal, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    camera = camera.resized(picture.shape[1], picture.shape[0])
    if any(camera.distortion):
        places = _distorted_places(camera)
        picture = cv2.remap(picture, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        shown = cv2.remap(shown, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0.0,))
        warm = cv2.remap(warm, *places, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,))
    picture = np.where(shown[..., None] < 0.999, np.float32(np.nan), picture).astype(np.float32)
    turned = pose[:3, :3].T * np.array([[1.0], [-1.0], [-1.0]])  # x right, y down, z forward
    intrinsics = np.array([[camera.fl_x, 0.0, camera.cx], [0.0, camera.fl_y, camera.cy], [0.0, 0.0, 1.0]])
    to_pixels = intrinsics @ np.column_stack((turned, -turned @ pose[:3, 3]))
    return picture, np.asarray(warm, dtype=np.float32), to_pixels


def _distorted_places(camera: Camera) -> tuple[Float32Array, Float32Array]:
    """Return columns and rows, (h, w) each, in the distorted picture of each undistorted pixel, for `cv2.remap`."""
    pinhole = replace(camera, k1=0.0, k2=0.0, k3=0.0, k4=0.0, p1=0.0, p2=0.0)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    pixels = camera.project(pinhole.rays(np.column_stack((columns.ravel() + 0.5, rows.ravel() + 0.5)))) - 0.5
    x, y = pixels.reshape(camera.height, camera.width, 2).astype(np.float32).transpose(2, 0, 1)
    return np.ascontiguousarray(x), np.ascontiguousarray(y)
