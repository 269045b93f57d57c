import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import cg

from tests.support.stuffed_shapes import SHAPES, on_surface, stiffness
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.stuffing.isosurface import stuff
from thermoxels_ns.mesh.tetrahedra import facet_areas, facet_normals


def errors(name: str) -> tuple[np.ndarray, np.ndarray]:
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
    for what, error in list(zip(("volume", "area"), errors(name)))[: 1 if sharp else 2]:
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
