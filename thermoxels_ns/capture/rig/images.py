"""Edges of photographs and thermal images at several sizes, and the score of how well a rig makes them agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.capture.photograph import open_photograph
from thermoxels_ns.capture.rig_types import RigFrame, RigModel
from thermoxels_ns.capture.sfm.sfm_model import SparseDepth
from thermoxels_ns.core.arrays import Float32Array, FloatArray
from thermoxels_ns.core.camera import Camera

FloatImage = Float32Array

_COARSEST_WIDTH = 80
_MOST_POINTS = 6_000
_STRONGEST_SHARE = 0.35
_WEAKEST_EDGE = 0.05
FARTHEST_FROM_POINT = 0.06
"""If the nearest scene point is farther from an edge (on the plane at depth 1), the edge's depth counts as unknown."""
SURE_DISTANCE = 0.01  # an edge so far from the nearest scene point, both drawn to depth 1, has half the weight
_EDGE_REACH = 2.0  # half the width of an edge, in standard deviations of its blur
_MARGIN_SHARE = 0.15
_FINER = 1.23
_GRADIENT_SIGMA_PX = 1.2
_NOISE_FACTOR = 3.0
_STRONG_PERCENTILE, _SMALLEST_SHARE = 98.0, 3e-3
"""In an image without noise, an edge of `_SMALLEST_SHARE` of the strong edges' |z| counts a half (`edge_field`)."""
_CONTRAST_SIGMA_PX, _CONTRAST_SIGMA_SHARE = 6.0, 0.02
_FEWEST_FOR_PATTERN = 8
_PATTERN_CORRELATION = 0.25
_BORDER_PX, _BORDER_SHARE = 2.0, 0.05
_PADDING = 2


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Edge pixels of one photograph, as points in space."""

    points: FloatArray  # positions in the visible camera's OpenCV axes, shape (n, 3) [world units]
    value: npt.NDArray[np.complex64]  # edge values (`edge_field`), each times its trust in the depth, shape (n,)


class ThermalEdges:
    """Edge values (`edge_field`) of one thermal image, which can be sampled between pixel centres."""

    def __init__(self, field: npt.NDArray[np.complex64]) -> None:
        """Store edge values, shape (height, width), and their slopes."""
        self.field = field
        self.weight: Float32Array = np.minimum.outer(*map(_ramp, field.shape)).astype(np.float32)
        padded = np.pad(field, _PADDING)  # zeros around, so that everything outside reads 0
        self._planes = padded, np.gradient(padded, axis=1), np.gradient(padded, axis=0)

    def sample(self, pixels: FloatArray) -> npt.NDArray[np.complex64]:
        """Return edge values and their derivatives by x and y, shape (3, n), at pixels (n, 2); 0 outside."""
        return np.stack([_bilinear(plane, pixels) for plane in self._planes])

    def weight_at(self, pixels: FloatArray) -> FloatArray:
        """Return the weights, 0 to 1, of points at pixels (n, 2), shape (n,); weights are 0 at the image's border."""
        return _bilinear(np.pad(self.weight, _PADDING), pixels).astype(np.float64)


class RigScore:
    """Score of how well a rig makes the edges of all frames agree, at one size of the thermal images.

    The edges of every photograph are points in front of its camera, each with an edge value a. A rig projects each
    point into the thermal image, whose edge value there is b. The score of the rig is sum(w Re a* b) over the points of
    all frames. The weights w fall to 0 at the border of the thermal image, and stay while the rig changes. If the score
    were divided by a changing sum(w |b|^2), or the weights followed the rig, it would pay to move points to where b is
    small, and the focal length would come out half a percent too long.
    """

    def __init__(
        self, edges: Sequence[EdgePoints], thermal: Sequence[ThermalEdges], rig: RigModel, around: FloatArray
    ) -> None:
        """Store the edges of each frame and the start `rig`; the weights are those at the changes `around` (10,)."""
        self.edges, self.thermal, self.rig = edges, thermal, rig
        self._weights = [t.weight_at(rig.project(around, e.points)) for e, t in zip(edges, thermal)]

    def slopes(self, change: FloatArray) -> tuple[float, FloatArray]:
        """Return the score of the rig with the ten changes `change`, and its derivative per frame, (frames, 10)."""
        total, rows = 0.0, []
        for one, thermal, weight in zip(self.edges, self.thermal, self._weights):
            sampled = thermal.sample(self.rig.project(change, one.points))
            value, *slope = weight * (one.value.conj() * sampled).real
            total += float(value.sum())
            rows.append(self.rig.pull_back(change, one.points, np.stack(slope, axis=1)))
        return total, np.array(rows)


