"""Sharpening: moves nodes of the chamfers that isosurface stuffing makes back to the sharp edges of the solid."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.mesh.quality.checks import component_of
from thermoxels_ns.mesh.stuffing.isosurface import StuffedSolid
from thermoxels_ns.mesh.tetrahedra import facet_area_vectors

ANGLES_DEG = (13.0, 160.0)
"""Range of the dihedral angles after a move, [degrees]; it is narrower than the range of stuffing itself."""
LONGEST_MOVE = 1.0  # nodes farther than this from the edge or corner do not move, [voxels]

_LEAST_DETERMINANT = 0.15
"""Least determinant of the matrix n_i . n_j of the planes' normals; below, the place where they meet is uncertain."""
_WRONG_SIDE = 0.15  # how far a node may lie on the wrong side of a plane of its edge, [voxels]
_CLEARANCE = 2.5
"""A node does not move towards another surface that faces it and is nearer than this, [voxels]."""
_ONE_CORNER = 0.5  # corners of the body found by different nodes are the same if they are this near, [voxels]
LEAST_TURN_DEG = 50.0
"""Two planes make an edge if the angle between their normals is more than this, [degrees], and more than
`TURN_OVER_SPREAD` times the spread of the normals within either. The ratio is 3.5 on a pipe, 15 at a cylinder's rim."""
TURN_OVER_SPREAD = 8.0

_FLAT_DEG = 8.0  # a node is flat if the normals of its triangles spread by less than this, [degrees] (root mean square)
_LEAST_FLAT_SHARE = 0.08
"""Chamfers are sought where flat triangles are more than this share of the area around; clean edges have over 0.1."""
_SHARE_RINGS = 8  # number of rings of triangles over which that share is averaged
_REACH = 3.0  # planes are fitted to flat triangles within this distance of a node, [voxels]
_NEAREST = 48  # of these, at most so many, the nearest, are used
_FARTHEST = 1.2  # of these, triangles whose plane is farther than this from the node are not used, [voxels]
_LEAST_FACETS = 3  # least number of triangles in a plane
_SPREAD_DEG = 9.0  # largest spread of the normals in one plane, [degrees] (root mean square)
_OFFSET_SPREAD = 0.2  # largest distance of the triangles in one plane from the plane, [voxels] (root mean square)
_CHUNK = 1 << 10  # number of nodes worked on at a time, so that their data stay in the processor's cache


def sharpen(solid: StuffedSolid, shape: tuple[int, ...]) -> StuffedSolid:
    """Return the mesh with nodes of chamfers moved to the edge or corner where the planes beside the chamfer meet.

    Where two planes of the surface meet, stuffing leaves a chamfer about half a voxel wide. The planes are fitted to
    flat parts of the surface within three voxels of a node, whose triangles are sorted by their normals into up to
    three planes. Where two or three planes are not found clearly, as on smooth or noisy surfaces and on walls of less
    than 3 voxels, nothing moves. Nodes move one after another, to corners first, then by the length of the move; a node
    moves only if all its tetrahedra stay sound (`ANGLES_DEG`, volume above 0). Nodes on the border of the lattice, and
    nodes that face another surface close by, stay. For boxes 48 voxels across, at any angle, the area is then within
    0.5 % instead of 3.2 %. `shape` is the number of voxels along each axis.
    """
    assert solid.points.min() >= 0.0 and np.all(solid.points.max(axis=0) <= shape)
    surface = Surface.of(solid)
    planes = edge_planes(surface)
    parts = [_ways(surface, planes, which) for which in ([0, 1], [0, 2], [1, 2], [0, 1, 2])]
    node, to, is_corner, length = (np.concatenate(column) for column in zip(*parts))
    # Moves to corners come first: nodes near a corner would otherwise end on the edges beside the corner.
    order = np.lexsort((node, length, ~is_corner))
    moves = _Moves(node[order], to[order], _same_corners(to[order], is_corner[order]))
    moves = moves.keep(np.all((moves.to > 0.0) & (moves.to < shape), axis=1))
    moves = moves.keep(_clear(surface, moves))
    if len(moves.node) == 0:
        return solid
    return replace(solid, points=_carry_out(solid.points, solid.tets, moves))


@dataclass(frozen=True)
class _Moves:
    """Possible moves of nodes, in the order in which they are tried; several moves may be of one node."""

    node: IntArray  # node numbers, shape (m,)
    to: FloatArray  # positions, shape (m, 3)
    corner: IntArray  # number of the body's corner that a move leads to, -1 for a move to an edge, (m,)

    def keep(self, which: npt.NDArray) -> _Moves:
        """Return the moves chosen by a mask or by their numbers."""
        return _Moves(self.node[which], self.to[which], self.corner[which])


