"""How well the edges of photographs, carried into the thermal images, agree with the thermal edges.

Every photograph becomes a set of points in front of its camera, where its edges are, each with an edge value a
(`edge_structure`). The rig says where they fall in the thermal image, whose edge value there is b. The score is
sum(Re a* b) / sqrt(sum |a|^2 sum |b|^2) over the points of all frames: 1 if all edges agree, 0 by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.rig_parameters import RigModel

FloatArray = npt.NDArray[np.float64]

_BORDER_SHARE = 0.03
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Edges of one photograph as points in front of its camera."""

    points: FloatArray
    """Shape (n, 3), the visible camera's OpenCV axes."""
    value: npt.NDArray[np.complex64]
    """Edge values, shape (n,)."""


class ThermalEdges:
    """Edge values of one thermal image and all that is needed to sample them smoothly."""

    def __init__(self, field: npt.NDArray[np.complex64]) -> None:
        """Take edge values, shape (height, width). Towards the border points count less and less."""
        height, width = field.shape
        self.size = width, height
        taper = np.minimum.outer(_ramp(height), _ramp(width)).astype(np.float32)
        strength = (field.real**2 + field.imag**2) * taper
        self._values = np.dstack([field.real * taper, field.imag * taper, taper, strength]).astype(np.float32)
        slopes = [
            cv2.filter2D(self._values, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT)
            for kernel in (np.array([[-0.5, 0.0, 0.5]]), np.array([[-0.5], [0.0], [0.5]]))
        ]
        self._slopes = slopes
        self.field = field
        self.weight = taper

    def sample(self, pixels: FloatArray, slopes: bool = True) -> tuple[npt.NDArray, list[npt.NDArray]]:
        """Values (n, 4) at pixel positions (n, 2) and their derivatives along x and y (each (n, 4)).

        The four are: real and imaginary part of the edge value, weight, strength. All are 0 outside the image.
        """
        place = np.nan_to_num(pixels, nan=-10.0, posinf=-10.0, neginf=-10.0).astype(np.float32) - np.float32(0.5)
        place = np.clip(place, -10.0, 30_000.0)
        columns = 1024
        rows = -(-len(place) // columns)
        padded = np.full((rows * columns, 2), -10.0, np.float32)
        padded[: len(place)] = place
        grid = padded.reshape(rows, columns, 2)

        def look(image: npt.NDArray) -> npt.NDArray:
            out = cv2.remap(
                image, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0
            )
            return out.reshape(-1, 4)[: len(place)]

        return look(self._values), [look(slope) for slope in self._slopes] if slopes else []


class RigScore:
    """The score of all frames at one size of the thermal images."""

    def __init__(self, edges: Sequence[EdgePoints], thermal: Sequence[ThermalEdges], rig: RigModel) -> None:
        """Take the photographs' edges and the thermal images of the same frames, and the rig changes count from."""
        self.edges, self.thermal, self.rig = edges, thermal, rig

    def value(self, change: FloatArray) -> float:
        """Score of all frames together."""
        return _score(self._sums(change, 0).sum(axis=0))

    def per_frame(self, change: FloatArray, shift: int = 0) -> FloatArray:
        """Score of each photograph with the thermal image of the frame `shift` later, shape (frames,)."""
        return np.array([_score(sums) for sums in self._sums(change, shift)])

    def with_slopes(self, change: FloatArray) -> tuple[float, FloatArray]:
        """Score and its derivative, split by the frames that it comes from, shape (frames, 10)."""
        sampled = [self.thermal[i].sample(self.rig.project(change, e.points)) for i, e in enumerate(self.edges)]
        total = np.sum([_weighted_sums(e.value, s[0]) for e, s in zip(self.edges, sampled)], axis=0)
        score, (_, own, other) = _score(total), np.maximum(total, _TINY)
        scale = 1.0 / np.sqrt(own * other)
        rows = []
        for one, (_, along) in zip(self.edges, sampled):
            a, b = scale * one.value.real, scale * one.value.imag
            c, d = (-0.5 * score / own) * np.abs(one.value) ** 2, -0.5 * score / other
            slope = np.column_stack([a * v[:, 0] + b * v[:, 1] + c * v[:, 2] + d * v[:, 3] for v in along])
            rows.append(self.rig.pull_back(change, one.points, slope))
        return score, np.array(rows)

    def _sums(self, change: FloatArray, shift: int) -> FloatArray:
        """Weighted sums of Re a* b, |a|^2 and |b|^2 of each frame, shape (frames, 3)."""
        count = len(self.edges)
        rows = []
        for number, one in enumerate(self.edges):
            values, _ = self.thermal[(number + shift) % count].sample(self.rig.project(change, one.points), False)
            rows.append(_weighted_sums(one.value, values))
        return np.array(rows)


def _weighted_sums(own: npt.NDArray[np.complex64], other: npt.NDArray[np.float32]) -> FloatArray:
    product = own.real @ other[:, 0] + own.imag @ other[:, 1]
    return np.array([product, (np.abs(own) ** 2) @ other[:, 2], other[:, 3].sum()], dtype=np.float64)


def _score(sums: FloatArray) -> float:
    return float(sums[0] / np.sqrt(max(sums[1] * sums[2], _TINY)))


def _ramp(length: int) -> npt.NDArray[np.float64]:
    """0 at both ends, 1 from a small share of the length on."""
    distance = np.minimum(np.arange(length) + 0.5, length - np.arange(length) - 0.5)
    return np.clip(distance / max(_BORDER_SHARE * length, 2.0), 0.0, 1.0)
