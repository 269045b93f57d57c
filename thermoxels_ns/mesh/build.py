"""Construction of a tagged tetrahedral mesh with temperatures, in metres, from a trained field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh.boundary.patches import PatchRules, apply_regions, with_patches
from thermoxels_ns.mesh.quality.checks import boundary_facets, component_of
from thermoxels_ns.mesh.solid.free_space import seen_facets
from thermoxels_ns.mesh.solid.level_set import level_of
from thermoxels_ns.mesh.solid.morphology import connected, grow
from thermoxels_ns.mesh.solid.voxels import SolidCells, SolidSelection, select_solid
from thermoxels_ns.mesh.stuffing.isosurface import stuff
from thermoxels_ns.mesh.stuffing.sharp_edges import sharpen
from thermoxels_ns.mesh.temperature import (
    MIN_OBSERVED_WEIGHT,
    extend_harmonically,
    interpolate_corners,
    tet_conductances,
)
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh, facet_normals
from thermoxels_ns.mesh.voxel_tets import boundary_tags, kuhn_tets

_NO_RULES = PatchRules()


@dataclass(frozen=True)
class BuiltMesh:
    """A mesh, the solid voxels that it was made from, and the counts of parts that were left out."""

    mesh: TetMesh
    solid: SolidCells
    unobserved_parts: int  # number of connected parts left out because no thermal ray saw any of their nodes
    unobserved_voxels: int  # number of voxels of these parts; `solid.cells` does not hold them
    idle_rules: tuple[str, ...] = ()
    """The user's rules that no triangle or tetrahedron of the mesh follows, see `Applied.idle`."""


def build_mesh(
    snapshot: GridSnapshot,
    selection: SolidSelection,
    world_to_metres: FloatArray,
    boundary: Literal["conforming", "voxel"] = "conforming",
    *,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    rules: PatchRules = _NO_RULES,
    metres_per_unit: float = 1.0,
) -> BuiltMesh:
    """Return a mesh of the solid part of a trained field, with nodal temperatures, regions and boundary tags.

    Connected parts that no thermal ray saw have no known temperature and are left out. The mesh of a field that
    photographs alone trained has no temperatures.

    Args:
        snapshot: The trained field on its corner lattice.
        selection: The rules that choose the solid voxels.
        world_to_metres: Similarity (rotation or reflection, one scale, shift), shape (4, 4), that maps homogeneous
            column vectors of the trained scene to metres. A reflection reorders nodes to keep volumes positive.
        boundary: Whether the boundary follows the level set of the density, or voxel faces.
        up: Up direction in the coordinates of the mesh.
        rules: The user's rules for patches and regions.
        metres_per_unit: Length, [m], of the unit of the input poses. The box of `selection` is in this unit.

    Raises:
        MeshError: `boundary` is another word, `select_solid` fails, or thermal rays measured no node of the mesh.
    """
    if boundary not in ("conforming", "voxel"):
        raise MeshError("boundary", expected="conforming or voxel", got=boundary, remedy="Pass one of them.")
    transform = np.asarray(world_to_metres, dtype=np.float64)
    scale, voxel = float(np.cbrt(abs(np.linalg.det(transform[:3, :3])))), boundary == "voxel"
    solid = select_solid(snapshot, selection, scale, transform[:3] / metres_per_unit)
    if voxel:
        corners, tets = kuhn_tets(solid.cells)
        points, facets = corners.astype(np.float64), boundary_facets(tets)
    else:
        level = level_of(snapshot.centre_density(), solid.threshold, solid.dense, solid.cells, solid.distance)
        stuffed = sharpen(stuff(level), level.shape)
        points, tets, facets = stuffed.points, stuffed.tets, stuffed.facets
    known = snapshot.temperature_c
    temperature_c, observed = np.full(len(points), np.nan), np.zeros(len(points), dtype=bool)
    if known is not None:  # temperatures are interpolated from measured corners alone
        measured = np.where(snapshot.observed_weight >= MIN_OBSERVED_WEIGHT, snapshot.observed_weight, 0.0)
        temperature_c, weight = interpolate_corners(points, known, measured)
        observed = weight >= MIN_OBSERVED_WEIGHT

    body = component_of(len(points), tets[:, :3].ravel(), tets[:, 1:].ravel())
    unseen = np.bincount(body, observed) == 0
    parts = int(np.count_nonzero(unseen)) if observed.any() else 0
    num_voxels = 0
    if parts:
        stays = ~unseen[body]
        goes = _bodies_at(solid.cells, points[tets[~stays[tets[:, 0]]]].mean(axis=1))
        num_voxels = int(np.count_nonzero(goes))
        solid = replace(solid, cells=solid.cells & ~goes)
        number = np.cumsum(stays) - 1
        tets, facets = number[tets[stays[tets[:, 0]]]], number[facets[stays[facets[:, 0]]]]
        points, temperature_c, observed = points[stays], temperature_c[stays], observed[stays]
    edges, conductance = tet_conductances(points, tets)
    if voxel:  # diagonals of voxels conduct nothing, and sides join all nodes
        edges, conductance = edges[conductance > 0.0], conductance[conductance > 0.0]
    if known is not None:
        temperature_c = extend_harmonically(edges, temperature_c, observed, edge_weights=conductance)

    on_border = boundary_tags(facets, points, snapshot.lattice.shape)
    facet_tags = np.where(_cut_by_region(points, facets, solid.within), FACET_BOX, on_border)
    if np.linalg.det(transform[:3, :3]) < 0.0:
        tets, facets = tets[:, [0, 2, 1, 3]], facets[:, ::-1]
    points_m = apply_transform(transform, snapshot.lattice.index_to_world(points))
    colour = None
    if snapshot.colour is not None:  # interpolated from corners with density; grey where no corner around has any
        found, near = interpolate_corners(points, snapshot.colour, snapshot.density > 0.0)
        colour = np.where(near[:, None] > 0.0, found, 0.5).astype(np.float32)
    of_tets = points_m[tets].mean(axis=1), None if colour is None else colour[tets].mean(axis=1)
    region, region_names, idle_regions = apply_regions(rules, *of_tets)
    mesh = TetMesh(
        points_m=points_m,
        tets=np.ascontiguousarray(tets),
        temperature_c=temperature_c,
        observed=observed,
        facets=np.ascontiguousarray(facets),
        facet_tags=facet_tags,
        region=region,
        region_names=region_names,
        colour=colour,
    )
    seen, outside = _seen_and_outside(mesh, points, solid, snapshot, transform[:3, :3] / scale)
    tagged, idle_patches = with_patches(replace(mesh, boundary=replace(mesh.boundary, seen=seen)), rules, up, outside)
    return BuiltMesh(tagged, solid, parts, num_voxels, (*idle_patches, *idle_regions))


