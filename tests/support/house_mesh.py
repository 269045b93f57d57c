"""A tagged mesh like a small house, for the tests of files and of the programs that read them."""

from itertools import permutations

import numpy as np

from thermoxels_ns.mesh.quality.checks import boundary_facets
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh, facet_normals
from thermoxels_ns.mesh.voxel_tets import boundary_tags, kuhn_tets


def house_mesh() -> TetMesh:
    """Walls one voxel thick with a window and a door on a floor two voxels thick; the nodes are shaken by 12 %.

    Three regions and five patches, the last of each empty; names with a space and with a letter that is not ASCII.
    """
    cells = np.zeros((9, 7, 7), dtype=bool)
    cells[:, :, :2] = True
    cells[[0, -1], :, :] = True
    cells[:, [0, -1], :] = True
    cells[3:6, 0, 3:5] = False
    cells[0, 2:4, 2:5] = False
    corners, tets = kuhn_tets(cells)
    random = np.random.default_rng(4)
    # Only two of the four faces of these tetrahedra are ever on a boundary: let each start at another node.
    even = np.array([p for p in permutations(range(4)) if np.linalg.det(np.eye(4)[list(p)]) > 0])
    tets = np.take_along_axis(tets, even[random.integers(0, len(even), len(tets))], axis=1)
    facets = boundary_facets(tets)
    points = (corners + random.uniform(-0.12, 0.12, corners.shape)) * 0.15 + [10.0, -3.0, 0.5]
    assert signed_volumes(points, tets).min() > 0

    normals = facet_normals(points, facets)
    middle = corners[facets].mean(axis=1)
    inside = np.all((middle > 0.9) & (middle < [8.1, 6.1, 7.1]), axis=1)
    patch = np.select([normals[:, 2] > 0.8, normals[:, 2] < -0.8, inside], [0, 1, 2], default=3)
    x, y, z = points.T
    temperature = 18.0 + 6.0 * np.sin(3.0 * x) * np.cos(4.0 * y) + 4.0 * z + random.uniform(-0.5, 0.5, len(points))
    return TetMesh(
        points_m=points,
        tets=tets,
        temperature_c=temperature,
        observed=random.random(len(points)) < 0.7,
        facets=facets,
        facet_tags=boundary_tags(facets, corners, (10, 8, 8)),
        region=(corners[tets].mean(axis=1)[:, 2] < 2.0).astype(np.int64),
        region_names=("walls", "floor slab", "roof"),
        boundary=Boundary(
            seen=middle[:, 1] < 3.0,
            patch=patch.astype(np.int64),
            patch_names=("up", "down", "inside", "façade 1", "cut by the box"),
        ),
        colour=random.random((len(points), 3)).astype(np.float32),
    )
