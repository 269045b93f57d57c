"""Density thresholds that tell solid voxels from empty ones: four rules."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.snapshot import GridSnapshot

FALLBACK_OPTICAL_DEPTH = 0.5
"""Density times voxel edge from which on a voxel is solid where rays say nothing: it takes 39 % of the light."""
SHARE_OF_RAYS = 0.95  # share of the rays that end on something that are to meet a solid voxel where they end
OPTICAL_DEPTH_BOUNDS = (0.02, math.log(2.0))
"""The automatic threshold times the voxel edge stays within these. Below the first a ray needs 35 voxels to lose half
of its light: half-transparent space, no surface. From the second on a single voxel stops half of it: a surface,
whatever stands behind it."""
OPAQUE_OPTICAL_DEPTH = 2.0
"""Density times voxel edge from which on a voxel is solid even though no ray ends in it: it stops 86 %."""
SHARE_THAT_ENDS = 0.5
"""Rays that end in a voxel, per weight that rays spent in it, above which it is part of what they end on. In a voxel
that ends all rays that come it is 1; where light leaked past a surface, or was lost before it, it is 0."""
LEAST_WEIGHT = 0.5
"""Weight that rays spent in a voxel, [rays], below which it does not tell whether any end there: a ray that ends in a
voxel spends about half of its weight there. Where rays are few, density alone decides."""
FEWEST_RAYS = 100  # with fewer rays than this that end on something, there is no evidence to choose by


@dataclass(frozen=True)
class Threshold:
    """The voxels that are dense enough."""

    cells: BoolArray
    """True where a voxel is dense enough, not empty and not ruled out by rays, shape `lattice.cell_shape`."""
    density: float  # density at the voxel centre from which on it is dense enough, [1 / world unit]
    explanation: str  # which rule chose it, and why, in one or two sentences


def automatic_threshold(snapshot: GridSnapshot, density: FloatArray) -> Threshold:
    """Choose the threshold, and the voxels that reach it, by where training rays end.

    A ray ends where half of its weight is spent. What it meets there is the densest voxel within half a voxel of that
    point (`RayEvidence.half_depth_density`): in whichever part of a voxel a sharp surface lies, a solid one is among
    them. The threshold is the highest density that `SHARE_OF_RAYS` of the rays meet, within `OPTICAL_DEPTH_BOUNDS`:
    what nearly all rays end on is solid, and what they merely pass through goes.

    Where rays spend weight but hardly any ends, density is what light left that leaked past a surface, or was lost
    beside it. Such a voxel must be opaque by itself (`OPAQUE_OPTICAL_DEPTH`). A few of them behind a surface would
    otherwise widen the body by a layer: the inside that no camera sees reaches as far as its farthest voxels.

    Without evidence the rule is that of `optical_depth_threshold`; without `RayEvidence.voxel_ends` all voxels that
    reach the threshold are solid. `density` is that at the voxel centres.
    """
    evidence = snapshot.evidence
    if evidence is None or len(evidence.half_depth_density) < FEWEST_RAYS:
        found = optical_depth_threshold(snapshot, density, FALLBACK_OPTICAL_DEPTH)
        known = "nothing is known of" if evidence is None else f"only {len(evidence.half_depth_density)} rays end among"
        reason = f"Automatic: {known} the training rays, so the rule is a fixed optical depth. {found.explanation}"
        return Threshold(found.cells, found.density, reason)
    voxel = snapshot.lattice.voxel_size
    met = evidence.half_depth_density
    low, high = (depth / voxel for depth in OPTICAL_DEPTH_BOUNDS)
    threshold = min(max(float(np.quantile(met, 1.0 - SHARE_OF_RAYS, method="lower")), low), high)
    # The densities of rays are float32; the threshold is one of them, and its own voxel must reach it.
    dense = density >= np.float32(threshold)
    cells, weight = dense, evidence.voxel_weight
    if evidence.voxel_ends is not None:
        passed = (evidence.voxel_ends <= SHARE_THAT_ENDS * weight) & (weight >= LEAST_WEIGHT)
        cells = dense & ~(passed & (density * voxel < OPAQUE_OPTICAL_DEPTH))
    held = float(weight[cells].sum(dtype=np.float64) / max(weight.sum(dtype=np.float64), 1e-300))
    share = float(np.mean(met >= np.float32(threshold)))
    bound = {low: ", the least that is not half-transparent", high: ", the most that is asked"}.get(threshold, "")
    count = np.count_nonzero(dense) - np.count_nonzero(cells)
    left_out = (
        f"{count} voxels that dense are left out: hardly any ray ends in them and they are not opaque by themselves. "
        if count
        else ""
    )
    return Threshold(
        cells,
        threshold,
        f"Automatic: {share:.0%} of the {len(met)} training rays that end on something meet, within half a voxel of "
        f"there, a voxel of density {threshold:.4g} or more (optical depth {threshold * voxel:.2g} per voxel{bound}). "
        f"{left_out}Those that are solid hold {held:.0%} of the weight that rays spent.",
    )


def optical_depth_threshold(snapshot: GridSnapshot, density: FloatArray, optical_depth: float) -> Threshold:
    """Choose voxels in which density times edge length is at least `optical_depth`."""
    threshold = optical_depth / snapshot.lattice.voxel_size
    lost = 1.0 - np.exp(-optical_depth)
    return Threshold(
        density >= threshold,
        threshold,
        f"Voxels of optical depth {optical_depth:g} or more are solid (density {threshold:.4g}): light that crosses "
        f"one loses at least {lost:.0%}.",
    )


def density_threshold(density: FloatArray, threshold: float) -> Threshold:
    """Choose voxels of at least the given density, [1 / world unit]; a voxel without density is never solid."""
    cells = (density >= threshold) & (density > 0.0)
    return Threshold(cells, float(threshold), f"Voxels of density {threshold:g} or more are solid, as asked.")


def percentile_threshold(density: FloatArray, percentile: float) -> Threshold:
    """Choose the densest (100 - percentile) % of all voxels of the box, as in the Thermoxels paper.

    Where more voxels tie at the threshold than were asked for (space that training never touched keeps its starting
    value), only the denser ones are taken, if there are any.

    Raises:
        MeshError: All voxels have the same density.
    """
    threshold = float(np.percentile(density, percentile))
    if percentile > 0.0 and 0.0 < density.min() == density.max():
        remedy = "Train longer, or pass --density-threshold to say from which density on a voxel is solid."
        got = f"the same density {threshold:.6g} in all {density.size} voxels"
        raise MeshError("density", expected="some voxels denser than others", got=got, remedy=remedy)
    positive = density > 0.0
    reached = positive & (density >= threshold)
    denser = positive & (density > threshold)
    asked = np.ceil((1.0 - percentile / 100.0) * density.size) + 1
    tied = np.count_nonzero(reached) > asked and bool(denser.any())
    return Threshold(
        denser if tied else reached,
        threshold,
        f"The densest {100.0 - percentile:g} % of all voxels are solid, as asked: "
        f"{'more than' if tied else 'at least'} density {threshold:.4g}.",
    )
