"""Thermal images in colours, alone and laid over photographs."""

from __future__ import annotations

import io

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from thermoxels_ns.capture.photograph import open_photograph
from thermoxels_ns.capture.rig_types import RigEstimate, RigFrame
from thermoxels_ns.capture.sfm.sfm_model import SparseDepth
from thermoxels_ns.core.camera import Camera

_WIDTH = 640
_DEPTH_STEP = 4  # Depth is looked up at every so many pixels of the reduced photograph, and linear between
_COLOUR_SHARE = 0.55  # How much of the thermal colours covers the photograph
_PERCENTILES = (2.0, 98.0)  # Of a thermal image's temperatures, for its darkest and brightest colours


def thermal_in_photograph(
    frame: RigFrame, temperature_c: npt.NDArray, visible: Camera, rig: RigEstimate, width: int = _WIDTH
) -> npt.NDArray[np.float32]:
    """Carry a thermal image, [degrees C], into the photograph's view, through the depth of the scene points.

    Returns temperatures by pixel of the photograph reduced to a width, NaN where the thermal image does not reach.
    """
    height = max(1, round(visible.height * width / visible.width))
    rays = _grid_rays(visible, width, height)
    coarse = (max(2, width // _DEPTH_STEP), max(2, height // _DEPTH_STEP))
    depth, _ = SparseDepth(frame.points_visible()).at(_grid_rays(visible, *coarse))
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=np.isfinite(depth)).reshape(coarse[::-1])
    parallax = cv2.resize(inverse, (width, height), interpolation=cv2.INTER_LINEAR).ravel()
    rotation, shift = rig.visible_to_thermal[:3, :3], rig.visible_to_thermal[:3, 3]
    local = rays @ rotation.T + parallax[:, None] * shift  # a point times its inverse depth projects alike
    pixels = rig.thermal_camera.project(local).reshape(height, width, 2).astype(np.float32) - np.float32(0.5)
    return cv2.remap(
        temperature_c.astype(np.float32),
        np.nan_to_num(pixels[..., 0], nan=-1e6),
        np.nan_to_num(pixels[..., 1], nan=-1e6),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),  # type: ignore[arg-type]
    )


def _grid_rays(camera: Camera, width: int, height: int) -> npt.NDArray[np.float64]:
    """Rays of depth 1 through the pixels of a reduced photograph, row by row, shape (width * height, 3)."""
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    return camera.resized(width, height).rays(grid)


def overlay(frame: RigFrame, temperature_c: npt.NDArray, visible: Camera, rig: RigEstimate) -> npt.NDArray:
    """Photograph in grey with its edges, thermal image in colours over it, shape (height, width, 3) of uint8."""
    carried = thermal_in_photograph(frame, temperature_c, visible, rig)
    height, width = carried.shape
    if isinstance(frame.photograph, np.ndarray):
        picture = Image.fromarray(frame.photograph.astype(np.uint8)).convert("L")
    else:
        picture = open_photograph(frame.photograph).convert("L")
    grey = np.asarray(picture.resize((width, height), Image.Resampling.BOX))
    base = np.repeat(grey[..., None], 3, axis=2).astype(np.float32)
    known = np.isfinite(carried)
    mixed = np.where(known[..., None], (1 - _COLOUR_SHARE) * base + _COLOUR_SHARE * colours(carried), base)
    edges = cv2.Canny(cv2.GaussianBlur(grey, (0, 0), 1.5), 40, 100) > 0
    mixed[edges & known] = 255.0
    return np.clip(mixed, 0, 255).astype(np.uint8)


def colours(temperature_c: npt.NDArray, limits: tuple[float, float] | None = None) -> npt.NDArray[np.float32]:
    """Temperatures as red, green and blue 0 to 255, black where NaN; `limits` by default those of the middle 96 %."""
    known = np.isfinite(temperature_c)
    if limits is None:
        low, high = np.percentile(temperature_c[known], _PERCENTILES) if known.any() else (0.0, 1.0)
    else:
        low, high = limits
    share = np.nan_to_num((temperature_c - low) / max(float(high - low), 1e-6))
    levels = np.clip(255 * share, 0, 255).astype(np.uint8)
    shown = cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1].astype(np.float32)
    shown[~known] = 0.0
    return shown


def jpeg_of(picture: npt.NDArray[np.uint8], quality: int = 82) -> bytes:
    """Encode a picture as a JPEG file."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, format="JPEG", quality=quality)
    return stream.getvalue()