def _ways(surface: Surface, planes: Planes, which: list[int]) -> tuple[IntArray, FloatArray, BoolArray, FloatArray]:
    """Return nodes, their goals (m, 3), which goals are corners, and distances, [voxels], for the planes `which`."""
    row = np.flatnonzero(planes.there[:, which].all(axis=1))
    normals, below = planes.normals[row][:, which], planes.distances[row][:, which]
    products = normals @ normals.transpose(0, 2, 1)
    clear = np.linalg.det(products) > _LEAST_DETERMINANT
    if len(which) == 2:
        # At a convex edge, the triangles of each plane and the chamfer lie below the other plane. At a concave edge
        # they lie above.
        centres = planes.centres[row][:, which]
        above = np.einsum("mpj,mpj->mp", normals, centres[:, ::-1]) - below
        convex, concave = np.all(above < 0.0, axis=1), np.all(above > 0.0, axis=1)
        clear &= (convex & np.all(below > -_WRONG_SIDE, axis=1)) | (concave & np.all(below < _WRONG_SIDE, axis=1))
    row, normals, below, products = row[clear], normals[clear], below[clear], products[clear]
    # This is the shortest step to a point that lies in all of the planes.
    step = np.einsum("mp,mpj->mj", np.linalg.solve(products, below[:, :, None])[:, :, 0], normals)
    length = np.linalg.norm(step, axis=1)
    short = length < LONGEST_MOVE
    node = planes.nodes[row[short]]
    return node, surface.points[node] + step[short], np.full(len(node), len(which) == 3), length[short]


def _same_corners(to: FloatArray, is_corner: BoolArray) -> IntArray:
    """Return for each goal `to` the number of its corner of the body, -1 where `is_corner` is False, shape (m,)."""
    number = np.full(len(to), -1, dtype=np.int64)
    corners = np.flatnonzero(is_corner)
    if len(corners):
        pairs = KDTree(to[corners]).query_pairs(_ONE_CORNER, output_type="ndarray")
        number[corners] = component_of(len(corners), *pairs.T)
    return number


def _clear(surface: Surface, moves: _Moves) -> BoolArray:
    """Return False for outward moves towards a surface that faces the node within `_CLEARANCE`, shape (m,)."""
    clear = np.ones(len(moves.node), dtype=bool)
    if len(clear) == 0:
        return clear
    start = surface.points[moves.node]
    others = np.flatnonzero(np.any(surface.node_normals != 0.0, axis=1))
    pairs = KDTree(start).sparse_distance_matrix(KDTree(surface.points[others]), _CLEARANCE, output_type="ndarray")
    move, other = pairs["i"], others[pairs["j"]]  # type: ignore[index]
    normal = surface.node_normals[moves.node]
    outward = np.einsum("ij,ij->i", moves.to - start, normal) > 0.0
    faces = np.einsum("ij,ij->i", normal[move], surface.node_normals[other]) < 0.1
    in_front = np.einsum("ij,ij->i", surface.points[other] - start[move], normal[move]) > 0.05
    clear[move[outward[move] & faces & in_front]] = False
    return clear


