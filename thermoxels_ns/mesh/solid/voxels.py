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
from thermoxels_ns.mesh.solid.threshold import (
    Threshold,
    automatic_threshold,
    density_threshold,
    optical_depth_threshold,
    percentile_threshold,
)

InteriorKind = Literal["solid", "hollow"]

SMALLEST_BODY = 0.01
"""Bodies (voxels that touch, if only by corners) of less than this share of the largest are mostly floaters."""

_WIDEST = 100


@dataclass(frozen=True)
class SolidSelection:
    """How solid voxels are told from empty ones. Without a threshold of your own it is found from the training rays."""

    voxel_optical_depth: float | None = None
    """Voxels in which density times edge length is at least this are solid: at 0.5, light that crosses one loses 39 %.
    Lower it if walls have holes, raise it if empty space turns solid. Left out, the threshold is automatic: the
    highest that 95 % of the training rays that end on something meet within half a voxel of where they end."""
    density_percentile: float | None = None
    """Percentile p of the density over all voxels of the box, 0 to 100: the (100 - p) % densest voxels are solid, as in
    the Thermoxels paper. Overrides the optical depth. Raise it if empty space turns solid, lower it if walls have
    holes."""
    density_threshold: float | None = None
    """Voxels at least this dense are solid, [1 / world unit of the trained scene]. Overrides both."""
    close_gaps: int = 1
    """Fill gaps and pinholes up to twice this many voxels wide (a morphological closing); thin walls are not
    continuous without it. 0: none."""
    region: RegionKind = "auto"
    """Which part is taken. auto: what photographs show about as well as what they were taken of, without bodies below
    1 % of the largest (floaters). all: everything."""
    region_box: Box | None = None
    """In place of auto, what lies in a box: xmin ymin zmin xmax ymax zmax in the coordinates of the input poses."""
    region_near: Ball | None = None
    """In place of auto, what lies near a point: x y z radius in the coordinates of the input poses."""
    interior: InteriorKind = "solid"
    """What becomes of the inside of a body of which photographs only show the shell. solid: it is filled, namely
    cavities that the shell encloses, and space within the body's convex hull that the training cameras would see if
    the shell did not stand in front of it (fewer than one in ten look into it), with the crevices that holes of the
    shell leave between the two. hollow: the shell alone is meshed, as thick as the photographs happened to make it. A
    cavity with a camera in it is a room and is never filled."""
    seal_openings: int = 2
    """While looking for the inside, openings in the shell up to twice this many voxels wide count as closed. It leaves
    the shell itself as it is."""
    wall_thickness: float | None = None
    """For facades seen from one side: make the seen surface this thick, [m], growing away from the cameras, never into
    space that they look through. Takes the place of filling the interior. Needs metres per unit."""

    def __post_init__(self) -> None:
        for name, (kind, low, high, usual) in _BOUNDS.items():
            value = getattr(self, name)
            if not (_is_within(value, kind, low, high) or (value is None and usual is None)):
                what = "a whole number" if kind is int else "a finite number"
                most = "" if high == math.inf else f" to {high:g}"
                option = f"--{name.replace('_', '-')}"
                expected = f"{what} from {low:g}{most}" if most else f"{what} of at least {low:g}"
                remedy = f"Leave {option} out." if usual is None else f"Pass {option} {usual}, or leave it out."
                raise MeshError(name, expected=expected, got=repr(value), remedy=remedy)
        for name in ("voxel_optical_depth", "wall_thickness"):
            value = getattr(self, name)
            if value is not None:
                check_positive(name, value, f"Leave --{name.replace('_', '-')} out.", MeshError)
        check_region(self.region, self.region_box, self.region_near)
        if self.interior not in get_args(InteriorKind):
            kinds = " or ".join(get_args(InteriorKind))
            raise MeshError("interior", expected=kinds, got=repr(self.interior), remedy="Pass --interior solid.")


def _is_within(value: Any, kind: Any, low: float, high: float) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool) and math.isfinite(value) and low <= value <= high


_BOUNDS: dict[str, tuple[Any, float, float, float | None]] = {
    "density_percentile": ((int, float), 0.0, 100.0, None),
    "density_threshold": ((int, float), 0.0, math.inf, None),
    "close_gaps": (int, 0, _WIDEST, 1),
    "seal_openings": (int, 0, _WIDEST, 2),
}
"""Type, least and most of options; what to pass instead, None for those that may be None."""


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
