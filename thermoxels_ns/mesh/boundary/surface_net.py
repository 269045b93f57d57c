"""The surface net of a voxel mesh: one quadrilateral for each voxel face, free to lie where the surface really is.

The faces between solid and empty voxels, and the nodes that they share, make a net. Faces keep their neighbours while
the nodes move, so what a moved face covers is the true surface that the face stands for (Gibson, Constrained elastic
surface nets, 1998; Ju et al., Dual contouring of Hermite data, 2002). Where two sheets of the surface touch in a node,
each has a vertex of its own there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.kernel_cache import kernel

IntArray = npt.NDArray[np.int64]

_REMEDY = "Pass the level function and the boundary of the same voxel mesh, in corner indices."
_RINGS: IntArray = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
"""The eight voxels around a node, numbered as `CORNER_OFFSETS`, four by four around the six lattice edges that end in
it, shape (6, 4)."""


def _pairs_of_rings() -> IntArray:
    """Pairs of neighbours around each ring, from voxel n to voxel n + 1; pairs of all eight voxels have one number."""
    pairs = [(low, low | bit) for bit in (4, 2, 1) for low in range(8) if not low & bit]
    return np.array([[pairs.index((min(p), max(p))) for p in zip(ring, np.roll(ring, -1))] for ring in _RINGS])


_PAIRS: IntArray = _pairs_of_rings()
"""Numbers, from 0 to 11 and four along each axis, of the pairs of neighbours in `_RINGS`, shape (6, 4)."""


@dataclass(frozen=True)
class VoxelFaces:
    """The voxel faces that make the boundary of a voxel mesh."""

    upper: IntArray
    """Voxel on the upper side of each face along its axis, also the index of its lowest corner, shape (f, 3)."""
    axis: IntArray
    """Axis that each face is normal to, shape (f,)."""
    outwards: IntArray
    """1 where the solid voxel is below the face along its axis, else -1, shape (f,)."""
    on_border: npt.NDArray[np.bool_]
    """True on the border of the lattice, where the box cuts the solid, shape (f,)."""
    nodes: IntArray
    """Corners of each face in order around it, from its lowest, shape (f, 4)."""
    of_triangle: IntArray
    """Face that each triangle is half of."""


@dataclass(frozen=True)
class SurfaceNet:
    """The faces inside the lattice, joined at vertices."""

    faces: IntArray
    """Numbers of the faces that are not on the border, shape (n,)."""
    corners: IntArray
    """Vertices of these faces, in order around each, shape (n, 4)."""
    index: IntArray
    """Corner index of the node that each vertex belongs to, shape (v, 3)."""
    first: IntArray
    """Where the faces of each vertex start in `around`, and the end, shape (v + 1,)."""
    around: IntArray
    """Rows of `corners` that each vertex is in, vertex after vertex, shape (4 n,)."""


def voxel_faces(level: npt.NDArray, points_index: npt.NDArray, facets: npt.NDArray) -> VoxelFaces:
    """Put the triangles of a voxel mesh's boundary together to voxel faces.

    Args:
        level: Positive in solid voxels, at voxel centres, shape (nx-1, ny-1, nz-1).
        points_index: Corner indices of the nodes, whole numbers, shape (n, 3).
        facets: Boundary triangles in any order and orientation, both halves of each face, shape (f, 3).

    Raises:
        MeshError: A triangle is not half of a face between a solid voxel and an empty one or the outside, or its other
            half is missing.
    """
    points = np.asarray(points_index)
    facets = np.ascontiguousarray(facets, dtype=np.int64)
    nodes = np.ascontiguousarray(points, dtype=np.int64)
    if not np.array_equal(points, nodes):
        # What lies between lattice corners is no voxel face; a number outside the lattice says so below.
        nodes = np.where(np.all(points == nodes, axis=1, keepdims=True), nodes, -1)
    axis, lowest, bad = _halves(nodes, facets, np.array(level.shape))
    if bad:
        raise _wrong(
            f"halves of the faces of {' x '.join(map(str, level.shape))} voxels",
            f"{bad} other triangles of {len(facets)}",
        )
    if len(facets) % 2 == 0 and _come_in_pairs(axis, lowest):
        first, of_triangle = np.arange(0, len(facets), 2), np.repeat(np.arange(len(facets) // 2), 2)
    else:
        sizes = (3, *(n + 1 for n in level.shape))
        _, first, of_triangle = np.unique(
            np.ravel_multi_index((axis, *lowest.T), sizes), return_index=True, return_inverse=True
        )
    axis, upper = axis[first], lowest[first]
    corners, outwards, on_border = _corners_and_sides(level, nodes, facets, of_triangle, axis, upper)
    missing = np.count_nonzero(corners < 0)
    if missing:
        raise _wrong("both halves of every voxel face", f"{missing} faces of which one is missing")
    wrong = np.count_nonzero(outwards == 0)
    if wrong:
        raise _wrong("voxel faces with level above 0 on one side only", f"{wrong} others")
    return VoxelFaces(upper, axis, outwards, on_border, corners, of_triangle)


def surface_net(level: npt.NDArray, points_index: npt.NDArray, faces: VoxelFaces) -> SurfaceNet:
    """Join the faces inside the lattice at vertices: one per node and sheet of the surface that passes it.

    Two faces that share an edge are of one sheet. Where four faces share one, because two solid voxels touch along it,
    the bilinear level around that edge says whether the solid goes on between the two or the empty space does.

    Args:
        level: Positive in solid voxels, at voxel centres.
        points_index: Corner indices of the nodes, shape (n, 3).
        faces: What `voxel_faces` returned for them.
    """
    nodes = np.ascontiguousarray(points_index, dtype=np.int64)
    inside = np.flatnonzero(~faces.on_border)
    sheet, sheets = _sheets(level, nodes, faces.nodes[inside], _RINGS, _PAIRS)
    start = np.cumsum(sheets) - sheets
    corners = _vertices(faces.upper[inside], faces.axis[inside], faces.nodes[inside], nodes, sheet, start)
    first, around = _faces_of_vertices(corners, int(sheets.sum()))
    return SurfaceNet(inside, corners, np.repeat(nodes, sheets, axis=0), first, around)


def _wrong(expected: str, got: str) -> MeshError:
    return MeshError("boundary facets", expected=expected, got=got, remedy=_REMEDY)


@kernel
def _halves(nodes, facets, shape):
    """Axis and lowest corner of each triangle; also how many are not half of a voxel face of the lattice."""
    axis = np.zeros(len(facets), np.int64)
    lowest = np.zeros((len(facets), 3), np.int64)
    bad = 0
    for f in range(len(facets)):
        flat, ones = 0, 0
        inside = True
        for c in range(3):
            a, b, d = nodes[facets[f, 0], c], nodes[facets[f, 1], c], nodes[facets[f, 2], c]
            low, high = min(a, b, d), max(a, b, d)
            lowest[f, c] = low
            inside = inside and low >= 0 and high <= shape[c]
            if high == low:
                flat += 1
                axis[f] = c
            elif high == low + 1:
                ones += 1
        twice = facets[f, 0] == facets[f, 1] or facets[f, 1] == facets[f, 2] or facets[f, 0] == facets[f, 2]
        if not (flat == 1 and ones == 2 and inside) or twice:
            bad += 1
    return axis, lowest, bad


@kernel(error_model="python")
def _come_in_pairs(axis, lowest):
    """Whether triangles 2 n and 2 n + 1 are of one face, for all n."""
    for f in range(0, len(axis), 2):
        if axis[f] != axis[f + 1]:
            return False
        for c in range(3):
            if lowest[f, c] != lowest[f + 1, c]:
                return False
    return True


@kernel(error_model="python")
def _corners_and_sides(level, nodes, facets, of_triangle, axis, upper):
    """Nodes around each face, -1 where no triangle has one; side of the solid, 0 if it is on both or on none."""
    corners = np.full((len(axis), 4), -1)
    for t in range(len(facets)):
        f = of_triangle[t]
        u, v = (axis[f] + 1) % 3, (axis[f] + 2) % 3
        for c in range(3):
            node = facets[t, c]
            du, dv = nodes[node, u] - upper[f, u], nodes[node, v] - upper[f, v]
            corners[f, du + 3 * dv - 2 * du * dv] = node
    outwards = np.zeros(len(axis), np.int64)
    on_border = np.zeros(len(axis), np.bool_)
    for f in range(len(axis)):
        i, j, k = upper[f]
        a = axis[f]
        above = upper[f, a] < level.shape[a] and level[i, j, k] > 0.0
        below = upper[f, a] > 0 and level[i - (a == 0), j - (a == 1), k - (a == 2)] > 0.0
        outwards[f] = int(below) - int(above)
        on_border[f] = upper[f, a] == 0 or upper[f, a] == level.shape[a]
    return corners, outwards, on_border


@kernel
def _sheets(level, nodes, corners, rings, pairs):
    """Sheet of the surface at each pair of voxels around each node, -1 where both are the same; number of sheets.

    Beyond the border of the lattice the level goes on as it is inside.
    """
    sheet = np.full((len(nodes), 12), np.int8(-1))
    count = np.zeros(len(nodes), np.int64)
    around = np.empty(8)
    for f in range(len(corners)):
        for c in range(4):
            node = corners[f, c]
            if count[node]:
                continue
            for voxel in range(8):
                i = min(max(nodes[node, 0] - 1 + (voxel >> 2 & 1), 0), level.shape[0] - 1)
                j = min(max(nodes[node, 1] - 1 + (voxel >> 1 & 1), 0), level.shape[1] - 1)
                k = min(max(nodes[node, 2] - 1 + (voxel & 1), 0), level.shape[2] - 1)
                around[voxel] = level[i, j, k]
            label = sheet[node]
            for r in range(6):
                crossed = 0
                for n in range(4):
                    if (around[rings[r, n]] > 0.0) != (around[rings[r, (n + 1) % 4]] > 0.0):
                        crossed += 1
                        if label[pairs[r, n]] < 0:
                            label[pairs[r, n]] = pairs[r, n]
                a, b, c0, d = around[rings[r, 0]], around[rings[r, 1]], around[rings[r, 2]], around[rings[r, 3]]
                # Of four crossings, two belong together at each solid voxel, or, if those hang together, at each empty
                # one; the sign of the level at its saddle in between says which, and solid hangs together if that is 0.
                apart = (a * c0 < b * d) if a > 0.0 else (b * d < a * c0)
                lone = (a > 0.0) == apart
                for n in range(4):
                    first = pairs[r, n]
                    if crossed == 0 or label[first] < 0 or (crossed == 4 and (n % 2 == 0) != lone):
                        continue
                    # The crossing before this one: of four the pair before, of two the other one.
                    second = pairs[r, (n + 3) % 4]
                    for back in range(1, 4):
                        if crossed == 2 and label[pairs[r, (n + back) % 4]] >= 0:
                            second = pairs[r, (n + back) % 4]
                    low, high = min(label[first], label[second]), max(label[first], label[second])
                    for pair in range(12):
                        if label[pair] == high:
                            label[pair] = low
            found = 0
            for pair in range(12):
                if label[pair] == pair:
                    for other in range(pair, 12):
                        if label[other] == pair:
                            label[other] = -2 - found
                    found += 1
            for pair in range(12):
                if label[pair] < -1:
                    label[pair] = -2 - label[pair]
            count[node] = found
    return sheet, count


@kernel(error_model="python")
def _vertices(upper, axis, corners, nodes, sheet, start):
    """Vertex at each corner of each face."""
    vertices = np.empty((len(corners), 4), np.int64)
    for f in range(len(corners)):
        a = axis[f]
        for c in range(4):
            node = corners[f, c]
            # The voxel above the face, seen from the node: 1 along the face's axis, else 0 or 1.
            around = np.int64(0)
            for along in range(3):
                around = 2 * around + upper[f, along] - nodes[node, along] + 1
            # Of the four pairs along an axis, those are in the order of what the lower voxel has in the other bits.
            if a == 0:
                rank = around & 3
            elif a == 1:
                rank = (around >> 2 & 1) * 2 + (around & 1)
            else:
                rank = around >> 1
            vertices[f, c] = start[node] + sheet[node, 4 * a + rank]
    return vertices


@kernel(error_model="python")
def _faces_of_vertices(corners, num_vertices):
    """Faces around each vertex, a counting sort."""
    first = np.zeros(num_vertices + 1, np.int64)
    for f in range(len(corners)):
        for c in range(4):
            first[corners[f, c] + 1] += 1
    for v in range(num_vertices):
        first[v + 1] += first[v]
    place = first[:-1].copy()
    around = np.empty(4 * len(corners), np.int64)
    for f in range(len(corners)):
        for c in range(4):
            v = corners[f, c]
            around[place[v]] = f
            place[v] += 1
    return first, around
