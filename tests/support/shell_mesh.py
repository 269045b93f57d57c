"""A whole spherical shell whose nodes lie on the spheres, as a cubed sphere cut into tetrahedra."""

from dataclasses import replace

import numpy as np

from tests.support.heat_meshes import mesh_from
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh
from thermoxels_ns.mesh.voxel_tets import kuhn_tets


def shell_mesh(inner_m: float, outer_m: float, parts: int, layers: int, *, eighth: bool = False) -> TetMesh:
    """Cut the shell into cells and each cell into six tetrahedra.

    Each of the six sides of the cube is made of four mirrored quarters, so that the diagonals of all of them meet.

    Args:
        inner_m: Radius of the inner sphere, [m].
        outer_m: Of the outer one.
        parts: Cells along half an edge of the cube.
        layers: Cells from sphere to sphere.
        eighth: Only what lies between the positive axes; nothing flows through its cuts.

    Returns:
        A mesh with the patches "inside" and "outside" (and "cut" of an eighth).
    """
    corners, tets = kuhn_tets(np.ones((parts, parts, layers), bool))
    u, v, w = (corners / [parts, parts, layers]).T
    ray = np.stack([np.tan(0.25 * np.pi * u), np.tan(0.25 * np.pi * v), np.ones_like(u)], axis=1)
    quarter = ray * ((inner_m + (outer_m - inner_m) * w) / np.linalg.norm(ray, axis=1))[:, None]
    points, blocks = [], []
    for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for signs in np.ndindex(*((1, 1, 1) if eighth else (2, 2, 2))):
            mirrored = quarter[:, axes] * (1.0 - 2.0 * np.array(signs))
            blocks.append((tets if sum(signs) % 2 == 0 else tets[:, [1, 0, 2, 3]]) + len(points) * len(quarter))
            points.append(mirrored)
    every = np.concatenate(points)
    _, first, number = np.unique(np.round(every / outer_m, 9) + 0.0, axis=0, return_index=True, return_inverse=True)
    nodes, tets = every[first], number.ravel()[np.concatenate(blocks)]
    mesh = mesh_from(nodes, tets)
    corner, facets = nodes[mesh.facets], mesh.facets
    radius = np.linalg.norm(corner, axis=2)
    patch = np.full(len(facets), 2)
    patch[np.all(np.abs(radius - inner_m) < 1e-9 * outer_m, axis=1)] = 0
    patch[np.all(np.abs(radius - outer_m) < 1e-9 * outer_m, axis=1)] = 1
    seen, names = np.ones(len(facets), bool), ("inside", "outside", "cut")
    return replace(mesh, boundary=Boundary(seen, patch, names))
