"""Score of a rig: how well photographs' edges agree with the thermal edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.rig.parameters import RigModel
from thermoxels_ns.capture.rig_types import FloatArray

_BORDER_PX = 2.0
_BORDER_SHARE = 0.05
_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Edges of one photograph as points in front of its camera."""

    points: FloatArray  # shape (n, 3), the visible camera's OpenCV axes
    value: npt.NDArray[np.complex64]  # edge values, shape (n,)


class ThermalEdges:
    """Edge values of one thermal image and all that is needed to sample them smoothly."""

    def __init__(self, field: npt.NDArray[np.complex64]) -> None:
        """Take edge values, shape (height, width)."""
        height, width = field.shape
        self.field = field
        self.weight: npt.NDArray[np.float32] = np.minimum.outer(_ramp(height), _ramp(width)).astype(np.float32)
        # Zeros around, so that everything outside reads 0.
        values = np.pad(np.dstack([field.real, field.imag]).astype(np.float32), ((2, 2), (2, 2), (0, 0)))
        self._planes = np.zeros((height + 4, width + 4, 6), np.float32)
        self._planes[..., :2] = values
        self._planes[:, 1:-1, 2:4] = 0.5 * (values[:, 2:] - values[:, :-2])
        self._planes[1:-1, :, 4:] = 0.5 * (values[2:] - values[:-2])

    def sample(self, pixels: FloatArray) -> npt.NDArray[np.float32]:
        """Edge values at pixels (n, 2), and their derivatives along x and y: complex as pairs (n, 6); 0 outside."""
        return _bilinear(self._planes, pixels + 2.0)

    def weight_at(self, pixels: FloatArray) -> FloatArray:
        """How much points at pixel positions (n, 2) count, shape (n,); 0 outside the image."""
        return _bilinear(np.pad(self.weight, 2)[..., None], pixels + 2.0)[:, 0].astype(np.float64)


class RigScore:
    """The score of all frames at one size of the thermal images.

    Every photograph becomes a set of points in front of its camera, where its edges are, each with an edge value a
    (`images`). The rig says where they fall in the thermal image, whose edge value there is b. The score is
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
        self._scale = 1.0 / np.sqrt(max(self._own * self._sums(around)[1], _TINY))

    def around(self, change: FloatArray) -> RigScore:
        """Same images, the points' weights taken at another place."""
        return RigScore(self.edges, self.thermal, self.rig, change)

    def value(self, change: FloatArray) -> float:
        """Score of all frames together."""
        product, other = self._sums(change)
        return product / np.sqrt(max(self._own * other, _TINY))

    def _sums(self, change: FloatArray) -> tuple[float, float]:
        """Weighted sums of Re a* b and |b|^2."""
        product, other = 0.0, 0.0
        for one, thermal, weight in zip(self.edges, self.thermal, self._weights):
            sampled = thermal.sample(self.rig.project(change, one.points))
            product += float(weight @ (one.value.real * sampled[:, 0] + one.value.imag * sampled[:, 1]))
            other += float(weight @ (sampled[:, 0] ** 2 + sampled[:, 1] ** 2))
        return product, other

    def slopes(self, change: FloatArray) -> tuple[float, FloatArray]:
        """What is maximised, and its derivative split by the frames that it comes from, shape (frames, 10)."""
        total, rows = 0.0, []
        for one, thermal, weight in zip(self.edges, self.thermal, self._weights):
            values = thermal.sample(self.rig.project(change, one.points))
            by_real, by_imaginary = (self._scale * weight * part for part in (one.value.real, one.value.imag))
            total += float(by_real @ values[:, 0] + by_imaginary @ values[:, 1])
            slope = np.column_stack([by_real * values[:, k] + by_imaginary * values[:, k + 1] for k in (2, 4)])
            rows.append(self.rig.pull_back(change, one.points, slope))
        return total, np.array(rows)


def _bilinear(planes: npt.NDArray[np.float32], pixels: FloatArray) -> npt.NDArray[np.float32]:
    """Sample planes (height, width, k) at pixel positions (n, 2); NaN and what is far off reads the corner."""
    rows, columns, depth = planes.shape
    place = np.nan_to_num(pixels, nan=-9.0, posinf=-9.0, neginf=-9.0) - 0.5
    x, y = np.clip(place[:, 0], 0.0, columns - 1.001), np.clip(place[:, 1], 0.0, rows - 1.001)
    left, top = x.astype(np.int64), y.astype(np.int64)
    u, v = (x - left).astype(np.float32)[:, None], (y - top).astype(np.float32)[:, None]
    flat, first = planes.reshape(rows * columns, depth), top * columns + left
    above = flat[first] * (1 - u) + flat[first + 1] * u
    below = flat[first + columns] * (1 - u) + flat[first + columns + 1] * u
    return above * (1 - v) + below * v


def _ramp(length: int) -> npt.NDArray[np.float64]:
    """0 near both ends, where edges are not known well, and 1 from a small share of the length on."""
    distance = np.minimum(np.arange(length) + 0.5, length - np.arange(length) - 0.5) - _BORDER_PX
    return np.clip(distance / max(_BORDER_SHARE * length, 2.0), 0.0, 1.0)
