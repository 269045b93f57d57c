"""Choice of the solid voxels: threshold, closing of gaps, region, removal of floaters, interior, surface, walls."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field
from scipy import ndimage

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence, Views
from thermoxels_ns.core.yaml_records import record, wrong
from thermoxels_ns.mesh.solid.free_space import MOST_CAMERAS, distance_to_ends, first_solid, without_front
from thermoxels_ns.mesh.solid.interior import THINNEST_GROWN, interior, wall_behind
from thermoxels_ns.mesh.solid.morphology import close_gaps, connected

_AsTuple = BeforeValidator(
    lambda given: tuple(np.asarray(given).tolist()) if isinstance(given, (list, np.ndarray)) else given
)
Box = Annotated[tuple[float, float, float, float, float, float], _AsTuple]
Ball = Annotated[tuple[float, float, float, float], _AsTuple]

SMALLEST_BODY = 0.01
"""Bodies (voxels that touch, if only by corners) with less than this share of the largest body's voxels are removed."""
FALLBACK_OPTICAL_DEPTH = 0.5  # least density times voxel edge of a solid voxel if there are too few rays to choose by
SHARE_OF_RAYS = 0.95  # share of the rays that end on something that shall meet a solid voxel at their end
OPTICAL_DEPTH_BOUNDS = (0.02, math.log(2.0))
"""Bounds of the automatic threshold, as density times voxel edge. At the first, a ray needs 35 voxels to lose half of
its light, as in half-transparent space. At the second, a single voxel stops half of the light, as a surface does."""
FEWEST_RAYS = 100  # least number of rays that end on something for the threshold to be chosen by rays
CENTRAL_PART, CENTRAL_RAYS = 0.5, 5  # share of an image's sides that counts as its middle, and rays along each side
NEAREST_SHARE = 0.25  # quantile of the distances to solid along these rays at which the camera is said to point
SEAL = 2  # openings up to twice this many voxels wide count as closed when the interior is found
MOST_BLOCKS = 500_000  # in lattices with more voxels, `where_cameras_look` interpolates between blocks of voxels


@record(MeshError)
class SolidSelection:
    """The rules that separate solid from empty voxels; the fields are the export's options of the same names."""

    density_percentile: Annotated[float, Field(ge=0, le=100)] | None = None
    """Percentile of the density of all voxels, as in the Thermoxels paper."""
    density_threshold: Annotated[float, Field(ge=0)] | None = None
    """Least density, [1 / world unit]; overrides the percentile. Rays choose if both are None."""
    close_gaps: Annotated[int, Field(ge=0, le=100)] = 1
    """Gaps up to twice this many voxels wide are filled (a morphological closing)."""
    region: Literal["auto", "all"] = "auto"  # auto: the voxels of `where_cameras_look`; all: all voxels
    region_box: Box | None = None  # xmin ymin zmin xmax ymax zmax, in coordinates of the input poses; replaces `region`
    region_near: Ball | None = None  # x y z radius in the same coordinates; replaces `region`
    interior: Literal["solid", "hollow"] = "solid"  # solid: the voxels of `interior` are filled; hollow: they are not
    wall_thickness: Annotated[float, Field(gt=0)] | None = None
    """Thickness that walls get instead of a filled interior, [m]."""

    def __post_init__(self) -> None:
        box, near = self.region_box, self.region_near
        if box is not None and not np.less(box[:3], box[3:]).all():
            expected, remedy = "xmin ymin zmin xmax ymax zmax, minima below maxima", "Pass --region-box 0 0 0 4 3 2."
            raise wrong("region_box", expected, box, remedy)
        if near is not None and not near[3] > 0:
            raise wrong("region_near", "x y z radius, above 0", near, "Pass --region-near 0 0 1 2.5.")
        asked = [f"--region {self.region}"] * (self.region != "auto")
        asked += ["--region-box"] * (box is not None) + ["--region-near"] * (near is not None)
        if len(asked) > 1:
            raise wrong("region", "one of them", " and ".join(asked), "Leave all but one of these options out.")


@dataclass(frozen=True)
class SolidStep:
    """The changes that one step on the way from density to solid voxels made."""

    name: str  # threshold, close gaps, region, interior, surface, wall or close rooms
    added: int  # number of voxels that the step made solid
    removed: int  # number of voxels that the step made empty
    remark: str  # one or two sentences on how and why


