"""Errors of meshes of known bodies: made of densities as the product does, and by the mesher alone of exact levels."""

from functools import cache

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import cg

from tests.support.stuffed_shapes import ANGLE_BOUNDS_DEG, SHAPES, centres, on_surface, stiffness
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh.build import build_mesh
from thermoxels_ns.mesh.quality.checks import check_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.mesh.stuffing.isosurface import stuff
from thermoxels_ns.mesh.tetrahedra import facet_areas, facet_normals

BODIES = ("sphere", "torus", "cylinder", "slab at 30 degrees", "slab at 45 degrees")
OFFSETS = ((0.11, -0.27, 0.38), (0.5, 0.0, -0.25), (-0.42, 0.33, 0.06))
"""Where the body's middle is, from the middle of the lattice, [voxels]."""
DEPTHS = {"exponential": (np.exp, 1.0), "blurred step": (lambda depth: 100.0 / (1.0 + np.exp(-2.0 * depth)), 50.0)}
"""Density as a function of the depth in voxels, and at the surface."""


@cache
def errors(name: str, cells: int, offset: tuple[float, float, float], kind: str = "exponential") -> tuple[float, ...]:
    """Relative errors of area and volume, and smallest and largest dihedral angle, [degrees]."""
    shape, size, voxels = SHAPES[name], 2.0 / cells, cells + 8
    function, threshold = DEPTHS[kind]

    def density(points: np.ndarray) -> np.ndarray:
        depth = -shape.distance((points - offset) * size) / size
        return function(np.clip(depth, -8.0, 8.0)).astype(np.float32)

    at_corners = density(centres(*(voxels + 1,) * 3))
    seen = np.ones(at_corners.shape, np.float32)
    lattice = Lattice((-0.5 * voxels * size,) * 3, size, at_corners.shape)  # type: ignore[arg-type]
    field = GridSnapshot(lattice, at_corners, 20.0 * seen, seen, density(centres(*(voxels,) * 3)))
    built = build_mesh(field, SolidSelection(density_threshold=threshold, close_gaps=0), np.eye(4))
    quality = check_mesh(built.mesh)
    angles = quality.dihedral_range_deg[0], quality.dihedral_range_deg[1]
    return quality.area_m2 / shape.area - 1.0, quality.volume_m3 / shape.volume - 1.0, *angles


@pytest.mark.parametrize("offset", OFFSETS)
@pytest.mark.parametrize("name", BODIES)
def test_area_and_volume_within_one_and_a_half_percent_at_48_voxels(name, offset):
    area, volume, low, high = errors(name, 48, offset)
    assert abs(area) < 0.015 and abs(volume) < 0.015, f"{name}: area {area:+.2%}, volume {volume:+.2%}"
    assert low >= ANGLE_BOUNDS_DEG[0] and high <= ANGLE_BOUNDS_DEG[1]


@pytest.mark.parametrize("kind", DEPTHS)
@pytest.mark.parametrize("name", BODIES)
def test_the_surface_is_less_than_a_tenth_of_a_voxel_off_at_any_resolution(name, kind):
    """So errors of volume are of first order, with a small factor: a level of density is not linear in the distance."""
    cells, shape = (24, 48, 96) if kind == "exponential" else (48, 96), SHAPES[name]
    shift = [errors(name, n, OFFSETS[0], kind)[1] * shape.volume / shape.area / (2.0 / n) for n in cells]
    assert np.abs(shift).max() < 0.1, f"{name}, {kind}: {shift} voxels"


@pytest.mark.parametrize("name", BODIES)
def test_area_goes_on_falling(name):
    """What is left at edges changes its sign with the body's place on the lattice; it is a share of a voxel wide."""
    area = errors(name, 96, OFFSETS[0])[0]
    assert abs(area) < 0.004, f"{name}: area {area:+.2%}"


def errors_of_levels(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of volume and area with 24, 48 and 96 voxels along the box."""
    shape, volumes, areas = SHAPES[name], [], []
    for cells in (24, 48, 96):
        solid = stuff(shape.level(cells))
        points = solid.points * (2.0 / cells)
        volumes.append(signed_volumes(points, solid.tets).sum() / shape.volume - 1.0)
        areas.append(facet_areas(points, solid.facets).sum() / shape.area - 1.0)
    return np.abs(volumes), np.abs(areas)


@pytest.mark.parametrize("name", SHAPES)
def test_second_order_of_volume_and_on_smooth_bodies_of_area(name):
    sharp = SHAPES[name].sharp_edges > 0.0
    for what, error in list(zip(("volume", "area"), errors_of_levels(name)))[: 1 if sharp else 2]:
        orders = np.log2(error[:-1] / error[1:])
        assert orders.min() > (1.65 if sharp else 1.9), f"{name}, {what}: observed orders {orders}, errors {error}"
        assert error[1] < 0.01, f"{name}, {what}: errors {error}"


def _solved(matrix: sparse.csr_array, load: np.ndarray) -> np.ndarray:
    found, status = cg(matrix, load, rtol=1e-10, atol=0.0, M=sparse.diags_array(1.0 / matrix.diagonal()))
    assert status == 0
    return found


def _conduction_error(cells: int, coarsest: int) -> float:
    """Root mean square error of a harmonic temperature in a ball, its surface held at the exact one."""
    solid = stuff(SHAPES["sphere"].level(cells), coarsest)
    points = solid.points * (2.0 / cells) - 1.0
    exact = np.exp(1.5 * points[:, 0]) * np.sin(1.5 * points[:, 1])
    matrix = stiffness(points, solid.tets)
    free, fixed = np.flatnonzero(~on_surface(solid)), np.flatnonzero(on_surface(solid))
    error = np.zeros(len(points))
    error[free] = _solved(matrix[free][:, free], -matrix[free][:, fixed] @ exact[fixed]) - exact[free]
    share = np.repeat(signed_volumes(points, solid.tets) / 4.0, 4)
    return float(np.sqrt(np.bincount(solid.tets.ravel(), share) @ error**2 / share.sum()))


@pytest.mark.parametrize(("coarsest", "order"), [(1, 1.9), (2, 1.5)])
def test_conduction_on_stuffed_meshes(coarsest, order):
    """Second order in the cells' size; with larger cells the share of the ball that they fill grows as well."""
    error = np.array([_conduction_error(cells, coarsest) for cells in (12, 24, 48)])
    orders = np.log2(error[:-1] / error[1:])
    assert orders.min() > order, f"largest cells {coarsest}: observed orders {orders}, errors {error}"
    assert error[-1] < 3e-4, f"largest cells {coarsest}: errors {error}"


def test_surface_temperatures_hardly_feel_larger_cells_inside():
    """A ball heated on one side that loses heat all around, as in the sun: what the mesher's default changes."""
    found = []
    for coarsest in (1, 4):
        solid = stuff(SHAPES["sphere"].level(36), coarsest)
        points = solid.points * (2.0 / 36) - 1.0
        third = facet_areas(points, solid.facets) / 3.0
        sun = np.maximum(facet_normals(points, solid.facets)[:, 0], 0.0)
        load, loss = (np.bincount(solid.facets.ravel(), np.repeat(rate * third, 3), len(points)) for rate in (sun, 2.0))
        matrix = stiffness(points, solid.tets) + sparse.diags_array(loss)
        found.append((len(solid.tets), _solved(matrix.tocsr(), load)[on_surface(solid)]))
    (uniform_tets, uniform), (graded_tets, graded) = found
    assert graded_tets < 0.6 * uniform_tets
    assert np.abs(graded - uniform).max() < 1e-3 * np.ptp(uniform)
