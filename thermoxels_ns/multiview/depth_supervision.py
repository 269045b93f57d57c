"""Depth supervision: feature rays to depths that several photographs agree about."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.multiview.photographs import read_photographs
from thermoxels_ns.multiview.stereo import Depths, depths_of

LEAST_SHARE = 0.01
"""Share of the pixels whose depth must be sure; less is chance."""
ERROR_PLANES = 0.25
"""Standard error of a depth, in planes of the sweep."""


def feature_rays_to_depths(depths: Depths) -> FeatureRays:
    """One line of sight per sure pixel, to a point of its own.

    Args:
        depths: Of photographs.

    Returns:
        The lines, photograph after photograph, [world units]. A line's uncertainty is `ERROR_PLANES` times the distance
        between the planes of its sweep, along the line.
    """
    photographs = depths.photographs
    (sure,) = np.nonzero(np.isfinite(depths.depth))
    number = np.searchsorted(photographs.firsts, sure, side="right") - 1
    place, width = sure - photographs.firsts[number], photographs.sizes[number, 0]
    pixel = np.column_stack((place % width + 0.5, place // width + 0.5, np.ones(len(sure))))
    inverses = np.linalg.inv(photographs.matrices[:, :, :3])
    along = np.einsum("nij,nj->ni", inverses[number], pixel)  # of depth 1
    origins = photographs.centres[number]
    points = origins + depths.depth[sure, None].astype(np.float64) * along
    error = ERROR_PLANES * depths.error[sure].astype(np.float64) * np.linalg.norm(along, axis=1)
    return FeatureRays(origins, np.arange(len(sure)), points, error)


def feature_rays_of_photographs(
    dataset: Any, near: float, lo: npt.ArrayLike, hi: npt.ArrayLike, say: Callable[[str], None]
) -> FeatureRays | None:
    """Find how far away is what training photographs show, and say what was found.

    Args:
        dataset: The training photographs, see `read_photographs`.
        near: Depth up to which they show nothing, [world units].
        lo: Lower corner of the box in which depths are looked for, [world units].
        hi: Upper corner.
        say: Told what was found.

    Returns:
        A ray to each depth that several photographs agree about; None where they say too little.
    """
    began = time.perf_counter()
    photographs = read_photographs(dataset, near)
    if photographs is None:
        return None
    depths = depths_of(photographs, lo, hi)
    few = "" if depths.share >= LEAST_SHARE else ", too few to tell anything"
    say(
        f"depths: {len(photographs)} photographs agree about {depths.share:.1%} of their pixels{few}; "
        f"{time.perf_counter() - began:.1f} s"
    )
    return None if few else feature_rays_to_depths(depths)
