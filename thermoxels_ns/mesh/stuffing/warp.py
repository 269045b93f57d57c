"""Where the surface cuts the lattice's edges, and which points move onto it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.mesh.stuffing.bcc_lattice import DIRECTIONS, LENGTHS, NUM_DIRECTIONS, OPPOSITE, BccLattice

ALPHA_INSIDE = np.where(LENGTHS == 1.0, 0.272, 0.397)
"""Share of each of the 14 edges within which a cut pulls a point inside the solid onto the surface."""
ALPHA_OUTSIDE = np.where(LENGTHS == 1.0, 0.282, 0.369)
"""The same for a point outside.

With these four numbers all dihedral angles are between 10.94 and 163.74 degrees: the extremes over all stencils, with
every cut and every moved point at every end of its range, chosen to make the range small. Labelle and Shewchuk (2007)
give one pair for both sides, 0.24999 and 0.41189, and the range 10.7 to 164.8; linear interpolation between random
levels then goes down to 9.6 degrees.
"""


def _contractible_links() -> BoolArray:
    """For every set of neighbours, as 14 bits: is what the lattice spans between them one piece without holes?"""
    # The neighbours of a point span a sphere of 24 triangles. A part of a sphere can be shrunk to a point if neither it
    # nor the rest of the sphere is empty or in several pieces.
    steps = DIRECTIONS[:, None, :] - DIRECTIONS[None, :, :]
    joined = (np.abs(steps[:, :, None, :] - DIRECTIONS).max(axis=-1) < 0.25).any(axis=-1)
    around = joined @ (1 << np.arange(NUM_DIRECTIONS))
    sets = np.arange(1 << NUM_DIRECTIONS)

    def in_one_piece(members: IntArray) -> BoolArray:
        reached = members & -members
        for _ in range(NUM_DIRECTIONS):
            for d in range(NUM_DIRECTIONS):
                reached |= np.where(reached >> d & 1, around[d], 0) & members
        return (reached == members) & (members != 0)

    return in_one_piece(sets) & in_one_piece(sets ^ sets[-1])


_CONTRACTIBLE = _contractible_links()


@dataclass(frozen=True)
class WarpedLattice:
    """The lattice with its near points moved onto the surface, and the cuts that are left."""

    sign: npt.NDArray[np.int8]  # +1 inside the solid, 0 on its surface, -1 outside, one per point of the lattice
    moved: IntArray  # points that moved, shape (m,)
    moved_to: FloatArray  # where they are now, fractional corner indices, shape (m, 3)
    inner: IntArray  # points with sign +1 that are not buried, ascending; shape (p,)
    cut_points: IntArray  # those of them that have a cut edge, ascending; shape (s,)
    cuts: FloatArray
    """How far along each of their edges the surface is, as a share of the edge, NaN where no cut is; shape (s, 14)."""


def warp(lattice: BccLattice, buried: BoolArray | None = None) -> WarpedLattice:
    """Find the cuts and move points that are too close to one onto the surface.

    A cut is where linear interpolation along an edge between two opposite signs is 0. A point with cuts within alpha
    times the edge length moves to the nearest of them and has sign 0 from then on; its edges are cut no more (Labelle
    and Shewchuk 2007, section 3). The remaining cuts are within [alpha, 1 - alpha]. `buried` points are not looked at,
    because they and all their neighbours are inside.

    Beyond the paper, nothing thin is lost: a point stays if the solid is not on its other side, seen from the cut, or
    if the solid (for a point outside: the empty space) would fall apart, close up or vanish with it. Its cuts are then
    held at alpha times the edge length, which the bounds on the angles allow. Where the surface is smooth and the
    solid a few voxels thick, no point stays.
    """
    level = lattice.level
    sign = (level > 0.0).astype(np.int8)
    sign -= level < 0.0
    inner = np.flatnonzero(sign > 0 if buried is None else (sign > 0) & ~buried)
    touches, touched = np.zeros(len(inner), dtype=bool), np.zeros(len(sign), dtype=bool)
    for neighbour in lattice.each_neighbour(inner):
        crosses = sign[neighbour] < 0
        touches |= crosses
        touched[neighbour[crosses]] = True
    # Points inside with a neighbour outside, and points outside with one inside.
    inside, outside = inner[touches], np.flatnonzero(touched)

    moved, moved_to = [], []
    for points, own, alpha in ((inside, 1, ALPHA_INSIDE), (outside, -1, ALPHA_OUTSIDE)):
        share = _cut_shares(lattice, sign, points)
        reach = np.where(share < alpha, share * LENGTHS, np.inf)
        nearest = np.argmin(reach, axis=1)
        near = np.flatnonzero(np.isfinite(reach[np.arange(len(points)), nearest]))
        points, nearest, share = points[near], nearest[near], share[near, nearest[near]]
        behind = points + lattice.offsets[lattice.is_corner(points), OPPOSITE[nearest]]
        thick = sign[behind] == own
        points, nearest, share = points[thick], nearest[thick], share[thick]
        # Taking a point away leaves the topology as it is if its neighbours of the same sign can be shrunk to a point.
        # No two points of one of the four classes (centre or corner, even or odd sum of indices) are neighbours, so
        # each class may be decided at once.
        free = np.zeros(len(points), dtype=bool)
        group = 2 * lattice.is_corner(points) + lattice.block_index(points).sum(axis=1) % 2
        for number in range(4):
            members = np.flatnonzero(group == number)
            alike = sign[lattice.neighbours(points[members])] == own
            free[members] = _CONTRACTIBLE[alike @ (1 << np.arange(NUM_DIRECTIONS))]
            sign[points[members[free[members]]]] = 0
        moved.append(points[free])
        moved_to.append(lattice.positions(points[free]) + share[free, None] * DIRECTIONS[nearest[free]])

    inner = inner[sign[inner] > 0]
    inside = inside[sign[inside] > 0]
    share = _cut_shares(lattice, sign, inside)
    is_cut = np.isfinite(share)
    has_cut = is_cut.any(axis=1)
    held = np.clip(share, ALPHA_INSIDE, 1.0 - ALPHA_OUTSIDE)
    return WarpedLattice(
        sign=sign,
        moved=np.concatenate(moved),
        moved_to=np.concatenate(moved_to),
        inner=inner,
        cut_points=inside[has_cut],
        cuts=np.where(is_cut, held, np.nan)[has_cut],
    )


def _cut_shares(lattice: BccLattice, sign: npt.NDArray[np.int8], points: IntArray) -> FloatArray:
    """Share of each edge from the point to its cut, infinite where none is; shape (n, 14)."""
    neighbours = lattice.neighbours(points)
    own = lattice.level[points].astype(np.float64)
    other = lattice.level[neighbours].astype(np.float64)
    # Where levels differ by more than the number type holds, the ratio is infinite and the cut at the point: right.
    with np.errstate(over="ignore", divide="ignore"):
        share = 1.0 / (1.0 - other / own[:, None])
    share[sign[neighbours] != -sign[points][:, None]] = np.inf
    return share
