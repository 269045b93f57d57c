"""Edges of photographs and thermal images at one size after another, and how well a rig makes them agree."""

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
from thermoxels_ns.core.errors import SceneError

FloatImage = Float32Array

_COARSEST_WIDTH = 80
_MOST_POINTS = 6_000
_STRONGEST_SHARE = 0.35
_WEAKEST_EDGE = 0.05
FARTHEST_FROM_POINT = 0.06
"""Distance on the plane at depth 1 to the next scene point, beyond which an edge's depth is not known."""
SURE_DISTANCE = 0.01  # distance on that plane up to which an edge's depth is that of the scene points around it
_EDGE_REACH = 2.0  # half the width of an edge, in standard deviations of its blur
_MARGIN_SHARE = 0.15
_FINER = 1.23
_ASPECT_TOLERANCE = 0.02
_GRADIENT_SIGMA_PX = 1.2
_NOISE_FACTOR = 3.0
_STRONG_PERCENTILE, _SMALLEST_SHARE = 98.0, 3e-3
"""Below this share of the strong edges' |z| an image without noise counts as flat."""
_CONTRAST_SIGMA_PX, _CONTRAST_SIGMA_SHARE = 6.0, 0.02
_FEWEST_FOR_PATTERN = 8
_PATTERN_CORRELATION = 0.25
_BORDER_PX, _BORDER_SHARE = 2.0, 0.05
_TINY = 1e-12
_PADDING = 2


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Edges of one photograph as points in front of its camera."""

    points: FloatArray  # shape (n, 3), the visible camera's OpenCV axes
    value: npt.NDArray[np.complex64]  # edge values, shape (n,)


class ThermalEdges:
    """Edge values of one thermal image and all that is needed to sample them smoothly."""

    def __init__(self, field: npt.NDArray[np.complex64]) -> None:
        """Take edge values, shape (height, width)."""
        self.field = field
        self.weight: Float32Array = np.minimum.outer(*map(_ramp, field.shape)).astype(np.float32)
        padded = np.pad(field, _PADDING)  # zeros around, so that everything outside reads 0
        self._planes = padded, np.gradient(padded, axis=1), np.gradient(padded, axis=0)

    def sample(self, pixels: FloatArray, *, slopes: bool = False) -> npt.NDArray[np.complex64]:
        """Edge values at pixels (n, 2) and, if asked for, their slopes along x and y, shape (1 or 3, n); 0 outside."""
        return np.stack([_bilinear(plane, pixels) for plane in self._planes[: 3 if slopes else 1]])

    def weight_at(self, pixels: FloatArray) -> FloatArray:
        """How much points at pixel positions (n, 2) count, shape (n,); 0 outside the image."""
        return _bilinear(np.pad(self.weight, _PADDING), pixels).astype(np.float64)


class RigScore:
    """The score of all frames at one size of the thermal images.

    Every photograph becomes a set of points in front of its camera, where its edges are, each with an edge value a.
    The rig says where they fall in the thermal image, whose edge value there is b. The score is
    sum(w Re a* b) / sqrt(sum(w |a|^2) sum(w |b|^2)) over the points of all frames: 1 if all edges agree, 0 by chance.

    What is maximised is the sum(w Re a* b) alone, with weights w that fall to 0 at the border of the thermal image and
    do not follow the rig. The points lie only where photographs have edges, so the last factor is no constant of the
    thermal images, and points at the border come and go: with either of them it pays to move points to where b is
    small, and the focal length comes out half a percent too long.
    """

    def __init__(
        self, edges: Sequence[EdgePoints], thermal: Sequence[ThermalEdges], rig: RigModel, around: FloatArray
    ) -> None:
        """Take edges of photographs and thermal images, what changes count from, and where the weights are taken."""
        self.edges, self.thermal, self.rig = edges, thermal, rig
        self._weights = [t.weight_at(rig.project(around, e.points)) for e, t in zip(edges, thermal)]
        self._own = sum(float(w @ np.abs(e.value) ** 2) for e, w in zip(edges, self._weights))
        self._norm = self._sums(around)[1]

    def around(self, change: FloatArray) -> RigScore:
        """Same images, the points' weights taken at another place."""
        return RigScore(self.edges, self.thermal, self.rig, change)

    def value(self, change: FloatArray) -> float:
        """Score of all frames together."""
        product, norm = self._sums(change)
        return product / norm

    def _sums(self, change: FloatArray) -> tuple[float, float]:
        """Weighted sum of Re a* b, and sqrt(sum(w |a|^2) sum(w |b|^2))."""
        product, other = 0.0, 0.0
        for one, thermal, weight in zip(self.edges, self.thermal, self._weights):
            (value,) = thermal.sample(self.rig.project(change, one.points))
            product += float(weight @ (one.value.conj() * value).real)
            other += float(weight @ np.abs(value) ** 2)
        return product, float(np.sqrt(max(self._own * other, _TINY)))

    def slopes(self, change: FloatArray) -> tuple[float, FloatArray]:
        """What is maximised, and its derivative split by the frames that it comes from, shape (frames, 10)."""
        total, rows = 0.0, []
        for one, thermal, weight in zip(self.edges, self.thermal, self._weights):
            sampled = thermal.sample(self.rig.project(change, one.points), slopes=True)
            value, *slope = weight / self._norm * (one.value.conj() * sampled).real
            total += float(value.sum())
            rows.append(self.rig.pull_back(change, one.points, np.stack(slope, axis=1)))
        return total, np.array(rows)


