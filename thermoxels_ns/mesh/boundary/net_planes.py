"""The plane of the true surface at each face of a surface net, and the vertices where these planes meet.

The planes start where the level function says that the surface crosses the line between a solid voxel and an empty
one. They are evened out between faces of about the same direction, and carried on to sharp edges from the flat parts
beside them, because there the level function, which is smooth over three voxels, rounds the edges off.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.mesh.boundary.surface_net import SurfaceNet, VoxelFaces

FloatArray = npt.NDArray[np.float64]

ACROSS_SHARE = 0.8
"""Across a face, the gradient is this share central differences and for the rest the step between its two voxels. The
latter alone turns the normals of a staircase without subvoxel information to the axes."""
ROUGHNESS = (0.025, 0.055)
"""Root mean square distance between neighbouring planes, [voxels]: below the first, planes stay as they are; above the
second, they are evened out as much as can be. Rounded edges have up to 0.02, noise and staircases 0.03 to 0.3."""
NEIGHBOUR_COSINES = (-0.3, 0.5, 0.8)
"""Smallest cosine between the normals of two faces that are averaged, pass by pass. Below 0, the first pass evens out
the steps of a wall of one voxel without subvoxel information; the later ones leave the edges of a box sharp."""
OFFSET_PASSES = 2
"""How often the places of neighbouring planes are evened out."""
OFFSET_COSINE = 0.8
"""Smallest cosine between the normals of two faces whose places are compared."""
FLAT_DEG = (5.0, 3.0)
"""A face is flat if the normals of the faces around it spread by less than this (root mean square): where planes stay
as they are, and where they are evened out."""
EDGE_DEG = 15.0
"""It is at an edge if they spread by more than this ..."""
EDGE_RINGS = 2
"""... or if a face this many rings away is."""
EDGE_PASSES = 5
"""Rings of faces over which planes are carried on; smoothing spoils about three on either side of an edge."""
EDGE_COSINE = 0.6
"""Smallest cosine between a face's own normal and that of a plane that is carried on to it."""
SAME_PLANE_COSINE = 0.95
"""Planes carried on to one face are averaged if their normals are this near to the best one's."""
LONGEST_MOVE = 1.0
"""Planes pass a face, and vertices the middle of the faces around them, at most this far away, [voxels]."""

_STIFFNESS = 0.02
"""Share of its way that holds a vertex where planes do not say where it is: along a flat surface, along an edge."""


@dataclass(frozen=True)
class NetPlanes:
    """One plane per face of a net; it need not touch its face."""

    point: FloatArray
    """A point of each plane, shape (n, 3), [voxels]."""
    normal: FloatArray
    """Its unit normal, shape (n, 3); it may point inwards where the surface is noise."""


def net_planes(level: npt.NDArray, faces: VoxelFaces, net: SurfaceNet) -> NetPlanes:
    """Find the plane of the true surface at each face of a net.

    Args:
        level: Positive in solid voxels and negative in empty ones, at voxel centres.
        faces: The faces.
        net: How they hang together.
    """
    around = net.corners, net.first, net.around
    point, normal = _crossings(level, faces.upper[net.faces], faces.axis[net.faces], ACROSS_SHARE)
    # Edges are rough in a narrow band, noise and staircases everywhere.
    rough = _least(_mean(_roughness(point, normal, *around, OFFSET_COSINE), *around), *around)
    share = np.clip((rough - ROUGHNESS[0]) / (ROUGHNESS[1] - ROUGHNESS[0]), 0.0, 1.0)
    for least in NEIGHBOUR_COSINES:
        normal = _evened_normals(normal, share, *around, least)
    for _ in range(OFFSET_PASSES):
        point = _evened_points(point, normal, share, *around, OFFSET_COSINE)

    spread = _spread_deg(normal, *around)
    settled = spread < FLAT_DEG[0] + (FLAT_DEG[1] - FLAT_DEG[0]) * share
    near_edge = spread > EDGE_DEG
    for _ in range(EDGE_RINGS):
        near_edge = _with_neighbours(near_edge, *around)
    own = normal
    for _ in range(EDGE_PASSES):
        waiting = np.flatnonzero(near_edge & ~settled)
        if len(waiting) == 0:
            break
        point, normal, settled = _carried_on(
            waiting, point, normal, own, settled, *around, EDGE_COSINE, SAME_PLANE_COSINE, LONGEST_MOVE
        )
    return NetPlanes(point, normal)


