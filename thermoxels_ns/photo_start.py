"""Start a training from where its photographs agree: read some of them small, set the density, say what was found."""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.field.voxel_grid import DensityActivation
from thermoxels_ns.photo_consistency import DensityStart, Photographs, density_from_photographs

if TYPE_CHECKING:
    from thermoxels_ns.model import ThermoxelsModel

MOST_PHOTOGRAPHS = 32
"""Photographs compared; of more, that many are taken at equal distances in the list."""
LONGEST_SIDE = 400
"""Pixels along the longer side at which photographs are compared; larger ones are averaged down."""
SMALLEST_EPS = 1e-8
"""Least eps of the density's optimiser: what photographs say must not be undone by rows with next to no gradient,
which a smaller one moves as fast as all others."""


def set_density(model: ThermoxelsModel, found: DensityStart) -> None:
    """Set the density of an untrained grid from what photographs say.

    Args:
        model: The model, on the lattice on which a start from photographs begins.
        found: Made for that lattice, see `find_start`; they say something.
    """
    assert found.log_gain is not None
    grid, config = model.grid, model.config
    factors = torch.from_numpy(found.log_gain.reshape(-1)[grid.voxels.corners]).double().exp()
    start = _raw(config.start_density / model.unit * factors, grid.activation)
    with torch.no_grad():
        grid.density.copy_(start[:, None].to(grid.density))


def hold_density(optimizer: torch.optim.Optimizer, step: int, hold: int) -> None:
    """Set the density's optimiser for a step of a training that started from photographs.

    For `hold` steps the density stands, while colours are still those of nothing; its gradients are already followed.

    Args:
        optimizer: That of the density; its scheduler sets the learning rate anew after each step.
        step: The step that comes.
        hold: First step at which the density moves.
    """
    for group in optimizer.param_groups:
        group["eps"] = max(group["eps"], SMALLEST_EPS)
        if step < hold:
            group["lr"] = 0.0


def _raw(density: torch.Tensor, activation: DensityActivation) -> torch.Tensor:
    """What the activation maps to densities above 0."""
    if activation == "relu":
        return density
    return torch.log(density) if activation == "exp" else density + torch.log(-torch.expm1(-density))


def find_start(model: ThermoxelsModel, datamanager: Any, left_out: Collection[int] = ()) -> DensityStart:
    """Ask the photographs, for the lattice on which a start from them begins, and say what was found.

    Args:
        model: The untrained model.
        datamanager: Has the photographs.
        left_out: Numbers of training photographs that are not asked.
    """
    begin = time.perf_counter()
    found = _find(model, datamanager, left_out)
    if found.log_gain is not None:
        CONSOLE.log(f"photographs: {found.report}; {time.perf_counter() - begin:.1f} s")
    return found


def _find(model: ThermoxelsModel, datamanager: Any, left_out: Collection[int]) -> DensityStart:
    if model.grid.sh is None or datamanager.config.streams == "thermal":
        return DensityStart(None, "no photographs train")
    photographs = read_photographs(datamanager.train_dataset, model.config.near_plane * model.unit, left_out)
    if photographs is None:
        return DensityStart(None, "no photograph is one of a perspective camera")
    return density_from_photographs(model.grid.lattice.refined(model.config.skipped_factor()), photographs)


def read_photographs(dataset: Any, near: float = 0.0, left_out: Collection[int] = ()) -> Photographs | None:
    """Read a selection of photographs as small pinhole pictures.

    Args:
        dataset: A `ThermalDataset` (any with cameras, get_image_uint8 and get_mask).
        near: Depth up to which they show nothing, [world units].
        left_out: Numbers of photographs that are not read.

    Returns:
        The photographs of perspective cameras; None if there are none.
    """
    cameras = dataset.cameras.to("cpu")
    usable = np.flatnonzero(cameras.camera_type.numpy().reshape(-1) == CameraType.PERSPECTIVE.value)
    usable = usable[~np.isin(usable, list(left_out))]
    if len(usable) > MOST_PHOTOGRAPHS:
        usable = usable[np.linspace(0, len(usable) - 1, MOST_PHOTOGRAPHS).round().astype(int)]
    if not len(usable):
        return None
    pictures, matrices = zip(*(_pinhole(dataset, cameras, int(index)) for index in usable))
    sizes = np.array([(picture.shape[1], picture.shape[0]) for picture in pictures], dtype=np.int64)
    return Photographs(
        np.stack(matrices),
        cameras.camera_to_worlds[usable, :, 3].double().numpy(),
        sizes,
        np.concatenate(([0], np.cumsum(np.prod(sizes, axis=1))[:-1])),
        np.concatenate([picture.reshape(-1, 3) for picture in pictures]),
        near,
    )


def _pinhole(dataset: Any, cameras: Cameras, index: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64]]:
    """A photograph averaged down and without distortion, shape (h, w, 3), and world -> homogeneous pixels, (3, 4)."""
    picture = dataset.get_image_uint8(index).numpy().astype(np.float32)
    picture /= np.float32(255.0)
    mask = dataset.get_mask(index)
    shown = np.ones(picture.shape[:2], np.float32) if mask is None else mask.numpy()[..., 0].astype(np.float32)
    height, width = picture.shape[:2]
    shrink = max(1.0, max(height, width) / LONGEST_SIDE)
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
