from collections.abc import Callable

import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh.build import BuiltMesh, build_mesh
from thermoxels_ns.mesh.quality.checks import check_mesh
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.mesh.tetrahedra import facet_areas

MODES = ["conforming", "voxel"]
AS_IT_IS = SolidSelection(density_threshold=0.5, close_gaps=0, region="all", interior="hollow")


def trained(cells: np.ndarray) -> GridSnapshot:
    """A field as training leaves one: opaque voxels, temperature 20 to 21, some corners unseen, cameras around."""
    cells = np.asarray(cells, dtype=bool)
    lattice = Lattice((-1.0, -1.0, -1.0), 2.0 / max(cells.shape), tuple(n + 1 for n in cells.shape))  # type: ignore[arg-type]
    solid = np.pad(cells, 1)
    touched = np.zeros(lattice.shape, dtype=bool)
    nx, ny, nz = lattice.shape
    for dx, dy, dz in np.ndindex(2, 2, 2):
        touched |= solid[dx : dx + nx, dy : dy + ny, dz : dz + nz]
    random = np.random.default_rng(0)
    weight = np.where(touched & (random.random(lattice.shape) < 0.8), 3.0, 0.1).astype(np.float32)
    weight[tuple(np.argwhere(touched)[:1].T)] = 3.0
    temperature = (20.0 + random.random(lattice.shape)).astype(np.float32)
    temperature[weight < 0.5] = 500.0  # what nobody measured may be anything
    density = np.where(cells, 40.0, 0.0).astype(np.float32)
    return GridSnapshot(
        lattice,
        np.where(touched, 40.0, 0.0).astype(np.float32),
        temperature,
        weight,
        density,
        colour=random.random((*lattice.shape, 3)).astype(np.float32),
        views=looking_at(
            (0.0, 0.0, 0.0), [[4.0, 0.5, 1.0], [-4.0, 0.3, 0.7], [0.2, 4.0, 0.4], [0.1, -4.0, 0.6], [0.3, 0.2, 4.0]]
        ),
    )


def thin_wall(degrees: float) -> np.ndarray:
    """Voxels whose centre is within half a voxel of a plane through the middle, turned about z."""
    x, y, _ = np.indices((16, 16, 10)) + 0.5
    angle = np.radians(degrees)
    across = (x - 8.0) * np.cos(angle) + (y - 8.0) * np.sin(angle)
    return np.abs(across - 0.25) <= 0.5 * max(1.0, np.abs(np.cos(angle)) + np.abs(np.sin(angle)))


def boxes(*corners: tuple[int, int, int], size: int = 3) -> np.ndarray:
    cells = np.zeros((10, 10, 10), dtype=bool)
    for i, j, k in corners:
        cells[i : i + size, j : j + size, k : k + size] = True
    return cells


HARD: dict[str, Callable[[], np.ndarray]] = {
    "wall one voxel thick": lambda: thin_wall(0.0),
    "wall at 30 degrees": lambda: thin_wall(30.0),
    "two touch at an edge": lambda: boxes((2, 2, 2), (5, 5, 2)),
    "two touch at a corner": lambda: boxes((2, 2, 2), (5, 5, 5)),
    "touches the border": lambda: boxes((0, 3, 7)),
    "single voxel": lambda: boxes((4, 4, 4), size=1),
    "checkerboard": lambda: np.indices((7, 6, 8)).sum(axis=0) % 2 == 0,
    "noise": lambda: np.random.default_rng(3).random((9, 10, 8)) < 0.4,
    "full": lambda: np.ones((6, 5, 7), dtype=bool),
    "a lattice of one voxel": lambda: np.ones((1, 1, 1), dtype=bool),
}


def assert_sound(built: BuiltMesh, mode: str) -> None:
    mesh, boundary = built.mesh, built.mesh.boundary
    quality = check_mesh(mesh)  # volumes above 0, conforming, closed
    low, high = (10.7, 164.8) if mode == "conforming" else (45.0 - 1e-6, 90.0 + 1e-6)
    assert low <= quality.dihedral_range_deg[0] and quality.dihedral_range_deg[1] <= high
    assert mesh.observed.any()
    assert mesh.temperature_c.min() >= 20.0 - 1e-6 and mesh.temperature_c.max() <= 21.0 + 1e-6
    assert facet_areas(mesh.points_m, mesh.facets).min() > 0.0
    assert boundary.patch.min() >= 0 and boundary.patch.max() < len(boundary.patch_names)
    assert mesh.colour.min() >= 0.0 and mesh.colour.max() <= 1.0


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", HARD)
def test_hard_bodies_become_sound_meshes(name: str, mode) -> None:
    cells = HARD[name]()
    assert_sound(build_mesh(trained(cells), SolidSelection(), np.eye(4), mode), mode)
    built = build_mesh(trained(cells), AS_IT_IS, np.diag([2.0, 2.0, 2.0, 1.0]), mode)
    assert_sound(built, mode)
    assert np.array_equal(built.solid.cells, cells) or built.unobserved_parts > 0
    if mode == "voxel":
        voxel_m = 2.0 * 2.0 / max(cells.shape)
        assert check_mesh(built.mesh).volume_m3 == pytest.approx(built.solid.cells.sum() * voxel_m**3)


def test_a_small_body_in_256_cubed_voxels() -> None:
    cells = np.zeros((256, 256, 256), dtype=bool)
    cells[100:130, 100:130, 180:184] = True
    built = build_mesh(trained(cells), AS_IT_IS, np.eye(4))
    assert_sound(built, "conforming")
    assert built.solid.cells.sum() == 30 * 30 * 4
