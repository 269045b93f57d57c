"""Score of a rig: how well photographs' edges agree with the thermal edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

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
    """Edge values of one thermal image, and how much they count."""

    def __init__(self, field: npt.NDArray[np.complex64]) -> None:
        """Take edge values, shape (height, width)."""
        height, width = field.shape
        self.field = field
        self.weight: npt.NDArray[np.float32] = np.minimum.outer(_ramp(height), _ramp(width)).astype(np.float32)
        self.slopes = np.gradient(field)[::-1]  # along x and y


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
        self._weights = [sampled(t.weight, rig.project(around, e.points)) for e, t in zip(edges, thermal)]
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
            found = sampled(thermal.field, self.rig.project(change, one.points))
            product += float(weight @ (one.value.conj() * found).real)
            other += float(weight @ np.abs(found) ** 2)
        return product, other

    def slopes(self, change: FloatArray) -> tuple[float, FloatArray]:
        """What is maximised, and its derivative split by the frames that it comes from, shape (frames, 10)."""
        total, rows = 0.0, []
        for one, thermal, weight in zip(self.edges, self.thermal, self._weights):
            pixels = self.rig.project(change, one.points)
            by_value = self._scale * weight * one.value.conj()
            total += float((by_value @ sampled(thermal.field, pixels)).real)
            by_pixel = np.column_stack([(by_value * sampled(slope, pixels)).real for slope in thermal.slopes])
            rows.append(np.einsum("nx,nxk->k", by_pixel, self.rig.slopes(change, one.points)))
        return total, np.array(rows)


def sampled(image: npt.NDArray, pixels: FloatArray, order: int = 1, outside: str = "constant") -> npt.NDArray:
    """Values of an image (of the coefficients of its spline, for an order above 1) at pixels (n, 2).

    Outside they are 0, or with `outside` "nearest" those of the border; NaN lies outside.
    """
    place = np.nan_to_num(pixels, nan=-9.0)[:, ::-1].T - 0.5
    return np.asarray(map_coordinates(image, place, order=order, prefilter=False, mode=outside))


def _ramp(length: int) -> npt.NDArray[np.float64]:
    """0 near both ends, where edges are not known well, and 1 from a small share of the length on."""
    distance = np.minimum(np.arange(length) + 0.5, length - np.arange(length) - 0.5) - _BORDER_PX
    return np.clip(distance / max(_BORDER_SHARE * length, 2.0), 0.0, 1.0)
