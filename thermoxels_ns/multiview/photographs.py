"""Read photographs as small pinhole pictures, to be compared with each other."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from nerfstudio.cameras.cameras import Cameras, CameraType

from thermoxels_ns.multiview.photo_consistency import Photographs

MOST_PHOTOGRAPHS = 32
"""Photographs compared; of more, that many are taken at equal distances in the list."""
LONGEST_SIDE = 400
"""Pixels along the longer side at which photographs are compared; larger ones are averaged down."""


def read_photographs(
    dataset: Any,
    near: float = 0.0,
    left_out: Collection[int] = (),
    most: int = MOST_PHOTOGRAPHS,
    longest_side: int = LONGEST_SIDE,
) -> Photographs | None:
    """Read a selection of photographs as small pinhole pictures.

    Args:
        dataset: A `ThermalDataset` (any with cameras, get_image_uint8 and get_mask).
        near: Depth up to which they show nothing, [world units].
        left_out: Numbers of photographs that are not read.
        most: Photographs read; of more, that many are taken at equal distances in the list.
        longest_side: Pixels along the longer side; larger photographs are averaged down.

    Returns:
        The photographs of perspective cameras; None if there are none.
    """
    cameras = dataset.cameras.to("cpu")
    usable = np.flatnonzero(cameras.camera_type.numpy().reshape(-1) == CameraType.PERSPECTIVE.value)
    usable = usable[~np.isin(usable, list(left_out))]
    if len(usable) > most:
        usable = usable[np.linspace(0, len(usable) - 1, most).round().astype(int)]
    if not len(usable):
        return None
    pictures, matrices = zip(*(_pinhole(dataset, cameras, int(index), longest_side) for index in usable))
    sizes = np.array([(picture.shape[1], picture.shape[0]) for picture in pictures], dtype=np.int64)
    return Photographs(
        np.stack(matrices),
        cameras.camera_to_worlds[usable, :, 3].double().numpy(),
        sizes,
        np.concatenate(([0], np.cumsum(np.prod(sizes, axis=1))[:-1])),
        np.concatenate([picture.reshape(-1, 3) for picture in pictures]),
        near,
    )


def _pinhole(
    dataset: Any, cameras: Cameras, index: int, longest_side: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """A photograph averaged down and without distortion, shape (h, w, 3), and world -> homogeneous pixels, (3, 4)."""
    picture = dataset.get_image_uint8(index).numpy().astype(np.float32)
    picture /= np.float32(255.0)
    mask = dataset.get_mask(index)
    shown = np.ones(picture.shape[:2], np.float32) if mask is None else mask.numpy()[..., 0].astype(np.float32)
    height, width = picture.shape[:2]
    shrink = max(1.0, max(height, width) / longest_side)
    size = (max(2, round(width / shrink)), max(2, round(height / shrink)))
    if shrink > 1.0:
        picture, shown = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (picture, shown))
    size = (picture.shape[1], picture.shape[0])
    along_x, along_y = size[0] / width, size[1] / height
    focal = np.array([float(cameras.fx[index, 0]) * along_x, float(cameras.fy[index, 0]) * along_y])
    centre = np.array([float(cameras.cx[index, 0]) * along_x, float(cameras.cy[index, 0]) * along_y])
    distortion = None if cameras.distortion_params is None else cameras.distortion_params[index].double().numpy()
    if distortion is not None and np.any(distortion):
        places = _distorted_places(size, focal, centre, distortion)
        picture = cv2.remap(picture, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        shown = cv2.remap(shown, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0.0,))
    picture = np.where(shown[..., None] < 0.999, np.float32(np.nan), picture).astype(np.float32)
    pose = np.asarray(cameras.camera_to_worlds[index], dtype=np.float64)
    turned = pose[:, :3].T * np.array([[1.0], [-1.0], [-1.0]])  # x right, y down, z forward
    intrinsics = np.array([[focal[0], 0.0, centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]])
    return picture, intrinsics @ np.column_stack((turned, -turned @ pose[:, 3]))


def _distorted_places(
    size: tuple[int, int], focal: npt.NDArray, centre: npt.NDArray, distortion: npt.NDArray
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Where the pixels of a pinhole picture lie in the distorted one: columns and rows for `cv2.remap`.

    Brown's model with nerfstudio's coefficients k1, k2, k3, k4, p1, p2.
    """
    k1, k2, k3, k4, p1, p2 = distortion
    x, y = np.meshgrid(*((np.arange(n) + 0.5 - centre[i]) / focal[i] for i, n in enumerate(size)))
    r = x * x + y * y
    radial = 1.0 + r * (k1 + r * (k2 + r * (k3 + r * k4)))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x)
    v = y * radial + 2.0 * p2 * x * y + p1 * (r + 2.0 * y * y)
    return (
        (u * focal[0] + centre[0] - 0.5).astype(np.float32),
        (v * focal[1] + centre[1] - 0.5).astype(np.float32),
    )