def net_vertices(planes: NetPlanes, net: SurfaceNet, level_shape: tuple[int, ...]) -> FloatArray:
    """Move every vertex to where the planes of the faces around it meet.

    That is the least sum of squared distances to the planes, with a spring to the mean of the faces' points that
    decides only where planes leave it open. Vertices on the border of the lattice stay on it.

    Returns:
        Vertices in corner indices, shape (v, 3), at most `LONGEST_MOVE` along each axis from their node.
    """
    size = np.array(level_shape)
    return _meeting_points(
        planes.point, planes.normal, net.index, net.first, net.around, size, _STIFFNESS, LONGEST_MOVE
    )


def evened_normals(normal: FloatArray, net: SurfaceNet) -> FloatArray:
    """Average the normals of a net's faces with those around them, but not across edges, shape (n, 3)."""
    for least in NEIGHBOUR_COSINES[1:]:
        normal = _evened_normals(normal, np.ones(len(normal)), net.corners, net.first, net.around, least)
    return normal


@kernel
def _crossings(level, upper, axis, across_share):
    """Where the level is 0 between the two voxels of each face, linear in between, and minus its gradient there."""
    point, normal = np.empty((len(axis), 3)), np.empty((len(axis), 3))
    for f in range(len(axis)):
        a = axis[f]
        high = (upper[f, 0], upper[f, 1], upper[f, 2])
        low = (high[0] - (a == 0), high[1] - (a == 1), high[2] - (a == 2))
        below, above = float(level[low]), float(level[high])
        share = below / (below - above)
        for along in range(3):
            point[f, along] = low[along] + 0.5
            slope = 0.0
            for side in range(2):
                i, j, k = low if side == 0 else high
                at = high[along] if side == 1 else low[along]
                before, after = max(at - 1, 0), min(at + 1, level.shape[along] - 1)
                if along == 0:
                    rise = float(level[after, j, k]) - float(level[before, j, k])
                elif along == 1:
                    rise = float(level[i, after, k]) - float(level[i, before, k])
                else:
                    rise = float(level[i, j, after]) - float(level[i, j, before])
                slope += (share if side == 1 else 1.0 - share) * rise / max(after - before, 1)
            normal[f, along] = -slope
        point[f, a] += share
        # Never 0 across the face, and never inwards.
        step = (1.0 - across_share) * (below - above)
        both = across_share * normal[f, a] + step
        normal[f, a] = both if both * step > step * step else step
        length = np.sqrt(normal[f, 0] ** 2 + normal[f, 1] ** 2 + normal[f, 2] ** 2)
        for along in range(3):
            normal[f, along] /= length
    return point, normal


@kernel
def _roughness(point, normal, corners, first, around, least):
    """How far the points around each face are off its plane (root mean square), [voxels]; see `_evened_points`."""
    roughness = np.empty(len(corners))
    for f in range(len(corners)):
        total, count = 0.0, 0
        for c in range(4):
            v = corners[f, c]
            for row in range(first[v], first[v + 1]):
                g = around[row]
                if g == f:
                    continue
                alike, ahead = 0.0, 0.0
                for k in range(3):
                    alike += normal[f, k] * normal[g, k]
                    ahead += 0.5 * (normal[f, k] + normal[g, k]) * (point[g, k] - point[f, k])
                if alike > least:
                    total += ahead * ahead
                    count += 1
        roughness[f] = np.sqrt(total / count) if count else 1.0
    return roughness


@kernel
def _mean(values, corners, first, around):
    """Mean of each face's value and those around it."""
    mean = np.empty(len(corners))
    for f in range(len(corners)):
        total, count = values[f], 1
        for c in range(4):
            v = corners[f, c]
            for row in range(first[v], first[v + 1]):
                if around[row] != f:
                    total += values[around[row]]
                    count += 1
        mean[f] = total / count
    return mean


