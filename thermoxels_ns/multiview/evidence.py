"""Evidence from the training photographs of a scene before there is a model: depths, backdrop, gains, offsets."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.multiview.backdrop import upwards
from thermoxels_ns.multiview.differences import matters, photograph_differences, without_gains
from thermoxels_ns.multiview.photographs import Photographs, read_photographs, thermal_at
from thermoxels_ns.multiview.stereo import depths_before_backdrop, depths_of, feature_rays_to_depths, rays_through

LEAST_SHARE = 0.01  # Depths are used if at least this share of the pixels has a sure depth; fewer may be chance
BEYOND = 1e3  # Distance of a backdrop, in diagonals of the box
TAIL = 0.5  # Share of points left out at either end of each axis, for the hull on which a ceiling lies, [%]
FEWEST_POINTS = 100  # Points in the box that such a hull needs
LEAST_UP = 0.5
"""Least cosine between the vertical and the normal of a side of the hull that may be a ceiling: 60 degrees. In two
drawn rooms 0.9 chooses the same rays within 2 %."""
CEILING_ERROR = 0.02  # Standard error of a ceiling's depth, of the depth; in a drawn living room 1.8 % in the median
LEAST_GAIN = 0.01  # Gains are corrected if the root mean square of their logarithms is above this
LEAST_OFFSET_K = 0.1  # Offsets of thermal images are corrected if their root mean square is above this, [K]


@dataclass(frozen=True, eq=False)
class PhotographEvidence:
    """Evidence from training photographs before there is a model."""

    photographs: Photographs  # Small photographs, already corrected by `log_gain` and `offset`
    depth: Float32Array  # Depth of each pixel where it is sure, else NaN, shape (pixels,), [world units]
    backdrop: BoolArray  # True for pixels that show a plain backdrop, shape (pixels,)
    ceiling: BoolArray  # True for pixels that show the plain ceiling of a room, shape (pixels,)
    feature_rays: FeatureRays | None
    """Rays to the depths on which several photographs agree; None if there are too few such depths (`LEAST_SHARE`)."""
    log_gain: FloatArray | None
    """Natural logarithm of the gain of each channel, (photographs, 3); None: gains were not corrected."""
    offset: FloatArray | None  # Offset of normalised temperature, (photographs,); None: offsets were not corrected

    def plain_rays(self, lo: FloatArray, hi: FloatArray) -> FeatureRays | None:
        """Return one ray per plain pixel: to a point far behind the box from `lo` to `hi`, or to a point on a ceiling.

        A ceiling is taken to lie on the convex hull of known points in the box: of the half of least relative error,
        since errors push the hull outwards, and without the outermost along each axis (`TAIL`). A pixel whose ray
        leaves the hull through a steep side (`LEAST_UP`) has no ray: it may show a plain wall that looks like the
        ceiling, and that may be nearer. None if fewer than `LEAST_SHARE` of the pixels have a ray, or if a ceiling has
        fewer than `FEWEST_POINTS` known points.
        """
        (chosen,) = np.nonzero(self.backdrop | self.ceiling)
        if len(chosen) < LEAST_SHARE * len(self.backdrop):
            return None
        if not self.ceiling.any():
            return rays_through(self.photographs, chosen, np.full(len(chosen), BEYOND * np.linalg.norm(hi - lo)))
        from scipy.spatial import ConvexHull  # slow to import and only needed here

        points, rays = np.zeros((0, 3)), self.feature_rays
        if rays is not None:
            points = rays.points[rays.point]
            error = rays.uncertainty / np.maximum(np.linalg.norm(points - rays.origins, axis=1), 1e-12)
            points = points[error <= (1.0 + 1e-5) * np.median(error)]  # equal ones count as equal
        points = points[((points >= lo) & (points <= hi)).all(axis=1)]  # a window shows things outside, too
        if len(points) < FEWEST_POINTS:
            return None
        low, high = np.percentile(points, (TAIL, 100.0 - TAIL), axis=0)
        hull = ConvexHull(points[((points >= low) & (points <= high)).all(axis=1)])
        origins, along = self.photographs.of_pixels(chosen)
        depth, up, is_above = np.full(len(chosen), np.inf), upwards(self.photographs), np.zeros(len(chosen), dtype=bool)
        for *normal, offset in hull.equations:
            outwards = along @ normal
            with np.errstate(divide="ignore"):
                here = np.where(outwards > 0.0, -(origins @ normal + offset) / outwards, np.inf)
            is_above[here < depth] = up @ normal > LEAST_UP
            depth = np.minimum(depth, here)
        inside = (depth > 0.0) & np.isfinite(depth) & is_above
        if inside.sum() < LEAST_SHARE * len(self.ceiling):
            return None
        depth = depth[inside]
        return rays_through(self.photographs, chosen[inside], depth, CEILING_ERROR * depth)


def evidence_of_photographs(
    dataset: Any,
    near: float,
    lo: npt.ArrayLike,
    hi: npt.ArrayLike,
    say: Callable[[str], None],
    gains: bool = True,
    offsets: bool = True,
) -> PhotographEvidence:
    """Return the evidence that the photographs of `dataset`, a `ThermalDataset`, give by comparison with each other.

    Depths are sought beyond the depth `near`, in the box from `lo` to `hi` and behind it, [world units]. If `gains` or
    `offsets` is True, these are estimated, and corrected if they matter. `say` receives the findings as text.
    """
    began = time.perf_counter()
    depths = depths_of(read_photographs(dataset, near), lo, hi)
    photographs = depths.photographs
    few = "" if depths.share >= LEAST_SHARE else ", too few to tell anything"
    temperatures = dataset.temperature_range
    span_k = 1.0 if temperatures is None else temperatures.span_k
    # Cameras of their own show a pixel of unknown depth about where they show the sky.
    far = np.float32(BEYOND * np.linalg.norm(np.subtract(hi, lo)))
    thermal = thermal_at(dataset, photographs, np.where(np.isnan(depths.depth), far, depths.depth))
    photographs = replace(photographs, thermal=thermal)
    log_gain = offset = None
    found = error = np.zeros((0, 4))
    if gains or offsets:
        found, error = photograph_differences(depths, thermal)
    if gains and matters(found[:, :3], error[:, :3], LEAST_GAIN):
        log_gain = found[:, :3]
        photographs = without_gains(photographs, log_gain)
        say(f"photographs differ in brightness and white balance by {np.std(log_gain):.1%}: corrected")
    if offsets and matters(found[:, 3], error[:, 3], LEAST_OFFSET_K / span_k):
        offset = found[:, 3]
        photographs = replace(photographs, thermal=thermal - offset.astype(np.float32)[photographs.numbers])
        say(f"thermal images are offset against each other by {np.std(offset) * span_k:.2f} K: corrected")
    depths, backdrop, ceiling = depths_before_backdrop(replace(depths, photographs=photographs))
    plain = f"a plain {'ceiling' if ceiling.any() else 'backdrop'} fills {np.mean(backdrop | ceiling):.1%}"
    say(
        f"depths: {len(photographs)} photographs agree about {depths.share:.1%} of their pixels{few}; {plain}; "
        f"{time.perf_counter() - began:.1f} s"
    )
    rays = None if few else feature_rays_to_depths(depths)
    return PhotographEvidence(photographs, depths.depth, backdrop, ceiling, rays, log_gain, offset)