@dataclass(frozen=True, eq=False)
class PreparedFrame:
    """Images and depths of one frame, read and checked."""

    grey: FloatImage  # grey values of the photograph, shape (height, width)
    contrast: FloatImage  # local contrast of the temperatures, shape (height, width) of the thermal camera [K]
    depth: SparseDepth  # depth seen by the visible camera, from the frame's scene points


@dataclass(frozen=True, eq=False)
class PreparedFrames:
    """All frames and both cameras; `score` compares the images at any size."""

    frames: tuple[PreparedFrame, ...]
    visible: Camera
    thermal: Camera
    median_depth: float  # of all scene points [world units]

    def sizes(self) -> list[tuple[int, int]]:
        """Return the sizes (width, height) of thermal images to compare at, from coarse to the full size."""
        width, height = self.thermal.width, self.thermal.height
        halvings = max(round(np.log2(max(width / _COARSEST_WIDTH, 1.0))), 0)
        return [(round(width / 2**k), round(height / 2**k)) for k in range(halvings, -1, -1)]

    def score(self, rig: RigModel, change: npt.NDArray, size: tuple[int, int], blur_px: float) -> RigScore:
        """Return the `RigScore` around `change` (10,) for thermal images of `size` (width, height) and edges' blur."""
        level = rig.at_size(*size)
        edges, thermal = [], []
        for frame in self.frames:
            small = cv2.resize(frame.contrast, size, interpolation=cv2.INTER_AREA)
            thermal.append(ThermalEdges(edge_field(small.astype(np.float32), blur_px)))
            edges.append(self._edge_points(frame, level, change, blur_px))
        return RigScore(edges, thermal, level, change)

    def _edge_points(self, frame: PreparedFrame, level: RigModel, change: npt.NDArray, blur_px: float) -> EdgePoints:
        """Return the strongest edges of a photograph that is reduced to pixels a little smaller than thermal pixels."""
        # With pixels of the same size, the score would prefer whole-pixel shifts, where interpolation blurs nothing.
        height, width = frame.grey.shape
        same = level.camera.fl_x / self.visible.resized(width, height).fl_x
        scale = min(_FINER * same, 1.0)
        size = max(round(width * scale), 8), max(round(height * scale), 8)
        small = cv2.resize(frame.grey, size, interpolation=cv2.INTER_AREA)
        field = edge_field(small.astype(np.float32), blur_px, scale / same)
        place = np.argwhere(np.abs(field) > _WEAKEST_EDGE)  # rows and columns
        rays = self.visible.resized(*size).rays(place[:, ::-1] + 0.5)
        seen = level.project(change, rays * self.median_depth)
        near = level.camera.contains(seen, -_MARGIN_SHARE * level.camera.width)
        strength = np.where(near, np.abs(field[tuple(place.T)]), 0.0)
        most = min(_MOST_POINTS, int(_STRONGEST_SHARE * field.size), np.count_nonzero(near))
        keep = np.sort(np.argsort(-strength, kind="stable")[:most])
        rays, (rows, columns) = rays[keep], place[keep].T
        depth, distance = frame.depth.at(rays)
        known = distance < FARTHEST_FROM_POINT
        # An edge's trust is constant across its width. Otherwise, where only one side of an outline has scene points,
        # the trust would fall across the outline and shift the edge.
        trust = np.zeros(field.shape, np.float32)
        trust[rows, columns] = 1.0 / (1.0 + (distance / SURE_DISTANCE) ** 4)
        reach = 2 * int(np.ceil(_EDGE_REACH * (blur_px * scale / same + 1.0))) + 1
        trust = cv2.dilate(trust, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
        value = (field * trust)[rows, columns]
        return EdgePoints(rays[known] * depth[known, None], value[known].astype(np.complex64))


def prepare_frames(frames: Sequence[RigFrame], visible: Camera, thermal: Camera) -> PreparedFrames:
    """Read the images of all frames and remove the fixed pattern; raise `SceneError` for a file that is damaged."""
    temperatures = [read_temperatures(frame) for frame in frames]
    prepared, depths = [], []
    for frame, contrast in zip(frames, without_fixed_pattern(temperatures)):
        depths.append(frame.points[frame.points[:, 2] > 0.0, 2])
        prepared.append(PreparedFrame(read_photograph(frame), contrast, SparseDepth(frame.points)))
    return PreparedFrames(tuple(prepared), visible, thermal, float(np.median(np.concatenate(depths))))


def read_temperatures(frame: RigFrame) -> FloatImage:
    """Return a frame's temperatures [degrees C], shape (height, width) of the thermal camera."""
    source = frame.temperature_c
    image = np.load(source, allow_pickle=False) if isinstance(source, Path) else np.asarray(source)
    return image.astype(np.float32)


def read_photograph(frame: RigFrame) -> FloatImage:
    """Return a frame's photograph as grey values, not turned by EXIF; raise `SceneError` if it cannot be decoded."""
    source = frame.photograph
    if isinstance(source, Path):
        image = np.asarray(open_photograph(source).convert("L"))
    else:
        image = np.asarray(source)
        image = image[..., :3].mean(axis=2) if image.ndim == 3 else image
    return image.astype(np.float32)


def edge_field(image: FloatImage, blur_px: float, pixels_per_pixel: float = 1.0) -> npt.NDArray[np.complex64]:
    """Return complex edge values of magnitude 0 (no edge) to 1 and twice the edge's angle, shape (height, width).

    A warm object may be bright or dark, so the sign of an edge says nothing; only place and direction count. The
    squared gradient z = (gx + i gy)^2 is the same for an edge and its negative.

    The edge value is z / (|z| + c), so strong edges all count nearly 1 and noise counts little; c is a multiple of the
    median of |z|, which is the level of noise in a mostly flat image. NaN pixels and pixels near them count as no edge.

    The edge values are then blurred by the standard deviation `blur_px`, so that edges agree from that far apart. Its
    unit is one coarse pixel, as wide as `pixels_per_pixel` pixels of the image.
    """
    bad = ~np.isfinite(image)
    filled = np.where(bad, np.float32(np.nanmedian(image) if not bad.all() else 0.0), image).astype(np.float32)
    filled -= filled.mean()
    sigma = _GRADIENT_SIGMA_PX * pixels_per_pixel
    smooth = cv2.GaussianBlur(filled, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    gx = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, borderType=cv2.BORDER_REPLICATE) / np.float32(32.0)
    gy = cv2.Scharr(smooth, cv2.CV_32F, 0, 1, borderType=cv2.BORDER_REPLICATE) / np.float32(32.0)
    real, imaginary = gx * gx - gy * gy, 2.0 * gx * gy
    strength = gx * gx + gy * gy
    middle, strong = np.percentile(strength, [50.0, _STRONG_PERCENTILE])
    floor = max(_NOISE_FACTOR * float(middle), _SMALLEST_SHARE * float(strong), 1e-30)
    weight = 1.0 / (strength + floor)
    if bad.any():
        reach = 2 * int(np.ceil(3.0 * sigma)) + 1
        weight[cv2.dilate(bad.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0] = 0.0
    parts = [cv2.GaussianBlur(part * weight, (0, 0), blur_px * pixels_per_pixel) for part in (real, imaginary)]
    return (parts[0] + 1j * parts[1]).astype(np.complex64)


def without_fixed_pattern(images: Sequence[FloatImage]) -> list[FloatImage]:
    """Return the `local_contrast` of each image [K] without the sensor's fixed pattern.

    Rows, columns and single pixels of a sensor may read differently. The pattern is the median local contrast over the
    images, and is subtracted only if there are enough images and its medians over two halves of them correlate.
    """
    contrast = [local_contrast(image) for image in images]
    if len(contrast) < _FEWEST_FOR_PATTERN:
        return contrast
    stack = np.nan_to_num(np.stack(contrast), nan=0.0)
    halves = [np.median(stack[start::2], axis=0).ravel() for start in (0, 1)]
    if not all(half.any() for half in halves) or not np.corrcoef(halves)[0, 1] > _PATTERN_CORRELATION:
        return contrast
    return [*(stack - np.median(stack, axis=0))]


def local_contrast(image: FloatImage) -> FloatImage:
    """Return each pixel minus the mean of its surroundings, free of drift and vignetting, [K]; NaN stays NaN."""
    known = np.isfinite(image)
    filled = np.where(known, image - image[known].mean(dtype=np.float64), 0.0) if known.any() else image
    reach = max(_CONTRAST_SIGMA_PX, _CONTRAST_SIGMA_SHARE * image.shape[1])
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), reach)
    around = cv2.GaussianBlur(filled.astype(np.float32), (0, 0), reach) / np.maximum(weight, 1e-6)
    return np.where(known, filled - around, np.nan).astype(np.float32)


def _bilinear(padded: npt.NDArray, pixels: FloatArray) -> npt.NDArray:
    """Sample a plane padded by `_PADDING` zeros at pixels (n, 2) counted without the padding; NaN pixels read 0."""
    place = np.nan_to_num(pixels, nan=-9.0)[:, ::-1].T + (_PADDING - 0.5)
    return ndimage.map_coordinates(padded, place, order=1, mode="nearest")


def _ramp(length: int) -> FloatArray:
    """Return weights for a row of pixels, shape (length,): 0 near both ends, where edges are unsure, rising to 1."""
    distance = np.minimum(np.arange(length) + 0.5, length - np.arange(length) - 0.5) - _BORDER_PX
    return np.clip(distance / max(_BORDER_SHARE * length, 2.0), 0.0, 1.0)