@kernel(error_model="python")
def _least(values, corners, first, around):
    """Least of each face's value and those around it."""
    least = values.copy()
    for f in range(len(corners)):
        for c in range(4):
            v = corners[f, c]
            for row in range(first[v], first[v + 1]):
                least[f] = min(least[f], values[around[row]])
    return least


@kernel
def _evened_normals(normal, share, corners, first, around, least):
    """Average each normal with those of the faces around it, the more the smaller the angle between them.

    A face that shares an edge comes twice, once for each end. `share` is how much of this is done.
    """
    result = np.empty_like(normal)
    for f in range(len(corners)):
        a0, a1, a2 = normal[f]
        t0, t1, t2 = a0, a1, a2
        if share[f] == 0.0:
            result[f] = normal[f]
            continue
        for c in range(4):
            v = corners[f, c]
            for row in range(first[v], first[v + 1]):
                g = around[row]
                if g == f:
                    continue
                b0, b1, b2 = normal[g]
                over = a0 * b0 + a1 * b1 + a2 * b2 - least
                if over > 0.0:
                    weight = share[f] * (over / (1.0 - least)) ** 2
                    t0, t1, t2 = t0 + weight * b0, t1 + weight * b1, t2 + weight * b2
        length = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
        # A term takes at most 0.0024 off the component along the normal itself, which starts at 1.
        result[f, 0], result[f, 1], result[f, 2] = t0 / length, t1 / length, t2 / length
    return result


@kernel
def _evened_points(point, normal, share, corners, first, around, least):
    """Move each plane along its normal to where its neighbours are.

    A neighbour's distance is measured along the mean of both normals: two planes tangent to one circle are then at
    distance 0, so that curved surfaces do not shrink.
    """
    result = np.empty_like(point)
    for f in range(len(corners)):
        a0, a1, a2 = normal[f]
        p0, p1, p2 = point[f]
        total, weights = 0.0, 1.0
        for c in range(4):
            v = corners[f, c]
            for row in range(first[v], first[v + 1]):
                g = around[row]
                if g == f:
                    continue
                b0, b1, b2 = normal[g]
                over = a0 * b0 + a1 * b1 + a2 * b2 - least
                if over > 0.0:
                    weight = share[f] * (over / (1.0 - least)) ** 2
                    q0, q1, q2 = point[g]
                    total += weight * 0.5 * ((a0 + b0) * (q0 - p0) + (a1 + b1) * (q1 - p1) + (a2 + b2) * (q2 - p2))
                    weights += weight
        step = total / weights
        result[f, 0], result[f, 1], result[f, 2] = p0 + step * a0, p1 + step * a1, p2 + step * a2
    return result


@kernel
def _spread_deg(normal, corners, first, around):
    """Root mean square angle between the normals around each face, its own included, and their mean, [degrees]."""
    spread = np.empty(len(corners))
    for f in range(len(corners)):
        t0, t1, t2 = normal[f]
        count = 1
        for c in range(4):
            v = corners[f, c]
            for row in range(first[v], first[v + 1]):
                g = around[row]
                if g != f:
                    t0, t1, t2 = t0 + normal[g, 0], t1 + normal[g, 1], t2 + normal[g, 2]
                    count += 1
        length = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2) / count
        # The mean of unit vectors is shorter than 1 by half the mean square of small angles.
        spread[f] = np.degrees(np.sqrt(2.0 * max(1.0 - length, 0.0)))
    return spread


@kernel(error_model="python")
def _with_neighbours(marked, corners, first, around):
    """Faces that are marked or share a vertex with one that is."""
    result = marked.copy()
    for f in range(len(corners)):
        if marked[f]:
            for c in range(4):
                v = corners[f, c]
                for row in range(first[v], first[v + 1]):
                    result[around[row]] = True
    return result


