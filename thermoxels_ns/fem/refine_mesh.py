"""Finer meshes of the same body: every tetrahedron is cut into eight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.fem.linear_tets import FACET_EDGES, TET_EDGES, mesh_edges
from thermoxels_ns.mesh.tetrahedra import TetMesh


def refine_mesh(mesh: TetMesh) -> TetMesh:
    """Return a conforming mesh of the same body with all edges halved: each tetrahedron becomes eight.

    Cutting off its four corners makes a tetrahedron into four children of the same shape and an octahedron, which is
    cut into four along the shortest of its three diagonals, as scikit-fem does. Children of the six tetrahedra of a
    cube (Kuhn) are such tetrahedra again, so no angle becomes obtuse.

    Nodes keep their numbers; the middles of the edges follow in the order of `mesh_edges`. Children inherit regions,
    tags and patches and stand in the order of their parents. Temperatures and colours of new nodes are means, and a new
    node counts as observed if both ends of its edge are observed.
    """
    edges = mesh_edges(mesh.tets, len(mesh.points_m))
    num_nodes, (low, high) = len(mesh.points_m), edges.ends.T
    points = np.concatenate([mesh.points_m, edges.midpoints(mesh.points_m)])
    local = np.concatenate([mesh.tets, num_nodes + edges.numbers(mesh.tets, TET_EDGES)], axis=1)
    facets = np.concatenate([mesh.facets, num_nodes + edges.numbers(mesh.facets, FACET_EDGES)], axis=1)
    tags, colour = mesh.boundary, mesh.colour
    return replace(
        mesh,
        points_m=points,
        tets=np.take_along_axis(local[:, None], _CHILDREN[_diagonals(points, local)], axis=2).reshape(-1, 4),
        temperature_c=np.concatenate([mesh.temperature_c, edges.midpoints(mesh.temperature_c)]),
        observed=np.concatenate([mesh.observed, mesh.observed[low] & mesh.observed[high]]),
        facets=facets[:, _FACET_CHILDREN].reshape(-1, 3),
        facet_tags=np.repeat(mesh.facet_tags, 4),
        region=np.repeat(mesh.region, 8),
        boundary=replace(
            tags,
            seen=np.repeat(tags.seen, 4),
            patch=np.repeat(tags.patch, 4),
            photographs=None if tags.photographs is None else np.repeat(tags.photographs, 4, axis=0),
        ),
        colour=None if colour is None else np.concatenate([colour, 0.5 * (colour[low] + colour[high])]),
    )


_OPPOSITE = ((4, 9), (6, 8), (7, 5))  # Pairs of middles of opposite edges; numbers 4 to 9 follow `TET_EDGES`


def _children() -> IntArray:
    """Return the local nodes of the 8 children for each of 3 diagonals, shape (3, 8, 4); 4 to 9 are middles."""
    middle = {frozenset(map(int, ends)): 4 + number for number, ends in enumerate(TET_EDGES)}
    corners = [[i if j == i else middle[frozenset((i, j))] for j in range(4)] for i in range(4)]
    place = np.vstack([np.zeros(3), np.eye(3)])
    place = np.concatenate([place, [place[list(ends)].mean(axis=0) for ends in TET_EDGES]])
    table = []
    for first in range(3):
        # The middles of one pair are the ends of the diagonal; the other two pairs are the ring around it.
        (a, b), (c, d) = (pair for pair in _OPPOSITE if pair is not _OPPOSITE[first])
        ring = [[*_OPPOSITE[first], *pair] for pair in ((a, c), (c, b), (b, d), (d, a))]
        upright = [t if np.linalg.det(place[t[1:]] - place[t[0]]) > 0.0 else [t[1], t[0], *t[2:]] for t in ring]
        table.append(corners + upright)
    return np.array(table)


_CHILDREN = _children()
_FACET_CHILDREN = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
"""Local nodes of a triangle's children: 0 to 2 are the corners and 3 to 5 the middles of `FACET_EDGES`."""
_TIE = 1.0 - 1e-9  # Diagonals shorter than the others by less than this factor count as equal: the first one is taken


def _diagonals(points: FloatArray, local: IntArray) -> IntArray:
    """Return for each tetrahedron the number of the shortest diagonal of its octahedron, shape (t,)."""
    lengths = [np.linalg.norm(points[local[:, a]] - points[local[:, b]], axis=1) for a, b in _OPPOSITE]
    chosen, best = np.zeros(len(local), np.int64), lengths[0]
    for option in (1, 2):
        shorter = lengths[option] < _TIE * best
        chosen, best = np.where(shorter, option, chosen), np.where(shorter, lengths[option], best)
    return chosen
