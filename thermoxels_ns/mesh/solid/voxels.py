"""Which voxels are solid: dense enough, gaps closed, in the region, no floaters, walls thick, interiors filled."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from thermoxels_ns.core.checks import check_positive
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh.solid.interior import THINNEST_GROWN, interior, wall_behind
from thermoxels_ns.mesh.solid.level_set import level_of
from thermoxels_ns.mesh.solid.morphology import close_gaps, connected
from thermoxels_ns.mesh.solid.region import Ball, Box, RegionKind, asked_region, check_region, where_cameras_look

InteriorKind = Literal["solid", "hollow"]

SMALLEST_BODY = 0.01
"""Bodies (voxels that touch, if only by corners) of less than this share of the largest are mostly floaters."""
FALLBACK_OPTICAL_DEPTH = 0.5  # density times voxel edge from which on a voxel is solid where rays say nothing
SHARE_OF_RAYS = 0.95  # share of the rays that end on something that are to meet a solid voxel where they end
OPTICAL_DEPTH_BOUNDS = (0.02, math.log(2.0))
"""The automatic threshold times the voxel edge stays within these. Below the first a ray needs 35 voxels to lose half
of its light: half-transparent space. From the second on a single voxel stops half of it: a surface."""
OPAQUE_OPTICAL_DEPTH = 2.0  # density times voxel edge from which on a voxel is solid even though no ray ends in it
SHARE_THAT_ENDS = 0.5
"""Rays that end in a voxel, per weight that rays spent in it, above which it is part of what they end on: 1 in a voxel
that ends all rays that come, 0 where light leaked past a surface."""
LEAST_WEIGHT = 0.5  # weight that rays spent in a voxel, [rays], below which density alone decides about it
FEWEST_RAYS = 100  # with fewer rays than this that end on something, there is no evidence to choose by


@dataclass(frozen=True)
class SolidSelection:
    """How solid voxels are told from empty ones, as the options of an export of the same names say."""

    voxel_optical_depth: float | None = None  # density times edge length; without any threshold it is automatic
    density_percentile: float | None = None
    """Over all voxels of the box, 0 to 100, as in the Thermoxels paper. Overrides the optical depth."""
    density_threshold: float | None = None  # [1 / world unit of the trained scene]; overrides both
    close_gaps: int = 1  # gaps up to twice this many voxels wide are filled (a morphological closing)
    region: RegionKind = "auto"
    region_box: Box | None = None  # in place of auto; in the coordinates of the input poses
    region_near: Ball | None = None  # the same
    interior: InteriorKind = "solid"
    seal_openings: int = 2  # openings up to twice this many voxels wide count as closed while looking for the inside
    wall_thickness: float | None = None  # [m]; takes the place of filling the interior

    def __post_init__(self) -> None:
        for name, (kind, high, usual) in _BOUNDS.items():
            value, option = getattr(self, name), f"--{name.replace('_', '-')}"
            number = isinstance(value, kind) and not isinstance(value, bool) and math.isfinite(value)
            if not ((number and 0 <= value <= high) or (value is None and usual is None)):
                what = "a whole number" if kind is int else "a finite number"
                expected = f"{what} of at least 0" if high == math.inf else f"{what} from 0 to {high:g}"
                remedy = f"Leave {option} out." if usual is None else f"Pass {option} {usual}, or leave it out."
                raise MeshError(name, expected=expected, got=repr(value), remedy=remedy)
        for name in ("voxel_optical_depth", "wall_thickness"):
            if getattr(self, name) is not None:
                check_positive(name, getattr(self, name), f"Leave --{name.replace('_', '-')} out.", MeshError)
        check_region(self.region, self.region_box, self.region_near)
        if self.interior not in get_args(InteriorKind):
            kinds = " or ".join(get_args(InteriorKind))
            raise MeshError("interior", expected=kinds, got=repr(self.interior), remedy="Pass --interior solid.")


_BOUNDS: dict[str, tuple[Any, float, int | None]] = {
    "density_percentile": ((int, float), 100.0, None),
    "density_threshold": ((int, float), math.inf, None),
    "close_gaps": (int, 100, 1),
    "seal_openings": (int, 100, 2),
}
"""Type and most of options from 0 on; what to pass instead, None for those that may be None."""


@dataclass(frozen=True)
class SolidStep:
    """What one step on the way from density to solid did."""

    name: str  # threshold, close gaps, region, wall or interior
    added: int  # voxels that it made solid
    removed: int  # voxels that it made empty
    remark: str  # how and why, in a sentence or two


@dataclass(frozen=True)
class SolidCells:
    """The solid voxels and how they were found."""

    cells: BoolArray  # True where a voxel is solid, shape (nx-1, ny-1, nz-1); at least one is
    level: Float32Array
    """Above 0 in solid voxels, below 0 in empty ones, in [-1, 1]; its trilinear zero between voxel centres is the
    surface. Shape of `cells`."""
    threshold: float  # density at voxel centres from which on a voxel counted as solid, [1 / world unit]
    explanation: str  # which rule chose the threshold, and why
    steps: tuple[SolidStep, ...]  # what each step did, in order; the first is the threshold
    component_sizes: IntArray  # Voxels in each body of the region once gaps are closed, largest first
    within: BoolArray
    """The region, solid or not. Where it ends the solid is cut, as it is where the lattice ends."""
    left_out: BoolArray  # Voxels that are solid, but not in the region or too small a body


def select_solid(
    snapshot: GridSnapshot,
    selection: SolidSelection,
    metres_per_world_unit: float | None = None,
    world_to_input: FloatArray | None = None,
    *,
    makes_up_volume: bool = True,
) -> SolidCells:
    """Choose the solid voxels of a trained field, by the density at their centres.

    A voxel without density is solid only if a step after the threshold makes it so. Only a wall thickness needs
    `metres_per_world_unit`; `world_to_input`, shape (3, 4), which leads to the coordinates of the region's box or
    point, is the identity if left out; `makes_up_volume` as in `level_of`.

    Raises:
        MeshError: No voxel is solid, or none in the region; density does not tell solid from empty; or a wall thickness
            is asked for but the scale or the cameras are not known.
    """
    thickness = _wall_voxels(snapshot, selection, metres_per_world_unit)
    density = snapshot.centre_density()
    chosen = _threshold(snapshot, density, selection)
    if not chosen.cells.any():
        expected = f"at least one voxel with density above 0 and at least the threshold {chosen.density:.6g}"
        got = f"none of {density.size}; the highest density at a voxel centre is {density.max():.6g}"
        remedy = "Train longer, or lower --voxel-optical-depth, --density-threshold or --density-percentile."
        raise MeshError("solid voxels", expected=expected, got=got, remedy=remedy)
    cells = chosen.cells
    steps = [SolidStep("threshold", int(cells.sum()), 0, chosen.explanation)]

    def step(name: str, after: BoolArray, remark: str) -> BoolArray:
        steps.append(SolidStep(name, int((after & ~cells).sum()), int((cells & ~after).sum()), remark))
        return after

    if selection.close_gaps:
        remark = f"Gaps up to {2 * selection.close_gaps} voxels wide are filled."
        cells = step("close gaps", close_gaps(cells, selection.close_gaps), remark)
    everything = cells
    within, where = _region(cells, snapshot, selection, world_to_input)
    kept, sizes, small = _without_floaters(cells & within, 0.0 if selection.region == "all" else SMALLEST_BODY)
    cells = step("region", kept, f"{where} {small}")
    left_out = everything & ~cells
    # What is left out still stands between cameras and what is taken; floaters never stood anywhere.
    standing = cells | (everything & ~within)
    if thickness is not None:
        assert snapshot.views is not None
        wall = cells | (wall_behind(standing, snapshot.lattice, snapshot.views, thickness) & within)
        asked = f"{selection.wall_thickness:g} m thick ({thickness:.3g} voxels)"
        remark = f"The seen surface is made {asked}."
        if thickness < THINNEST_GROWN:
            remark = f"A wall {asked} is thinner than one and a half voxels; the seen surface stays as thick as it is."
        cells = step("wall", wall, remark)
    elif selection.interior == "solid":
        inside, remark = _inside(standing, within, snapshot, selection)
        cells = step("interior", cells | inside, remark)
    return SolidCells(
        cells=cells,
        level=level_of(density, chosen.density, chosen.cells, cells, makes_up_volume=makes_up_volume),
        threshold=chosen.density,
        explanation=chosen.explanation,
        steps=tuple(steps),
        component_sizes=np.sort(sizes)[::-1].astype(np.int64),
        within=within,
        left_out=left_out,
    )


def _threshold(snapshot: GridSnapshot, density: FloatArray, selection: SolidSelection) -> Threshold:
    """The voxels that are dense enough, by the rule that is asked for."""
    if selection.density_threshold is not None:
        return density_threshold(density, selection.density_threshold)
    if selection.density_percentile is not None:
        return percentile_threshold(density, selection.density_percentile)
    if selection.voxel_optical_depth is not None:
        return optical_depth_threshold(snapshot, density, selection.voxel_optical_depth)
    return automatic_threshold(snapshot, density)


def _region(
    cells: BoolArray, snapshot: GridSnapshot, selection: SolidSelection, world_to_input: FloatArray | None
) -> tuple[BoolArray, str]:
    """The voxels, solid or not, that belong to what is asked for, and which these are."""
    box, near, views = selection.region_box, selection.region_near, snapshot.views
    if box is not None or near is not None:
        to_input = np.eye(4)[:3] if world_to_input is None else world_to_input
        what = (
            "What lies in the box is taken." if near is None else f"What lies within {near[3]:g} of a point is taken."
        )
        return asked_region(cells, snapshot.lattice, box, near, to_input), what
    if selection.region == "all":
        return np.ones_like(cells), "All is taken."
    if views is None or len(views.focal) == 0:
        return np.ones_like(cells), "The cameras are not known, so all is taken."
    what = "What photographs show about as well as what they were taken of is taken."
    return where_cameras_look(cells, snapshot.lattice, views), what


def _without_floaters(cells: BoolArray, smallest: float) -> tuple[BoolArray, IntArray, str]:
    """Drop bodies below this share of the largest; sizes of all of them, and what was done."""
    labels = connected(cells)
    sizes = np.bincount(labels.ravel())[1:]
    keep = sizes >= smallest * sizes.max()
    gone = f"{len(sizes) - int(keep.sum())} of {len(sizes)} bodies in it"
    remark = f"{gone} have less than {smallest:.0%} of the largest one's voxels and go."
    return np.concatenate(([False], keep))[labels], sizes, remark


def _inside(
    cells: BoolArray, within: BoolArray, snapshot: GridSnapshot, selection: SolidSelection
) -> tuple[BoolArray, str]:
    inside = interior(cells, snapshot.lattice, snapshot.views, selection.seal_openings, within)
    remark = f"{int(inside.enclosed.sum())} voxels of enclosed cavities are filled"
    if snapshot.views is None:
        remark += "; the cameras are not known, so nothing is known to be hidden from them."
    else:
        hidden = int(inside.hidden.sum())
        remark += f", and {hidden} voxels that cameras cannot look into, within the hull of their body."
    if inside.rooms:
        remark += f" {inside.rooms} cavities with a camera in them stay empty."
    return inside.enclosed | inside.hidden, remark


def _wall_voxels(
    snapshot: GridSnapshot, selection: SolidSelection, metres_per_world_unit: float | None
) -> float | None:
    """The wall thickness that is asked for, [voxels]."""
    if selection.wall_thickness is None:
        return None
    if metres_per_world_unit is None:
        remedy = "Pass --metres-per-unit 1 if the input poses are in metres, or leave out --wall-thickness."
        got = f"{selection.wall_thickness:g} m, but no length of a unit"
        raise MeshError("wall_thickness", expected="a scene whose scale is known", got=got, remedy=remedy)
    check_positive("metres_per_world_unit", metres_per_world_unit, "Pass --metres-per-unit.", MeshError)
    if snapshot.views is None or len(snapshot.views.focal) == 0:
        expected = "training cameras, which tell the side that is seen"
        remedy = "Export from a trained scene, or leave out --wall-thickness."
        raise MeshError("wall_thickness", expected=expected, got="a field without cameras", remedy=remedy)
    voxels = selection.wall_thickness / (metres_per_world_unit * snapshot.lattice.voxel_size)
    if voxels > max(snapshot.lattice.cell_shape):
        longest = selection.wall_thickness * max(snapshot.lattice.cell_shape) / voxels
        got, remedy = f"{selection.wall_thickness:g} m", "Pass it in metres, and check --metres-per-unit."
        raise MeshError("wall_thickness", expected=f"at most the scene box, {longest:.3g} m", got=got, remedy=remedy)
    return voxels


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
    point (`RayEvidence.half_depth_density`). The threshold is the highest density that `SHARE_OF_RAYS` of the rays
    meet, within `OPTICAL_DEPTH_BOUNDS`: what nearly all rays end on is solid, what they merely pass through goes.

    Where rays spend weight but hardly any ends, density is what light left that leaked past a surface. Such a voxel
    must be opaque by itself (`OPAQUE_OPTICAL_DEPTH`): a few behind a surface would widen the body by a layer.

    Without evidence the rule is that of `optical_depth_threshold`; without `RayEvidence.voxel_ends` all voxels that
    reach the threshold are solid. `density` is that at the voxel centres.
    """
    evidence, voxel = snapshot.evidence, snapshot.lattice.voxel_size
    if evidence is None or len(evidence.half_depth_density) < FEWEST_RAYS:
        found = optical_depth_threshold(snapshot, density, FALLBACK_OPTICAL_DEPTH)
        known = "nothing is known of" if evidence is None else f"only {len(evidence.half_depth_density)} rays end among"
        reason = f"Automatic: {known} the training rays, so the rule is a fixed optical depth. {found.explanation}"
        return Threshold(found.cells, found.density, reason)
    met, weight = evidence.half_depth_density, evidence.voxel_weight
    low, high = (depth / voxel for depth in OPTICAL_DEPTH_BOUNDS)
    threshold = min(max(float(np.quantile(met, 1.0 - SHARE_OF_RAYS, method="lower")), low), high)
    # The densities of rays are float32; the threshold is one of them, and its own voxel must reach it.
    cells = dense = density >= np.float32(threshold)
    if evidence.voxel_ends is not None:
        passed = (evidence.voxel_ends <= SHARE_THAT_ENDS * weight) & (weight >= LEAST_WEIGHT)
        cells = dense & ~(passed & (density * voxel < OPAQUE_OPTICAL_DEPTH))
    held = float(weight[cells].sum(dtype=np.float64) / max(weight.sum(dtype=np.float64), 1e-300))
    share = float(np.mean(met >= np.float32(threshold)))
    bound = {low: ", the least that is not half-transparent", high: ", the most that is asked"}.get(threshold, "")
    count, left_out = np.count_nonzero(dense) - np.count_nonzero(cells), ""
    if count:
        left_out = f"{count} voxels that dense are left out: hardly any ray ends in them and they are not opaque. "
    return Threshold(
        cells,
        threshold,
        f"Automatic: {share:.0%} of the {len(met)} training rays that end on something meet, within half a voxel of "
        f"there, a voxel of density {threshold:.4g} or more (optical depth {threshold * voxel:.2g} per voxel{bound}). "
        f"{left_out}Those that are solid hold {held:.0%} of the weight that rays spent.",
    )


def optical_depth_threshold(snapshot: GridSnapshot, density: FloatArray, optical_depth: float) -> Threshold:
    """Choose voxels in which density times edge length is at least `optical_depth`."""
    threshold, lost = optical_depth / snapshot.lattice.voxel_size, 1.0 - np.exp(-optical_depth)
    said = f"Voxels of optical depth {optical_depth:g} or more are solid (density {threshold:.4g}): light that crosses "
    return Threshold(density >= threshold, threshold, f"{said}one loses at least {lost:.0%}.")


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
    reached, denser = ((density > 0.0) & (over(density, threshold)) for over in (np.greater_equal, np.greater))
    asked = np.ceil((1.0 - percentile / 100.0) * density.size) + 1
    tied = np.count_nonzero(reached) > asked and bool(denser.any())
    said = f"{'more than' if tied else 'at least'} density {threshold:.4g}."
    explanation = f"The densest {100.0 - percentile:g} % of all voxels are solid, as asked: {said}"
    return Threshold(denser if tied else reached, threshold, explanation)
