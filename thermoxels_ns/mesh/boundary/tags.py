"""Tags of boundary triangles: true normal and area, whether cameras see them, and their patch."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.boundary.facet_normals import true_surface
from thermoxels_ns.mesh.boundary.patch_rules import PatchRules
from thermoxels_ns.mesh.boundary.patches import apply_patches
from thermoxels_ns.mesh.boundary.visibility import seen_facets
from thermoxels_ns.mesh.quality.checks import facet_normals
from thermoxels_ns.mesh.solid.voxels import SolidCells
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, Boundary, TetMesh

BoundaryMode = Literal["conforming", "voxel"]
"""How the boundary of a mesh runs: along the level set of the density, or along voxel faces."""


def tag_boundary(
    mesh: TetMesh,
    points_index: npt.NDArray[np.float64],
    solid: SolidCells,
    lattice: Lattice,
    views: Views | None,
    world_to_metres: npt.NDArray[np.float64],
    mode: BoundaryMode,
    up: tuple[float, float, float],
    rules: PatchRules,
) -> tuple[Boundary, tuple[str, ...]]:
    """Find out what physics needs to know of every boundary triangle.

    Args:
        mesh: The mesh, whose `boundary` is not read.
        points_index: Its nodes as fractional corner indices, shape (n, 3).
        solid: The solid it was made from.
        lattice: Where the voxels are.
        views: The training cameras. None: nothing is known to be hidden, every triangle counts as seen.
        world_to_metres: Similarity from the lattice's world to the mesh, shape (4, 4).
        mode: How the boundary runs.
        up: Up direction in the coordinates of the mesh.
        rules: Patches of the user.

    Returns:
        Normals, area factors, visibility and patches; and the rules that no triangle follows.

    Raises:
        MeshError: A rule cannot be applied, or `up` is no direction.
    """
    linear = world_to_metres[:3, :3] / np.cbrt(abs(np.linalg.det(world_to_metres[:3, :3])))
    on_box = mesh.facet_tags == FACET_BOX
    if mode == "voxel":
        in_world, factor = true_surface(solid.level, points_index, mesh.facets)
        normal = in_world @ linear.T
    else:
        normal = facet_normals(mesh.points_m, mesh.facets)
        in_world = normal @ linear
        factor = np.ones(len(mesh.facets))
    centroids = points_index[mesh.facets].mean(axis=1)
    if views is None:
        seen = np.ones(len(mesh.facets), dtype=bool)
    else:
        seen = seen_facets(solid.cells, views, lattice, lattice.index_to_world(centroids), in_world)
    patch, names, idle = apply_patches(
        rules,
        centroids_m=mesh.points_m[mesh.facets].mean(axis=1),
        normals=normal,
        up=up,
        seen=seen,
        on_box=on_box,
        colours=None if mesh.colour is None else mesh.colour[mesh.facets].mean(axis=1),
    )
    return Boundary(normal=normal, area_factor=factor, seen=seen, patch=patch, patch_names=names), idle