def _carry_out(points: FloatArray, tets: IntArray, moves: _Moves) -> FloatArray:
    """Return positions (n, 3) after the moves, made in order, except moves after which a tetrahedron is not sound."""
    touched = np.zeros(len(points), dtype=bool)
    touched[moves.node] = True
    near = tets[touched[tets].any(axis=1)]
    order = np.argsort(near.ravel(), kind="stable")
    first = np.searchsorted(near.ravel()[order], np.arange(len(points) + 1))
    points, bounds = points.copy(), np.cos(np.radians(ANGLES_DEG))
    _move_nodes(points, near, order // 4, first, moves.node, moves.to, moves.corner, bounds)
    return points


@kernel
def _move_nodes(points, tets, around, first, node, to, corner, bounds):
    """Move `points` in place where all stays sound; the tetrahedra of node n are `around[first[n]:first[n + 1]]`."""
    moved = np.zeros(len(points), np.bool_)
    taken = np.zeros(corner.max() + 1 if len(corner) else 0, np.bool_)
    for move in range(len(node)):
        n = node[move]
        if moved[n] or (corner[move] >= 0 and taken[corner[move]]):
            continue
        before = points[n].copy()
        points[n] = to[move]
        for tet in around[first[n] : first[n + 1]]:
            if not _is_sound(points[tets[tet]], bounds):
                points[n] = before
                break
        else:
            moved[n] = True
            if corner[move] >= 0:
                taken[corner[move]] = True


@kernel
def _is_sound(corners, bounds):
    """Return whether a tetrahedron (4, 3) has a volume above 0 and dihedral cosines within `bounds` (high, low)."""
    normals, volume = np.zeros((4, 3)), 0.0
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        for n in range(1, 4):  # the face opposite node n has the nodes 0, p and q
            p, q = n % 3 + 1, (n + 1) % 3 + 1
            normals[n, axis] = (corners[p, one] - corners[0, one]) * (corners[q, two] - corners[0, two])
            normals[n, axis] -= (corners[p, two] - corners[0, two]) * (corners[q, one] - corners[0, one])
            normals[0, axis] -= normals[n, axis]
        volume += (corners[1, axis] - corners[0, axis]) * normals[1, axis]
    if volume <= 0.0:
        return False
    for i in range(4):
        for j in range(i):
            product, square_i, square_j = 0.0, 0.0, 0.0
            for axis in range(3):
                product += normals[i, axis] * normals[j, axis]
                square_i += normals[i, axis] ** 2
                square_j += normals[j, axis] ** 2
            cosine = -product / np.sqrt(square_i * square_j)
            if cosine > bounds[0] or cosine < bounds[1]:
                return False
    return True


@dataclass(frozen=True)
class Surface:
    """The boundary triangles of a mesh that do not lie on the border of the lattice."""

    points: FloatArray  # all nodes of the mesh, shape (n, 3)
    facets: IntArray  # triangles, shape (f, 3)
    areas: FloatArray  # areas of the triangles, shape (f,)
    normals: FloatArray  # unit normals of the triangles, shape (f, 3)
    node_normals: FloatArray
    """Mean unit normal of the triangles around each node, weighted by area, shape (n, 3). The mean is shorter than 1
    where normals differ, and 0 at nodes without a triangle."""
    on_border: BoolArray  # True for nodes on the border of the lattice, shape (n,)

    @classmethod
    def of(cls, solid: StuffedSolid) -> Surface:
        """Return the surface of a stuffed solid."""
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
    """The planes of the surface beside nodes that may lie on a chamfer: none, two or three for each node."""

    nodes: IntArray  # node numbers, shape (m,)
    there: BoolArray  # True for the planes that a node has, shape (m, 3)
    normals: FloatArray  # unit normals, shape (m, 3, 3)
    distances: FloatArray  # how far the node lies below each plane, [voxels], shape (m, 3)
    centres: FloatArray  # vectors from the node to the mean centroid of each plane's triangles, shape (m, 3, 3)


def edge_planes(surface: Surface) -> Planes:
    """Return the nodes that may lie on a chamfer, ascending, and the planes beside them.

    A node lies on a chamfer if it is not flat and the flat surface nearby lies in two or three planes.
    """
    squared = np.einsum("ij,ij->i", surface.node_normals, surface.node_normals)
    flat_nodes = squared > (1.0 - 0.5 * np.radians(_FLAT_DEG) ** 2) ** 2  # triangles around the node lie in one plane
    flat = flat_nodes[surface.facets].all(axis=1)
    chamfer = np.zeros(len(surface.points), dtype=bool)
    if flat.any() and not flat.all():
        count, around = len(surface.points), _sum_at_nodes(surface.facets, surface.areas, len(surface.points))
        area, share = np.maximum(around, np.finfo(np.float64).tiny), flat.astype(np.float64)
        for _ in range(_SHARE_RINGS):  # share of flat triangles in the area around each triangle
            share = (_sum_at_nodes(surface.facets, surface.areas * share, count) / area)[surface.facets].mean(axis=1)
        chamfer[surface.facets[share > _LEAST_FLAT_SHARE]] = True
    nodes = np.flatnonzero(chamfer & ~flat_nodes & ~surface.on_border)
    if len(nodes) == 0:
        none = np.empty((0, 3, 3))
        return Planes(nodes, np.empty((0, 3), dtype=bool), none, np.empty((0, 3)), none)
    facets = np.flatnonzero(flat)
    centroids = surface.points[surface.facets[facets]].mean(axis=1)
    tree = KDTree(centroids)
    parts = [
        _planes_beside(surface, nodes[start : start + _CHUNK], tree, centroids, facets)
        for start in range(0, len(nodes), _CHUNK)
    ]
    return Planes(*(np.concatenate([getattr(part, name) for part in parts]) for name in Planes.__dataclass_fields__))


def _planes_beside(surface: Surface, nodes: IntArray, tree: KDTree, centroids: FloatArray, facets: IntArray) -> Planes:
    """Return the planes of the flat triangles near some nodes, without nodes that have less than two planes.

    Triangles are sorted by their normals around three seeds: the nearest normal, the one that differs most from it, and
    the one that differs most from both. If the triangles of a seed do not lie in a plane, the node gets no plane.
    `tree` holds the `centroids` of the flat triangles, whose numbers are `facets`.
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
    # The offset is the mean of that along each triangle's own normal and that along their mean normal: this mean has no
    # second-order error on curved surfaces.
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
    """Return the inner products of vectors (m, k, 3) with others (m, 3), shape (m, k)."""
    return (vectors @ others[:, :, None])[:, :, 0]


def _sum_at_nodes(facets: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Return for each node the sum of `values`, one per triangle, over the triangles around the node, (count,)."""
    total = np.zeros(count)
    for column in facets.T:
        total += np.bincount(column, values, count)
    return total
