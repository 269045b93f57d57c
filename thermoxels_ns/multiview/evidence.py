"""What the training photographs of a scene say before there is a model."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.multiview.differences import matters, photograph_differences
from thermoxels_ns.multiview.photographs import Photographs, read_photographs, thermal_at
from thermoxels_ns.multiview.stereo import (
    Depths,
    depths_before_backdrop,
    depths_of,
    feature_rays_to_depths,
    rays_through,
)

LEAST_SHARE = 0.01  # Share of the pixels whose depth must be sure; less is chance
REFINED_SIDE = 640  # Pixels along the longer side of the photographs in which depths are refined
LEAST_GAIN = 0.01  # Root mean square of the logarithms of gains from which on photographs are corrected
LEAST_OFFSET_K = 0.1  # The same of offsets of thermal images, [K]


@dataclass(frozen=True, eq=False)
class PhotographEvidence:
    """What training photographs say before there is a model."""

    photographs: Photographs  # The photographs, small, without differences of gain and offset that matter
    backdrop: BoolArray  # Which of their pixels show a plain backdrop, shape (pixels,)
    feature_rays: FeatureRays | None
    """Rays to each depth that several photographs agree about; None where these are too few to tell anything."""
    log_gain: FloatArray | None
    """Logarithm of the gain of each photograph and channel, (photographs, 3); None: none that matters was found."""
    offset: FloatArray | None  # Offset of each thermal image, of the temperature range, (photographs,), or None


def depths_of_dataset(dataset: Any, near: float, lo: npt.ArrayLike, hi: npt.ArrayLike) -> Depths | None:
    """Depths of a `ThermalDataset`'s photographs behind `near`, in the box from `lo` to `hi` and behind it.

    All in world units; None without perspective photographs.
    """
    photographs = read_photographs(dataset, near)
    if photographs is None:
        return None
    return depths_of(photographs, lo, hi, larger=read_photographs(dataset, near, longest_side=REFINED_SIDE))


def evidence_of_photographs(
    dataset: Any,
    near: float,
    lo: npt.ArrayLike,
    hi: npt.ArrayLike,
    say: Callable[[str], None],
    gains: bool = True,
    offsets: bool = True,
) -> PhotographEvidence | None:
    """Compare training photographs with each other, and say what was found; None without perspective photographs.

    Depths are looked for behind `near`, in the box from `lo` to `hi` and beyond it, [world units]. `gains` and
    `offsets` say which differences between photographs are looked for.
    """
    began = time.perf_counter()
    depths = depths_of_dataset(dataset, near, lo, hi)
    if depths is None:
        return None
    photographs = depths.photographs
    few = "" if depths.share >= LEAST_SHARE else ", too few to tell anything"
    span_k = dataset.temperature_range.span_k
    found = photograph_differences(depths, thermal_at(dataset, photographs, depths.depth)) if gains or offsets else None
    log_gain = offset = None
    if gains and found is not None and matters(found.log_gain, found.log_gain_error, LEAST_GAIN):
        log_gain, photographs = found.log_gain, found.without_gains(photographs)
        say(f"photographs differ in brightness and white balance by {np.std(log_gain):.1%}: corrected")
    if offsets and found is not None and matters(found.offset, found.offset_error, LEAST_OFFSET_K / span_k):
        offset, photographs = found.offset, found.without_offsets(photographs)
        say(f"thermal images are offset against each other by {np.std(offset) * span_k:.2f} K: corrected")
    depths, backdrop = depths_before_backdrop(replace(depths, photographs=photographs))
    say(
        f"depths: {len(photographs)} photographs agree about {depths.share:.1%} of their pixels{few}; "
        f"a plain backdrop fills {backdrop.mean():.1%}; {time.perf_counter() - began:.1f} s"
    )
    rays = None if few else feature_rays_to_depths(depths)
    return PhotographEvidence(photographs, backdrop, rays, log_gain, offset)


def rays_through_backdrop(photographs: Photographs, backdrop: BoolArray, beyond: float) -> FeatureRays | None:
    """Rays through the pixels of a backdrop, to points so far away [world units]; None where hardly any shows one."""
    (chosen,) = np.nonzero(backdrop)
    enough = len(chosen) >= LEAST_SHARE * len(backdrop)
    return rays_through(photographs, chosen, np.full(len(chosen), beyond)) if enough else None