@dataclass(frozen=True)
class SolidCells:
    """The solid voxels of a field, their surface level, and the steps that found them."""

    cells: BoolArray  # True where a voxel is solid, shape (nx-1, ny-1, nz-1); at least one is
    dense: BoolArray  # True for voxels that the threshold chose
    threshold: float  # least density at the centre of a voxel that counts as dense, [1 / world unit]
    steps: tuple[SolidStep, ...]  # all steps in order; the remark of the first says which rule chose the threshold
    within: BoolArray  # True for voxels, solid or not, in the region; the solid is cut at its border
    left_out: BoolArray  # True for dense voxels and closed gaps outside the region or in bodies that were too small
    rooms: BoolArray | None  # True for empty voxels enclosed by walls of given thickness; None if not asked for
    distance: Float32Array | None = None  # Result of `distance_to_ends`; None if rays did not choose the threshold


def select_solid(
    snapshot: GridSnapshot,
    selection: SolidSelection,
    metres_per_world_unit: float = 1.0,
    world_to_input: FloatArray | None = None,
) -> SolidCells:
    """Return the solid voxels of a trained field: voxels above a density threshold, changed by further steps.

    `metres_per_world_unit` is used only for a wall thickness; the caller must then give a snapshot with cameras.
    `world_to_input`, (3, 4), maps world coordinates to those of the region's box or ball; None is the identity.

    Raises:
        MeshError: No voxel is dense enough; none lies in the box or ball asked for; a percentile is asked for and all
            voxels have one density; or the wall is thicker than the scene box.
    """
    voxel_m = metres_per_world_unit * snapshot.lattice.voxel_size
    wall_m, longest_m = selection.wall_thickness, max(snapshot.lattice.cell_shape) * voxel_m
    if wall_m is not None and wall_m > longest_m:
        expected, remedy = f"at most the scene box, {longest_m:.3g} m", "Pass metres, and check --metres-per-unit."
        raise MeshError("wall_thickness", expected=expected, got=f"{wall_m:g} m", remedy=remedy)
    density = snapshot.centre_density()
    chosen = dense_voxels(snapshot, density, selection)
    if not chosen.cells.any():
        expected = f"at least one voxel with density above 0 and at least the threshold {chosen.density:.6g}"
        got = f"none of {density.size}; the highest density at a voxel centre is {density.max():.6g}"
        remedy = "Train longer, or lower --density-threshold or --density-percentile."
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
    within, remark = _region(cells, snapshot, selection, world_to_input)
    least = 0.0 if selection.region == "all" else SMALLEST_BODY
    large, sizes = _large_bodies(cells & within, least)
    small = np.count_nonzero(sizes < least * sizes.max())
    remark += f" {small} of {len(sizes)} bodies in it have less than {least:.0%} of the largest one's voxels and go."
    cells = step("region", large, remark)
    left_out = everything & ~cells
    # Solid outside the region still blocks the view of cameras into the region; floaters block nothing.
    opaque, rooms = cells | (everything & ~within), None
    if wall_m is None and selection.interior == "solid":
        inside = interior(opaque, snapshot.lattice, snapshot.views, SEAL, within)
        remark = "Cavities without a camera are filled, and what cameras cannot look into within the hull of a body."
        cells = step("interior", cells | inside, remark)
    distance = None
    if chosen.by_rays:
        assert snapshot.evidence is not None
        remark = "Voxels with their centres in front of where rays end go, unless a ray then meets no solid."
        distance = distance_to_ends(snapshot.evidence, cells.shape)
        cells = step("surface", _large_bodies(without_front(cells, snapshot.evidence, distance), least)[0], remark)
        opaque = cells | (everything & ~within)
    if wall_m is not None:
        assert snapshot.views is not None, "the side that is seen is that of the cameras"
        thickness = wall_m / voxel_m
        wall = cells | (wall_behind(opaque, snapshot.lattice, snapshot.views, thickness) & within)
        asked = f"{wall_m:g} m thick ({thickness:.3g} voxels)"
        remark = f"The seen surface is made {asked}."
        if thickness < THINNEST_GROWN:
            remark = f"A wall {asked} is thinner than one and a half voxels; the seen surface stays as thick as it is."
        cells = step("wall", wall, remark)
        if selection.interior == "hollow":
            rooms = interior(opaque | cells, snapshot.lattice, snapshot.views, SEAL, within) & ~cells
            depth = np.asarray(ndimage.distance_transform_edt(cells | rooms | ~within))
            remark = "Where no camera looks, as below the lowest floor, the rooms are closed by a wall as thick."
            cells = step("close rooms", cells | (rooms & (depth <= thickness)), remark)
            rooms &= ~cells
    return SolidCells(
        cells=cells,
        dense=chosen.cells,
        threshold=chosen.density,
        steps=tuple(steps),
        within=within,
        left_out=left_out,
        rooms=rooms,
        distance=distance,
    )


