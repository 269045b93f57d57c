from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from tests.support.stuffed_shapes import SHAPES, centres
from thermoxels_ns.mesh.quality.checks import boundary_facets, facet_areas, facet_normals
from thermoxels_ns.mesh.quality.report import check_mesh
from thermoxels_ns.mesh.solid.level_set import level_of
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, FACET_SURFACE
from thermoxels_ns.mesh.voxel_tets import (
    LEAST_AREA_FACTOR,
    boundary_tags,
    kuhn_tets,
    voxel_facets,
    voxel_surface,
)


def exposed_faces(cells: np.ndarray) -> int:
    """Number of voxel faces between solid and empty, by plain loops."""
    padded = np.pad(cells, 1)
    return sum(
        not padded[tuple(np.add(cell, step))]
        for cell in np.argwhere(padded)
        for step in ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1])
    )


def voxels(*others: tuple[int, int, int]) -> np.ndarray:
    """The middle one of 3 x 3 x 3 voxels, and others."""
    cells = np.zeros((3, 3, 3), dtype=bool)
    cells[tuple(zip((1, 1, 1), *others))] = True
    return cells


PATTERNS = {
    "single": voxels(),
    "sharing a face": voxels((1, 2, 1)),
    "sharing an edge": voxels((2, 2, 1)),
    "sharing a corner": voxels((2, 2, 2)),
    "checkerboard": np.indices((4, 3, 5)).sum(axis=0) % 2 == 0,
    "full": np.ones((3, 3, 3), dtype=bool),
    "hollow": ~voxels(),
}


@pytest.mark.parametrize("name", PATTERNS)
def test_volume_area_and_validity(mesh_of_cells, name):
    cells = PATTERNS[name]
    quality = check_mesh(mesh_of_cells(cells, voxel_size=0.5))
    assert quality.num_tets == 6 * cells.sum()
    assert quality.volume_m3 == pytest.approx(cells.sum() * 0.5**3, rel=1e-14)
    assert quality.num_facets == 2 * exposed_faces(cells)
    assert quality.area_m2 == pytest.approx(exposed_faces(cells) * 0.5**2, rel=1e-14)
    assert quality.criteria[0].figure == pytest.approx(0.5**3 / 6, rel=1e-14)
    assert (quality.dihedral_range_deg[0], quality.dihedral_range_deg[1]) == pytest.approx((45.0, 90.0))


def turned(facets: np.ndarray) -> list:
    """Triangles with their smallest node first, orientation kept, in one order."""
    rows = [tuple(np.roll(row, -int(np.argmin(row)))) for row in facets]
    assert len(set(rows)) == len(rows)
    return sorted(rows)


@pytest.mark.parametrize("name", PATTERNS)
def test_voxel_faces_give_the_boundary_of_the_tetrahedra(name):
    cells = PATTERNS[name]
    assert turned(voxel_facets(cells)) == turned(boundary_facets(kuhn_tets(cells)[1]))


def test_box_facets_are_those_on_the_lattice_border(mesh_of_cells):
    cells = np.zeros((3, 3, 3), dtype=bool)
    cells[1:, 1, 1] = True  # touches the box at x = 3 with one voxel face
    mesh = mesh_of_cells(cells, voxel_size=1.0)
    box = mesh.facet_tags == FACET_BOX
    assert np.all(mesh.points_m[mesh.facets[box]][:, :, 0] == 3.0)
    assert facet_areas(mesh.points_m, mesh.facets[box]).sum() == pytest.approx(1.0)
    assert np.count_nonzero(mesh.facet_tags == FACET_SURFACE) == len(mesh.facets) - 2


CELLS = 80
MIDDLE = 0.5 * CELLS * (1.0 + np.array([0.0137, -0.0071, 0.0043]))
"""Middle of the shapes, [voxels]: between voxels, as at 45 degrees a whole layer of a slab depends on it."""
DENSITIES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "ramp": lambda distance: np.exp(np.clip(-distance, -8.0, 8.0)),
    "jump": lambda distance: np.where(distance < 0.0, 10.0, 0.01),
}


@cache
def exported(name: str, kind: str) -> np.ndarray:
    """The level that an export makes of an exact field."""
    points = (centres(CELLS, CELLS, CELLS) + 0.5 * CELLS - MIDDLE) * 2.0 / CELLS
    density = DENSITIES[kind](SHAPES[name].distance(points) * CELLS / 2.0)
    return level_of(density, 1.0, density >= 1.0, density >= 1.0, makes_up_volume=False)


def surface(level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corner indices of the nodes and boundary triangles of the voxel mesh of a level function."""
    return kuhn_tets(level > 0.0)[0], voxel_facets(level > 0.0)


@pytest.mark.parametrize(("kind", "bound"), [("ramp", 0.03), ("jump", 0.04)])
@pytest.mark.parametrize("name", SHAPES)
def test_area_is_within_three_or_four_percent(name: str, kind: str, bound: float) -> None:
    points, facets = surface(exported(name, kind))
    exact = SHAPES[name].area * (0.5 * CELLS) ** 2
    own = facet_areas(points.astype(float), facets)
    if name != "slab at 0 degrees":
        assert own.sum() > 1.15 * exact  # what there is to correct
    assert own @ voxel_surface(exported(name, kind), points, facets)[1] == pytest.approx(exact, rel=bound)


@pytest.mark.parametrize("seed", range(3))
def test_a_plane_has_its_normal_and_its_area(seed: int) -> None:
    """The factor is the cosine between the face and the plane, up to where the plane leaves the lattice."""
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    level = -0.02 * (centres(24, 24, 24) @ normal - random.uniform(-2.0, 2.0))
    points, facets = surface(level)
    steps = boundary_tags(facets, points, (25, 25, 25)) != FACET_BOX
    normals, factors = voxel_surface(level, points, facets)
    assert np.count_nonzero(steps) > 300
    assert normals[steps] == pytest.approx(np.broadcast_to(normal, normals[steps].shape), abs=1e-9)
    own = np.abs(facet_normals(points.astype(float), facets)[steps] @ normal)
    assert factors[steps] == pytest.approx(np.maximum(own, LEAST_AREA_FACTOR), abs=1e-9)
