"""Cameras as transforms.json writes them: one pose and one set of intrinsics, checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType
from PIL import Image

from thermoxels_ns.core.errors import SceneError

# One centre per camera: the training rays store one direction per pixel and one origin per photograph.
_CENTRAL = (CameraType.PERSPECTIVE, CameraType.FISHEYE, CameraType.EQUIRECTANGULAR)


@dataclass(frozen=True)
class Intrinsics:
    """One camera's projection in pixels; the centre of the top left pixel is at (0.5, 0.5)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """OpenCV's k1, k2, k3, k4, p1, p2 in nerfstudio's order."""
    camera_type: int = CameraType.PERSPECTIVE.value

    def resized(self, width: int, height: int) -> Intrinsics:
        """Same camera, its image sampled with another number of pixels; distortion does not change."""
        x, y = width / self.width, height / self.height
        return Intrinsics(
            width, height, self.fx * x, self.fy * y, self.cx * x, self.cy * y, self.distortion, self.camera_type
        )

    def scaled(self, factor: float) -> Intrinsics:
        """Same camera with pixels `1 / factor` times as large; a last part of a pixel is cut off."""
        width, height = (max(int(length * factor + 1e-6), 1) for length in (self.width, self.height))
        focal = (self.fx * factor, self.fy * factor, self.cx * factor, self.cy * factor)
        return Intrinsics(width, height, *focal, self.distortion, self.camera_type)


def read_pose(values: Any, where: str) -> npt.NDArray[np.float64]:
    """Check a camera-to-world matrix (3 x 4 or 4 x 4): finite, and a rotation in its upper left."""
    try:
        matrix = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise SceneError(where, expected="4 x 4 numbers", got=f"shape {matrix.shape}", remedy="Correct the json.")
    pose = np.eye(4)
    pose[:3] = matrix[:3]
    remedy = "Remove the frame or run structure from motion again."
    if not np.isfinite(pose).all():
        raise SceneError(where, expected="finite numbers", got="NaN or infinity", remedy=remedy)
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-2 or np.linalg.det(rotation) < 0:
        raise SceneError(where, expected="a rotation in the upper left 3 x 3", got=rotation.tolist(), remedy=remedy)
    return pose


def read_intrinsics(meta: dict[str, Any], entry: dict[str, Any], image: Path | None, where: str) -> Intrinsics:
    """Read a camera; the frame's own values go before the scene's, the image's size before nothing."""
    values = {**meta, **entry}
    remedy = "Correct the json."
    model = values.get("camera_model", "OPENCV")
    camera_type = CAMERA_MODEL_TO_TYPE.get(model) if isinstance(model, str) else None
    if camera_type not in _CENTRAL:
        raise SceneError(
            f"{where}: camera_model",
            expected="PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, OPENCV_FISHEYE or EQUIRECTANGULAR",
            got=model,
            remedy="Undistort the photographs to a pinhole camera.",
        )
    size = _image_size(image, where) if image is not None else None
    try:
        width, height = (
            int(values[key]) if size is None else int(values.get(key, size[i])) for i, key in enumerate("wh")
        )
        focal = tuple(float(values[key]) for key in ("fl_x", "fl_y", "cx", "cy"))
        if "distortion_params" in values:
            distortion = tuple(float(value) for value in values["distortion_params"])
        else:
            distortion = tuple(float(values.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    except KeyError as problem:
        raise SceneError(
            where, expected="intrinsics fl_x, fl_y, cx, cy, w, h", got=f"no {problem.args[0]}", remedy=remedy
        ) from problem
    except (TypeError, ValueError, OverflowError) as problem:
        raise SceneError(where, expected="numbers as intrinsics", got=problem, remedy=remedy) from problem
    good = np.isfinite((*focal, *distortion)).all() and len(distortion) == 6 and min(width, height) > 0
    if not good or min(focal[:2]) <= 0:
        raise SceneError(
            where,
            expected="finite intrinsics, positive focal lengths and size, six distortion parameters",
            got={"w": width, "h": height, "fl_x, fl_y, cx, cy": focal, "distortion": distortion},
            remedy=remedy,
        )
    if size is not None and (width, height) != size:
        raise SceneError(
            where,
            expected=f"a photograph of {width} x {height} pixels as the intrinsics say",
            got=f"{size[0]} x {size[1]}",
            remedy="Use the photographs that the poses were computed from, or scale the intrinsics.",
        )
    return Intrinsics(width, height, *focal, distortion, camera_type.value)  # type: ignore[arg-type]


def _image_size(path: Path, where: str) -> tuple[int, int]:
    """Width and height from the file's header."""
    try:
        with Image.open(path) as image:
            return image.size
    except Exception as problem:  # Pillow's plugins raise many types on damaged headers
        raise SceneError(
            f"{where}: {path.name}",
            expected="a readable photograph",
            got=problem,
            remedy="The file is damaged; copy it again or remove the frame.",
        ) from problem
