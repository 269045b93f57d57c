"""Isosurface stuffing: tetrahedra that follow the zero level of a lattice of voxel centres."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.checks import check_finite, check_shape
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.stuffing.bcc_lattice import DIRECTIONS, BccLattice, bcc_lattice
from thermoxels_ns.mesh.stuffing.coarse_interior import CoarseInterior, coarse_interior
from thermoxels_ns.mesh.stuffing.stencils import (
    BUNDLE_EDGES,
    BUNDLE_POINTS,
    CODE_WEIGHTS,
    NUM_BUNDLE_NODES,
    SIDES_OUTWARD,
    stencil_table,
)
from thermoxels_ns.mesh.stuffing.warp import WarpedLattice, warp
from thermoxels_ns.mesh.tetrahedra import FACET_BOX
from thermoxels_ns.mesh.voxel_tets import boundary_tags

_CHUNK = 1 << 16


@dataclass(frozen=True)
class StuffedSolid:
    """Tetrahedra that fill a solid up to its surface, in fractional corner indices of the voxel lattice."""

    points: FloatArray
    """Nodes, shape (n, 3), all different and all used; each coordinate is from 0 to the number of voxels."""
    tets: IntArray  # node numbers, shape (t, 4), positively oriented
    facets: IntArray  # boundary triangles, shape (f, 3), right-hand normal out of the solid
    on_surface: BoolArray  # True for nodes of boundary triangles, shape (n,)
    on_box: BoolArray
    """True for boundary triangles on the border of the voxel lattice, exactly on its plane, shape (f,)."""


def stuff(level: npt.NDArray[np.floating], coarsest: int = 4) -> StuffedSolid:
    """Fill the part of a voxel lattice where the level is above 0 with tetrahedra up to the zero level.

    Isosurface stuffing (Labelle and Shewchuk 2007, ACM Transactions on Graphics 26(3), article 57) on a body-centred
    cubic lattice: of one voxel near the surface, of cubes that double in size from there on inwards. All dihedral
    angles are between 10.9 and 163.8 degrees, whatever the levels are; where the solid is away from the surface they
    are between 45 and 120, and 60 and 90 in cells of one voxel. The surface is the same to the last bit whatever the
    size of the cells inside.

    The surface is exact in the second order of the voxel size where the level is linear over the voxels next to it.
    Levels that stop at -1 and 1 should therefore not do so closer than 1.5 voxels to the surface: at 0.5 voxels the
    area of a sphere comes out 1.5 % too large at every resolution, and 13 % with -1 and 1 alone. Sharp edges, those
    where the surface meets the border included, become chamfers about half a voxel wide. Solid voxels that share a
    face stay in one piece, and walls and gaps of one voxel get no holes.

    Args:
        level: Levels at the voxel centres, above 0 in solid voxels, shape (cx, cy, cz). Only their ratios matter.
        coarsest: Edge of the largest cells inside the solid, [voxels], a power of two; 1 makes all cells alike. Larger
            cells than 4 hardly save anything, because most tetrahedra are at the surface: between them and the inside
            lie two voxels and a layer of every size between.

    Returns:
        The mesh. Where solid voxels touch the border of the lattice, it ends on the border.

    Raises:
        MeshError: A level is NaN or infinite, none is above 0, or the largest edge is no power of two.

    >>> solid = stuff(np.ones((1, 1, 1)))
    >>> len(solid.points), len(solid.tets), len(solid.facets), bool(solid.on_box.all())
    (15, 24, 24, True)
    >>> [len(stuff(np.ones((30, 30, 30)), coarsest).tets) for coarsest in (1, 2, 4, 8)]
    [334800, 158208, 148848, 148800]
    """
    check_coarsest("coarsest", coarsest, "Pass 4, or 1 for cells of one voxel throughout.")
    level = _checked(level)
    lattice = bcc_lattice(level)
    interior = coarse_interior(lattice, coarsest)
    warped = warp(lattice, None if interior is None else interior.buried(lattice))
    nodes = _number_nodes(lattice, warped, interior)
    filled = [_fill_bundles(bundles, warped.sign, nodes) for bundles in _solid_bundles(lattice, warped.sign, interior)]
    tets, facets = (list(arrays) for arrays in zip(*filled))
    if interior is not None:
        tets.append(nodes.of_point[interior.tets])
    tets, facets = (np.concatenate(arrays, dtype=np.int64) for arrays in (tets, facets))
    on_surface = np.zeros(len(nodes.points), dtype=bool)
    on_surface[facets] = True
    on_box = boundary_tags(facets, nodes.points, tuple(n + 1 for n in level.shape)) == FACET_BOX
    return StuffedSolid(nodes.points, tets, facets, on_surface, on_box)


def check_coarsest(name: str, value: int, remedy: str) -> None:
    """Raise `MeshError` unless the largest edge of cells is a power of two."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not (whole and value >= 1 and value & (value - 1) == 0):
        raise MeshError(name, expected="1, 2, 4, 8 or another power of two, [voxels]", got=repr(value), remedy=remedy)


def _checked(level: npt.NDArray) -> npt.NDArray[np.floating]:
    level = np.asarray(level)
    if level.dtype not in (np.float32, np.float64):
        level = level.astype(np.float64)
    remedy = "Pass one level for every voxel of the lattice."
    check_shape("level", level, (None, None, None), remedy, MeshError)
    check_finite("level", level, remedy, MeshError)
    if not np.any(level > 0.0):
        expected = "solid voxels, with levels above 0"
        raise MeshError("level", expected=expected, got="none", remedy="Lower the threshold.")
    return level


