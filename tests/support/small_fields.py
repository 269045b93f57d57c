"""Small trained fields and meshes, made by hand."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from tests.support.heat_meshes import mesh_from
from tests.support.house_mesh import house_mesh
from thermoxels_ns.core.lattice import CORNER_OFFSETS, Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh.build import build_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.mesh.voxel_tets import boundary_tags, kuhn_tets


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


def crossed_diagonals() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Two voxels side by side, and the same with the second mirrored: diagonals on the face that they share cross."""
    corners, tets = kuhn_tets(np.ones((2, 1, 1), dtype=bool))
    number = {tuple(c): n for n, c in enumerate(corners.tolist())}
    mirrored = np.array([[number[(x, 1 - y, z)] for x, y, z in corners[t].tolist()] for t in tets[6:]])
    return corners.astype(float), tets, np.vstack([tets[:6], mirrored[:, [0, 2, 1, 3]]])


@pytest.fixture
def mesh_of_cells() -> Callable[[npt.NDArray[np.bool_]], TetMesh]:
    """Mesh given voxels of edge 0.5 m as they are, at 20 degrees."""

    def make(cells: npt.NDArray[np.bool_], voxel_size: float = 0.5) -> TetMesh:
        corners, tets = kuhn_tets(cells)
        mesh = mesh_from(corners * voxel_size, tets)
        assert np.all(signed_volumes(mesh.points_m, tets) > 0)
        return replace(mesh, facet_tags=boundary_tags(mesh.facets, corners, tuple(n + 1 for n in cells.shape)))

    return make


@pytest.fixture
def random_cells() -> Callable[[int], npt.NDArray[np.bool_]]:
    """A random carved block of voxels, at least one of them solid; odd sizes along the axes."""

    def make(seed: int) -> npt.NDArray[np.bool_]:
        random = np.random.default_rng(seed)
        cells = random.random(tuple(random.integers(1, 7, size=3))) < random.uniform(0.15, 0.95)
        cells[tuple(random.integers(0, cells.shape))] = True
        return cells

    return make


@pytest.fixture
def corner_density() -> Callable[[npt.NDArray[np.bool_]], npt.NDArray[np.float32]]:
    """Corner density 1 on the corners of the given voxels, 0 elsewhere: those voxels have density 1 at the centre."""

    def make(cells: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
        nx, ny, nz = cells.shape
        density = np.zeros((nx + 1, ny + 1, nz + 1), dtype=np.float32)
        for dx, dy, dz in CORNER_OFFSETS:
            np.maximum(
                density[dx : dx + nx, dy : dy + ny, dz : dz + nz],
                cells,
                out=density[dx : dx + nx, dy : dy + ny, dz : dz + nz],
            )
        return density

    return make


@pytest.fixture(scope="session")
def tagged_mesh() -> TetMesh:
    """A small house with regions, patches and colours, some parts of them empty."""
    return house_mesh()
