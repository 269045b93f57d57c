"""How well the edges of photographs, carried into the thermal images, agree with the thermal edges.

Every photograph becomes a set of points in front of its camera, where its edges are, each with an edge value a
(`edge_structure`). The rig says where they fall in the thermal image, whose edge value there is b. The score is
sum(Re a* b) / sqrt(sum |a|^2 sum |b|^2) over the points of all frames: 1 if all edges agree, 0 by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
        taper = np.minimum.outer(_ramp(height), _ramp(width)).astype(np.float32)
        self.field = field
        self.weight = taper
        strength = np.abs(field) ** 2 * taper
        values = np.dstack([field.real * taper, field.imag * taper, taper, strength]).astype(np.float32)
        values = np.pad(values, ((2, 2), (2, 2), (0, 0)))  # zeros around, so that everything outside reads 0
        self._planes = np.zeros((height + 4, width + 4, 12), np.float32)
        self._planes[..., :4] = values
        self._planes[:, 1:-1, 4:8] = 0.5 * (values[:, 2:] - values[:, :-2])
        self._planes[1:-1, :, 8:] = 0.5 * (values[2:] - values[:-2])

    def sample(self, pixels: FloatArray) -> tuple[npt.NDArray[np.float32], ...]:
        """Values (n, 4) at pixel positions (n, 2) and their derivatives along x and along y, each (n, 4).

        The four are: real and imaginary part of the edge value, weight, strength. All are 0 outside the image.
        """
        rows, columns, _ = self._planes.shape
        place = np.nan_to_num(pixels, nan=-9.0, posinf=-9.0, neginf=-9.0) + 1.5  # from the padded corner's centre
        x, y = np.clip(place[:, 0], 0.0, columns - 1.001), np.clip(place[:, 1], 0.0, rows - 1.001)
        left, top = x.astype(np.int64), y.astype(np.int64)
        u, v = (x - left).astype(np.float32)[:, None], (y - top).astype(np.float32)[:, None]
        flat, first = self._planes.reshape(rows * columns, 12), top * columns + left
        above = flat[first] * (1 - u) + flat[first + 1] * u
        below = flat[first + columns] * (1 - u) + flat[first + columns + 1] * u
        out = above * (1 - v) + below * v
        return out[:, :4], out[:, 4:8], out[:, 8:]


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
        for one, (_, *along) in zip(self.edges, sampled):
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
            values, _, _ = self.thermal[(number + shift) % count].sample(self.rig.project(change, one.points))
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
