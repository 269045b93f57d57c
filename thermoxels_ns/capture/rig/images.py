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
"""Distance from an edge to the nearest scene point, both at depth 1, beyond which the edge's depth is unknown."""
SURE_DISTANCE = 0.01  # distance from an edge to the nearest scene point, both at depth 1, at which its trust is 1/2
_EDGE_REACH = 2.0  # half the width of an edge, in standard deviations of its blur
_MARGIN_SHARE = 0.15
_FINER = 1.23
_GRADIENT_SIGMA_PX = 1.2
_NOISE_FACTOR = 3.0
_STRONG_PERCENTILE, _SMALLEST_SHARE = 98.0, 3e-3
"""In an image without noise, an edge of `_SMALLEST_SHARE` of the strong edges' |z| has the value 1/2: `edge_field`."""
_CONTRAST_SIGMA_PX, _CONTRAST_SIGMA_SHARE = 6.0, 0.02
_FEWEST_FOR_PATTERN = 8
_PATTERN_CORRELATION = 0.25
_BORDER_PX, _BORDER_SHARE = 2.0, 0.05


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Edge pixels of one photograph, as points in space."""

    points: FloatArray  # positions in the visible camera's OpenCV axes, shape (n, 3) [world units]
    value: npt.NDArray[np.complex64]  # edge values (`edge_field`), each times its trust in the depth, shape (n,)


class ThermalEdges:
    """Edge values (`edge_field`) of one thermal image, interpolated linearly between pixel centres."""

    def __init__(self, field: npt.NDArray[np.complex64]) -> None:
        """Store edge values `field` (height, width), their derivatives, and weights that fall to 0 at the border."""
        self.field = field
        self.weight: Float32Array = np.minimum.outer(*map(_ramp, field.shape)).astype(np.float32)
        self._planes = field, np.gradient(field, axis=1), np.gradient(field, axis=0)

    def sample(self, pixels: FloatArray) -> npt.NDArray[np.complex64]:
        """Return edge values and their derivatives by x and y, (3, n), at pixel positions (n, 2); outside: 0."""
        return np.stack([_bilinear(plane, pixels) for plane in self._planes])


class RigScore:
    """Score of how well a rig makes the edges of all frames agree, at one size of the thermal images.

    The edges of every photograph are points in front of its camera, each with an edge value a. A rig projects each
    point into the thermal image, which has the edge value b there. The score of the rig is sum(w Re a* b) over the
    points of all frames. The weights w fall to 0 at the border of the thermal image and are constant while the rig
    changes. If weights changed with the rig, or if the score were divided by sum(w |b|^2), points could gain by moving
    to places with a small b, and the focal length found would be half a percent too long.
    """

    def __init__(
        self, edges: Sequence[EdgePoints], thermal: Sequence[ThermalEdges], rig: RigModel, around: FloatArray
    ) -> None:
        """Store the edges of each frame and the start `rig`; weights are computed at the ten changes `around` (10,)."""
        self.edges, self.thermal, self.rig = edges, thermal, rig
        self._weights = [
            _bilinear(t.weight, rig.project(around, e.points)).astype(float) for e, t in zip(edges, thermal)
        ]

    def slopes(self, change: FloatArray) -> tuple[float, FloatArray]:
        """Return the score at the ten changes `change` (10,), and each frame's part of its derivative, (frames, 10)."""
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
    median_depth: float  # median depth of all scene points [world units]

    def sizes(self) -> list[tuple[int, int]]:
        """Return the sizes (width, height) at which thermal images are compared, halvings of the full size, rising."""
        width, height = self.thermal.width, self.thermal.height
        halvings = max(round(np.log2(max(width / _COARSEST_WIDTH, 1.0))), 0)
        return [(round(width / 2**k), round(height / 2**k)) for k in range(halvings, -1, -1)]

    def score(self, rig: RigModel, change: npt.NDArray, size: tuple[int, int], blur_px: float) -> RigScore:
        """Return the `RigScore` for thermal images of `size` (width, height), with weights at the ten changes `change`.
        `blur_px` is the standard deviation of the edges' blur [thermal pixels at that size]."""
        level = RigModel(rig.camera.resized(*size), rig.transform, size[0] / rig.camera.width)
        edges, thermal = [], []
        for frame in self.frames:
            small = cv2.resize(frame.contrast, size, interpolation=cv2.INTER_AREA)
            thermal.append(ThermalEdges(edge_field(small.astype(np.float32), blur_px)))
            edges.append(self._edge_points(frame, level, change, blur_px))
        return RigScore(edges, thermal, level, change)

    def _edge_points(self, frame: PreparedFrame, level: RigModel, change: npt.NDArray, blur_px: float) -> EdgePoints:
        """Return the strongest edges of a frame's photograph, reduced to pixels a little smaller than thermal pixels.
        `level` is the rig at the thermal images' size. Left out are edges that it projects, with the changes `change`,
        far outside the thermal image, and edges of unknown depth."""
        # With pixels of the same size, the score would prefer whole-pixel shifts, as interpolation then blurs nothing.
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
    """Return the images of all frames without the sensor's fixed pattern; raise `SceneError` if a file is damaged."""
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
    """Return a frame's photograph as grey values (height, width), not turned by EXIF; `SceneError`: not decodable."""
    source = frame.photograph
    if isinstance(source, Path):
        image = np.asarray(open_photograph(source).convert("L"))
    else:
        image = np.asarray(source)
        image = image[..., :3].mean(axis=2) if image.ndim == 3 else image
    return image.astype(np.float32)