def _large_bodies(cells: BoolArray, least: float) -> tuple[BoolArray, IntArray]:
    """Return the voxels of bodies of at least `least` times the largest body's size, and all sizes (b,), [voxels]."""
    labels = connected(cells)
    sizes = np.bincount(labels.ravel())[1:]
    return np.append(False, sizes >= least * sizes.max())[labels], sizes


@dataclass(frozen=True)
class Threshold:
    """The density threshold that was chosen, and the voxels that reach it."""

    cells: BoolArray  # True where a voxel is dense enough, shape `lattice.cell_shape`
    density: float  # least density at the centre of a voxel that is dense enough, [1 / world unit]
    explanation: str  # one or two sentences on which rule chose the threshold, and why
    by_rays: bool = False  # True if training rays chose the threshold


def dense_voxels(snapshot: GridSnapshot, density: FloatArray, selection: SolidSelection) -> Threshold:
    """Return the dense voxels by the rule of `selection`, and the threshold; `density` is given at voxel centres.

    If `selection` has no rule, the threshold is the highest, within `OPTICAL_DEPTH_BOUNDS`, at which the share
    `SHARE_OF_RAYS` of training rays end on dense voxels. With fewer than `FEWEST_RAYS` rays, the threshold is
    `FALLBACK_OPTICAL_DEPTH` divided by the voxel edge. Raises `MeshError` as `_densest_share`, if it is used.
    """
    evidence = snapshot.evidence
    if selection.density_threshold is not None:
        threshold = float(selection.density_threshold)
        explanation = f"Voxels of density {threshold:g} or more are solid, as asked."
        return Threshold((density >= threshold) & (density > 0.0), threshold, explanation)
    if selection.density_percentile is not None:
        return _densest_share(density, selection.density_percentile)
    if evidence is not None and len(evidence.half_depth_density) >= FEWEST_RAYS:
        return _where_rays_end(evidence, density, snapshot.lattice.voxel_size)
    known = "nothing is known of" if evidence is None else f"only {len(evidence.half_depth_density)} rays end among"
    threshold = FALLBACK_OPTICAL_DEPTH / snapshot.lattice.voxel_size
    reason = f"Automatic: {known} the training rays, so voxels of optical depth {FALLBACK_OPTICAL_DEPTH:g} or more"
    return Threshold(density >= threshold, threshold, f"{reason} are solid (density {threshold:.4g}).")


def _where_rays_end(evidence: RayEvidence, density: FloatArray, voxel: float) -> Threshold:
    """Return the voxels that training rays end on, and the threshold; `voxel` is a voxel's edge, [world units].

    A ray ends at the point at which half of its weight is spent. The ray meets the densest voxel within half a voxel of
    that point (`RayEvidence.half_depth_density`). The threshold is the highest density that the share `SHARE_OF_RAYS`
    of the rays meet or exceed, kept within `OPTICAL_DEPTH_BOUNDS`: nearly all rays end on solid voxels.
    """
    met = evidence.half_depth_density
    low, high = (depth / voxel for depth in OPTICAL_DEPTH_BOUNDS)
    threshold = min(max(float(np.quantile(met, 1.0 - SHARE_OF_RAYS, method="lower")), low), high)
    # Densities are float32, and the voxel whose density became the threshold must reach it.
    share = float(np.mean(met >= np.float32(threshold)))
    return Threshold(
        density >= np.float32(threshold),
        threshold,
        f"Automatic: {share:.0%} of the {len(met)} training rays that end on something meet, within half a voxel of "
        f"there, a voxel of density {threshold:.4g} or more (optical depth {threshold * voxel:.2g} per voxel).",
        by_rays=True,
    )


def _densest_share(density: FloatArray, percentile: float) -> Threshold:
    """Return the densest (100 - percentile) % of all voxels and the threshold, as in the Thermoxels paper.

    Voxels exactly as dense as the threshold are left out if denser voxels exist, because training leaves the initial
    density in space that no ray touches. Raises `MeshError` if `percentile` and all, equal, densities are above 0.
    """
    threshold = float(np.percentile(density, percentile))
    if percentile > 0.0 and 0.0 < density.min() == density.max():
        remedy = "Train longer, or pass --density-threshold to say from which density on a voxel is solid."
        got = f"the same density {threshold:.6g} in all {density.size} voxels"
        raise MeshError("density", expected="some voxels denser than others", got=got, remedy=remedy)
    denser = density > threshold
    cells = denser if denser.any() else (density >= threshold) & (density > 0.0)
    explanation = (
        f"The densest {100.0 - percentile:g} % of all voxels are solid, as asked: above density {threshold:.4g}."
    )
    return Threshold(cells, threshold, explanation)