def _bodies_at(cells: BoolArray, points: FloatArray) -> BoolArray:
    """Return a mask of the solid voxels whose face-connected body holds one of the points (n, 3), [voxels]."""
    body = connected(cells, connectivity=1)
    chosen = np.zeros(int(body.max()) + 1, dtype=bool)
    chosen[body[tuple(np.floor(points).astype(np.int64).T)]] = True
    chosen[0] = False
    return chosen[body]


def _cut_by_region(points: FloatArray, facets: IntArray, within: BoolArray) -> BoolArray:
    """Return a mask (f,): True for triangles whose outer neighbour voxel lies outside the region of an export. `points`
    (n, 3) are corner indices; `within` is True in voxels of the region. The solid may continue there."""
    # A smoothed surface lies at most half a voxel inside the voxel face that it stands for.
    beside = np.floor(points[facets].mean(axis=1) + 0.75 * facet_normals(points, facets)).astype(np.int64)
    inside = np.all((beside >= 0) & (beside < within.shape), axis=1)
    cut = np.zeros(len(beside), dtype=bool)
    cut[inside] = ~within[tuple(beside[inside].T)]
    return cut


def _seen_and_outside(
    mesh: TetMesh, points_index: FloatArray, solid: SolidCells, snapshot: GridSnapshot, rotation: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Return two masks (f,): boundary triangles that cameras see (all if no cameras are known), and exterior triangles.
    `points_index` (n, 3) are the nodes in corner indices. `rotation` (3, 3) turns the trained scene to the mesh."""
    normal = facet_normals(mesh.points_m, mesh.facets)
    seen = np.ones(len(mesh.facets), dtype=bool)
    if snapshot.views is not None:
        centroids = snapshot.lattice.index_to_world(points_index[mesh.facets].mean(axis=1))
        seen = seen_facets(solid.cells, snapshot.views, snapshot.lattice, centroids, normal @ rotation)
    outside = seen
    if solid.rooms is not None:
        beside = np.floor(points_index[mesh.facets].mean(axis=1) + 0.75 * normal @ rotation).astype(np.int64)
        beside = np.clip(beside, 0, np.array(solid.rooms.shape) - 1)
        inner = ~seen & grow(solid.rooms, 1)[tuple(beside.T)]
        # In a building with rooms, what faces none is outside, seen or not, as below the lowest floor.
        outside = ~inner if np.count_nonzero(inner) > 0.5 * np.count_nonzero(~seen) else seen
    return seen, outside


def apply_transform(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (n, 3) mapped by a matrix (4, 4) that acts on homogeneous column vectors."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]
