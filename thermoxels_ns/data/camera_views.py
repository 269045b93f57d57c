"""Training cameras as pinholes, for the question which surfaces they looked at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from nerfstudio.cameras.cameras import Cameras, CameraType

from thermoxels_ns.core.snapshot import Views

_WIDEST = np.deg2rad(80.0)
"""Angle from the optical axis up to which a pinhole stands for a fisheye lens."""
_CUBE = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    ],
    dtype=np.float64,
)
"""Rotations, by columns x right, y up, z back, whose view directions are the six half axes."""


def views_of_cameras(cameras: Sequence[Cameras]) -> Views:
    """Describe cameras by pinholes without distortion, in order.

    Lens distortion is ignored, so at the border of a distorted photograph a view reaches a little too far or not far
    enough. A fisheye lens becomes a pinhole with the same focal length whose image spans the same angles along both
    axes, at most 80 degrees to each side; a panorama (equirectangular) becomes the six sides of a cube.

    Args:
        cameras: Cameras of the trained scene.

    Returns:
        The views in the coordinates of the trained scene.
    """
    parts = [_views(each.to("cpu")) for each in cameras]
    return Views(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ("camera_to_world", "focal", "centre")),
        size=np.concatenate([part.size for part in parts]),
    )


def _views(cameras: Cameras) -> Views:
    def pairs(first: str, second: str, kind: npt.DTypeLike = np.float64) -> npt.NDArray:
        return np.stack([getattr(cameras, name).numpy().reshape(-1).astype(kind) for name in (first, second)], axis=1)

    pose = cameras.camera_to_worlds.numpy().astype(np.float64)
    focal, centre, size = pairs("fx", "fy"), pairs("cx", "cy"), pairs("width", "height", np.int64)
    kind = cameras.camera_type.numpy().reshape(-1)

    fisheye = kind == CameraType.FISHEYE.value
    before = focal * np.tan(np.clip(centre / focal, -_WIDEST, _WIDEST))
    behind = focal * np.tan(np.clip((size - centre) / focal, -_WIDEST, _WIDEST))
    centre = np.where(fisheye[:, None], before, centre)
    size = np.where(fisheye[:, None], np.ceil(before + behind).astype(np.int64), size)

    panorama = kind == CameraType.EQUIRECTANGULAR.value
    sides = np.where(panorama, len(_CUBE), 1)
    of = np.repeat(np.arange(len(pose)), sides)
    pose, focal, centre, size = pose[of], focal[of], centre[of], size[of]
    cube = panorama[of]
    turned = np.einsum("nij,njk->nik", pose[cube][:, :, :3], np.tile(_CUBE, (np.count_nonzero(panorama), 1, 1)))
    pose[cube, :, :3] = turned
    # A side spans a quarter of the horizon.
    side = np.maximum(1, size[cube, :1] // 4)
    focal[cube], centre[cube], size[cube] = 0.5 * side, 0.5 * side, side
    return Views(pose, focal, centre, size)
