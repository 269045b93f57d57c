"""Meshes for problems of heat flow: of any tetrahedra, and boxes cut along planes, with named sides and regions."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.mesh.quality.checks import boundary_facets
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh, facet_normals
from thermoxels_ns.mesh.voxel_tets import kuhn_tets

SIDES = ("x0", "x1", "y0", "y1", "z0", "z1")
"""Patches of a box: the lower and the upper end of each axis."""

Nodal = float | Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]]


def mesh_from(
    points: npt.NDArray[np.float64], tets: npt.NDArray[np.int64], temperature_c: Nodal = 20.0, **fields: Any
) -> TetMesh:
    """A mesh of any tetrahedra with the boundary that they have, seen everywhere and of one region unless told."""
    facets = boundary_facets(tets)
    nodal = temperature_c(points) if callable(temperature_c) else np.full(len(points), float(temperature_c))
    seen, tags, region = np.ones(len(points), bool), np.zeros(len(facets), np.int64), np.zeros(len(tets), np.int64)
    return replace(TetMesh(points, tets, nodal, seen, facets, tags, region), **fields)


def planes(*knots: float, step: float) -> npt.NDArray[np.float64]:
    """Coordinates from knot to knot, all knots included, in parts of at most one step.

    >>> planes(0.0, 1.0, 1.5, step=0.5).tolist()
    [0.0, 0.5, 1.0, 1.5]
    """
    parts = [
        np.linspace(low, high, max(int(np.ceil((high - low) / step - 1e-9)), 1), endpoint=False)
        for low, high in pairwise(knots)
    ]
    return np.concatenate([*parts, knots[-1:]])


def graded(*knots: float, finest: float, growth: float, coarsest: float) -> npt.NDArray[np.float64]:
    """Coordinates from knot to knot, fine beside each knot and coarser between them.

    >>> graded(0.0, 6.0, finest=1.0, growth=2.0, coarsest=9.0).tolist()
    [0.0, 1.0, 3.0, 5.0, 6.0]
    """
    parts = []
    for low, high in pairwise(knots):
        half = [finest]
        while 2.0 * sum(half) < (high - low) * (1.0 - 1e-9):
            half.append(min(half[-1] * growth, coarsest))
        # The last one made it too long: leave it out if what is left is not much too coarse.
        if len(half) > 1 and 2.0 * sum(half[:-1]) > 0.8 * (high - low):
            half.pop()
        steps = np.array([*half, *half[::-1]])
        parts.append(low + np.concatenate([[0.0], np.cumsum(steps)[:-1]]) * ((high - low) / steps.sum()))
    return np.concatenate([*parts, knots[-1:]])


def box_mesh(
    x: Sequence[float] | npt.NDArray[np.float64],
    y: Sequence[float] | npt.NDArray[np.float64],
    z: Sequence[float] | npt.NDArray[np.float64],
    *,
    temperature_c: Nodal = 20.0,
    regions: dict[str, Callable[[npt.NDArray[np.float64]], npt.NDArray[np.bool_]]] | None = None,
    patches: dict[str, Callable[[npt.NDArray[np.float64], npt.NDArray[np.float64]], npt.NDArray[np.bool_]]]
    | None = None,
    keep: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.bool_]] | None = None,
    keep_tets: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.bool_]] | None = None,
) -> TetMesh:
    """Cut a box along planes into cells and each cell into six tetrahedra.

    Args:
        x: Coordinates of the planes across the first axis, ascending.
        y: Of the second.
        z: Of the third.
        temperature_c: Temperature of the nodes, or a function of their positions.
        regions: Rules by centroid of a cell; the last that holds names the cell. None: one region, "solid".
        patches: Rules by centroid and normal of a boundary triangle; the last that holds names it. Without any it has
            the name of its side, or "other" inside the box.
        keep: Which cells to keep, by centroid; None: all.
        keep_tets: Which of their tetrahedra to keep, by centroid; None: all. With x >= y and the same planes across
            both axes, one side of the diagonal: tetrahedra do not cross it.
    """
    axes = [np.asarray(axis, dtype=np.float64) for axis in (x, y, z)]
    middles = [0.5 * (axis[1:] + axis[:-1]) for axis in axes]
    centre = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1)
    cells = np.ones(centre.shape[:3], bool) if keep is None else keep(centre)
    corners, tets = kuhn_tets(cells)
    points = np.stack([axis[corners[:, i]] for i, axis in enumerate(axes)], axis=1)
    names, number = ("solid",), np.zeros(centre.shape[:3], np.int64)
    if regions:
        names, number = tuple(regions), np.full(centre.shape[:3], -1)
        for index, rule in enumerate(regions.values()):
            number[rule(centre)] = index
        assert (number[cells] >= 0).all(), "cells without a region"
    region = np.repeat(number[cells], 6)
    if keep_tets is not None:
        kept = keep_tets(points[tets].mean(axis=1))
        used, numbers = np.unique(tets[kept], return_inverse=True)
        points, tets, region = points[used], numbers.reshape(-1, 4), region[kept]
    mesh = mesh_from(points, tets, temperature_c, region=region, region_names=names)
    return replace(mesh, boundary=_tags(points, mesh.facets, axes, patches or {}))


def _tags(points, facets, axes, patches) -> Boundary:
    normal, centroid = facet_normals(points, facets), points[facets].mean(axis=1)
    names = (*SIDES, "other", *(name for name in patches if name not in SIDES))
    patch = np.full(len(facets), names.index("other"))
    for side, (axis, end) in zip(SIDES, ((axis, end) for axis in range(3) for end in (0, -1))):
        patch[np.isclose(centroid[:, axis], axes[axis][end], rtol=0, atol=1e-12)] = names.index(side)
    for name, rule in patches.items():
        patch[rule(centroid, normal)] = names.index(name)
    return Boundary(np.ones(len(facets), bool), patch, names)