def edge_field(image: FloatImage, blur_px: float, pixels_per_pixel: float = 1.0) -> npt.NDArray[np.complex64]:
    """Return complex edge values (height, width): magnitude 0 (no edge) to 1, phase twice the angle of the gradient.

    A warm object may be bright or dark in a photograph, so only place and direction of an edge are compared, not its
    sign. The squared gradient z = (gx + i gy)^2 is the same for an edge and its negative. The edge value is
    z / (|z| + c), so that strong edges have nearly 1 and noise has little. c is a multiple of the median of |z|, which
    is the level of noise in a mostly flat image. NaN pixels and pixels near them have no edge. The values are then
    blurred, so that edges a little apart also agree. The blur's standard deviation is `blur_px` coarse pixels, each as
    wide as `pixels_per_pixel` pixels of the image.
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
    """Return the `local_contrast` of each thermal image [K] without the sensor's fixed pattern.

    Rows, columns and single pixels of a sensor may read differently. This pattern is the median of the local contrast
    over all images. It is subtracted only if there are enough images and the medians of two halves correlate.
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
    """Return each pixel minus the mean of its surroundings [K], which removes drift and vignetting; NaN remains NaN."""
    known = np.isfinite(image)
    filled = np.where(known, image - image[known].mean(dtype=np.float64), 0.0) if known.any() else image
    reach = max(_CONTRAST_SIGMA_PX, _CONTRAST_SIGMA_SHARE * image.shape[1])
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), reach)
    around = cv2.GaussianBlur(filled.astype(np.float32), (0, 0), reach) / np.maximum(weight, 1e-6)
    return np.where(known, filled - around, np.nan).astype(np.float32)


def _bilinear(plane: npt.NDArray, pixels: FloatArray) -> npt.NDArray:
    """Return bilinear samples (n,) of a plane, which is 0 outside, at pixel positions (n, 2); NaN: 0."""
    place = np.nan_to_num(pixels, nan=-9.0)[:, ::-1].T - 0.5
    return ndimage.map_coordinates(plane, place, order=1, mode="grid-constant")


def _ramp(length: int) -> FloatArray:
    """Return weights (length,) for a row of pixels: 0 at both ends, because edges are unsure there, rising to 1."""
    distance = np.minimum(np.arange(length) + 0.5, length - np.arange(length) - 0.5) - _BORDER_PX
    return np.clip(distance / max(_BORDER_SHARE * length, 2.0), 0.0, 1.0)
