"""From which density on a voxel is solid: four rules, each of which says what it chose and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.errors import MeshError, explain
from thermoxels_ns.snapshot import GridSnapshot

FALLBACK_OPTICAL_DEPTH = 0.5
"""Density times voxel edge from which on a voxel is solid where rays say nothing: it takes 39 % of the light."""
SHARE_OF_RAYS = 0.85
"""Share of the rays that end on something for which the voxel they end in is to be solid."""
OPTICAL_DEPTH_BOUNDS = (0.02, 1.0)
"""The automatic threshold times the voxel edge stays within these. Below the first a ray needs 35 voxels to lose half
of its light: fog, not a surface. From the second on a voxel stops 63 %: solid, whatever stands behind it."""
FEWEST_RAYS = 100
"""With fewer rays than this that end on something, there is no evidence to choose by."""


@dataclass(frozen=True)
class Threshold:
    """The voxels that are dense enough."""

    cells: npt.NDArray[np.bool_]
    """True where a voxel is dense enough and not empty, shape `lattice.cell_shape`."""
    density: float
    """Density at the voxel centre from which on that is so, [1 / world unit]."""
    explanation: str
    """Which rule chose it, and why, in one or two sentences."""


def automatic_threshold(snapshot: GridSnapshot, density: npt.NDArray[np.float64]) -> Threshold:
    """Choose the threshold by where training rays end.

    Light that leaks through a surface, or is lost in fog before it, says little about where the surface is; the voxel
    in which a ray has spent half of its weight is part of what it ends on. The threshold is the highest density that
    `SHARE_OF_RAYS` of these voxels have, ray by ray, within `OPTICAL_DEPTH_BOUNDS`: so surfaces stay closed for nearly
    all rays, and what rays merely pass through goes. Without evidence it is the rule of `optical_depth_threshold`.

    Args:
        snapshot: The trained field.
        density: Its density at the voxel centres.
    """
    evidence = snapshot.evidence
    if evidence is None or len(evidence.half_depth_density) < FEWEST_RAYS:
        found = optical_depth_threshold(snapshot, density, FALLBACK_OPTICAL_DEPTH)
        known = "nothing is known of" if evidence is None else f"only {len(evidence.half_depth_density)} rays end among"
        reason = f"Automatic: {known} the training rays, so the rule is a fixed optical depth. {found.explanation}"
        return Threshold(found.cells, found.density, reason)
    voxel = snapshot.lattice.voxel_size
    ends = float(np.quantile(evidence.half_depth_density, 1.0 - SHARE_OF_RAYS, method="lower"))
    low, high = (depth / voxel for depth in OPTICAL_DEPTH_BOUNDS)
    threshold = min(max(ends, low), high)
    # The densities of rays are float32; the threshold is one of them, and its own voxel must reach it.
    cells = density >= np.float32(threshold)
    weight = evidence.voxel_weight
    held = float(weight[cells].sum(dtype=np.float64) / max(weight.sum(dtype=np.float64), 1e-300))
    share = float(np.mean(evidence.half_depth_density >= np.float32(threshold)))
    bound = {low: ", the least that is not fog", high: ", the most that is asked"}.get(threshold, "")
    return Threshold(
        cells,
        threshold,
        f"Automatic: {share:.0%} of the {len(evidence.half_depth_density)} training rays that end on something end in "
        f"a voxel of density {threshold:.4g} or more (optical depth {threshold * voxel:.2g} per voxel{bound}). Voxels "
        f"that dense hold {held:.0%} of the weight that rays spent.",
    )


def optical_depth_threshold(
    snapshot: GridSnapshot, density: npt.NDArray[np.float64], optical_depth: float
) -> Threshold:
    """Choose voxels in which density times edge length is at least `optical_depth`."""
    threshold = optical_depth / snapshot.lattice.voxel_size
    lost = 1.0 - np.exp(-optical_depth)
    return Threshold(
        density >= threshold,
        threshold,
        f"Voxels of optical depth {optical_depth:g} or more are solid (density {threshold:.4g}): light that crosses "
        f"one loses at least {lost:.0%}.",
    )


def density_threshold(density: npt.NDArray[np.float64], threshold: float) -> Threshold:
    """Choose voxels of at least the given density, [1 / world unit]; a voxel without density is never solid."""
    cells = (density >= threshold) & (density > 0.0)
    return Threshold(cells, float(threshold), f"Voxels of density {threshold:g} or more are solid, as asked.")


def percentile_threshold(density: npt.NDArray[np.float64], percentile: float) -> Threshold:
    """Choose the densest (100 - percentile) % of all voxels of the box, as in the Thermoxels paper.

    Where more voxels tie at the threshold than were asked for (space that training never touched keeps its starting
    value), only the denser ones are taken, if there are any.

    Raises:
        MeshError: All voxels have the same density.
    """
    threshold = float(np.percentile(density, percentile))
    if percentile > 0.0 and 0.0 < density.min() == density.max():
        raise MeshError(
            explain(
                "density",
                expected="some voxels denser than others",
                got=f"the same density {threshold:.6g} in all {density.size} voxels",
                remedy="Train longer, or pass --density-threshold to say from which density on a voxel is solid.",
            )
        )
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
