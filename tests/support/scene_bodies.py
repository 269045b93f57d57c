from dataclasses import replace

import numpy as np

from tests.support.heat_bodies import make_body
from thermoxels_ns.mesh.boundary.patches import PatchRules, with_patches
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh, facet_normals

Z_UP = (0.0, 0.0, 1.0)


def tagged_body(cells: np.ndarray, voxel_m: float, outside: np.ndarray, cut_below_x: float = 0.0) -> TetMesh:
    """A body of voxels at 15 C with the default patches and the regions solid and slab (empty).

    Args:
        cells: Which voxels are solid.
        voxel_m: Their size.
        outside: True for voxels beyond which photographs look, on a lattice two larger that starts one voxel earlier.
        cut_below_x: Facets whose middle has an x below it, in voxels, are cut by the box around the scene.
    """
    mesh = make_body(cells, voxel_m, 15.0)
    corners = np.rint(mesh.points_m / voxel_m)
    normals, middle = facet_normals(corners, mesh.facets), corners[mesh.facets].mean(axis=1)
    beyond = np.floor(middle + 0.5 * normals).astype(int) + 1
    cut = np.where(middle[:, 0] < cut_below_x, FACET_BOX, mesh.facet_tags)
    tagged, _ = with_patches(replace(mesh, facet_tags=cut), PatchRules(), Z_UP, outside[tuple(beyond.T)])
    return replace(tagged, region_names=("solid", "slab"), facet_tags=mesh.facet_tags)


def room(from_within: bool = False) -> TetMesh:
    """A closed room of 4 m with walls, floor and ceiling of 1 m; its side at x = 0 is cut by the box.

    Or all of it, photographed from within.
    """
    cells = np.ones((4, 4, 4), dtype=bool)
    cells[1:3, 1:3, 1:3] = False
    outside = np.full((6, 6, 6), not from_within)
    outside[2:4, 2:4, 2:4] = from_within
    return tagged_body(cells, 1.0, outside, cut_below_x=0.0 if from_within else 1e-6)


def wall() -> TetMesh:
    """A wall of 0.2 m that fills the box: outside at its larger y, the room at y = 0, the rest is cut."""
    cells = np.ones((1, 4, 1), dtype=bool)
    outside = np.zeros((3, 6, 3), dtype=bool)
    outside[:, 5] = True
    mesh = tagged_body(cells, 0.05, outside)
    across = np.abs(facet_normals(mesh.points_m, mesh.facets)[:, 1]) < 0.5
    patch = np.where(across, mesh.boundary.patch_names.index("cut"), mesh.boundary.patch)
    return replace(mesh, boundary=replace(mesh.boundary, patch=patch))
