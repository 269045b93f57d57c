"""The true normal of a surface made of voxel faces, and the share of each face's area that is true area.

A staircase of voxel faces has |nx| + |ny| + |nz| times the area of the plane it stands for, at any voxel size. Its
faces point along the axes; where the surface points is in the level function that the voxels were cut from.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from thermoxels_ns.checks import check_finite
from thermoxels_ns.errors import MeshError, explain
from thermoxels_ns.mesh.quality import facet_normals

LEAST_AREA_FACTOR = 0.05
"""Lower bound of a facet's area factor: no facet that convection or radiation acts on is without area."""

_LEVEL_CLIP = 0.125
"""Levels are clipped to this first: what they say beyond the voxels at the surface rounds the edges of a box, by 1.5 %
of its area at 48 voxels across and levels that reach 1 half a voxel inside."""
_NEIGHBOUR_RADIUS = 2.3
"""Voxel faces whose centres are this close are averaged, [voxels]; about twenty of a smooth surface."""
_NEIGHBOUR_COSINES = (-0.3, 0.5, 0.8)
"""Smallest cosine between the normals of two faces that are averaged, pass by pass. Below 0, the first pass evens out
the steps of a wall of one voxel without subvoxel information; the later ones leave the edges of a box sharp."""
_REMEDY = "Pass the level function and the boundary of the same voxel mesh, in corner indices."


def facet_normals_from_level(
    level: npt.NDArray, points_index: npt.NDArray, facets: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64]:
    """Outward unit normal of the level set at each boundary triangle of a voxel mesh.

    First, minus the gradient of `level` on a compact stencil around each voxel face: across the face the difference of
    its two voxels, along it the mean of the central differences on both sides (one-sided at the lattice's border).
    Then the normals of faces nearby that point about the same way are averaged in three passes. Before that, a face's
    error leans to its own axis, which makes areas up to 39 % too large; after it, the steps of one staircase agree.
    Measured at 48 voxels across: areas of spheres, tori, cylinders and tilted boxes within 2 %, of walls of one voxel
    within 4 % (most of it is lost at edges, where a staircase rounds the shape); normals on the sphere within 3 degrees
    on average and 8 at most, also if `level` is no more than a sign.

    Where the scene box cuts the solid, the normal is the box's, exactly.

    Args:
        level: Positive in solid voxels and negative in empty ones, at voxel centres, shape (nx-1, ny-1, nz-1).
        points_index: Corner indices of the nodes, whole numbers, shape (n, 3).
        facets: Boundary triangles, each one half of a voxel face, shape (f, 3); their orientation does not matter.

    Returns:
        Normals along the lattice's axes, out of the solid, shape (f, 3). Both halves of a voxel face have the same.

    Raises:
        MeshError: A triangle is not half of a face between a solid voxel and an empty one or the outside.

    >>> facet_normals_from_level(np.ones((1, 1, 1)), np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1]]), np.array([[0, 1, 2]]))
    array([[1., 0., 0.]])
    """
    level = np.clip(check_finite("level", np.asarray(level), _REMEDY, MeshError), -_LEVEL_CLIP, _LEVEL_CLIP)
    below, axis, face_of_facet = _voxel_faces(np.asarray(points_index), np.asarray(facets), level.shape)
    above = below.copy()
    above[np.arange(len(axis)), axis] += 1
    across_below, across_above = _outside_is_none(level, below), _outside_is_none(level, above)
    if np.any((across_below > 0.0) == (across_above > 0.0)):
        raise MeshError(
            explain(
                "boundary facets",
                expected="voxel faces with level above 0 on one side only",
                got=f"{np.count_nonzero((across_below > 0.0) == (across_above > 0.0))} others",
                remedy=_REMEDY,
            )
        )

    faces = np.arange(len(axis))
    outside = np.any(below < 0, axis=1) | np.any(above >= np.array(level.shape), axis=1)
    normals = np.zeros((len(axis), 3))
    # Outside the box the level goes on with the other sign, so nothing is left of the gradient along the box.
    normals[faces, axis] = np.where(across_below > 0.0, 1.0, -1.0)
    surface = np.flatnonzero(~outside)
    gradient = _gradient_at_faces(level, below[surface], above[surface], axis[surface])
    normals[surface] = -gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    own = np.zeros((len(surface), 3))
    own[np.arange(len(surface)), axis[surface]] = np.where(across_below[surface] > 0.0, 1.0, -1.0)
    averaged = _average_with_neighbours(normals[surface], 0.5 * (below[surface] + above[surface]))
    # Where surfaces of different directions are nearer than a voxel to each other, the average may point inwards.
    inwards = np.einsum("ij,ij->i", averaged, own) <= 0.0
    averaged[inwards] = own[inwards]
    normals[surface] = averaged
    return normals[face_of_facet]