def _region(
    cells: BoolArray, snapshot: GridSnapshot, selection: SolidSelection, world_to_input: FloatArray | None
) -> tuple[BoolArray, str]:
    """Return a mask of the voxels, solid or not, of the region of `selection`, and a sentence that describes it."""
    box, near, views = selection.region_box, selection.region_near, snapshot.views
    if box is not None or near is not None:
        to_input = np.eye(4)[:3] if world_to_input is None else world_to_input
        what = "in the box" if near is None else f"within {near[3]:g} of a point"
        return _asked_region(cells, snapshot.lattice, box, near, to_input), f"What lies {what} is taken."
    if selection.region == "all":
        return np.ones_like(cells), "All is taken."
    if views is None or len(views.focal) == 0:
        return np.ones_like(cells), "The cameras are not known, so all is taken."
    what = "What photographs show about as well as what they were taken of is taken."
    return where_cameras_look(cells, snapshot.lattice, views), what


def where_cameras_look(cells: BoolArray, lattice: Lattice, views: Views) -> BoolArray:
    """Return a mask of voxels, solid or not, that photographs show about as well as the object they were taken of.

    The solid `cells` that rays through the middle of a camera's image meet give the distance of this object;
    `Views.shown_well` compares each voxel with it.
    """
    eyes, count = lattice.world_to_index(views.camera_to_world[:, :, 3]), len(views.focal)
    reach = np.full(count, np.nan)
    part = CENTRAL_PART * ((np.arange(CENTRAL_RAYS) + 0.5) / CENTRAL_RAYS - 0.5)
    for camera in np.unique(np.linspace(0, count - 1, min(count, MOST_CAMERAS)).round().astype(np.int64)).tolist():
        across, along = np.meshgrid(*np.outer(views.size[camera] / views.focal[camera], part))
        local = np.stack((across.ravel(), along.ravel(), np.full(CENTRAL_RAYS**2, -1.0)), axis=1)
        direction = local / np.linalg.norm(local, axis=1, keepdims=True) @ views.camera_to_world[camera, :, :3].T
        met = first_solid(cells, eyes[camera], direction)
        if np.isfinite(met).any():
            reach[camera] = lattice.voxel_size * float(np.quantile(met[np.isfinite(met)], NEAREST_SHARE))
    block = 1
    while cells.size > MOST_BLOCKS * block**3:
        block *= 2
    shape = tuple(-(-n // block) for n in cells.shape)
    middles = (np.stack(np.unravel_index(np.arange(math.prod(shape)), shape), axis=1) + 0.5) * block
    well = views.shown_well(lattice.index_to_world(middles), reach).reshape(shape)
    if block > 1:
        well = np.asarray(ndimage.zoom(well.astype(np.float32), block, order=1, mode="nearest", grid_mode=True)) >= 0.5
    return well[tuple(slice(n) for n in cells.shape)]


def _asked_region(
    cells: BoolArray, lattice: Lattice, box: Box | None, near: Ball | None, world_to_input: FloatArray
) -> BoolArray:
    """Return a mask of voxels with centres in a box or ball; raise `MeshError` if no solid voxel (`cells`) is in it."""
    # Each input coordinate is a sum of three terms, one per voxel index: one array per axis is enough.
    middles = [
        lattice.lo[axis] + (np.arange(count) + 0.5) * lattice.voxel_size for axis, count in enumerate(cells.shape)
    ]
    along_x, along_y, along_z = np.ix_(*middles)
    places = [row[0] * along_x + row[1] * along_y + row[2] * along_z + row[3] for row in world_to_input]
    if box is not None:
        found = [(place >= low) & (place <= high) for place, low, high in zip(places, box[:3], box[3:])]
        within = found[0] & found[1] & found[2]
    else:
        assert near is not None
        away = [(place - middle) ** 2 for place, middle in zip(places, near[:3])]
        within = away[0] + away[1] + away[2] <= near[3] ** 2
    if (cells & within).any():
        return within
    size = lattice.voxel_size * float(np.cbrt(abs(np.linalg.det(world_to_input[:, :3]))))
    digits = max(0, 1 - math.floor(math.log10(size)))
    ends = (place[cells] for place in places)
    lower, upper = (_typed(end, digits) for end in np.array([(end.min() - size, end.max() + size) for end in ends]).T)
    expected = f"some of the solid in it, which lies from {lower} to {upper}"
    got, remedy = f"none in {_typed(box or near or ())}", f"Pass --region-box {lower} {upper}, or less."
    raise MeshError("region_near" if box is None else "region_box", expected=expected, got=got, remedy=remedy)


def _typed(values: tuple[float, ...] | FloatArray, digits: int | None = None) -> str:
    """Return numbers separated by blanks, as typed on a command line, with `digits` decimals if given."""
    return " ".join(f"{value:g}" if digits is None else f"{value:.{digits}f}" for value in values)