@dataclass(frozen=True)
class _Nodes:
    """The nodes: points inside that have cuts, other points inside, points on the surface, cuts."""

    points: FloatArray  # positions, shape (n, 3)
    of_point: npt.NDArray[np.integer]  # node number of every lattice point, -1 where it is no node
    of_cut: npt.NDArray[np.integer]  # node numbers of the cuts on the 14 edges of the first nodes, -1 where no cut is


def _number_nodes(lattice: BccLattice, warped: WarpedLattice, interior: CoarseInterior | None) -> _Nodes:
    inner, sign = warped.inner, warped.sign
    # A point on the surface is a node if one of its neighbours is inside: they share a tetrahedron.
    touched = np.zeros(len(sign), dtype=bool)
    for neighbour in lattice.each_neighbour(inner):
        touched[neighbour[sign[neighbour] == 0]] = True
    plain = np.zeros(len(sign), dtype=bool)
    plain[inner] = True
    plain[warped.cut_points] = False
    if interior is not None:
        plain[interior.tets] = True
    kept = np.concatenate([warped.cut_points, np.flatnonzero(plain), np.flatnonzero(touched)])
    row, direction = np.nonzero(np.isfinite(warped.cuts))

    total = len(kept) + len(row)
    integer = np.int32 if total < 2**31 else np.int64
    of_point = np.full(len(sign), -1, dtype=integer)
    of_point[kept] = np.arange(len(kept))
    of_cut = np.full(warped.cuts.shape, -1, dtype=integer)
    of_cut[row, direction] = np.arange(len(kept), total)

    points = np.empty((total, 3))
    points[: len(kept)] = lattice.positions(kept)
    moved = touched[warped.moved]
    points[of_point[warped.moved[moved]]] = warped.moved_to[moved]
    points[len(kept) :] = points[row] + warped.cuts[row, direction, None] * DIRECTIONS[direction]
    return _Nodes(points, of_point, of_cut)


@dataclass(frozen=True)
class _Bundles:
    """Some of the voxel faces of one axis, each with the four lattice tetrahedra around it."""

    points: IntArray  # flat lattice indices of the six points of each bundle, shape (6, b)
    sides: IntArray  # flat steps from a centre to the one beyond each side of the face, shape (4,)
    directions: IntArray  # lattice direction of each edge of a bundle, there and back, shape (13, 2)


def _solid_bundles(
    lattice: BccLattice, sign: npt.NDArray[np.int8], interior: CoarseInterior | None
) -> Iterator[_Bundles]:
    """All bundles with a point inside the solid but none in larger cubes, a chunk at a time."""
    inner = sign > 0
    first, second = np.array(BUNDLE_EDGES).T
    for axis in range(3):
        # Bundles are written for the x axis; x, y, z turn into the axes from here on in their order.
        strides = np.roll(lattice.strides, -axis)
        corners = np.where(BUNDLE_POINTS[2:] > 0.0, 0, -1) @ strides + lattice.num_centres
        offsets = np.concatenate([[0, strides[0]], corners])
        steps = np.roll(BUNDLE_POINTS[second] - BUNDLE_POINTS[first], axis, axis=1)
        ways = np.stack([steps, -steps], axis=1)
        directions = np.argmin(np.abs(ways[:, :, None, :] - DIRECTIONS).max(axis=-1), axis=-1)

        # Where a step leaves a row, a layer or a block it ends in the padding, where nothing is inside.
        active = np.zeros(lattice.num_centres, dtype=bool)
        for offset in offsets:
            active |= inner[offset : offset + len(active)]
        if interior is not None:
            active &= ~interior.covered
            active[: -strides[0]] &= ~interior.covered[strides[0] :]
        below = np.flatnonzero(active)
        for start in range(0, len(below), _CHUNK):
            yield _Bundles(below[start : start + _CHUNK] + offsets[:, None], SIDES_OUTWARD @ strides, directions)


def _fill_bundles(
    bundles: _Bundles, sign: npt.NDArray[np.int8], nodes: _Nodes
) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.integer]]:
    """Tetrahedra and boundary triangles in the bundles."""
    table = stencil_table()
    count = bundles.points.shape[1]
    signs = sign[bundles.points]
    code = CODE_WEIGHTS @ (signs + np.int16(1))

    number = np.empty((NUM_BUNDLE_NODES, count), dtype=nodes.of_point.dtype)
    number[:6] = nodes.of_point[bundles.points]
    for edge, (a, b) in enumerate(BUNDLE_EDGES):
        cut = np.flatnonzero(signs[a] * signs[b] < 0)
        from_a = signs[a, cut] > 0
        row = np.where(from_a, number[a, cut], number[b, cut])
        number[6 + edge, cut] = nodes.of_cut[row, np.where(from_a, *bundles.directions[edge])]
    number = number.reshape(-1)

    bundle, row = _rows(table.tet_start, code)
    tets = number[table.tets[row] * count + bundle[:, None]]

    bundle, row = _rows(table.facet_start, code)
    behind = table.facet_behind[row]
    asks = np.flatnonzero(behind >= 0)
    centre, side = np.divmod(behind[asks], 4)
    beyond = bundles.points[centre, bundle[asks]] + bundles.sides[side]
    keep = np.ones(len(row), dtype=bool)
    keep[asks] = sign[beyond] <= 0
    facets = number[table.facets[row[keep]] * count + bundle[keep, None]]
    return tets, facets


def _rows(start: IntArray, code: npt.NDArray[np.int16]) -> tuple[IntArray, IntArray]:
    """Bundle and table row of everything that the codes of the bundles call for."""
    counts = start[code + 1] - start[code]
    bundle = np.repeat(np.arange(len(code)), counts)
    shift = start[code] + counts - np.cumsum(counts)
    return bundle, np.arange(len(bundle)) + shift[bundle]