def area_factors(
    points: npt.NDArray, facets: npt.NDArray[np.int64], normals: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """True area that each boundary triangle stands for, over its own area: |e . n| of its own and the true normal.

    The faces of a staircase of area A_a along axis a cover a plane of area A = A_a / |n_a|, so with the true normal
    the sum of A_a |n_a| is A (n . n) = A. A common error of the normals by an angle d changes that sum by the factor
    cos(d), of second order; dividing by |nx| + |ny| + |nz| instead, which is exact too, leaves an error of first order
    and loses more at edges.

    Args:
        points: Nodes, shape (n, 3), in the axes of `normals`; any unit.
        facets: Boundary triangles, shape (f, 3).
        normals: True unit normals, shape (f, 3).

    Returns:
        Factors in [`LEAST_AREA_FACTOR`, 1], shape (f,); 1 where the triangle lies in the true surface.
    """
    own = facet_normals(np.asarray(points, dtype=np.float64), np.asarray(facets))
    cosine = np.abs(np.einsum("ij,ij->i", own, normals))
    return np.clip(cosine, LEAST_AREA_FACTOR, 1.0)


def _voxel_faces(
    points_index: npt.NDArray, facets: npt.NDArray, shape: tuple[int, ...]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The different voxel faces that triangles are halves of.

    Returns:
        The voxel below each face (index -1 along its axis if the face is the lower side of the lattice), the axis of
        each face, and the face of each triangle.
    """
    corners = points_index[facets]
    lowest = corners.min(axis=1, initial=np.iinfo(np.int64).max).astype(np.int64)
    span = corners.max(axis=1, initial=-1) - lowest
    axis = np.argmin(span, axis=1).astype(np.int64)
    halves = (np.sort(span, axis=1) == [0, 1, 1]).all(axis=1) & np.all(corners == np.rint(corners), axis=(1, 2))
    inside = np.all(lowest >= 0, axis=1) & np.all(lowest + span <= np.array(shape), axis=1)
    if not np.all(halves & inside):
        raise MeshError(
            explain(
                "boundary facets",
                expected=f"halves of the faces of {' x '.join(map(str, shape))} voxels",
                got=f"{np.count_nonzero(~(halves & inside))} other triangles of {len(facets)}",
                remedy=_REMEDY,
            )
        )
    counts = (3, *(n + 1 for n in shape))
    key, face_of_facet = np.unique(np.ravel_multi_index((axis, *lowest.T), counts), return_inverse=True)
    axis, *index = np.unravel_index(key, counts)
    below = np.stack(index, axis=1)
    below[np.arange(len(axis)), axis] -= 1
    return below, axis, face_of_facet


def _outside_is_none(level: npt.NDArray, voxels: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Level of voxels, -1 outside the lattice."""
    inside = np.all((voxels >= 0) & (voxels < np.array(level.shape)), axis=1)
    values = np.full(len(voxels), -1.0)
    values[inside] = level[tuple(voxels[inside].T)]
    return values


def _gradient_at_faces(
    level: npt.NDArray, below: npt.NDArray[np.int64], above: npt.NDArray[np.int64], axis: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64]:
    """Gradient of `level` at the middle of voxel faces, shape (faces, 3), [1 / voxel]; never zero across the face."""
    gradient = np.zeros((len(axis), 3))
    for along in range(3):
        for side in (below, above):
            lower, upper = side.copy(), side.copy()
            lower[:, along] = np.maximum(side[:, along] - 1, 0)
            upper[:, along] = np.minimum(side[:, along] + 1, level.shape[along] - 1)
            steps = np.maximum(upper[:, along] - lower[:, along], 1)
            rise = level[tuple(upper.T)].astype(np.float64) - level[tuple(lower.T)]
            gradient[:, along] += 0.5 * rise / steps
    gradient[np.arange(len(axis)), axis] = level[tuple(above.T)].astype(np.float64) - level[tuple(below.T)]
    return gradient


def _average_with_neighbours(
    normals: npt.NDArray[np.float64], centres: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Average each normal with those nearby, the more the smaller the angle between them; edges stay sharp."""
    if len(normals) == 0:
        return normals
    first, second = KDTree(centres).query_pairs(_NEIGHBOUR_RADIUS, output_type="ndarray").T
    for least in _NEIGHBOUR_COSINES:
        cosine = np.einsum("ij,ij->i", normals[first], normals[second])
        close = cosine > least
        a, b = first[close], second[close]
        weight = ((cosine[close] - least) / (1.0 - least)) ** 2
        total = normals.copy()
        for along in range(3):
            total[:, along] += np.bincount(a, weight * normals[b, along], len(normals))
            total[:, along] += np.bincount(b, weight * normals[a, along], len(normals))
        # A term takes at most 0.0024 off the component along the normal itself, which starts at 1, and at most 153
        # faces are this close: the sum is never zero.
        normals = total / np.linalg.norm(total, axis=1, keepdims=True)
    return normals