@dataclass(frozen=True, eq=False)
class PreparedFrame:
    """One frame, read and checked."""

    grey: FloatImage  # photograph, shape (height, width)
    contrast: FloatImage  # local contrast of the temperatures, shape (height, width) of the thermal camera [K]
    depth: SparseDepth


@dataclass(frozen=True, eq=False)
class PreparedFrames:
    """All frames and both cameras, ready to be compared at any size."""

    frames: tuple[PreparedFrame, ...]
    visible: Camera
    thermal: Camera
    median_depth: float  # of all scene points [world units]

    def sizes(self) -> list[tuple[int, int]]:
        """Sizes of the thermal images to go through, coarse to fine; the last one is the full size."""
        width, height = self.thermal.width, self.thermal.height
        halvings = max(round(np.log2(max(width / _COARSEST_WIDTH, 1.0))), 0)
        return [(round(width / 2**k), round(height / 2**k)) for k in range(halvings, -1, -1)]

    def score(self, rig: RigModel, change: npt.NDArray, size: tuple[int, int], blur_px: float) -> RigScore:
        """Make the score at one size; `change` says about where in the thermal image the points lie."""
        level = rig.at_size(*size)
        edges, thermal = [], []
        for frame in self.frames:
            small = cv2.resize(frame.contrast, size, interpolation=cv2.INTER_AREA)
            thermal.append(ThermalEdges(edge_field(small.astype(np.float32), blur_px)))
            edges.append(self._edge_points(frame, level, change, blur_px))
        return RigScore(edges, thermal, level, change)

    def _edge_points(self, frame: PreparedFrame, level: RigModel, change: npt.NDArray, blur_px: float) -> EdgePoints:
        """The strongest edges of a photograph, in pixels somewhat smaller than the thermal image's."""
        # Pixels of the same size would fall onto each other at whole shifts, which interpolation then prefers.
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
        # An edge's weight is the same across its width: where only one side of an outline has scene points, a weight
        # that falls across the outline would move it.
        trust = np.zeros(field.shape, np.float32)
        trust[rows, columns] = 1.0 / (1.0 + (distance / SURE_DISTANCE) ** 4)
        reach = 2 * int(np.ceil(_EDGE_REACH * (blur_px * scale / same + 1.0))) + 1
        trust = cv2.dilate(trust, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
        turn = level.transform[:3, :3]
        roll = np.exp(2j * np.arctan2(turn[1, 0], turn[0, 0]))
        value = (field * trust)[rows, columns] * roll
        return EdgePoints(rays[known] * depth[known, None], value[known].astype(np.complex64))


def prepare_frames(frames: Sequence[RigFrame], visible: Camera, thermal: Camera) -> PreparedFrames:
    """Read the images of all frames, take out the thermal camera's fixed pattern and check sizes (`SceneError`)."""
    temperatures = [read_temperatures(frame, thermal) for frame in frames]
    prepared, depths = [], []
    for frame, contrast in zip(frames, without_fixed_pattern(temperatures)):
        points = frame.points_visible()
        depths.append(points[points[:, 2] > 0.0, 2])
        prepared.append(PreparedFrame(read_photograph(frame, visible), contrast, SparseDepth(points)))
    return PreparedFrames(tuple(prepared), visible, thermal, float(np.median(np.concatenate(depths))))


def read_temperatures(frame: RigFrame, camera: Camera) -> FloatImage:
    """Temperatures of a frame as an array of the thermal camera's size [degrees C]."""
    source = frame.temperature_c
    image = np.load(source, allow_pickle=False) if isinstance(source, Path) else np.asarray(source)
    if image.shape != (camera.height, camera.width):
        expected = f"the thermal camera's {camera.height} rows and {camera.width} columns"
        remedy = "Leave the frame out, or give the camera that took it."
        raise SceneError(f"{frame.name}: temperatures", expected=expected, got=image.shape, remedy=remedy)
    return image.astype(np.float32)


def read_photograph(frame: RigFrame, camera: Camera) -> FloatImage:
    """Photograph of a frame as grey values; EXIF's orientation is not applied, as in structure from motion."""
    source = frame.photograph
    if isinstance(source, Path):
        image = np.asarray(open_photograph(source).convert("L"))
    else:
        image = np.asarray(source)
        image = image[..., :3].mean(axis=2) if image.ndim == 3 else image
    height, width = image.shape
    if abs(width * camera.height / (height * camera.width) - 1.0) > _ASPECT_TOLERANCE:
        expected = f"the aspect of the visible camera, {camera.width} x {camera.height}"
        got, remedy = f"{width} x {height} pixels", "Use the photographs that the poses were computed from."
        raise SceneError(f"{frame.name}: photograph", expected=expected, got=got, remedy=remedy)
    return image.astype(np.float32)


def edge_field(image: FloatImage, blur_px: float, pixels_per_pixel: float = 1.0) -> npt.NDArray[np.complex64]:
    """Edges of an image as complex numbers of magnitude 0 to 1 and twice the edge's angle, shape (height, width).

    A warm thing may be bright or dark, so the sign of an edge says nothing; its place and its direction do. The squared
    complex gradient (gx + i gy)^2 has the edge's strength and twice its angle, so an edge and its negative are equal.

    Strong edges all count as 1 and noise as little: z / (|z| + c) with c a multiple of the median of |z|, the
    level of noise in an image that is mostly flat. NaN pixels and what lies next to them count as no edge.

    `blur_px` is the standard deviation of the blur that follows: how far apart two edges may lie to be found, in pixels
    of which `pixels_per_pixel` of the image make one.
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
    """Local contrasts of images without what stays in place while the camera moves.

    Rows, columns and single pixels may read differently. The pattern is the median local contrast over the images. It
    is taken out only where two halves of the images agree on it.
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
    """Difference of each pixel to its surroundings, in which drift and vignetting do not show; NaN stays NaN."""
    known = np.isfinite(image)
    filled = np.where(known, image - image[known].mean(dtype=np.float64), 0.0) if known.any() else image
    reach = max(_CONTRAST_SIGMA_PX, _CONTRAST_SIGMA_SHARE * image.shape[1])
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), reach)
    around = cv2.GaussianBlur(filled.astype(np.float32), (0, 0), reach) / np.maximum(weight, 1e-6)
    return np.where(known, filled - around, np.nan).astype(np.float32)


def _bilinear(padded: npt.NDArray, pixels: FloatArray) -> npt.NDArray:
    """Sample a plane with zeros around at pixel positions (n, 2) of the plane without them; NaN reads 0."""
    place = np.nan_to_num(pixels, nan=-9.0)[:, ::-1].T + (_PADDING - 0.5)
    return ndimage.map_coordinates(padded, place, order=1, mode="nearest")


def _ramp(length: int) -> FloatArray:
    """0 near both ends, where edges are not known well, and 1 from a small share of the length on."""
    distance = np.minimum(np.arange(length) + 0.5, length - np.arange(length) - 0.5) - _BORDER_PX
    return np.clip(distance / max(_BORDER_SHARE * length, 2.0), 0.0, 1.0)
