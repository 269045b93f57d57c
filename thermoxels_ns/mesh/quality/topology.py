"""How a mesh hangs together: bodies, boundary surfaces, their genus, and where they are pinched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.mesh.quality.face_count import Groups, group_pairs


@dataclass(frozen=True)
class SurfaceComponent:
    """Triangles of the boundary that hang together by edges."""

    num_triangles: int
    euler_characteristic: int  # vertices - edges + triangles
    genus: int | None
    """Number of handles, (2 - Euler characteristic) / 2; None where the component is not a closed manifold."""
    is_cavity: bool
    """True where it bounds a hole inside a body: it is closed and the volume that it encloses is negative."""


@dataclass(frozen=True)
class SurfaceTopology:
    """How a boundary hangs together."""

    num_open_edges: int
    """Edges whose triangles do not pass them equally often in both directions; 0: the surface is closed."""
    num_non_manifold_edges: int  # edges with more than two triangles: bodies that touch along an edge
    num_non_manifold_vertices: int
    """Vertices whose triangles are not one fan: bodies that touch at a point, and the ends of non-manifold edges."""
    euler_characteristic: int  # vertices - edges + triangles of the whole surface
    components: tuple[SurfaceComponent, ...]  # largest first


def group_sides(facets: IntArray) -> Groups:
    """Find the edges that triangles share; row 3 f + s is the side of triangle f from its node s to the next."""
    ends = np.roll(facets, -1, axis=1)
    return group_pairs(np.minimum(facets, ends).ravel(), np.maximum(facets, ends).ravel())


def count_bodies(num: int, pairs: IntArray) -> int:
    """Number of connected components of the things 0 to `num` - 1, given which pairs of them hang together (p, 2)."""
    return int(component_of(num, pairs[:, 0], pairs[:, 1]).max(initial=-1)) + 1


def tets_across_faces(face_groups: Groups) -> IntArray:
    """Pairs of tetrahedra that share a face, shape (p, 2), from `face_count.group_faces`."""
    return np.stack(_neighbours(face_groups), axis=1) >> 2


def triangles_across_edges(sides: Groups) -> IntArray:
    """Pairs of triangles that share an edge, shape (p, 2), from `group_sides`."""
    return np.stack(_neighbours(sides), axis=1) // 3


def surface_topology(points: FloatArray, facets: IntArray, sides: Groups | None = None) -> SurfaceTopology:
    """Count the components of a triangulated surface, their handles, and where it is no manifold.

    Nodes (n, 3), [m]; triangles (f, 3), right-hand normal out of the body; `sides` is `group_sides(facets)` if known.
    """
    sides = group_sides(facets) if sides is None else sides
    uses = sides.sizes
    start, end = facets.ravel(), np.roll(facets, -1, axis=1).ravel()
    upwards = start < end
    num_open = int(np.count_nonzero(sides.sums(np.where(upwards, 1, -1))))

    left, right = _neighbours(sides)
    component = component_of(len(facets), left // 3, right // 3)
    # Corner 3 f + s of triangle f lies at its node s. Two corners at one node are in one fan if an edge with just two
    # triangles lies between them.
    two_only = (uses == 2)[sides.of_row[left]]
    left, right = left[two_only], right[two_only]
    rows = np.arange(len(start))
    next_corner = rows - rows % 3 + (rows + 1) % 3
    low, high = np.where(upwards, rows, next_corner), np.where(upwards, next_corner, rows)
    fan = component_of(len(start), np.concatenate([low[left], high[left]]), np.concatenate([low[right], high[right]]))
    a_corner = np.zeros(int(fan.max(initial=-1)) + 1, dtype=np.int64)
    a_corner[fan] = rows
    fans_at_node = np.bincount(start[a_corner], minlength=1)

    edge_component = component[sides.first // 3]
    vertices = group_pairs(component[rows // 3], start)
    count = int(component.max(initial=-1)) + 1
    num_triangles = np.bincount(component, minlength=count)
    num_vertices = np.bincount(component[vertices.first // 3], minlength=count)
    euler = num_vertices - np.bincount(edge_component, minlength=count) + num_triangles
    odd_edges = np.bincount(edge_component, weights=uses != 2, minlength=count)
    closed = (odd_edges == 0) & (np.bincount(component[a_corner // 3], minlength=count) == num_vertices)
    is_open = np.bincount(edge_component, weights=uses % 2, minlength=count) > 0
    # Signed volumes between triangles and the middle of the nodes.
    corner = (points - points.mean(axis=0))[facets]
    cones = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6.0
    cavity = ~is_open & (np.bincount(component, weights=cones, minlength=count) < 0.0)
    order = np.argsort(-num_triangles, kind="stable")
    return SurfaceTopology(
        num_open_edges=num_open,
        num_non_manifold_edges=int(np.count_nonzero(uses > 2)),
        num_non_manifold_vertices=int(np.count_nonzero(fans_at_node > 1)),
        euler_characteristic=int(np.count_nonzero(fans_at_node)) - len(uses) + len(facets),
        components=tuple(
            SurfaceComponent(
                num_triangles=int(num_triangles[n]),
                euler_characteristic=int(euler[n]),
                genus=(2 - int(euler[n])) // 2 if closed[n] else None,
                is_cavity=bool(cavity[n]),
            )
            for n in order
        ),
    )


def _neighbours(groups: Groups) -> tuple[IntArray, IntArray]:
    """Rows that follow each other inside a group."""
    follows = np.ones(len(groups.order), dtype=bool)
    follows[groups.start] = False
    at = np.flatnonzero(follows)
    return groups.order[at - 1], groups.order[at]


def component_of(num: int, first: IntArray, second: IntArray) -> IntArray:
    """Number of the connected component that each of `num` things is in, shape (num,)."""
    if num == 0:
        return np.zeros(0, dtype=np.int64)
    links = sparse.coo_array((np.ones(len(first), dtype=bool), (first, second)), shape=(num, num))
    return connected_components(links, directed=False)[1].astype(np.int64)