@kernel
def _carried_on(waiting, point, normal, own, settled, corners, first, around, least, same, farthest):
    """Give waiting faces the plane of settled ones beside them, if it fits where they are."""
    new_point, new_normal, new_settled = point.copy(), normal.copy(), settled.copy()
    for f in waiting:
        p0, p1, p2 = point[f]
        # First which neighbour's plane is most like the face, then the mean of that and of those like it.
        best, chosen = least, -1
        t0, t1, t2, gap, count = 0.0, 0.0, 0.0, 0.0, 0
        for sweep in range(2):
            if sweep == 1 and chosen < 0:
                break
            for c in range(4):
                v = corners[f, c]
                for row in range(first[v], first[v + 1]):
                    g = around[row]
                    if not settled[g]:
                        continue
                    b0, b1, b2 = normal[g]
                    alike = own[f, 0] * b0 + own[f, 1] * b1 + own[f, 2] * b2
                    if alike <= least:
                        continue
                    ahead = b0 * (point[g, 0] - p0) + b1 * (point[g, 1] - p1) + b2 * (point[g, 2] - p2)
                    if abs(ahead) >= farthest:
                        continue
                    if sweep == 0:
                        if alike > best:
                            best, chosen = alike, g
                    elif b0 * normal[chosen, 0] + b1 * normal[chosen, 1] + b2 * normal[chosen, 2] > same:
                        t0, t1, t2, gap, count = t0 + b0, t1 + b1, t2 + b2, gap + ahead, count + 1
        if chosen >= 0:
            length = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
            t0, t1, t2, gap = t0 / length, t1 / length, t2 / length, gap / count
            new_normal[f, 0], new_normal[f, 1], new_normal[f, 2] = t0, t1, t2
            new_point[f, 0], new_point[f, 1], new_point[f, 2] = p0 + gap * t0, p1 + gap * t1, p2 + gap * t2
            new_settled[f] = True
    return new_point, new_normal, new_settled


@kernel
def _meeting_points(point, normal, index, first, around, size, stiffness, farthest):
    """Vertices nearest to the planes of the faces around them, from the mean of these faces' points."""
    vertices = np.empty((len(index), 3))
    m = np.empty((3, 3))
    b, start = np.empty(3), np.empty(3)
    for v in range(len(index)):
        count = first[v + 1] - first[v]
        for i in range(3):
            start[i] = float(index[v, i])
        if count:
            for i in range(3):
                start[i] = 0.0
                for row in range(first[v], first[v + 1]):
                    start[i] += point[around[row], i] / count
        for i in range(3):
            if index[v, i] == 0 or index[v, i] == size[i]:
                start[i] = float(index[v, i])
            b[i] = 0.0
            for j in range(3):
                m[i, j] = 0.0
        for row in range(first[v], first[v + 1]):
            f = around[row]
            ahead = 0.0
            for i in range(3):
                ahead += normal[f, i] * (point[f, i] - start[i])
            for i in range(3):
                b[i] += normal[f, i] * ahead / count
                for j in range(3):
                    m[i, j] += normal[f, i] * normal[f, j] / count
        for i in range(3):
            if index[v, i] == 0 or index[v, i] == size[i]:
                b[i] = 0.0
                for j in range(3):
                    m[i, j] = m[j, i] = 0.0
            m[i, i] += stiffness
        # The matrix is symmetric and at least the stiffness.
        c0 = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
        c1 = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
        c2 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
        determinant = m[0, 0] * c0 + m[0, 1] * c1 + m[0, 2] * c2
        d0 = (c0 * b[0] + c1 * b[1] + c2 * b[2]) / determinant
        d1 = (
            c1 * b[0] + (m[0, 0] * m[2, 2] - m[0, 2] ** 2) * b[1] + (m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]) * b[2]
        ) / determinant
        d2 = (
            c2 * b[0] + (m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]) * b[1] + (m[0, 0] * m[1, 1] - m[0, 1] ** 2) * b[2]
        ) / determinant
        shorter = min(1.0, farthest / max(np.sqrt(d0 * d0 + d1 * d1 + d2 * d2), 1e-12))
        for i in range(3):
            moved = start[i] + shorter * (d0 if i == 0 else d1 if i == 1 else d2)
            vertices[v, i] = min(max(moved, index[v, i] - farthest), index[v, i] + farthest)
    return vertices
