"""Moves the nodes of chamfers back to the sharp edges that isosurface stuffing cuts off."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.mesh.quality.checks import component_of, facet_area_vectors
from thermoxels_ns.mesh.quality.tet_shapes import shapes_in_chunks
from thermoxels_ns.mesh.stuffing.isosurface import StuffedSolid

ANGLES_DEG = (13.0, 160.0)
"""No move leaves a dihedral angle outside this range, narrower than that of stuffing itself."""
LONGEST_MOVE = 1.0  # nodes farther than this from the edge stay, [voxels]

_LEAST_DETERMINANT = 0.15
"""Smallest determinant of the inner products of the normals of planes; below, where they meet is uncertain."""
_WRONG_SIDE = 0.15  # how far a node may seem to lie beyond a plane of its edge, [voxels]
_CLEARANCE = 2.5
"""Nodes do not move towards a facing surface nearer than this, [voxels], so the two do not cross."""
_ONE_CORNER = 0.5  # corners that two nodes could move to are the same if they are this near, [voxels]
LEAST_TURN_DEG = 50.0
"""Two planes make an edge if their normals differ by more than this, and by more than `TURN_OVER_SPREAD` times the
spread of the normals in either: 3.5 times is a pipe, 15 the rim of a cylinder."""
TURN_OVER_SPREAD = 8.0

_FLAT_DEG = 8.0  # a node is flat if the normals around it spread by less than this (root mean square)
_LEAST_FLAT_SHARE = 0.08
"""Nodes are looked at where flat triangles are at least this share of the surface around: above 0.1 at clean edges."""
_SHARE_RINGS = 8  # rings of triangles over which that share is averaged
_REACH = 3.0  # planes are made of flat triangles this near, [voxels] ..
_NEAREST = 48  # ... and of no more than this many of them ...
_FARTHEST = 1.2  # ... whose own plane passes the node within this distance, [voxels].
_LEAST_FACETS = 3  # no plane is made of fewer triangles
_SPREAD_DEG = 9.0  # most that the normals in one plane may spread (root mean square)
_OFFSET_SPREAD = 0.2  # most that triangles in one plane may be off it, [voxels] (root mean square)
_CHUNK = 1 << 10  # nodes at a time: what is worked on stays in the processor's cache


def sharpen(solid: StuffedSolid, shape: tuple[int, ...]) -> StuffedSolid:
    """Move nodes of chamfers to the edge or corner where the planes of the surface beside them meet.

    Stuffing sees the level at lattice points only, so where two planes of the surface meet it leaves a chamfer about
    half a voxel wide. Planes come from the flat parts of the surface within three voxels: the triangles there are
    sorted by their normals into at most three. Where it is not clear that there are two or three of them, as on smooth
    or noisy surfaces and walls of less than 3 voxels, nothing moves. Nodes move one after another, those with the
    shortest way first, each only if all tetrahedra around it stay sound. Nodes on the border of the lattice stay, and
    so do those with another surface in front of them. `shape` is the number of voxels along each axis.

    At 48 voxels across, the area of boxes at any angle is within 0.5 % instead of 3.2 %.
    """
    assert solid.points.min() >= 0.0 and np.all(solid.points.max(axis=0) <= shape)
    surface = Surface.of(solid)
    planes = edge_planes(surface)
    parts = [_ways(surface, planes, which) for which in ([0, 1], [0, 2], [1, 2], [0, 1, 2])]
    node, to, is_corner, length = (np.concatenate(column) for column in zip(*parts))
    # Corners first: the nodes nearest to one would otherwise end on the edges beside it.
    order = np.lexsort((node, length, ~is_corner))
    moves = _Moves(node[order], to[order], _same_corners(to[order], is_corner[order]))
    moves = moves.keep(np.all((moves.to > 0.0) & (moves.to < shape), axis=1))
    moves = moves.keep(_clear(surface, moves))
    if len(moves.node) == 0:
        return solid
    return replace(solid, points=_carry_out(solid.points, solid.tets, moves))


@dataclass(frozen=True)
class _Moves:
    """Where nodes could move to, those to be tried first in front."""

    node: IntArray  # node numbers, shape (m,); a node may have several places to go to
    to: FloatArray  # positions, shape (m, 3)
    corner: IntArray
    """Moves with the same number, if it is not negative, lead to the same corner of the body; shape (m,)."""

    def keep(self, which: npt.NDArray) -> _Moves:
        """Some of them, by mask or number."""
        return _Moves(self.node[which], self.to[which], self.corner[which])


def _ways(surface: Surface, planes: Planes, which: list[int]) -> tuple[IntArray, FloatArray, BoolArray, FloatArray]:
    """Nodes, places, whether these are corners, and how far away they are, for some of the planes."""
    row = np.flatnonzero(planes.there[:, which].all(axis=1))
    normals, below = planes.normals[row][:, which], planes.distances[row][:, which]
    products = normals @ normals.transpose(0, 2, 1)
    clear = np.linalg.det(products) > _LEAST_DETERMINANT
    if len(which) == 2:
        # At a convex edge either plane's triangles are below the other plane, and so is the chamfer; at a concave one
        # all are above.
        centres = planes.centres[row][:, which]
        above = np.einsum("mpj,mpj->mp", normals, centres[:, ::-1]) - below
        convex, concave = np.all(above < 0.0, axis=1), np.all(above > 0.0, axis=1)
        clear &= (convex & np.all(below > -_WRONG_SIDE, axis=1)) | (concave & np.all(below < _WRONG_SIDE, axis=1))
    row, normals, below, products = row[clear], normals[clear], below[clear], products[clear]
    # The shortest step to all of the planes.
    step = np.einsum("mp,mpj->mj", np.linalg.solve(products, below[:, :, None])[:, :, 0], normals)
    length = np.linalg.norm(step, axis=1)
    short = length < LONGEST_MOVE
    node = planes.nodes[row[short]]
    return node, surface.points[node] + step[short], np.full(len(node), len(which) == 3), length[short]


def _same_corners(to: FloatArray, is_corner: BoolArray) -> IntArray:
    """Number the different corners among places, -1 for those that are none, shape (m,)."""
    number = np.full(len(to), -1, dtype=np.int64)
    corners = np.flatnonzero(is_corner)
    if len(corners):
        pairs = KDTree(to[corners]).query_pairs(_ONE_CORNER, output_type="ndarray")
        number[corners] = component_of(len(corners), *pairs.T)
    return number


def _clear(surface: Surface, moves: _Moves) -> BoolArray:
    """False for moves towards a surface that faces them, shape (m,)."""
    clear = np.ones(len(moves.node), dtype=bool)
    if len(clear) == 0:
        return clear
    start = surface.points[moves.node]
    others = np.flatnonzero(np.any(surface.node_normals != 0.0, axis=1))
    others = others[is_near(surface.points[others], start, _CLEARANCE)]
    pairs = KDTree(start).sparse_distance_matrix(KDTree(surface.points[others]), _CLEARANCE, output_type="ndarray")
    move, other = pairs["i"], others[pairs["j"]]  # type: ignore[index]
    normal = surface.node_normals[moves.node]
    outward = np.einsum("ij,ij->i", moves.to - start, normal) > 0.0
    faces = np.einsum("ij,ij->i", normal[move], surface.node_normals[other]) < 0.1
    in_front = np.einsum("ij,ij->i", surface.points[other] - start[move], normal[move]) > 0.05
    clear[move[outward[move] & faces & in_front]] = False
    return clear


def _carry_out(points: FloatArray, tets: IntArray, moves: _Moves) -> FloatArray:
    """Make one move after another if the tetrahedra around the node stay sound."""
    # A move may be made at once with others if it is the first in the order of all that wait for the tetrahedra around
    # its node; so the result is that of making them one by one.
    touched = np.zeros(len(points), dtype=bool)
    touched[moves.node] = True
    used = touched[tets[:, 0]]
    for column in tets.T[1:]:
        used |= touched[column]
    around = tets[used]
    nodes, local = np.unique(around, return_inverse=True)
    around = local.reshape(around.shape)
    node = np.searchsorted(nodes, moves.node)
    place = points[nodes]
    order = np.argsort(around.ravel(), kind="stable")
    first = np.searchsorted(around.ravel()[order], np.arange(len(nodes) + 1))
    tets_of_node = order // 4

    never = len(node)
    moved = np.zeros(len(nodes), dtype=bool)
    waiting = np.arange(len(node))
    while len(waiting):
        turn = np.full(len(nodes), never)
        np.minimum.at(turn, node[waiting], waiting)
        next_in_tet = turn[around].min(axis=1)
        np.minimum.at(turn, around.ravel(), np.repeat(next_in_tet, 4))
        now = waiting[turn[node[waiting]] == waiting]
        # Without moves to a corner that an earlier one waits for.
        numbers, earlier = np.unique(moves.corner[waiting], return_index=True)
        earliest = waiting[earlier][np.searchsorted(numbers, moves.corner[now])]
        now = now[(moves.corner[now] < 0) | (earliest == now)]

        mine = node[now]
        counts = first[mine + 1] - first[mine]
        owner = np.repeat(np.arange(len(now)), counts)
        slot = np.arange(len(owner)) + np.repeat(first[mine] + counts - np.cumsum(counts), counts)
        members = around[tets_of_node[slot]]
        corners = place[members]
        corners[members == mine[owner, None]] = moves.to[now[owner]]
        good = np.bincount(owner, ~_sound(corners), len(now)) == 0
        place[mine[good]] = moves.to[now[good]]
        moved[mine[good]] = True
        waiting = waiting[~np.isin(waiting, now)]
        taken = moves.corner[now[good]]
        waiting = waiting[~moved[node[waiting]] & ~np.isin(moves.corner[waiting], taken[taken >= 0])]
    result = points.copy()
    result[nodes] = place
    return result


def _sound(corners: FloatArray) -> BoolArray:
    """Tetrahedra (t, 4, 3) with volume and angles within bounds, shape (t,)."""
    sound = np.empty(len(corners), dtype=bool)
    low, high = np.cos(np.radians(ANGLES_DEG))
    for which, shapes in shapes_in_chunks(corners.reshape(-1, 3), np.arange(4 * len(corners)).reshape(-1, 4)):
        cosines = shapes.dihedral_cosines()
        sound[which] = (shapes.six_volumes > 0.0) & (cosines.max(axis=0) <= low) & (cosines.min(axis=0) >= high)
    return sound


@dataclass(frozen=True)
class Surface:
    """The boundary without what lies on the border of the lattice."""

    points: FloatArray  # all nodes, shape (n, 3)
    facets: IntArray  # triangles, shape (f, 3)
    areas: FloatArray
    normals: FloatArray  # areas (f,) and unit normals (f, 3) of the triangles
    node_normals: FloatArray
    """Mean normals of the triangles around each node, weighted by area, not of unit length: shorter where they differ,
    0 where there are none. Shape (n, 3)."""
    on_border: BoolArray  # True for nodes on the border of the lattice, shape (n,)

    @classmethod
    def of(cls, solid: StuffedSolid) -> Surface:
        """Leave out triangles on the border."""
        on_border = np.zeros(len(solid.points), dtype=bool)
        on_border[solid.facets[solid.on_box]] = True
        facets = solid.facets[~solid.on_box]
        vectors = facet_area_vectors(solid.points, facets)
        areas = np.linalg.norm(vectors, axis=1)
        around = _sum_at_nodes(facets, areas, len(solid.points))
        total = np.stack([_sum_at_nodes(facets, column, len(solid.points)) for column in vectors.T], axis=1)
        mean = total / np.where(around > 0.0, around, 1.0)[:, None]
        return cls(solid.points, facets, areas, vectors / areas[:, None], mean, on_border)


@dataclass(frozen=True)
class Planes:
    """None, two or three planes beside each node."""

    nodes: IntArray  # node numbers, shape (m,)
    there: BoolArray  # which of them there are, shape (m, 3)
    normals: FloatArray  # unit normals, shape (m, 3, 3)
    distances: FloatArray  # how far the node lies below each plane, [voxels], shape (m, 3)
    centres: FloatArray  # middle of the triangles that lie in it, from the node, shape (m, 3, 3)


def edge_planes(surface: Surface) -> Planes:
    """Find the nodes of chamfers, ascending, and the planes beside them.

    A node that is not flat, with flat surface nearby that lies in two or three planes, is taken for one of a chamfer.
    """
    squared = np.einsum("ij,ij->i", surface.node_normals, surface.node_normals)
    flat_nodes = squared > (1.0 - 0.5 * np.radians(_FLAT_DEG) ** 2) ** 2  # triangles around lie in one plane
    flat = flat_nodes[surface.facets].all(axis=1)
    chamfer = np.zeros(len(surface.points), dtype=bool)
    if flat.any() and not flat.all():
        count, around = len(surface.points), _sum_at_nodes(surface.facets, surface.areas, len(surface.points))
        area, share = np.maximum(around, np.finfo(np.float64).tiny), flat.astype(np.float64)
        for _ in range(_SHARE_RINGS):  # of the area around each triangle, how much is of flat ones
            share = (_sum_at_nodes(surface.facets, surface.areas * share, count) / area)[surface.facets].mean(axis=1)
        chamfer[surface.facets[share > _LEAST_FLAT_SHARE]] = True
    nodes = np.flatnonzero(chamfer & ~flat_nodes & ~surface.on_border)
    if len(nodes) == 0:
        none = np.empty((0, 3, 3))
        return Planes(nodes, np.empty((0, 3), dtype=bool), none, np.empty((0, 3)), none)
    facets = np.flatnonzero(flat)
    centroids = surface.points[surface.facets[facets]].mean(axis=1)
    close = is_near(centroids, surface.points[nodes], _REACH)
    facets, centroids = facets[close], centroids[close]
    tree = KDTree(centroids)
    parts = [
        _planes_beside(surface, nodes[start : start + _CHUNK], tree, centroids, facets)
        for start in range(0, len(nodes), _CHUNK)
    ]
    return Planes(*(np.concatenate([getattr(part, name) for part in parts]) for name in Planes.__dataclass_fields__))


def _planes_beside(surface: Surface, nodes: IntArray, tree: KDTree, centroids: FloatArray, facets: IntArray) -> Planes:
    """Sort the flat triangles near each of some nodes by their normals into planes; nodes with one plane are left out.

    Three seeds are chosen: the nearest normal, the one that differs most from it, and the one that differs most from
    both. If what is taken for a plane is not plane, the node has none. The tree holds the flat triangles' centroids.
    """
    distance, found = map(np.asarray, tree.query(surface.points[nodes], k=_NEAREST, distance_upper_bound=_REACH))
    several = np.flatnonzero(np.count_nonzero(np.isfinite(distance), axis=1) >= 2 * _LEAST_FACETS)
    nodes, distance, found = nodes[several], distance[several], found[several]
    usable = np.isfinite(distance)
    found = np.where(usable, found, 0)
    ways = centroids[found] - surface.points[nodes][:, None]
    normals = surface.normals[facets[found]]
    below = np.einsum("mkj,mkj->mk", normals, ways)
    usable &= _products(normals, surface.node_normals[nodes]) > 0.1
    usable &= np.abs(below) < _FARTHEST

    seeds = [normals[np.arange(len(nodes)), np.argmax(usable, axis=1)]]
    there = [usable.any(axis=1)]
    closest = np.full(usable.shape, -2.0)
    for _ in range(2):
        closest = np.maximum(closest, _products(normals, seeds[-1]))
        candidate = np.where(usable, closest, 2.0)
        other = np.argmin(candidate, axis=1)[:, None]
        turned = np.take_along_axis(candidate, other, axis=1)[:, 0] < np.cos(np.radians(LEAST_TURN_DEG))
        there.append(there[-1] & turned)
        seeds.append(np.take_along_axis(normals, other[:, :, None], axis=1)[:, 0])
    two = np.flatnonzero(there[1])
    plane, is_there = np.stack(seeds, axis=1)[two], np.stack(there, axis=1)[two]
    ways, normals, below = ways[two], normals[two], below[two]
    weight = surface.areas[facets[found[two]]] * (1.0 - (np.minimum(distance[two], _REACH) / _REACH) ** 2)
    weight[~usable[two]] = 0.0

    for _ in range(2):
        cosine = np.where(is_there[:, None], normals @ plane.transpose(0, 2, 1), -2.0)
        share = weight[:, :, None] * (np.argmax(cosine, axis=2)[:, :, None] == np.arange(3))
        total = share.transpose(0, 2, 1) @ normals
        length = np.linalg.norm(total, axis=2)
        plane = np.where(length[:, :, None] > 0.0, total / np.where(length > 0.0, length, 1.0)[:, :, None], plane)
    sums = share.sum(axis=1)
    scale = np.where(sums > 0.0, sums, 1.0)
    # Half with each triangle's own normal, half with their mean: where the surface is curved, that has no error of
    # second order.
    offset = 0.5 * (ways @ plane.transpose(0, 2, 1) + below[:, :, None])
    mean = (share * offset).sum(axis=1) / scale
    scatter = (share * (offset - mean[:, None]) ** 2).sum(axis=1) / scale
    is_plane = (np.count_nonzero(share, axis=1) >= _LEAST_FACETS) & (scatter < _OFFSET_SPREAD**2)
    spread = np.sqrt(np.maximum(2.0 - 2.0 * length / scale, 0.0))
    is_plane &= spread < np.radians(_SPREAD_DEG)
    is_there &= np.all(is_plane | ~is_there, axis=1)[:, None]
    turn = np.arccos(np.clip(plane @ plane.transpose(0, 2, 1), -1.0, 1.0))
    turn[~(is_there[:, None] & is_there[:, :, None]) | np.eye(3, dtype=bool)] = np.pi
    turn = turn.min(axis=(1, 2))
    spread = np.where(is_there, spread, 0.0).max(axis=1)
    is_there &= ((turn > np.radians(LEAST_TURN_DEG)) & (turn > TURN_OVER_SPREAD * spread))[:, None]
    return Planes(nodes[two], is_there, plane, mean, share.transpose(0, 2, 1) @ ways / scale[:, :, None])


def _products(vectors: FloatArray, others: FloatArray) -> FloatArray:
    """Inner products of vectors (m, k, 3), k in a row with the same other one (m, 3), shape (m, k)."""
    return (vectors @ others[:, :, None])[:, :, 0]


def is_near(points: FloatArray, others: FloatArray, distance: float) -> BoolArray:
    """True at least for points (n, 3) within `distance` of one of the others (m, 3), shape (n,)."""
    low = others.min(axis=0) - 2.0 * distance
    inside = np.all((points > low) & (points < others.max(axis=0) + 2.0 * distance), axis=1)
    marked = np.zeros(np.floor((others.max(axis=0) - low) / distance).astype(int) + 3, dtype=bool)
    marked[tuple(np.floor((others - low) / distance).astype(int).T)] = True
    marked = binary_dilation(marked, np.ones((3, 3, 3)))
    inside[inside] = marked[tuple(np.floor((points[inside] - low) / distance).astype(int).T)]
    return inside


def _sum_at_nodes(facets: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Sum of a value over the triangles around each node, shape (count,)."""
    total = np.zeros(count)
    for column in facets.T:
        total += np.bincount(column, values, count)
    return total
