"""The planes of a surface beside the chamfers that isosurface stuffing leaves at edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.mesh.quality.checks import facet_area_vectors
from thermoxels_ns.mesh.stuffing.isosurface import StuffedSolid

LEAST_TURN_DEG = 50.0
"""Two planes make an edge if their normals differ by more than this; on a sphere of 5 voxels radius, what is within
`_REACH` does not."""
TURN_OVER_SPREAD = 8.0
"""They differ by this many times the spread of the normals in either: 3.5 is a pipe, 15 the rim of a cylinder."""

_FLAT_DEG = 8.0  # a node is flat if the normals around it spread by less than this (root mean square)
_LEAST_FLAT_SHARE = 0.08
"""Nodes are looked at where flat triangles are at least this share of the surface around. At clean edges it is above
0.1, on most of a noisy surface below 0.05."""
_SHARE_RINGS = 8  # rings of triangles over which that share is averaged
_REACH = 3.0  # planes are made of flat triangles this near, [voxels] ..
_NEAREST = 48  # ... and of no more than this many of them ...
_FARTHEST = 1.2  # ... whose own plane passes the node within this distance, [voxels].
_LEAST_FACETS = 3  # no plane is made of fewer triangles
_SPREAD_DEG = 9.0  # most that the normals in one plane may spread (root mean square)
_OFFSET_SPREAD = 0.2  # most that triangles in one plane may be off it, [voxels] (root mean square)
_CHUNK = 1 << 10  # nodes at a time: what is worked on stays in the processor's cache


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

    def flat_nodes(self) -> BoolArray:
        """True where the triangles around a node lie in one plane, shape (n,)."""
        squared = np.einsum("ij,ij->i", self.node_normals, self.node_normals)
        return squared > (1.0 - 0.5 * np.radians(_FLAT_DEG) ** 2) ** 2


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
    Planes are made of flat triangles only, never of the chamfer itself. Surfaces that are smooth or noisy have none.
    """
    flat_nodes = surface.flat_nodes()
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
