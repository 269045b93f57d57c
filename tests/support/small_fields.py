"""Small trained fields and meshes, made by hand."""

from collections.abc import Callable
from dataclasses import replace
from itertools import permutations

import numpy as np
import numpy.typing as npt
import pytest
import torch

from tests.support.heat_bodies import mesh_from
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.field.kept_voxels import KeptVoxels
from thermoxels_ns.mesh.build import build_mesh
from thermoxels_ns.mesh.quality.checks import boundary_facets
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh, facet_normals
from thermoxels_ns.mesh.voxel_tets import boundary_tags, kuhn_tets


def kept_mask(voxels: KeptVoxels) -> torch.Tensor:
    """True for kept voxels, in the shape of the lattice's cells."""
    kept = torch.zeros(voxels.lattice.cell_shape, dtype=torch.bool)
    kept.view(-1)[torch.from_numpy(voxels.cells)] = True
    return kept


@pytest.fixture
def snapshot_of() -> Callable[..., GridSnapshot]:
    """Make a snapshot from corner densities; temperature 20 and weight 1 everywhere unless given."""

    def make(density: npt.ArrayLike, temperature_c=20.0, observed_weight=1.0, lo=(0.0, 0.0, 0.0), voxel_size=0.5):
        density = np.asarray(density, dtype=np.float32)
        return GridSnapshot(
            Lattice(lo, voxel_size, density.shape),  # type: ignore[arg-type]
            density,
            np.broadcast_to(np.asarray(temperature_c, dtype=np.float32), density.shape),
            np.broadcast_to(np.asarray(observed_weight, dtype=np.float32), density.shape),
        )

    return make


@pytest.fixture
def box_mesh(snapshot_of) -> TetMesh:
    """A full box of 3 x 4 x 2 voxels of 0.5 m, untagged, temperature 20 + 3 x + y - 2 z, its inner nodes unseen."""
    shape = (4, 5, 3)
    x, y, z = np.meshgrid(*map(np.arange, shape), indexing="ij")
    weight = np.ones(shape)
    weight[1:-1, 1:-1, 1:-1] = 0.0
    snapshot = snapshot_of(np.ones(shape), 20.0 + 0.5 * (3 * x + y - 2 * z), weight)
    selection = SolidSelection(close_gaps=0, density_threshold=0.5)
    return replace(build_mesh(snapshot, selection, np.eye(4), "voxel").mesh, boundary=None)


@pytest.fixture
def mesh_of_cells() -> Callable[[npt.NDArray[np.bool_]], TetMesh]:
    """Mesh given voxels of edge 0.5 m as they are, at 20 degrees."""

    def make(cells: npt.NDArray[np.bool_], voxel_size: float = 0.5) -> TetMesh:
        corners, tets = kuhn_tets(cells)
        mesh = mesh_from(corners * voxel_size, tets)
        assert np.all(signed_volumes(mesh.points_m, tets) > 0)
        return replace(mesh, facet_tags=boundary_tags(mesh.facets, corners, tuple(n + 1 for n in cells.shape)))

    return make


@pytest.fixture(scope="session")
def tagged_mesh() -> TetMesh:
    """A small house: walls one voxel thick with a window and a door on a floor two voxels thick, nodes shaken by 12 %.

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
